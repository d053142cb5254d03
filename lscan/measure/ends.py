"""Where lit segments end, from how their brightness falls there.

The camera's blur draws the end of a line out over two or three columns: at the distance d
inside its end a line is as bright as ``Phi(d / blur)`` of what it would be, Phi being the
integral of the normal distribution, for a Gaussian blur (the pixel's own width taken in).  Each
segment's brightness is a straight line, the shading of fan and lens, times that of its two
ends; all segments of a picture share one blur.  All are fitted together by least squares to the
columns of the picture, so that speckle, which moves single columns, is averaged over the fall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import norm

from lscan.measure.segments import Segment, Trace
from lscan.records import Floats, Ints, Mask

UNDIMMED = 0.95
"""Brightness of a segment's last point, in units of the segment's, above which no fall is seen."""

PIXEL = float(1 / np.sqrt(12))
"""Standard deviation, in columns, of a pixel's own width: the least blur there is."""

USUAL_BLUR = 0.8  # columns, where the fit starts: a lens of 0.7 pixels, and the pixel's width
USUAL_SCATTER = 0.1  # of brightness from column to column, relative, where the fit starts
INSIDE = 0.99  # of a segment's brightness: columns that are not dimmed by an end
ROUNDS = 3
MOST_BLUR = 3.0  # columns; what falls more slowly is no end but a shadow

LEAST_SHARE = 0.05
"""Least brightness, in units of the segment's, of columns that tell of its end: dimmer ones are
found only where speckle makes them bright."""

UNMODELLED = 0.01
"""Uncertainty of a column's brightness that is no noise, in units of the segment's: the halo of
light that clear water scatters about a line."""

FALSE_LIGHT = 0.015
"""Standard uncertainty of an end, in columns, that no further picture lessens.  Half a percent of
the segment's brightness, left of a halo or a lit wall where the ground beside the line is taken
off (stripe/core.py), moves a fall over two columns by as much, outwards."""


@dataclass(frozen=True)
class End:
    """Where a segment ends.

    x_mm: the place.  own_mm: its standard uncertainty from noise, another in every picture.
    common_mm: alike in all pictures of one place: FALSE_LIGHT, or, where no fall is seen, the
    columns' spacing.
    point: index into the trace of the segment's outermost point.
    """

    x_mm: float
    own_mm: float
    common_mm: float
    point: int


def segment_ends(line: Trace, segments: Sequence[Segment]) -> list[tuple[End, End]]:
    """The left and the right end of each segment of one profile.

    Where no fall is seen, the end is half a column beyond the last point, to within an even
    distribution over one column.
    """
    model = _Model.of(line, segments)
    if not len(model.falling):
        return model.ends(line, segments, model.start(), np.zeros(model.size))
    values, relative = model.start(), USUAL_SCATTER
    for _ in range(ROUNDS):  # each with the noise and the choice of columns by the last one's fit
        share = model.share(values)
        used = share > LEAST_SHARE
        sigma = np.hypot(relative * share, UNMODELLED) * model.level(values)
        answer = least_squares(
            model.misfit,
            values,
            bounds=model.bounds(),
            x_scale=model.scales(),
            args=(np.where(used, sigma, np.inf),),
        )
        values = answer.x
        relative = model.scatter(values)
    slopes = np.asarray(answer.jac, dtype=float)
    misfit = float(np.sum(answer.fun**2)) / max(int(used.sum()) - model.size, 1)
    variance = np.diag(np.linalg.pinv(slopes.T @ slopes)) * max(misfit, 1.0)
    return model.ends(line, segments, values, np.sqrt(np.maximum(variance, 0.0)))


@dataclass(frozen=True)
class _Model:
    """Brightness of the columns of S segments, as a function of a vector of values.

    The values are: each segment's brightness in its middle, (S,), and that brightness' growth
    per half length, (S,); the blur, mm; the ends that show a fall, mm, those on the left first.
    x, peak: (K,) of all columns that have a brightness.  segment: (K,) which they belong to.
    middle, half: (S,) mm.  outermost: (2, S) x of the last points on the left and the right.
    falls: (2, S) mask.  spacing_mm: from column to column.
    """

    x: Floats
    peak: Floats
    segment: Ints
    middle: Floats
    half: Floats
    outermost: Floats
    falls: Mask
    spacing_mm: float

    @classmethod
    def of(cls, line: Trace, segments: Sequence[Segment]) -> _Model:
        points = np.concatenate([part.points for part in segments])
        which = np.repeat(np.arange(len(segments)), [len(part.points) for part in segments])
        known = np.isfinite(line.brightness[points]) & (line.brightness[points] > 0)
        outermost = np.array([[line.x[part.points[k]] for part in segments] for k in (0, -1)])
        falls = np.array([[_falls(line, part, k) for part in segments] for k in (0, -1)])
        return cls(
            x=line.x[points[known]],
            peak=line.brightness[points[known]],
            segment=which[known],
            middle=outermost.mean(axis=0),
            half=(outermost[1] - outermost[0]) / 2,
            outermost=outermost,
            falls=falls,
            spacing_mm=line.spacing_mm,
        )

    @property
    def falling(self) -> Ints:
        """Indices into the 2 S ends of those that show a fall."""
        return np.flatnonzero(self.falls)

    @property
    def size(self) -> int:
        """Number of values."""
        return 2 * len(self.middle) + 1 + len(self.falling)

    def start(self) -> Floats:
        """Each segment evenly lit, and ending at its last point."""
        count = len(self.middle)
        level = [
            float(np.median(self.peak[self.segment == k])) if (self.segment == k).any() else 0.0
            for k in range(count)
        ]
        blur = USUAL_BLUR * self.spacing_mm
        ends = self.outermost.ravel()[self.falling]
        return np.array([*level, *np.zeros(count), blur, *ends])

    def scales(self) -> Floats:
        """What is a small change of each value."""
        level = np.maximum(self.start()[: len(self.middle)], 1.0)
        return np.array([*level, *level, *np.full(1 + len(self.falling), self.spacing_mm)])

    def bounds(self) -> tuple[Floats, Floats]:
        """The least and the greatest of each value: ends stay within 3 columns of the last."""
        low, high = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        blur, start = 2 * len(self.middle), self.start()
        low[blur], high[blur] = PIXEL * self.spacing_mm, MOST_BLUR * self.spacing_mm
        low[blur + 1 :] = start[blur + 1 :] - 3 * self.spacing_mm
        high[blur + 1 :] = start[blur + 1 :] + 3 * self.spacing_mm
        return low, high

    def share(self, values: Floats) -> Floats:
        """(K,) part of its segment's brightness that the ends leave to each column."""
        count = len(self.middle)
        blur, places = values[2 * count], np.full(2 * count, np.nan)
        places[self.falling] = values[2 * count + 1 :]
        left, right = places.reshape(2, count)[:, self.segment]
        inside = norm.cdf((self.x - left) / blur), norm.cdf((right - self.x) / blur)
        return np.nan_to_num(inside[0], nan=1.0) * np.nan_to_num(inside[1], nan=1.0)

    def level(self, values: Floats) -> Floats:
        """(K,) brightness, in DN, that each column would have were its segment endless."""
        count = len(self.middle)
        along = (self.x - self.middle[self.segment]) / self.half[self.segment]
        return values[self.segment] + along * values[count + self.segment]

    def bright(self, values: Floats) -> Floats:
        """(K,) brightness of each column, in DN."""
        return self.level(values) * self.share(values)

    def scatter(self, values: Floats) -> float:
        """Robust standard deviation, relative, of columns far from any end about the fit."""
        inside = self.share(values) > INSIDE
        off = self.peak[inside] / self.bright(values)[inside] - 1
        return 1.4826 * float(np.median(np.abs(off))) if inside.any() else USUAL_SCATTER

    def misfit(self, values: Floats, sigma: Floats) -> Floats:
        """(K,) brightness less what was seen, in units of ``sigma`` (K,)."""
        return (self.bright(values) - self.peak) / sigma

    def ends(
        self, line: Trace, segments: Sequence[Segment], values: Floats, sigma: Floats
    ) -> list[tuple[End, End]]:
        """The ends that the values tell, and those without a fall."""
        half, even = self.spacing_mm / 2, self.spacing_mm / np.sqrt(12)
        place = (self.outermost + np.array([[-half], [half]])).ravel()
        own, common = np.zeros(len(place)), np.full(len(place), even)
        first = 2 * len(self.middle) + 1
        place[self.falling], own[self.falling] = values[first:], sigma[first:]
        common[self.falling] = FALSE_LIGHT * self.spacing_mm
        points = np.array([[part.points[k] for part in segments] for k in (0, -1)]).ravel()
        found = [
            End(float(x), float(s), float(e), int(p))
            for x, s, e, p in zip(place, own, common, points, strict=True)
        ]
        return list(zip(found[: len(segments)], found[len(segments) :], strict=True))


def _falls(line: Trace, segment: Segment, end: int) -> bool:
    """Whether a segment's outermost point, its first (0) or last (-1), is dimmer than the rest."""
    peaks = line.brightness[segment.points]
    known = peaks[np.isfinite(peaks)]
    full = float(np.median(known)) if len(known) else 0.0
    return bool(full > 0 and peaks[end] < UNDIMMED * full)
