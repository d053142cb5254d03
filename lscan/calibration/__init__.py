"""Plane maps: from a pixel to (x, z) in the laser sheet, each solved from one board picture."""
