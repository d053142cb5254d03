"""Where lit segments end, from how their brightness falls there.

The camera's blur draws the end of a line out over two or three columns.  Each segment's
brightness is a straight line, the shading of fan and lens, times that of its two ends, blurred
steps (stripe/blurredstep.py); all segments of a picture share one blur.  All are fitted together
to the columns of the picture, so that speckle, which moves single columns, is averaged over
the fall.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lscan.measure.segments import Segment, Trace
from lscan.records import Floats, Mask
from lscan.stripe.blurredstep import NO_END, StepLimits, StepSamples, fit_steps

UNDIMMED = 0.95
"""Brightness of a segment's last point, in units of the segment's, above which no fall is seen."""

USUAL_BLUR = 0.8  # columns, where the fit starts: a lens of 0.7 pixels, and the pixel's width

BLURS = (1 / np.sqrt(12), 3.0)
"""Least and greatest blur, columns: the pixel's own width, and what falls more slowly is no end but
a shadow."""

LEAST_T = -1.645
"""Depth, in widths of the blur, from which columns show the end: at 5 % of the segment's
brightness.  Dimmer ones are found only where speckle makes them bright."""

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

    Attributes
    ----------
    x_mm : float, mm, the place, frame of the sheet
    own_mm : float, mm, its standard uncertainty from noise, another in every picture
    common_mm : float, mm, uncertainty alike in all pictures of one place: FALSE_LIGHT, or, where no
        fall is seen, the columns' spacing
    point : int, index into the trace of the segment's outermost point
    """

    x_mm: float
    own_mm: float
    common_mm: float
    point: int


def segment_ends(line: Trace, segments: Sequence[Segment]) -> list[tuple[End, End]]:
    """The left and the right end of each segment of one profile.

    Where no fall is seen, the end is half a column beyond the last point, to within an even
    distribution over one column.

    Parameters
    ----------
    line : Trace, mm, the profile's points from left to right, with their brightness
    segments : sequence of Segment, of that profile
    """
    outermost = np.array([[part.points[k] for part in segments] for k in (0, -1)])
    falls = np.array([[_falls(line, part, k) for part in segments] for k in (0, -1)])
    step = line.spacing_mm
    place = line.x[outermost] + np.array([[-step / 2], [step / 2]])
    own, common = np.zeros(place.shape), np.full(place.shape, step / np.sqrt(12))
    if falls.any():
        limits = StepLimits(LEAST_T, np.inf, (BLURS[0] * step, BLURS[1] * step), step, UNMODELLED)
        last = line.x[outermost][falls]
        samples = _samples(line, segments, falls)
        within, blur = np.full(len(last), 1.5 * step), np.array([USUAL_BLUR * step])
        fit = fit_steps(samples, last, within, blur, limits)
        place[falls] = np.clip(fit.place, last - 3 * step, last + 3 * step)
        own[falls] = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
        common[falls] = FALSE_LIGHT * step
    left, right = (
        [End(float(x), float(s), float(e), int(p)) for x, s, e, p in zip(*side, strict=True)]
        for side in zip(place, own, common, outermost, strict=True)
    )
    return list(zip(left, right, strict=True))


def _samples(line: Trace, segments: Sequence[Segment], falls: Mask) -> StepSamples:
    """The columns of all segments; the places are the ends that fall, those on the left first."""
    points = np.concatenate([part.points for part in segments])
    which = np.repeat(np.arange(len(segments)), [len(part.points) for part in segments])
    known = np.isfinite(line.brightness[points]) & (line.brightness[points] > 0)
    points, which = points[known], which[known]
    x = line.x[points]
    outwards = np.array([[-1.0], [1.0]])
    along = np.concatenate([_along(line, part) for part in segments])[known]
    places = np.where(falls, np.cumsum(falls).reshape(falls.shape) - 1, -1)
    by_place = (outwards * falls)[:, None] * np.eye(2)[:, :, None]
    return StepSamples(
        stretch=which,
        brightness=line.brightness[points],
        level=np.stack([np.ones_like(along), along]),
        by_place=by_place[..., which],
        offset=np.where(falls[:, which], outwards * x, NO_END),
        places=places.T,
        group=np.zeros(len(segments), dtype=np.int64),
        wall=np.full(len(segments), -1),
    )


def _along(line: Trace, part: Segment) -> Floats:
    """(K,) place of the segment's points between its ends, -1 to 1."""
    x = line.x[part.points]
    return 2 * (x - x[0]) / max(float(x[-1] - x[0]), line.spacing_mm) - 1


def _falls(line: Trace, segment: Segment, end: int) -> bool:
    """Whether a segment's outermost point, its first (0) or last (-1), is dimmer than the rest."""
    peaks = line.brightness[segment.points]
    known = peaks[np.isfinite(peaks)]
    full = float(np.median(known)) if len(known) else 0.0
    return bool(full > 0 and peaks[end] < UNDIMMED * full)
