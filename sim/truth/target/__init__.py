"""The target and all else that stands in the tank, cut by the laser's sheet."""
