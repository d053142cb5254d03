"""One rig of a study evaluated: its states, and its errors in either tier."""
