"""Steps 1 to 5 of the paper (Sec. III.3) for one coordinate of the board.

To find z the lines are the latitude lines, ``across`` is v, ``along`` is u, and the rulers
are the vertical ones.  To find x the same code runs with the roles swapped: longitude lines,
across u, along v, horizontal rulers.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from lscan.calibration.maps.lines import Curve, GridLine
from lscan.calibration.maps.rulers import FittedRuler
from lscan.calibration.region import MARGIN
from lscan.calibration.stored import STRICT, NotNegative
from lscan.records import Floats, Ints, Mask, select

# The region's margin, and as much again for what the outermost line misses its own marks by.
WEIGHT_SLACK = 2 * MARGIN

NEWTON_STEPS = 12
NEWTON_PX = 1e-9

ValuesOf = Callable[[int, Mask], Floats]
"""Gives the values of a line, by its index, at the places under a mask."""


@dataclass(frozen=True)
class Targets:
    """N points of the picture.

    Attributes
    ----------
    along, across : (N,) array, px, along and across the lines
    variance : (N,) array, px², of either
    """

    along: Floats
    across: Floats
    variance: Floats


@dataclass(frozen=True)
class Between:
    """The two lines on either side of each of N points, and where between them it lies.

    Attributes
    ----------
    lower, upper : (N,) array, indices of the lines; lower has the smaller across coordinate
    fraction : (N,) array, the weight of the upper line in eq. (3): 0 on the lower, 1 on the upper
    span_px : (N,) array, px, from line to line, along the across axis
    """

    lower: Ints
    upper: Ints
    fraction: Floats
    span_px: Floats

    def blend(self, values_of: ValuesOf, power: int = 1) -> Floats:
        """(N,) weighted sum over the two lines; values_of(line, mask) gives a line's values."""
        below = (1 - self.fraction) ** power * on_lines(self.lower, values_of)
        return below + self.fraction**power * on_lines(self.upper, values_of)


def on_lines(index: Ints, values_of: ValuesOf) -> Floats:
    """(N,) of the line index[n] each; values_of(line, mask) gives a line's values."""
    values = np.empty(len(index))
    for line in np.unique(index):
        here = index == line
        values[here] = values_of(int(line), here)
    return values


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

    def locate(self, targets: Targets) -> tuple[Floats, Floats]:
        """Board coordinate in mm and its variance in mm², (N,) each; NaN where not surrounded.

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
        value, variance = self._read_lines(targets, between)
        if not self.rulers:
            return value, variance
        closest = self._closest_ruler(targets)
        for k in np.unique(closest[closest >= 0]):
            here = closest == k
            ruler, there, around = self.rulers[k], select(targets, here), select(between, here)
            place, meets = self._intersect(ruler, there, around)
            ruled_variance = self._ruler_variance(ruler, there, around, place)
            value[here] = np.where(meets, ruler.conversion(place), value[here])
            variance[here] = np.where(meets, ruled_variance, variance[here])
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
        points = np.arange(len(targets.along))
        heights = np.stack([line.curve(targets.along) for line in self.lines])
        reached = np.stack([line.reaches(targets.along, self.reach_px) for line in self.lines])
        order = np.argsort(np.where(reached, heights, np.inf), axis=0)
        below = (reached & (heights <= targets.across)).sum(axis=0)
        rank = np.clip(below - 1, 0, np.maximum(reached.sum(axis=0) - 2, 0))
        lower, upper = order[rank, points], order[rank + 1, points]
        start = heights[lower, points]
        span = heights[upper, points] - start
        known = (reached.sum(axis=0) >= 2) & (span > 0)
        fraction = (targets.across - start) / np.where(known, span, 1.0)
        inside = known & (fraction >= -WEIGHT_SLACK) & (fraction <= 1 + WEIGHT_SLACK)
        return Between(lower, upper, fraction, span), inside

    def _curve(self, line: int) -> Curve:
        return self.lines[line].curve

    def _heights(self, along: Floats) -> ValuesOf:
        """The lines at ``along``, across px; blended by eq. (3) they are the line H."""
        return lambda line, here: self._curve(line)(along[here])

    def _slope(self, between: Between, along: Floats) -> Floats:
        return between.blend(lambda line, here: self._curve(line).slope(along[here]))

    def _read_lines(self, targets: Targets, between: Between) -> tuple[Floats, Floats]:
        """Without a ruler: linear in the weight (Sec. II)."""
        places = np.array([line.at_mm for line in self.lines])
        start = places[between.lower]
        pitch = places[between.upper] - start
        # Where a line between the two ends short of the target, the cell is twice as wide and
        # the weight's linearity four times as wrong: only a ruler may be read there.
        neighbours = np.abs(between.upper - between.lower) == 1
        pitch = np.where(neighbours, pitch, np.nan)
        along = targets.along
        noise = targets.variance * (1 + self._slope(between, along) ** 2) + between.blend(
            lambda line, here: self._curve(line).variance(self._curve(line).basis(along[here])),
            power=2,
        )
        return start + between.fraction * pitch, noise * (pitch / between.span_px) ** 2

    def _closest_ruler(self, targets: Targets) -> Ints:
        """(N,) index of the ruler nearest to each point of those with marks beside it, or -1."""
        gaps = np.stack([np.abs(r.line(targets.across) - targets.along) for r in self.rulers])
        beside = np.stack([r.reaches(targets.across) for r in self.rulers])
        closest = np.argmin(np.where(beside, gaps, np.inf), axis=0)
        return np.where(beside.any(axis=0), closest, -1)

    def _intersect(
        self, ruler: FittedRuler, targets: Targets, between: Between
    ) -> tuple[Floats, Mask]:
        """Steps 3 and 4: where the interpolated line H meets the ruler's line R, across px.

        The mask is of the points for which it does within the ruler's marks.  Newton on
        y - H(R(y)) from the target's own height.  H and R run nearly along the two axes, so the
        slope hardly changes and is taken once.
        """
        place = targets.across
        lean = self._slope(between, ruler.line(place)) * ruler.line.slope(place)
        for _ in range(NEWTON_STEPS):
            miss = place - between.blend(self._heights(ruler.line(place)))
            place = place - miss / (1 - lean)
            if np.all(np.abs(miss) < NEWTON_PX):
                break
        return place, (np.abs(miss) < NEWTON_PX) & ruler.reaches(place)

    def _ruler_variance(
        self, ruler: FittedRuler, targets: Targets, between: Between, place: Floats
    ) -> Floats:
        """Variance of the value read, mm^2, to first order.

        A change of the target, of the two lines and of the ruler's line moves the
        intersection; the same two lines also set the weight, so their errors at the target
        count against those at the intersection.
        """
        crossing = ruler.line(place)
        slope = self._slope(between, crossing)
        heights = self._heights(crossing)
        far, near = on_lines(between.upper, heights), on_lines(between.lower, heights)
        ratio = (far - near) / between.span_px

        def line_variance(line: int, here: Mask) -> Floats:
            curve = self._curve(line)
            rows = curve.basis(crossing[here])
            rows = rows - ratio[here, None] * curve.basis(targets.along[here])
            return curve.variance(rows)

        tilt = self._slope(between, targets.along)
        across = ratio**2 * targets.variance * (1 + tilt**2)
        across += between.blend(line_variance, power=2)
        across += slope**2 * ruler.line.variance(ruler.line.basis(place))
        lean = slope * ruler.line.slope(place)
        scale = ruler.conversion.slope(place) / (1 - lean)
        return scale**2 * across + ruler.conversion.variance(ruler.conversion.basis(place))
