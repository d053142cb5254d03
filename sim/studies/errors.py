"""From where points were measured and where they are to the errors that a study looks at."""

from dataclasses import dataclass

import numpy as np

from lscan.errors import MeasurementError
from lscan.records import Floats
from sim.studies.problem import Output

MOST_LOST = 0.2  # of the places: beyond, a rig is no rig to speak of
PER_MM = 100.0  # of a length whose error is given
WITHIN = 0.99  # of the places of a scan, as reports state it of slices


@dataclass(frozen=True)
class ErrorFrame:
    """Where the P places of a scan lie, and what is fitted to their errors.

    Attributes
    ----------
    world_mm : (P, 3) array, mm, world frame, as the rig ought to be
    """

    world_mm: Floats

    @property
    def outputs(self) -> tuple[Output, ...]:
        """What ``errors_of`` gives, in this order."""
        count = len(self.world_mm)
        return (
            Output("height", "mm", count),
            Output("levelled", "mm", count),
            Output("levelled-rms", "mm"),
            Output("levelled-99", "mm"),
            Output("level", "mm"),
            Output("tilt-across", "deg"),
            Output("tilt-along", "deg"),
            Output("length-across", f"mm per {PER_MM:g} mm"),
            Output("length-along", f"mm per {PER_MM:g} mm"),
            Output("turn", "deg"),
        )

    def errors_of(self, measured_mm: Floats, true_mm: Floats, height_mm: Floats) -> Floats:
        """(K,) errors, measured less true.

        height: of each place, above the true surface beneath where it was measured.  levelled: the
        same less the plane that fits it best, whose height in the middle of all places is level,
        and whose slopes across the track and along it are tilt-across and tilt-along.
        levelled-rms, levelled-99: of one scan, the rms of levelled, and what 99 % of the places
        keep within.
        length-across, length-along: of 100 mm.  turn: of what was measured, about the vertical.

        Parameters
        ----------
        measured_mm, true_mm : (P, 3) array, mm, world frame; NaN where the map has no value
        height_mm : (P,) array, mm, of ``measured_mm`` above the surface

        Raises
        ------
        MeasurementError
            More than a fifth of the places were lost.
        """
        found = np.isfinite(height_mm)
        lost = 1 - np.mean(found)
        if lost > MOST_LOST:
            raise MeasurementError(f"{100 * lost:.0f} % of the places lie beside the board")
        middle = self.world_mm.mean(axis=0)
        across, along = (self.world_mm - middle)[:, :2].T
        plane = np.column_stack([np.ones(len(across)), across, along])
        off = (measured_mm - true_mm)[:, :2]
        fitted = np.column_stack([height_mm, off])
        if not found.all():
            # A place that was lost is given what its neighbours' plane says: it adds nothing.
            fit = np.linalg.lstsq(plane[found], fitted[found])[0]
            fitted = np.where(found[:, np.newaxis], fitted, plane @ fit)
        else:
            fit = np.linalg.lstsq(plane, fitted)[0]
        height, (of_height, of_x, of_y) = fitted[:, 0], fit.T
        levelled = height - plane @ of_height
        sizes = np.sqrt(np.mean(levelled**2)), np.quantile(np.abs(levelled), WITHIN)
        slopes = np.degrees(np.arctan(of_height[1:]))
        turn = np.degrees((of_y[1] - of_x[2]) / 2)
        scalars = [*sizes, of_height[0], *slopes, PER_MM * of_x[1], PER_MM * of_y[2], turn]
        return np.concatenate([height, levelled, scalars])
