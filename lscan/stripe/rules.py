"""Extractors that put the centre where a rule says, the paper's among them.

A rule is judged by what it would do to the line that was there: a Gaussian of the
neighbours' width at the place found, averaged over each pixel.  On that line it errs by a
little even without noise (interpolation, pixels cut off), and has a derivative by each
pixel, through which the pixels' noise reaches the centre, and so does what the real line
differs by (fit.py).  sigma_px holds all three.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import wraps
from typing import cast

import numpy as np

from lscan.config.rig import StripeSection
from lscan.records import Floats, GreyValues, Ints, Mask, Stripe
from lscan.stripe.api import Extractor, on_integers
from lscan.stripe.fit import LineWindows, lines, parameters_of
from lscan.stripe.likelihood import Survey, survey
from lscan.stripe.loops.centre import CENTROID, MIDDLE, RELATIVE, centroids
from lscan.stripe.peaks import (
    clipped_middles,
    nominal_peaks,
    smoothed_by_width,
    smoothing_px,
    stripe_at,
    windows,
)
from lscan.stripe.picture import Noise, line_noise

# Extractors that put the centre where a rule says: what they share, and their uncertainty.


@dataclass(frozen=True)
class LineLight:
    """The line in K columns, its ground taken off, in windows of n pixels.

    Attributes
    ----------
    steps : (n,) array, px, place from the middle pixel
    light : (K, n) array, DN
    clipped : (K, n) mask, of the pixels that may have seen more light than they say
    width_px : (K,) array, px, standard deviation of the line
    noise : Noise, of the pixels
    """

    steps: Floats
    light: Floats
    clipped: Mask
    width_px: Floats
    noise: Noise


Rule = Callable[[LineLight], tuple[Floats, Floats]]
"""From K lines to the centre's offset (K,) from the middle pixel in px, NaN where there is
none, and the derivative (K, n) of that offset by each value of the light, in px/DN."""


def extractor(rule: Rule) -> Extractor:
    """Decorator of a rule that makes it an extractor, which applies it in each column.

    The ground under the line is the straight line through the means of the pixels three to
    four widths away.  Statuses as in peaks.py, in windows that suit the line's width;
    NO_PEAK also where the rule finds no centre near the peak, see :meth:`Survey.is_near`.

    Parameters
    ----------
    rule : callable, from the LineLight of K lines to the centre's offset (K,), px from the middle
        pixel, and its derivative (K, n) by the light, px/DN
    """

    @wraps(rule, assigned=("__module__", "__name__", "__qualname__", "__doc__"))
    def extract(image: GreyValues, settings: StripeSection, clipped: Mask) -> Stripe:
        seen = survey(image, settings, clipped)
        if isinstance(seen, Stripe):
            return seen
        ground = _Ground.beside(seen.view, seen.width_px)
        light = ground.taken_off(seen.view.grey)
        offset, _ = rule(_line_light(seen, light))
        sigma = _sigma(rule, seen, ground, light, np.nan_to_num(offset))
        kept = seen.is_near(offset, sigma)
        return stripe_at(seen.stripe, seen.peaks, offset, sigma, kept)

    del extract.__wrapped__  # its signature is an extractor's, not the rule's
    return on_integers(extract)


@dataclass(frozen=True)
class _Ground:
    """The straight line under K lines: weights (K, n) of the pixels in its level and slope."""

    steps: Floats
    level: Floats
    slope: Floats

    @staticmethod
    def beside(view: LineWindows, width_px: Floats) -> "_Ground":
        """The ground by the means of the used pixels beyond three widths on either side.

        Level where only one side has any, zero where none has.
        """
        beyond = view.used & ~view.clipped
        beyond &= np.abs(view.steps) > np.ceil(3 * width_px)[:, None]
        upper, lower = _mean(beyond & (view.steps < 0)), _mean(beyond & (view.steps > 0))
        at_upper, at_lower = upper @ view.steps, lower @ view.steps
        both = (at_upper != 0) & (at_lower != 0)
        apart = np.where(both, at_lower - at_upper, 1.0)[:, None]
        slope = np.where(both[:, None], (lower - upper) / apart, 0.0)
        level = np.where(both[:, None], upper - at_upper[:, None] * slope, upper + lower)
        return _Ground(view.steps, level, slope)

    def taken_off(self, grey: Floats) -> Floats:
        """``grey`` (K, n) less the ground."""
        return grey - self.values(grey)

    def values(self, grey: Floats) -> Floats:
        """The ground (K, n) under the lines of ``grey``."""
        level = (self.level * grey).sum(axis=1, keepdims=True)
        slope = (self.slope * grey).sum(axis=1, keepdims=True)
        return level + slope * self.steps

    def derivative_by_grey(self, derivative: Floats) -> Floats:
        """The derivative (K, n) by the grey values of what has ``derivative`` by the light."""
        by_level = derivative.sum(axis=1, keepdims=True)
        by_slope = (derivative @ self.steps)[:, None]
        return derivative - by_level * self.level - by_slope * self.slope


def _mean(chosen: Mask) -> Floats:
    """Weights (K, n) of the mean over the chosen pixels of each row, 0 where none are."""
    return chosen / np.maximum(chosen.sum(axis=1, keepdims=True), 1)


def _sigma(rule: Rule, seen: Survey, ground: _Ground, light: Floats, offset: Floats) -> Floats:
    """Standard uncertainty (K,) in px of the centres that ``rule`` put at ``offset``."""
    steps, width = seen.view.steps, seen.width_px
    core = np.abs(steps) <= np.ceil(3 * width)[:, None]
    flux = np.maximum((light * core).sum(axis=1), 1e-3)
    level, height = np.zeros(len(offset)), flux / (np.sqrt(2 * np.pi) * width)
    model = lines(parameters_of(offset, width, height, level, level), steps).light
    veil = ground.values(seen.view.grey) - seen.view.base[:, None]
    variance = seen.noise.variance(model, veil) + (seen.misfit * model) ** 2
    expected, derivative = rule(_line_light(seen, ground.taken_off(model)))
    noise = (ground.derivative_by_grey(derivative) ** 2 * variance).sum(axis=1)
    return np.sqrt(noise + (expected - offset) ** 2)


def _line_light(seen: Survey, light: Floats) -> LineLight:
    return LineLight(seen.view.steps, light, seen.view.clipped, seen.width_px, seen.noise)


# The stripe extractors of the paper: brightest pixel, centroid, centroid of relative values.
#
# All three start from the nominal peak of each column, the first maximum from the top, and look at
# the window of ``span_px`` pixels on either side of it (Sec. V.B).  They differ only in how far
# from the nominal peak they put the centre of the line:
#
# - ``maximum``: at the nominal peak itself;
# - ``centroid``: eq. (8) with the grey values as weights;
# - ``centroid_relative``: eq. (8) with the window's smallest grey value subtracted first.
#
# Where the crest is clipped, the first maximum is its upper end and not its middle: by as much as
# half its width in every column alike.  There the nominal peak is the middle of the clipped pixels,
# and the centre too where the window hardly sees beyond them.


_FARTHEST_PX = 15  # from a line's crest, of pixels that might be it


def _centred(image: GreyValues, settings: StripeSection, clipped: Mask, rule: int) -> Stripe:
    """The stripe by a rule of ``centroids``.

    A column has a line where its highest value exceeds its median by more than
    ``threshold_dn``: NO_PEAK otherwise, AT_BORDER where the window does not fit the picture.

    sigma_px combines three.  The noise of the pixels (picture.py), carried through the derivative
    of the centre.  The choice of the nominal peak, to which the paper notes that the result is
    sensitive: by how much the centre would move with the brighter neighbour as nominal peak (a
    whole pixel at most), for each pixel of the line within two standard deviations of it; n that
    are together have a variance of n² / 12.  For ``maximum`` and a clear peak that is a uniform
    distribution as wide as a pixel; for a centroid whose window holds the whole line it vanishes;
    between them it accounts for the tails that the window cuts off.  And, where the background is
    guessed from the window, whose smallest value may be the line's own tail, that guess: the
    column's median is the one that cannot be; the truth lies between the two centroids, rather near
    the one found (a triangular distribution, whose mean square about its high end is a sixth of its
    width's).  For a Gaussian line the last two are the size of what the window cuts off; a line
    wider than the span, whose crest is flat, has sigma_px too large.
    Fast where ``image.T`` is contiguous in memory.
    """
    columns = np.require(image.T, None, ["C", "W"])  # see likelihood.py
    stripe, peaks = nominal_peaks(columns, settings)
    if len(peaks.columns) == 0:
        return stripe
    middle, flat = clipped_middles(clipped.T, peaks)
    peaks = replace(peaks, rows=np.floor(middle).astype(int))
    # One pixel wider than the window on either side, to try the neighbour as nominal peak.
    wide = windows(columns, peaks.columns, peaks.rows, settings.span_px + 1)
    noise = line_noise(columns, wide[:, 1:-1] - peaks.base[:, None], peaks.columns)
    smoothed, width_px = smoothed_by_width(columns, settings.line_width_px), settings.line_width_px
    around = windows(smoothed, peaks.columns, peaks.rows, max(_FARTHEST_PX, settings.span_px))
    # The mean of as many pixels as a Gaussian kernel amounts to, 2 sqrt(pi) times its width.
    averaged = max(2 * np.sqrt(np.pi) * smoothing_px(width_px), 1.0)
    offset, variance_px = centroids(
        wide, around, peaks.base, rule, noise.constant, noise.per_dn, averaged
    )
    wide_crest = flat > settings.span_px
    offset[wide_crest] = (middle - peaks.rows)[wide_crest]
    variance_px[wide_crest] = 1 / 12  # of a pixel at either end; extract_stripe adds the rest

    # Only grey values that are negative can throw the centroid out of its window.
    kept = np.abs(offset) <= settings.span_px
    return stripe_at(stripe, peaks, offset, np.sqrt(variance_px), kept)


@on_integers
def maximum(image: GreyValues, settings: StripeSection, clipped: Mask) -> Stripe:
    """The line at the brightest pixel of each column, the first from the top of several equal ones.

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold and span; see :func:`_centred`
    clipped : (H, W) mask, the middle of whose run about the peak is the peak

    References
    ----------
    Sec. V.B of the paper: the nominal peak.
    """
    return _centred(image, settings, clipped, MIDDLE)


@on_integers
def centroid(image: GreyValues, settings: StripeSection, clipped: Mask) -> Stripe:
    """The line at the centroid of the grey values about each column's nominal peak.

    A background within the window draws it to the nominal peak.

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold and span; see :func:`_centred`
    clipped : (H, W) mask, the middle of whose run about the peak is the peak

    References
    ----------
    Sec. V.B and eq. (8) of the paper.
    """
    return _centred(image, settings, clipped, CENTROID)


@on_integers
def centroid_relative(image: GreyValues, settings: StripeSection, clipped: Mask) -> Stripe:
    """The line at the centroid of the grey values above the smallest one in the window.

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold and span; see :func:`_centred`
    clipped : (H, W) mask, the middle of whose run about the peak is the peak

    References
    ----------
    Sec. V.B of the paper: eq. (8) with the relative intensities.
    """
    return _centred(image, settings, clipped, RELATIVE)


# The log-parabola: of a Gaussian the logarithm is a parabola, whose vertex is the centre.


_DYNAMIC = 10.0
"""Of the logarithm: what a parabola puts farther below the peak has no weight to speak of."""

_TRACE = 1e-10


@extractor
def gaussian(seen: LineLight) -> tuple[Floats, Floats]:
    """The line by a parabola through the logarithms of the light about each column's peak.

    Weighted least squares over the pixels within two widths, or as far beyond as there are
    clipped ones, which are left out: the logarithm of light I with the variance V has the
    variance V / I², so each pixel has the weight I² / V.  The weights come from the pixels
    first, then from the parabola found, as noisy weights prefer what noise made bright; the
    derivative holds them fixed.  Light below its own deviation counts as that: its logarithm says
    no more.  See rules.py.

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold and span
    clipped : (H, W) mask, of the pixels that may have seen more light than they say

    References
    ----------
    H. Guo, IEEE Signal Processing Magazine 28(5), 134 (2011).
    """
    reach = np.maximum(1, np.rint(2 * seen.width_px)) + seen.clipped.sum(axis=1) / 2
    near = (np.abs(seen.steps) <= reach[:, None]) & ~seen.clipped
    deviation = np.sqrt(seen.noise.variance(seen.light))
    light = np.maximum(seen.light, deviation)
    x = seen.steps / seen.width_px[:, None]  # of order 1, for the sake of the inverse
    powers = x[:, None, :] ** np.arange(3)[None, :, None]
    gain = _gain(powers, near * (light / deviation) ** 2)
    most = np.log(light.max(axis=1, keepdims=True))
    parabola = (_coefficients(gain, light)[:, None] @ powers)[:, 0]
    fitted = np.exp(np.clip(parabola, most - _DYNAMIC, most))
    gain = _gain(powers, near * fitted**2 / seen.noise.variance(fitted))
    _, slope, bend = _coefficients(gain, light).T
    bend = np.where((bend < 0) & (near.sum(axis=1) >= 3), bend, np.nan)
    vertex = -slope / (2 * bend)
    by_log = -(gain[:, 1] + 2 * vertex[:, None] * gain[:, 2]) / (2 * bend[:, None])
    width = seen.width_px
    return vertex * width, by_log * width[:, None] / light


def _gain(powers: Floats, weight: Floats) -> Floats:
    """(K, 3, n) the parabola's coefficients by each logarithm, in weighted least squares."""
    weighted = powers * weight[:, None]
    normal = weighted @ powers.transpose(0, 2, 1)
    # Fewer than three pixels determine no parabola: this keeps it flat, and changes no other.
    normal += _TRACE * np.eye(3) * (1 + np.trace(normal, axis1=1, axis2=2))[:, None, None]
    return cast(Floats, np.linalg.solve(normal, weighted))


def _coefficients(gain: Floats, light: Floats) -> Floats:
    """(K, 3) coefficients of the parabola through the logarithms of ``light`` (K, n)."""
    return (gain @ np.log(light)[..., None])[..., 0]


# Blais and Rioux's peak detector: the zero crossing of a filtered derivative.


@extractor
def blais_rioux(seen: LineLight) -> tuple[Floats, Floats]:
    """The line where the derivative of each column's light crosses zero.

    The derivative is the sum of the m pixels above less that of the m below, with m nearest twice
    the line's width; between the two pixels where it changes sign it is taken as straight.
    See rules.py.

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold and span
    clipped : (H, W) mask, of the pixels that may have seen more light than they say

    References
    ----------
    Blais and Rioux, Signal Processing 11, 145 (1986), who use orders 2 m of 2, 4 and 8.
    """
    taps = np.maximum(np.rint(2 * seen.width_px), 1).astype(int)
    filtered = _tap_difference(seen.light, taps)
    rises = (filtered[:, :-1] < 0) & (filtered[:, 1:] >= 0)
    inside = np.abs(seen.steps[:-1] + 0.5) <= np.ceil(2 * seen.width_px)[:, None] + 1
    distance = np.where(rises & inside, np.abs(seen.steps[:-1] + 0.5), np.inf)
    at = distance.argmin(axis=1)
    found = np.isfinite(distance.min(axis=1))
    every = np.arange(len(at))
    before, after = filtered[every, at], filtered[every, at + 1]
    rise = np.where(found, after - before, np.nan)
    share = -before / rise
    # d share = -[(1 - share) d before + share d after] / rise
    upper, lower = _taps(seen.steps, at, taps), _taps(seen.steps, at + 1, taps)
    derivative = -((1 - share)[:, None] * upper + share[:, None] * lower) / rise[:, None]
    return seen.steps[at] + share, derivative


def _tap_difference(light: Floats, taps: Ints) -> Floats:
    """(K, n) sum of the ``taps`` (K,) pixels above each one less that of those below."""
    n = light.shape[1]
    total = np.concatenate([np.zeros((len(light), 1)), light.cumsum(axis=1)], axis=1)
    place = np.arange(n)

    def up_to(end: Ints) -> Floats:
        return np.take_along_axis(total, np.clip(end, 0, n), axis=1)

    above = total[:, :-1] - up_to(place - taps[:, None])
    below = up_to(place + taps[:, None] + 1) - total[:, 1:]
    return above - below


def _taps(steps: Floats, at: Ints, taps: Ints) -> Floats:
    """Coefficients (K, n) of each pixel in the filter's output at pixel ``at`` (K,)."""
    distance = steps - steps[at][:, None]
    return np.where(np.abs(distance) <= taps[:, None], -np.sign(distance), 0.0)


# The peak of the smoothed column, by a parabola through three values about it.


_APART = 0.5  # the three values', in widths of the line


@extractor
def smoothed_peak(seen: LineLight) -> tuple[Floats, Floats]:
    """The line at the peak of each column smoothed with the line's own width.

    A Gaussian as wide as the line is its matched filter: of all filters it raises the peak
    most above the noise.  The smoothed column is a function of any place, not of pixels alone,
    so the three values may be closer together than pixels: half a width.  See rules.py.

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold and span
    clipped : (H, W) mask, of the pixels that may have seen more light than they say
    """
    apart = _APART * seen.width_px
    middle = _highest(seen)
    kernels = _kernel(seen, (np.arange(-1, 2) + middle[:, None]) * apart[:, None])  # (K, 3, n)
    before, peak, after = (kernels @ seen.light[..., None])[..., 0].T
    bend = before - 2 * peak + after
    bend = np.where(bend < 0, bend, np.nan)
    vertex = (before - after) / (2 * bend)
    by_value = np.stack([0.5 - vertex, 2 * vertex, -0.5 - vertex], axis=1) / bend[:, None]
    derivative = (by_value[:, :, None] * kernels).sum(axis=1) * apart[:, None]
    return (middle + vertex) * apart, derivative


def _highest(seen: LineLight) -> Floats:
    """(K,) place, in steps of half a width, of the highest value near the middle pixel."""
    reach = int(np.ceil(np.max((seen.width_px + 2) / (_APART * seen.width_px))))
    places = np.arange(-reach, reach + 1, dtype=float)
    kernels = _kernel(seen, places * _APART * seen.width_px[:, None])
    smooth = (kernels @ seen.light[..., None])[..., 0]
    return places[smooth.argmax(axis=1)]


def _kernel(seen: LineLight, places: Floats) -> Floats:
    """Weights (K, P, n) of the pixels in the smoothed values at ``places`` (K, P)."""
    width = seen.width_px[:, None, None]
    distance = (seen.steps - places[:, :, None]) / width
    return np.where(np.abs(distance) <= 4, np.exp(-0.5 * distance**2), 0.0)


# The centroid of squared intensities: bright pixels count for more, noise far out for less.


@extractor
def centroid_squared(seen: LineLight) -> tuple[Floats, Floats]:
    """The line at the centroid of the squared light within 2.5 widths of each column's peak.

    The squares of a Gaussian are a Gaussian, narrower by sqrt(2): the window cuts off what
    lies beyond 3.5 of its widths.  See rules.py.

    Parameters
    ----------
    image : (H, W) array, DN, grey values
    settings : StripeSection, threshold and span
    clipped : (H, W) mask, of the pixels that may have seen more light than they say
    """
    reach = np.maximum(np.ceil(2.5 * seen.width_px), 2)[:, None]
    light = np.where(np.abs(seen.steps) <= reach, seen.light, 0.0)
    total = (light**2).sum(axis=1)
    total = np.where(total > 0, total, np.nan)
    offset = (light**2 @ seen.steps) / total
    return offset, 2 * light * (seen.steps - offset[:, None]) / total[:, None]
