"""Measures of the test pieces: distances and circles, grooves, slices and their roughness."""

from lscan.measure.board import diameters, distances, unmeasured_distances
from lscan.measure.circle import Circle, fit_circle
from lscan.measure.grooves import groove_dimensions
from lscan.measure.roughness import (
    fit_power_law,
    power_spectrum,
    rms_height,
    structure_function,
)
from lscan.measure.slices import SliceErrors, compare_slice

__all__ = [
    "Circle",
    "SliceErrors",
    "compare_slice",
    "diameters",
    "distances",
    "fit_circle",
    "fit_power_law",
    "groove_dimensions",
    "power_spectrum",
    "rms_height",
    "structure_function",
    "unmeasured_distances",
]
