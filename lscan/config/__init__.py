"""The files a user writes: rig, board and target, read into strict models, and plug-ins by name."""
