"""The scatter of a line's centres as the line itself shows it, from column to column.

A model of the noise (model.py) gives every pixel an error of its own.  In the pictures of most
cameras that does not hold: colours are filled in from neighbours, edges sharpened, blocks of
pixels compressed together, and the target's texture shifts the light of many columns alike.
Errors that pixels share average out less, and a noise estimated from how neighbouring pixels
differ is too small.

What the centres do is seen without a model.  Third differences along the line,
c[i] - 3 c[i+h] + 3 c[i+2h] - c[i+3h], vanish on any parabola, and hold 20 times the variance of
errors that are independent h columns apart.  So h must reach as far as columns share errors;
the shorter it is, the less of the target's relief is taken for scatter.  How far that is, the
line's *width* tells: it has the errors of the same pixels, and hardly any of the relief.
Where its third differences are the same at every h, each column has errors of its own, h is 1,
and of relief nothing is left but what is rough from one column to the next.
"""

from dataclasses import replace

import numpy as np

from lscan.records import Floats, Ints, Status, Stripe, has_value
from lscan.stripe.noise.model import robust_variance
from lscan.stripe.peaks import windows
from lscan.stripe.pieces import pieces
from lscan.stripe.width import line_width

_THIRD = np.array([1.0, -3.0, 3.0, -1.0])
_REPEATED = 1 + 2 * (15**2 + 6**2 + 1**2) / 20**2
"""By how much the variance of a mean square of third differences exceeds that of as many
independent values: the sum of their squared autocorrelations, 1, -15/20, 6/20 and -1/20."""

_LAGS = (1, 2, 4, 8, 16)  # columns; a block of JPEG has 8, of its subsampled colours 16
_SETTLED = 1.25  # ratio of the variances at a lag and the one before that is no growth
_BEYOND_CHANCE = 4.0  # standard deviations
_FEWEST = 32  # third differences
_SPANS = 8  # stretches as long as the lag, of columns that share errors: sigma to a third
_FINEST_PX = 1.5  # a narrower window lets the raster of the pixels through
_STEPS = 4  # from a pixel beside the line, to a hundredth of a pixel


def at_least_seen(stripe: Stripe, light: Floats) -> Stripe:
    """The stripe with sigma_px enlarged to what its centres scatter about their neighbours.

    One factor for the columns that are OK and one for those SATURATED, never below 1.

    Parameters
    ----------
    stripe : Stripe, px, of N entries
    light : (N, L) array, DN, row i being the column (or row) of the picture that entry i of the
        stripe was found in
    """
    if np.count_nonzero(has_value(stripe.status)) < _FEWEST:
        return stripe
    lag, run, sigma_px = shared_columns(stripe, light), pieces(stripe), stripe.sigma_px.copy()
    for status in (Status.OK, Status.SATURATED):
        kept = stripe.status == status
        sigma_px[kept] *= excess(stripe, np.where(kept, run, -1), lag)
    return replace(stripe, sigma_px=sigma_px)


def excess(stripe: Stripe, run: Ints, lag: int) -> float:
    """Scatter of the centres over the one that sigma_px states, at least 1.

    With a lag of 1 the noise may be as stated: an excess within chance, four standard deviations
    of it, counts as none.

    Parameters
    ----------
    stripe : Stripe, px, of N entries
    run : (N,) array, number of the piece each entry belongs to (pieces.py), -1 for none
    lag : int, columns, from which on the centres' errors are independent; a shorter one is taken
        where the pieces hold less than eight stretches of it, and 1 is returned where they hold
        fewer than 32 third differences
    """
    certain, at = lag > 1, _quadruples(run, lag)
    while lag > 1 and len(at) < max(_FEWEST, _SPANS * lag):
        lag = 3 * lag // 4
        at = _quadruples(run, lag)
    if len(at) < _FEWEST:
        return 1.0
    stated = stripe.sigma_px[at] ** 2 @ _THIRD**2
    ratio = robust_variance(stripe.centre_px[at] @ _THIRD / np.sqrt(stated))
    chance = 0.0 if certain else _BEYOND_CHANCE * np.sqrt(2 * _REPEATED / len(at))
    return float(np.sqrt(ratio)) if ratio > 1 + chance else 1.0


def shared_columns(stripe: Stripe, light: Floats) -> int:
    """Columns along which the pixels share their errors, 1 where each column has its own.

    The lag, of 1, 2, 4, 8 and 16, beyond which the third differences of the line's width grow
    no more; 1 where none of them grows by more than chance, four standard deviations.

    Parameters
    ----------
    stripe : Stripe, px, of N entries, some of which have a value
    light : (N, L) array, DN, as :func:`at_least_seen` takes it
    """
    width = _widths(stripe, light)
    run = np.where(np.isfinite(width), pieces(stripe), -1)
    differences = [width[_quadruples(run, lag)] @ _THIRD for lag in _LAGS]
    differences = [values for values in differences if len(values) >= _FEWEST]
    scatter = np.array([robust_variance(values) for values in differences])
    growth = scatter[1:] / np.maximum(scatter[:-1], np.finfo(float).tiny)
    # Two variances are compared, each of as many values as the second has, or more.
    count = np.array([len(values) for values in differences[1:]])
    chance = _BEYOND_CHANCE * np.sqrt(2 * 2 * _REPEATED / count)
    if (growth <= 1 + chance).all():
        return 1
    return _LAGS[int(np.append(growth <= _SETTLED, True).argmax())]


def _widths(stripe: Stripe, light: Floats) -> Floats:
    """(N,) the light's variance across the line, NaN where there is no line.

    Weighted by a Gaussian as wide as the line, in units of its variance, about the middle that
    the first moments so weighted have: through such a window half of a Gaussian's displacement
    is seen, so each step towards it goes twice as far.
    """
    valued = np.flatnonzero(has_value(stripe.status))
    scale = max(line_width(light, valued), _FINEST_PX)
    reach = int(np.ceil(3 * scale)) + 2
    steps = np.arange(-reach, reach + 1, dtype=float)
    row = np.rint(stripe.centre_px[valued]).astype(int)
    grey = windows(light, valued, row, reach)
    grey = grey - grey[:, [0, 1, -2, -1]].mean(axis=1, keepdims=True)
    middle = (stripe.centre_px[valued] - row)[:, None]
    for _ in range(_STEPS):
        distance = (steps - middle) / scale
        weighted = np.exp(-0.5 * distance**2) * grey
        total = weighted.sum(axis=1, keepdims=True)
        total = np.where(total > 0, total, np.nan)
        moved = (weighted * distance).sum(axis=1, keepdims=True) / total
        middle = middle + scale * np.clip(2 * moved, -1.0, 1.0)
    variance = np.full(len(stripe.status), np.nan)
    variance[valued] = (weighted * distance**2).sum(axis=1) / total[:, 0]
    return variance


def _quadruples(run: Ints, lag: int) -> Ints:
    """(Q, 4) entries ``lag`` apart, all of the same piece; -1 is none."""
    first = np.arange(max(len(run) - 3 * lag, 0))
    at = first[:, None] + lag * np.arange(4)
    piece = run[at]
    return at[(piece[:, 0] >= 0) & (piece == piece[:, :1]).all(axis=1)]
