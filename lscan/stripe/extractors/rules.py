"""Extractors that put the centre where a rule says: what they share, and their uncertainty.

A rule is judged by what it would do to the line that was there: a Gaussian of the
neighbours' width at the place found, averaged over each pixel.  On that line it errs by a
little even without noise (interpolation, pixels cut off), and has a derivative by each
pixel, through which the pixels' noise reaches the centre, and so does what the real line
differs by (noise/scatter.py).  sigma_px holds all three.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps

import numpy as np

from lscan.config.rig import StripeSection
from lscan.records import Floats, GreyValues, Mask, Stripe
from lscan.stripe.api import Extractor, on_integers
from lscan.stripe.crosssection import lines, parameters_of
from lscan.stripe.extractors.survey import Survey, survey
from lscan.stripe.noise.model import Noise
from lscan.stripe.peaks import centred
from lscan.stripe.scoring import LineWindows


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
        offset, _ = rule(_lit(seen, light))
        sigma = _sigma(rule, seen, ground, light, np.nan_to_num(offset))
        kept = seen.is_near(offset, sigma)
        return centred(seen.stripe, seen.peaks, offset, sigma, kept)

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
        values: Floats = level + slope * self.steps
        return values

    def carried(self, derivative: Floats) -> Floats:
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
    model = _ideal(steps, offset, width, light)
    veil = ground.values(seen.view.grey) - seen.view.base[:, None]
    variance = seen.noise.variance(model, veil) + (seen.misfit * model) ** 2
    expected, derivative = rule(_lit(seen, ground.taken_off(model)))
    noise = (ground.carried(derivative) ** 2 * variance).sum(axis=1)
    return np.sqrt(noise + (expected - offset) ** 2)


def _lit(seen: Survey, light: Floats) -> LineLight:
    return LineLight(seen.view.steps, light, seen.view.clipped, seen.width_px, seen.noise)


def _ideal(steps: Floats, offset: Floats, width: Floats, light: Floats) -> Floats:
    """Noise-free lines (K, n) at ``offset`` with the width given and the light's flux."""
    core = np.abs(steps) <= np.ceil(3 * width)[:, None]
    flux = np.maximum((light * core).sum(axis=1), 1e-3)
    level = np.zeros(len(offset))
    height = flux / (np.sqrt(2 * np.pi) * width)
    return lines(parameters_of(offset, width, height, level, level), steps).light
