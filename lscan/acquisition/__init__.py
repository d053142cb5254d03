"""A scan and its run folder: acquiring, writing, resuming, reading back, replaying."""
