"""The paper's map: longitude and latitude lines with auxiliary rulers (Secs. II and III).

Variants: "1", "2" or "bspline" for the fit of the lines (first-order rms, second-order rms,
cubic B-spline), each also with "-norulers".
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from lscan.calibration.fields import STRICT, NotNegative, Number
from lscan.calibration.maps.graticulelines import (
    DEGREE,
    Curve,
    CurvePoints,
    CurveTable,
    Fit,
    GridLine,
    fit_curves,
    fit_lines,
    fit_polynomials,
)
from lscan.calibration.marks import MARGIN, covered_region, joined_marks, spacing_px, with_marks
from lscan.calibration.planemap import Estimate, MapSolver, SolvedMap, with_lack_of_fit
from lscan.config.rig import OpticsSection
from lscan.errors import BoardNotFound
from lscan.records import BoardReading, Floats, Ints, Mask, RulerReading, select

# Auxiliary rulers: from a place on a ruler's line in the picture to mm (paper Figs. 14 to 16).
#
# The paper looks a pixel coordinate up in the "ruler conversion curve" of Fig. 16, and also
# speaks of interpolating between the two marks around it.  Here the conversion curve is the
# least-squares polynomial of order 4 through all marks of the ruler, used only where they
# reach.  On the paper's view it departs from the truth by 0.002 mm rms, less than straight
# lines from mark to mark (0.009 mm), and it averages the noise of the marks: at 0.05 px its
# standard error is about 0.015 mm, where two marks alone would leave 0.04 mm.


CONVERSION_ORDER = 4


@dataclass(frozen=True)
class FittedRuler:
    """A ruler that crosses the lines it reads: a vertical one crosses the latitude lines.

    Attributes
    ----------
    at_mm : float, mm, its fixed coordinate on the board
    line : Curve, px, its own fitted line, along px as a function of across px (GridLine has them
        the other way round, because a ruler runs across the lines it reads)
    conversion : Curve, mm as a function of across px, Fig. 16
    first_px, last_px : float, px, across: the stretch where conversion holds, half a mark beyond
        the outermost marks
    """

    __pydantic_config__ = STRICT
    at_mm: Number
    line: Curve
    conversion: Curve
    first_px: Number
    last_px: Number

    def reaches(self, across_px: Floats) -> Mask:
        """Mask of the places on the ruler that its marks cover.

        Parameters
        ----------
        across_px : (N,) array, px
        """
        return (across_px >= self.first_px) & (across_px <= self.last_px)


def fit_rulers(readings: Sequence[RulerReading], fit: Fit) -> tuple[FittedRuler, ...]:
    """The rulers with lines of the same kind as the map's, without those of too few marks.

    Too few: not enough for the line, or for a conversion curve with a mark to spare.

    Parameters
    ----------
    readings : sequence of RulerReading, px and mm
    fit : str, of the line: "1", "2" or "bspline"

    References
    ----------
    Sec. III.3 and Figs. 14 to 16 of the paper.
    """
    usable, lines, conversions, orders = [], [], [], []
    for reading in readings:
        across, marks, found = ruler_axis(reading), reading.marks, reading.marks.found
        place, along = marks.image_px[found, across], marks.image_px[found, 1 - across]
        sigma, mm = marks.sigma_px[found], marks.board_mm[found, across]
        different = len(set(place.tolist()))
        if different > max(DEGREE[fit], 3):
            usable.append(reading)
            lines.append(CurvePoints(place, along, sigma, sigma))
            conversions.append(CurvePoints(place, mm, sigma, np.zeros_like(sigma)))
            orders.append(min(CONVERSION_ORDER, different - 2))
    rulers, curves = [], (fit_curves(lines, fit), fit_polynomials(conversions, orders))
    for reading, points, line, conversion in zip(usable, lines, *curves, strict=True):
        half = float(np.median(np.diff(np.sort(points.x)))) / 2
        first, last = float(points.x.min()) - half, float(points.x.max()) + half
        rulers.append(FittedRuler(reading.at_mm, line, conversion, first, last))
    return tuple(rulers)


def ruler_axis(reading: RulerReading) -> int:
    """The coordinate a ruler reads: 1 (v, z) for a vertical one, 0 (u, x) for a horizontal.

    Parameters
    ----------
    reading : RulerReading, its direction counts
    """
    return 1 if reading.direction == "vertical" else 0


# Steps 1 to 5 of the paper (Sec. III.3) for one coordinate of the board.
#
# To find z the lines are the latitude lines, ``across`` is v, ``along`` is u, and the rulers are
# the vertical ones.  To find x the same code runs with the roles swapped: longitude lines, across
# u, along v, horizontal rulers.


# The region's margin, and as much again for what the outermost line misses its own marks by.
WEIGHT_SLACK = 2 * MARGIN

NEWTON_STEPS = 12
NEWTON_PX = 1e-9


@dataclass(frozen=True)
class Targets:
    """N points of the picture.

    Attributes
    ----------
    along, across : (N,) array, px, along and across the lines
    variance : (N,) array, px², of either; None where no variance is asked for
    """

    along: Floats
    across: Floats
    variance: Floats | None


@dataclass(frozen=True)
class Between:
    """The two lines on either side of each of N points, and where between them it lies.

    Attributes
    ----------
    lines : (N, 2) array, their indices; the first has the smaller across coordinate
    weights : (N, 2) array, of the two lines in eq. (3): 0 and 1 on the second
    span_px : (N,) array, px, from line to line, along the across axis
    """

    lines: Ints
    weights: Floats
    span_px: Floats

    def blend(self, values: Floats, power: int = 1) -> Floats:
        """(N,) weighted sums of values (N, 2) over the two lines."""
        both = self.weights**power * values
        return both[:, 0] + both[:, 1]


@dataclass(frozen=True)
class LineSet:
    """All lines of one direction and the rulers that cross them.

    Attributes
    ----------
    lines : tuple of GridLine, px, two or more
    rulers : tuple of FittedRuler, that cross them
    reach_px : float, px, how far a line may be continued beyond its outermost marks: the spacing of
        the control points.  Next to a missing mark, or where the board looks slanted, the lines
        around a point need not both have marks on either side of it.
    """

    __pydantic_config__ = STRICT
    lines: Annotated[tuple[GridLine, ...], Field(min_length=2)]
    rulers: tuple[FittedRuler, ...]
    reach_px: NotNegative

    @cached_property
    def _curves(self) -> CurveTable:
        return CurveTable(tuple(line.curve for line in self.lines))

    @cached_property
    def _ruler_lines(self) -> CurveTable:
        return CurveTable(tuple(ruler.line for ruler in self.rulers))

    @cached_property
    def _conversions(self) -> CurveTable:
        return CurveTable(tuple(ruler.conversion for ruler in self.rulers))

    def locate(self, targets: Targets) -> tuple[Floats, Floats]:
        """Board coordinate in mm and its variance in mm², (N,) each; NaN where not surrounded.

        The variance is NaN everywhere where that of the targets is None.

        With rulers the coordinate is read on the closest one (steps 3 and 4); where the
        point's line meets no stretch of marks on it, or where there is no ruler, it is
        linear in the weight between the two lines, if they are neighbours.

        Parameters
        ----------
        targets : Targets, px, N points

        References
        ----------
        Sec. III.3 of the paper, steps 1 to 5.
        """
        value, variance = np.full((2, len(targets.along)), np.nan)
        between, inside = self.surround(targets)
        known = select(targets, inside), select(between, inside)
        value[inside], variance[inside] = self._read(*known)
        return value, variance

    def _read(self, targets: Targets, between: Between) -> tuple[Floats, Floats]:
        if not self.rulers:
            return self._read_lines(targets, between)
        value, variance = np.full((2, len(targets.along)), np.nan)
        closest = self._closest_ruler(targets)
        ruled = closest >= 0
        ruler, there, around = closest[ruled], select(targets, ruled), select(between, ruled)
        place, meets = self._intersect(ruler, there, around)
        ruled[ruled] = meets
        met = ruler[meets], select(there, meets), select(around, meets), place[meets]
        value[ruled], variance[ruled] = self._read_ruler(*met)
        if not ruled.all():
            known = select(targets, ~ruled), select(between, ~ruled)
            value[~ruled], variance[~ruled] = self._read_lines(*known)
        return value, variance

    def surround(self, targets: Targets) -> tuple[Between, Mask]:
        """The two lines around each point, the weight between them, and which points have both.

        Steps 1 and 2.  The paper iterates the weight (bisection, its footnote 1) until the
        interpolated curve passes through the target.  At the target's own along coordinate eq. (3)
        is linear in the weight, so here it is solved directly.

        Parameters
        ----------
        targets : Targets, px, N points

        Returns
        -------
        tuple of Between and array
            The mask (N,) is of the points that have a line on either side.

        References
        ----------
        Sec. III.3 and eq. (3) of the paper.
        """
        points, each = np.arange(len(targets.along)), np.arange(len(self.lines))[:, None]
        heights, _ = self._curves.look_up(each, targets.along)
        low, high = np.array([(line.first_px, line.last_px) for line in self.lines]).T[..., None]
        reached = (targets.along >= low - self.reach_px) & (targets.along <= high + self.reach_px)
        order = np.argsort(np.where(reached, heights, np.inf), axis=0)
        below = (reached & (heights <= targets.across)).sum(axis=0)
        rank = np.clip(below - 1, 0, np.maximum(reached.sum(axis=0) - 2, 0))
        lower, upper = order[rank, points], order[rank + 1, points]
        start = heights[lower, points]
        span = heights[upper, points] - start
        known = (reached.sum(axis=0) >= 2) & (span > 0)
        fraction = (targets.across - start) / np.where(known, span, 1.0)
        inside = known & (fraction >= -WEIGHT_SLACK) & (fraction <= 1 + WEIGHT_SLACK)
        lines, weights = np.column_stack([lower, upper]), np.column_stack([1 - fraction, fraction])
        return Between(lines, weights, span), inside

    def _between_lines(self, between: Between, along: Floats) -> tuple[Floats, Floats]:
        """The lines that eq. (3) interpolates, H, at ``along``: across px, and their slopes."""
        values, slopes = self._curves.look_up(between.lines, along[:, None])
        return between.blend(values), between.blend(slopes)

    def _read_lines(self, targets: Targets, between: Between) -> tuple[Floats, Floats]:
        """Without a ruler: linear in the weight (Sec. II)."""
        places = np.array([line.at_mm for line in self.lines])
        start = places[between.lines[:, 0]]
        pitch = places[between.lines[:, 1]] - start
        # Where a line between the two ends short of the target, the cell is twice as wide and
        # the weight's linearity four times as wrong: only a ruler may be read there.
        neighbours = np.abs(between.lines[:, 1] - between.lines[:, 0]) == 1
        pitch = np.where(neighbours, pitch, np.nan)
        value = start + between.weights[:, 1] * pitch
        if targets.variance is None:
            return value, np.full_like(value, np.nan)
        of_lines = (self._curves.modes(between.lines, targets.along[:, None]) ** 2).sum(axis=0)
        _, slope = self._between_lines(between, targets.along)
        noise = targets.variance * (1 + slope**2) + between.blend(of_lines, power=2)
        return value, noise * (pitch / between.span_px) ** 2

    def _closest_ruler(self, targets: Targets) -> Ints:
        """(N,) index of the ruler nearest to each point of those with marks beside it, or -1."""
        places, _ = self._ruler_lines.look_up(np.arange(len(self.rulers))[:, None], targets.across)
        gaps = np.abs(places - targets.along)
        beside = np.stack([r.reaches(targets.across) for r in self.rulers])
        closest = np.argmin(np.where(beside, gaps, np.inf), axis=0)
        return np.where(beside.any(axis=0), closest, -1)

    def _intersect(self, ruler: Ints, targets: Targets, between: Between) -> tuple[Floats, Mask]:
        """Steps 3 and 4: where the interpolated line H meets the ruler's line R, across px.

        The mask is of the points for which it does within the ruler's marks.  Newton on
        y - H(R(y)) from the target's own height.  H and R run nearly along the two axes, so the
        slope hardly changes and is taken once.
        """
        place, lean = targets.across, None
        for _ in range(NEWTON_STEPS):
            along, ruler_slope = self._ruler_lines.look_up(ruler, place)
            height, slope = self._between_lines(between, along)
            lean = slope * ruler_slope if lean is None else lean
            miss = place - height
            place = place - miss / (1 - lean)
            if np.all(np.abs(miss) < NEWTON_PX):
                break
        low, high = np.array([(r.first_px, r.last_px) for r in self.rulers]).T
        return place, (np.abs(miss) < NEWTON_PX) & (place >= low[ruler]) & (place <= high[ruler])

    def _read_ruler(
        self, ruler: Ints, targets: Targets, between: Between, place: Floats
    ) -> tuple[Floats, Floats]:
        """The values read on rulers, mm, and their variances, mm^2, to first order.

        A change of the target, of the two lines and of the ruler's line moves the
        intersection; the same two lines also set the weight, so their errors at the target
        count against those at the intersection.
        """
        value, conversion_slope = self._conversions.look_up(ruler, place)
        if targets.variance is None:
            return value, np.full_like(value, np.nan)
        curves, rulers, lines = self._curves, self._ruler_lines, between.lines
        crossing, ruler_slope = rulers.look_up(ruler, place)
        heights, slopes = curves.look_up(lines, crossing[:, None])
        slope = between.blend(slopes)
        ratio = (heights[:, 1] - heights[:, 0]) / between.span_px
        there, here = (curves.modes(lines, along[:, None]) for along in (crossing, targets.along))
        of_lines = ((there - ratio[:, None] * here) ** 2).sum(axis=0)
        _, tilt = self._between_lines(between, targets.along)
        across = ratio**2 * targets.variance * (1 + tilt**2) + between.blend(of_lines, power=2)
        across += slope**2 * (rulers.modes(ruler, place) ** 2).sum(axis=0)
        scale = conversion_slope / (1 - slope * ruler_slope)
        return value, scale**2 * across + (self._conversions.modes(ruler, place) ** 2).sum(axis=0)


# The paper's map: longitude and latitude lines with auxiliary rulers (Secs. II and III).


NO_RULERS = "-norulers"
VARIANTS: dict[str, tuple[Fit, bool]] = {
    fit + ending: (fit, not ending) for fit in DEGREE for ending in ("", NO_RULERS)
}


class Graticule(SolvedMap):
    """A solved graticule.

    Its uncertainty combines, to first order, that of the pixel, the covariances of the two
    lines around the point, of the ruler's line and of its conversion curve.  What neighbouring
    points have in common no modes say, but those of a calibration (spline.with_hidden_errors).

    Attributes
    ----------
    latitudes : LineSet, the lines of the grid rows and the vertical rulers; they give z
    longitudes : LineSet, the lines of the grid columns and the horizontal rulers; they give x
    transposed : bool, whether the lines are of the picture with u and v exchanged, as those of a
        board are whose rows run down the picture
    region : Region, px, where the map holds
    lack_of_fit_mm : (2,) array, mm, of x and of z (calibration/planemap.py)

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
            marks = joined_marks(reading)
            reading = with_marks(reading, replace(marks, image_px=marks.image_px[:, ::-1]))
        rows = _fit_lines(reading, 0, fit)
        columns = _fit_lines(reading, 1, fit)
        reach = spacing_px(reading)
        row, column = (np.array([line is not None for line in some]) for some in (rows, columns))
        return Graticule(
            latitudes=LineSet(_present(rows), _rulers(reading, 1, fit, with_rulers), reach),
            longitudes=LineSet(_present(columns), _rulers(reading, 0, fit, with_rulers), reach),
            transposed=transposed,
            region=covered_region(region_of, np.outer(row, column).ravel() & reading.grid.found),
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


def _rulers(reading: BoardReading, reads: int, fit: Fit, wanted: bool) -> tuple[FittedRuler, ...]:
    """The rulers that read coordinate ``reads``: 0, the horizontal ones; 1, the vertical."""
    direction = ("horizontal", "vertical")[reads]
    read = [r for r in reading.rulers if wanted and r.direction == direction]
    return fit_rulers(read, fit)


# Curves of a solved graticule as points to draw (paper Figs. 13, 16, 33 and 34).


Kind = Literal["latitude", "longitude", "vertical ruler", "horizontal ruler"]


@dataclass(frozen=True)
class DrawnLine:
    """One fitted line of a graticule.

    Attributes
    ----------
    kind : str, "latitude", "longitude", "vertical ruler" or "horizontal ruler"
    at_mm : float, mm, its place on the board
    image_px : (S, 2) array, px, points (u, v)
    """

    kind: Kind
    at_mm: float
    image_px: Floats


@dataclass(frozen=True)
class DrawnConversion:
    """Fig. 16 for one ruler: px (v of a vertical ruler, u of a horizontal) against mm.

    Attributes
    ----------
    direction : str, "vertical" or "horizontal"
    at_mm : float, mm, its place on the board
    marks_px : (N,) array, px, of the marks found
    marks_mm : (N,) array, mm, of the marks found
    curve_px : (S,) array, px, of the conversion curve
    curve_mm : (S,) array, mm, of the conversion curve
    """

    direction: Literal["vertical", "horizontal"]
    at_mm: float
    marks_px: Floats
    marks_mm: Floats
    curve_px: Floats
    curve_mm: Floats


def graticule_lines(graticule: Graticule, samples: int = 200) -> list[DrawnLine]:
    """All lines of the graticule and its rulers, each over the stretch its marks span.

    Parameters
    ----------
    graticule : Graticule, solved
    samples : int, points per line, S

    References
    ----------
    Figs. 13, 33 and 34 of the paper.
    """
    across, down = graticule.latitudes, graticule.longitudes
    curves: list[tuple[Kind, GridLine | FittedRuler, Curve]] = [
        *(("latitude", line, line.curve) for line in across.lines),
        *(("longitude", line, line.curve) for line in down.lines),
        *(("vertical ruler", ruler, ruler.line) for ruler in across.rulers),
        *(("horizontal ruler", ruler, ruler.line) for ruler in down.rulers),
    ]
    drawn = []
    for kind, line, curve in curves:
        along = np.linspace(line.first_px, line.last_px, samples)
        runs_across = kind in ("latitude", "horizontal ruler")
        along_u = runs_across != graticule.transposed
        pair = (along, curve(along)) if along_u else (curve(along), along)
        drawn.append(DrawnLine(kind, line.at_mm, np.column_stack(pair)))
    return drawn


def ruler_conversions(
    graticule: Graticule, reading: BoardReading, samples: int = 200
) -> list[DrawnConversion]:
    """The conversion curve of each ruler that the graticule uses, with the marks behind it.

    Parameters
    ----------
    graticule : Graticule, solved
    reading : BoardReading, the one the graticule was solved from
    samples : int, points per curve, S

    References
    ----------
    Fig. 16 of the paper.
    """
    drawn = []
    for ruler in reading.rulers:
        axis, found = ruler_axis(ruler), ruler.marks.found
        fitted = (graticule.longitudes, graticule.latitudes)[axis].rulers
        for solved in (one for one in fitted if one.at_mm == ruler.at_mm):
            place = np.linspace(solved.first_px, solved.last_px, samples)
            drawn.append(
                DrawnConversion(
                    direction=ruler.direction,
                    at_mm=ruler.at_mm,
                    marks_px=ruler.marks.image_px[found, axis ^ graticule.transposed],
                    marks_mm=ruler.marks.board_mm[found, axis],
                    curve_px=place,
                    curve_mm=solved.conversion(place),
                )
            )
    return drawn
