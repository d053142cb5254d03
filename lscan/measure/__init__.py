"""Measures of the test pieces: distances and circles, grooves and slices."""

from lscan.measure.board import Circle, diameters, distances, fit_circle, unmeasured_distances
from lscan.measure.grooves import SliceErrors, compare_slice, groove_dimensions, scale_along_track

__all__ = [
    "Circle", "SliceErrors", "compare_slice", "diameters", "distances", "fit_circle",
    "groove_dimensions", "scale_along_track", "unmeasured_distances",
]  # fmt: skip
