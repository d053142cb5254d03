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
MOST_BLUR = 3.0  # columns; what falls more slowly is no end but a shadow

DIMMEST = 0.05
"""Least brightness that noise is computed for: it grows as the root of the light, between
reading noise, alike everywhere, and speckle, in proportion to it."""


@dataclass(frozen=True)
class End:
    """Where a segment ends.

    x_mm: the place.  own_mm: its standard uncertainty from noise, another in every picture.
    sampling_mm: from the columns' spacing, alike in all pictures of one place.
    point: index into the trace of the segment's outermost point.
    """

    x_mm: float
    own_mm: float
    sampling_mm: float
    point: int


def segment_ends(line: Trace, segments: Sequence[Segment]) -> list[tuple[End, End]]:
    """The left and the right end of each segment of one profile.

    Where no fall is seen, the end is half a column beyond the last point, to within an even
    distribution over one column.
    """
    model = _Model.of(line, segments)
    if not len(model.falling):
        return model.ends(line, segments, model.start(), np.zeros(model.size))
    values, scatter, slopes = model.start(), 0.0, np.zeros((1, model.size))
    for _ in range(2):  # each time with the noise that the last fit's brightness says
        sigma = np.sqrt(np.maximum(model.share(values), DIMMEST))
        answer = least_squares(
            model.misfit, values, bounds=model.bounds(), x_scale=model.scales(), args=(sigma,)
        )
        values, slopes = answer.x, np.asarray(answer.jac, dtype=float)
        scatter = float(np.sum(answer.fun**2)) / max(len(model.peak) - model.size, 1)
    variance = np.diag(np.linalg.pinv(slopes.T @ slopes)) * scatter
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

    def bright(self, values: Floats) -> Floats:
        """(K,) brightness of each column, in DN."""
        count = len(self.middle)
        along = (self.x - self.middle[self.segment]) / self.half[self.segment]
        level = values[self.segment] + along * values[count + self.segment]
        return level * self.share(values)

    def misfit(self, values: Floats, sigma: Floats) -> Floats:
        """(K,) brightness less what was seen, in units of ``sigma`` (K,)."""
        return (self.bright(values) - self.peak) / sigma

    def ends(
        self, line: Trace, segments: Sequence[Segment], values: Floats, sigma: Floats
    ) -> list[tuple[End, End]]:
        """The ends that the values tell, and those without a fall."""
        half, even = self.spacing_mm / 2, self.spacing_mm / np.sqrt(12)
        place = (self.outermost + np.array([[-half], [half]])).ravel()
        own, sampling = np.zeros(len(place)), np.full(len(place), even)
        first = 2 * len(self.middle) + 1
        place[self.falling], own[self.falling] = values[first:], sigma[first:]
        sampling[self.falling] = 0.0
        points = np.array([[part.points[k] for part in segments] for k in (0, -1)]).ravel()
        found = [
            End(float(x), float(s), float(e), int(p))
            for x, s, e, p in zip(place, own, sampling, points, strict=True)
        ]
        return list(zip(found[: len(segments)], found[len(segments) :], strict=True))


def _falls(line: Trace, segment: Segment, end: int) -> bool:
    """Whether a segment's outermost point, its first (0) or last (-1), is dimmer than the rest."""
    peaks = line.brightness[segment.points]
    known = peaks[np.isfinite(peaks)]
    full = float(np.median(known)) if len(known) else 0.0
    return bool(full > 0 and peaks[end] < UNDIMMED * full)
