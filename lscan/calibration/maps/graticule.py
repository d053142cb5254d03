"""The paper's map: longitude and latitude lines with auxiliary rulers (Secs. II and III).

Variants: "1", "2" or "bspline" for the fit of the lines (first-order rms, second-order rms,
cubic B-spline), each also with "-norulers".
"""

from dataclasses import replace

import numpy as np

from lscan.calibration.evaluate import Estimate
from lscan.calibration.maps.lines import DEGREE, Fit, GridLine, fit_lines
from lscan.calibration.maps.lineset import LineSet, Targets
from lscan.calibration.maps.rulers import FittedRuler, fit_rulers
from lscan.calibration.readings import joined_marks, with_marks
from lscan.calibration.region import covered_region, spacing_px
from lscan.calibration.solved import MapSolver, SolvedMap, with_lack_of_fit
from lscan.config.rig import OpticsSection
from lscan.errors import BoardNotFound
from lscan.records import BoardReading, Floats, Mask, select

NO_RULERS = "-norulers"
VARIANTS: dict[str, tuple[Fit, bool]] = {
    fit + ending: (fit, not ending) for fit in DEGREE for ending in ("", NO_RULERS)
}


class Graticule(SolvedMap):
    """A solved graticule.

    Its uncertainty combines, to first order, that of the pixel, the covariances of the two
    lines around the point, of the ruler's line and of its conversion curve; the last two are
    common to neighbouring points, which no modes say.

    Attributes
    ----------
    latitudes : LineSet, the lines of the grid rows and the vertical rulers; they give z
    longitudes : LineSet, the lines of the grid columns and the horizontal rulers; they give x
    transposed : bool, whether the lines are of the picture with u and v exchanged, as those of a
        board are whose rows run down the picture
    region : Region, px, where the map holds
    lack_of_fit_mm : (2,) array, mm, of x and of z (solved.py)

    References
    ----------
    Secs. II and III of the paper.
    """

    latitudes: LineSet
    longitudes: LineSet
    transposed: bool = False

    def estimate(self, image_px: Floats, variance_px2: Floats) -> Estimate:
        """Points of covered pixels; NaN where no two lines of a direction surround one.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        variance_px2 : (N,) array, px², of either pixel coordinate
        """
        u, v = self._along_and_across(image_px)
        x, variance_x = self.longitudes.locate(Targets(v, u, variance_px2))
        z, variance_z = self.latitudes.locate(Targets(u, v, variance_px2))
        return Estimate(np.column_stack([x, z]), np.column_stack([variance_x, variance_z]))

    def points(self, image_px: Floats) -> Floats:
        """World points (N, 2) mm, x and z, by the graticule alone.

        Parameters
        ----------
        image_px : (N, 2) array, u and v in px
        """
        u, v = self._along_and_across(image_px)
        x, _ = self.longitudes.locate(Targets(v, u, None))
        z, _ = self.latitudes.locate(Targets(u, v, None))
        return np.column_stack([x, z])

    def _along_and_across(self, image_px: Floats) -> tuple[Floats, Floats]:
        """(N,) px along the rows of the grid and (N,) px across them."""
        u, v = image_px.T
        return (v, u) if self.transposed else (u, v)


class GraticuleSolver(MapSolver[Graticule]):
    """Solves graticules; see the module for the variants."""

    family, model, what = "graticule", Graticule, "graticule"
    variants = tuple(VARIANTS)

    def fit(self, reading: BoardReading, variant: str, optics: OpticsSection) -> Graticule:
        """The graticule through the marks that were found.

        A line needs one mark more than its order (four for the B-spline) and is left out
        where it has fewer; its neighbours then span two cells.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        variant : str, one of VARIANTS
        optics : OpticsSection, not used

        Raises
        ------
        BoardNotFound
            Where fewer than two lines of a direction remain.

        References
        ----------
        Secs. II and III of the paper.
        """
        return with_lack_of_fit(self.fit_points(reading, variant, optics), reading)

    def fit_points(self, reading: BoardReading, variant: str, optics: OpticsSection) -> Graticule:
        """The graticule without its lack of fit.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        variant : str, one of VARIANTS
        optics : OpticsSection, not used

        Raises
        ------
        BoardNotFound
            As ``fit``.
        """
        fit, with_rulers = VARIANTS[variant]
        region_of, transposed = reading, _rows_run_down(reading)
        if transposed:
            reading = _transposed(reading)
        rows = _fit_lines(reading, 0, fit)
        columns = _fit_lines(reading, 1, fit)
        reach = spacing_px(reading)
        return Graticule(
            latitudes=LineSet(_present(rows), _rulers(reading, 1, fit, with_rulers), reach),
            longitudes=LineSet(_present(columns), _rulers(reading, 0, fit, with_rulers), reach),
            transposed=transposed,
            region=covered_region(region_of, _on_lines(reading, rows, columns)),
            lack_of_fit_mm=np.zeros(2),
        )


solver = GraticuleSolver()


def _rows_run_down(reading: BoardReading) -> bool:
    """Whether the grid's rows lie nearer to the picture's columns than to its rows.

    A line is fitted as across over along, so a board may lean by less than 90 degrees only.
    """
    step = np.abs(np.diff(reading.grid.image_px.reshape(*reading.shape, 2), axis=1))
    if np.isnan(step[..., 0]).all():
        return False
    along_u, along_v = np.nanmedian(step, axis=(0, 1))
    return bool(along_v > along_u)


def _transposed(reading: BoardReading) -> BoardReading:
    """The reading of the picture with u and v exchanged, of grid and rulers."""
    marks = joined_marks(reading)
    return with_marks(reading, replace(marks, image_px=marks.image_px[:, ::-1]))


def _fit_lines(reading: BoardReading, along: int, fit: Fit) -> list[GridLine | None]:
    """One line per grid row (along = 0) or per grid column (along = 1)."""
    count = reading.shape[along]
    index = np.indices(reading.shape)[along].ravel()
    lines = fit_lines([select(reading.grid, index == k) for k in range(count)], along, fit)
    if len(_present(lines)) < 2:
        kind = ("latitude", "longitude")[along]
        raise BoardNotFound(
            f"a graticule needs two {kind} lines of {DEGREE[fit] + 1} control points or more, "
            f"found {len(_present(lines))} among {int(reading.grid.found.sum())} control points"
        )
    return lines


def _present(lines: list[GridLine | None]) -> tuple[GridLine, ...]:
    return tuple(line for line in lines if line is not None)


def _on_lines(
    reading: BoardReading, rows: list[GridLine | None], columns: list[GridLine | None]
) -> Mask:
    """Mask of the control points found on a latitude line and on a longitude line."""
    row = np.array([line is not None for line in rows])
    column = np.array([line is not None for line in columns])
    return np.outer(row, column).ravel() & reading.grid.found


def _rulers(reading: BoardReading, reads: int, fit: Fit, wanted: bool) -> tuple[FittedRuler, ...]:
    """The rulers that read coordinate ``reads``: 0, the horizontal ones; 1, the vertical."""
    direction = ("horizontal", "vertical")[reads]
    read = [r for r in reading.rulers if wanted and r.direction == direction]
    return fit_rulers(read, fit)
