"""Steps 1 to 5 of the paper (Sec. III.3) for one coordinate of the board.

To find z the lines are the latitude lines, ``across`` is v, ``along`` is u, and the rulers
are the vertical ones.  To find x the same code runs with the roles swapped: longitude lines,
across u, along v, horizontal rulers.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from pydantic import Field

from lscan.calibration.maps.curvetable import CurveTable
from lscan.calibration.maps.lines import GridLine
from lscan.calibration.maps.rulers import FittedRuler
from lscan.calibration.region import MARGIN
from lscan.calibration.stored import STRICT, NotNegative
from lscan.records import Floats, Ints, Mask, select

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
        return CurveTable.of([line.curve for line in self.lines])

    @cached_property
    def _ruler_lines(self) -> CurveTable:
        return CurveTable.of([ruler.line for ruler in self.rulers])

    @cached_property
    def _conversions(self) -> CurveTable:
        return CurveTable.of([ruler.conversion for ruler in self.rulers])

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
        reached = self._reached(targets.along)
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

    def _reached(self, along: Floats) -> Mask:
        """(lines, N) whether a line's marks span the place, or it lies so little beyond them."""
        low, high = np.array([(line.first_px, line.last_px) for line in self.lines]).T[..., None]
        return (along >= low - self.reach_px) & (along <= high + self.reach_px)

    def _interpolated(self, between: Between, along: Floats) -> tuple[Floats, Floats]:
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
        rows = self._curves.basis(between.lines, targets.along[:, None])
        of_lines = self._curves.variance(between.lines, rows)
        _, slope = self._interpolated(between, targets.along)
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
            height, slope = self._interpolated(between, along)
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
        there, here = (curves.basis(lines, along[:, None]) for along in (crossing, targets.along))
        rows = there - ratio[:, None, None] * here
        _, tilt = self._interpolated(between, targets.along)
        across = ratio**2 * targets.variance * (1 + tilt**2)
        across += between.blend(curves.variance(lines, rows), power=2)
        across += slope**2 * rulers.variance(ruler, rulers.basis(ruler, place))
        scale = conversion_slope / (1 - slope * ruler_slope)
        converted = self._conversions.variance(ruler, self._conversions.basis(ruler, place))
        return value, scale**2 * across + converted
