"""Where a line begins and ends, to a fraction of a column.

The camera blurs an end over a column or two, and speckle makes every column's light its own.
An end is where the light has fallen to half of what it is beside it: for any symmetrical blur
that is where the sharp line ended.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import norm

from lscan.config.rig import StripeSection
from lscan.errors import InputError
from lscan.records import Bytes, Floats, Ints, Stripe
from lscan.stripe.lines import lines_of
from lscan.stripe.noise.model import constant_variance, line_variance_per_dn
from lscan.stripe.pieces import pieces
from lscan.stripe.width import line_width

_INSIDE, _OUTSIDE = 14, 6  # columns of the line, and beyond its end, that the fit looks at
_FEWEST = 8  # columns of a piece whose ends are located
_STRAIGHT = 10  # columns through which the line is drawn on beyond its end
_REACH = 3  # of the line's widths, to either side of it, in which a column's light is summed
_BLUR_OF_WIDTH = 0.7
"""The blur as a share of the line's width, where it is not known: between a line that is as
narrow as the blur (1) and one twice as wide (0.5)."""
_BLUR_SPREAD = 0.5, 0.1  # relative uncertainty of the blur, unknown and from the settings
_TREND_PER_PX = 0.005  # what brightness changes by, in parts, from one column to the next
_PEDESTAL = 0.02  # light beyond the end, in parts of the line's
_ROUNDS = 12


@dataclass(frozen=True)
class LineEnd:
    """One end of a piece of the line.

    at_px: place along the picture (the column, or the row with ``axis="rows"``), in fractions.
    centre_px: the line's centre there, across it.  sigma_px: standard uncertainty of at_px.
    side: "start" where the line begins towards higher columns, "end" where it ceases.
    """

    at_px: float
    centre_px: float
    sigma_px: float
    side: Literal["start", "end"]


def line_ends(
    stripe: Stripe,
    image: Bytes,
    settings: StripeSection,
    background: Bytes | None = None,
) -> tuple[LineEnd, ...]:
    """The ends of all pieces of the line, from left to right (with rows: from the top).

    stripe: what ``extract_stripe`` found in ``image`` with ``settings``.
    image, background: (H, W) grey or (H, W, 3) RGB uint8, as ``extract_stripe`` has them.

    A piece (pieces.py) of fewer than 8 columns has no ends, nor has one where the picture's
    edge cuts it.  Each column's light is summed about the straight line through the piece's
    last ten; the sums of 14 columns within and 6 beyond the end are fitted by a step, blurred
    by a Gaussian and by the width of a pixel, on a pedestal and with a slope, by weighted
    least squares.  Blur, pedestal and slope are held by what is usual (or by
    ``settings.blur_px``); sigma_px takes in what is not known of them, the pixels' noise, the
    scatter between columns that speckle makes, and how badly the step fits.

    Raises InputError where stripe and picture are not of one size.
    """
    grey = lines_of(image, settings.channel, settings.axis, where="image").grey.astype(float)
    if background is not None:
        grey -= lines_of(background, settings.channel, settings.axis, where="background").grey
    if len(grey) != len(stripe.centre_px):
        raise InputError(
            "stripe is not of the picture's size",
            where="line_ends",
            value=len(stripe.centre_px),
            allowed=f"{len(grey)} {settings.axis}",
        )
    label = pieces(stripe)
    found = _found_ends(label)
    if len(found) == 0:
        return ()
    width = line_width(grey, np.flatnonzero(label >= 0))
    near = [_light_about(grey, stripe, label, column, side, width) for column, side in found]
    light = np.array([fluxes for fluxes, _ in near])
    scatter = _Scatter.of(grey, stripe, label, width, settings)
    at, sigma = _fit(light, scatter, *_blur(width, settings))
    return tuple(
        LineEnd(
            at_px=float(column + side * place),
            centre_px=float(np.polyval(course, side * place)),
            sigma_px=float(spread),
            side="end" if side > 0 else "start",
        )
        for (column, side), (_, course), place, spread in zip(found, near, at, sigma, strict=True)
    )


def _found_ends(label: Ints) -> list[tuple[int, int]]:
    """(column, side) of each end: the piece's last column; 1 where it goes no further right."""
    ends = []
    for piece in range(int(label.max()) + 1):
        columns = np.flatnonzero(label == piece)
        if len(columns) >= _FEWEST:
            ends += [(int(columns[0]), -1)] if columns[0] > 0 else []
            ends += [(int(columns[-1]), 1)] if columns[-1] < len(label) - 1 else []
    return ends


def _light_about(
    grey: Floats, stripe: Stripe, label: Ints, column: int, side: int, width: float
) -> tuple[Floats, Floats]:
    """The columns' light in DN, outwards through an end, and the line's course there.

    Light: (20,), NaN beyond the piece's other end or the picture.  Course: the coefficients of
    the centre's straight line over the distance from ``column``, for ``numpy.polyval``.
    """
    members = np.flatnonzero(label == label[column])
    # The last two columns are left out of the straight line: the blur has mixed them.
    last = members[2 : 2 + _STRAIGHT] if side < 0 else members[-2 - _STRAIGHT : -2]
    course = np.polyfit(last - column, stripe.centre_px[last], 1)
    at = column + side * np.arange(1 - _INSIDE, _OUTSIDE + 1)
    there = (at >= 0) & (at < len(grey)) & (side * (at - column) > -len(members))
    reach = int(np.ceil(_REACH * width))
    middle = np.rint(np.polyval(course, at - column)).astype(int)
    rows = middle[:, None] + np.arange(-reach, reach + 1)
    there &= (rows[:, 0] >= 0) & (rows[:, -1] < grey.shape[1])
    at = np.clip(at, 0, len(grey) - 1)
    window = grey[at[:, None], np.clip(rows, 0, grey.shape[1] - 1)]
    ground = np.median(grey[at].astype(np.float32), axis=1, keepdims=True)
    return np.where(there, (window - ground).sum(axis=1), np.nan), course


@dataclass(frozen=True)
class _Scatter:
    """Variance of a column's summed light F, DN²: constant + per_dn F + (relative F)²."""

    constant: float
    per_dn: float
    relative: float

    def variance(self, light: Floats) -> Floats:
        """DN², same shape as ``light`` in DN."""
        light = np.maximum(light, 0.0)
        total: Floats = self.constant + self.per_dn * light + (self.relative * light) ** 2
        return total

    @classmethod
    def of(
        cls, grey: Floats, stripe: Stripe, label: Ints, width: float, settings: StripeSection
    ) -> _Scatter:
        """As the settings state it, else as the columns scatter from one to the next.

        Speckle of contrast C in each pixel of a Gaussian line of width w leaves C / sqrt(2
        sqrt(pi) w) in the sum of a column: the sum of its squares over the square of its sum.
        """
        reach = int(np.ceil(_REACH * width))
        count, known = 2 * reach + 1, settings.noise
        if known is not None:
            relative = known.speckle / np.sqrt(2 * np.sqrt(np.pi) * width)
            return cls(count * known.read_dn**2, known.dn_per_electron, relative)
        at = np.flatnonzero(label >= 0)
        middle = np.rint(stripe.centre_px[at]).astype(int)
        rows = np.clip(middle[:, None] + np.arange(-reach, reach + 1), 0, grey.shape[1] - 1)
        light = grey[at[:, None], rows] - np.median(grey[at], axis=1, keepdims=True)
        pixel = constant_variance(grey)
        # Whatever makes the columns scatter is charged as if it grew with the light itself.
        per_dn = line_variance_per_dn(light, at, pixel)
        typical = max(float(np.median(light.sum(axis=1))), 1.0)
        return cls(count * pixel, 0.0, float(np.sqrt(per_dn / typical)))


def _blur(width: float, settings: StripeSection) -> tuple[float, float]:
    """Standard deviation of the blur along the line in px, and its relative uncertainty."""
    unknown, known = _BLUR_SPREAD
    if settings.blur_px is None:
        return _BLUR_OF_WIDTH * width, unknown
    return settings.blur_px, known


def _fit(
    light: Floats, scatter: _Scatter, blur: float, blur_spread: float
) -> tuple[Floats, Floats]:
    """Place (E,) of the ends in px beyond the last column of the piece, and their sigmas.

    light: (E, 20) of each end's columns in DN, the piece's last at index 13, NaN where none.

    Unknowns: the end, the logarithm of brightness, that of the blur, the trend per column and
    the pedestal.  All but the first two are held by priors, which enter as measurements
    of their own; Gauss-Newton for all ends at once, weighted by the light fitted.
    """
    there = np.isfinite(light)
    step = np.arange(light.shape[1], dtype=np.float64) - (_INSIDE - 1)
    level = np.nanmedian(light[:, : _INSIDE - 3], axis=1)
    level = np.maximum(level, 1.0)
    values = np.where(there, light / level[:, None], 0.0)
    held = np.array([0.0, 0.0, 1 / blur_spread, 1 / _TREND_PER_PX, 1 / _PEDESTAL]) ** 2
    prior = np.array([0.0, 0.0, np.log(blur), 0.0, 0.0])
    unknown: Floats = np.tile(prior, (len(light), 1))
    # The start: as much light as there is makes so many whole columns.
    outer = values[:, _INSIDE - 5 :].sum(axis=1)
    unknown[:, 0] = np.clip(outer - 4.5, -3.0, 3.0)
    for _ in range(_ROUNDS):
        model, slope = _blurred_step(step, unknown)
        variance = scatter.variance(model * level[:, None]) / level[:, None] ** 2
        weight = np.where(there, 1 / variance, 0.0)
        normal = np.einsum("ekp,ek,ekq->epq", slope, weight, slope) + np.diag(held)
        right = np.einsum("ekp,ek,ek->ep", slope, weight, values - model)
        right += held * (prior - unknown)
        change = np.linalg.solve(normal, right[..., None])[..., 0]
        unknown += np.clip(change, -0.5, 0.5)
    model, _ = _blurred_step(step, unknown)
    misfit = (weight * (values - model) ** 2).sum(axis=1) / np.maximum(there.sum(axis=1) - 2, 1)
    # What scatters more than it should, or is no blurred step (a lit wall), widens sigma: Birge's
    # ratio (R. T. Birge, Phys. Rev. 40, 207, 1932).
    return unknown[:, 0], np.sqrt(np.linalg.inv(normal)[:, 0, 0] * np.maximum(misfit, 1.0))


def _blurred_step(step: Floats, unknown: Floats) -> tuple[Floats, Floats]:
    """Light (E, 20) of a blurred step in parts of the level, and its derivatives (E, 20, 5).

    A pixel collects A integral of Phi((end - x) / s) dx over its width, the integral of Phi
    being Psi(t) = t Phi(t) + phi(t).
    """
    end, log_level, log_blur, trend, pedestal = (unknown[:, k, None] for k in range(5))
    blur = np.exp(log_blur)
    near, far = (end - step + 0.5) / blur, (end - step - 0.5) / blur
    share = blur * (_psi(near) - _psi(far))
    by_end = norm.cdf(near) - norm.cdf(far)
    by_blur = blur * (norm.pdf(near) - norm.pdf(far))  # dPsi/ds, and ds = s d(log s)
    level = np.exp(log_level)
    bright = level * (1 + trend * (step - end))
    slope = [
        bright * by_end - level * trend * share,
        bright * share,
        bright * by_blur,
        level * (step - end) * share,
        np.ones_like(share),
    ]
    return bright * share + pedestal, np.stack(slope, axis=-1)


def _psi(t: Floats) -> Floats:
    integral: Floats = t * norm.cdf(t) + norm.pdf(t)
    return integral
