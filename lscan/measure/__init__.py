"""Measures of the test pieces: distances and circles, grooves and slices."""

from lscan.measure.board import diameters, distances, unmeasured_distances
from lscan.measure.circle import Circle, fit_circle
from lscan.measure.grooves import groove_dimensions
from lscan.measure.slices import SliceErrors, compare_slice, scale_along_track

__all__ = [
    "Circle",
    "SliceErrors",
    "compare_slice",
    "diameters",
    "distances",
    "fit_circle",
    "groove_dimensions",
    "scale_along_track",
    "unmeasured_distances",
]
