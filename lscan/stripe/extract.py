"""From a picture to the stripe in it: the one function that everybody calls."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import compress
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from lscan.config.plugins import find_plugin_or_function, foreign_error, frames_of_others
from lscan.config.rig import NoiseSection, StripeSection
from lscan.errors import InputError, LscanError
from lscan.files.disk import write_atomically
from lscan.files.pictures import linear_dn, linear_picture
from lscan.records import (
    Axis,
    Bytes,
    Floats,
    GreyValues,
    Ints,
    Mask,
    PlanePoints,
    Status,
    Stripe,
    has_value,
)
from lscan.stripe import peaks
from lscan.stripe.api import (
    Extractor,
    Picture,
    require_stripe,
    smooths_along,
    stripes_by,
    takes_integers,
)
from lscan.stripe.corrections import correct_blur, smooth
from lscan.stripe.picture import (
    PictureLines,
    check_pair,
    check_picture,
    difference_noise,
    faint_threshold,
    is_coded,
    lines_of,
    robust_variance,
    stated_noise,
)
from lscan.stripe.returns import OneReturn, choose_return, withhold

# The scatter of a line's centres as the line itself shows it, from column to column.
#
# A model of the noise (picture.py) gives every pixel an error of its own.  In the pictures of most
# cameras that does not hold: colours are filled in from neighbours, edges sharpened, blocks of
# pixels compressed together, and the target's texture shifts the light of many columns alike.
# Errors that pixels share average out less, and a noise estimated from how neighbouring pixels
# differ is too small.
#
# What the centres do is seen without a model.  Third differences along the line,
# c[i] - 3 c[i+h] + 3 c[i+2h] - c[i+3h], vanish on any parabola, and hold 20 times the variance of
# errors that are independent h columns apart.  So h must reach as far as columns share errors;
# the shorter it is, the less of the target's relief is taken for scatter.  How far that is, the
# line's *width* tells: it has the errors of the same pixels, and hardly any of the relief.
# Where its third differences are the same at every h, each column has errors of its own, h is 1,
# and of relief nothing is left but what is rough from one column to the next.


_Number = TypeVar("_Number", bound=np.number)

_REPEATED = 1 + 2 * (15**2 + 6**2 + 1**2) / 20**2
"""By how much the variance of a mean square of third differences exceeds that of as many
independent values: the sum of their squared autocorrelations, 1, -15/20, 6/20 and -1/20."""

_LAGS = (1, 2, 4, 8, 16)  # columns; a block of JPEG has 8, of its subsampled colours 16
_SETTLED = 1.25  # ratio of the variances at a lag and the one before that is no growth
_BEYOND_CHANCE = 4.0  # standard deviations
_FEWEST_DIFFERENCES = 32  # third differences
_WIDTHS = 3.0  # of the line: extractors that smooth along it do so over its width
_SPANS = 8  # stretches as long as the lag, of columns that share errors: sigma to a third
_FINEST_PX = 1.5  # a narrower window lets the raster of the pixels through
_STEPS = 4  # from a pixel beside the line, to a hundredth of a pixel


SeenLine = tuple[Stripe, GreyValues, Ints]
"""A stripe, px, of N entries; the light (N, L) in DN, row i being the column (or row) of the
picture that entry i of the stripe was found in; and (N,), px, where each of those is the highest.
"""


def at_least_seen(seen: Sequence[SeenLine]) -> list[Stripe]:
    """The stripes with sigma_px enlarged to what their centres scatter about their neighbours.

    One factor for the columns that are OK and one for those SATURATED, never below 1.

    Parameters
    ----------
    seen : sequence of SeenLine, of one picture each
    """
    enough = [
        np.count_nonzero(has_value(stripe.status)) >= _FEWEST_DIFFERENCES for stripe, *_ in seen
    ]
    lags = iter(shared_columns(list(compress(seen, enough))))
    each = zip(seen, enough, strict=True)
    return [_widen_sigma(one[0], next(lags)) if many else one[0] for one, many in each]


def beyond_stated(seen: Sequence[SeenLine], settings: StripeSection) -> list[Stripe]:
    """The stripes with sigma_px enlarged where a line scatters more than its stated noise makes it.

    What is compared is the light's own first moment, weighted with a Gaussian of the line's width:
    that judges the noise which is stated, and not what an extractor makes of it.  Where it exceeds
    the noise, sigma_px grows by that, or by no more than the centres scatter beyond it.

    Parameters
    ----------
    seen : sequence of SeenLine, of one picture each
    settings : StripeSection, the extractor, and the noise as stated for these pictures
    """
    assert settings.noise is not None
    found = []
    for one in seen:
        stripe, factor = one[0], 1.0
        if np.count_nonzero(has_value(stripe.status)) >= _FEWEST_DIFFERENCES:
            moments, lag = _weighted_middles(*one, settings.noise), shared_columns([one])[0]
            factor = excess(moments, peaks.pieces(moments), lag)
            if factor > 1 and not smooths_along(find_extractor(settings.extractor)):
                factor = min(factor, excess(stripe, peaks.pieces(stripe), lag))
        found.append(replace(stripe, sigma_px=factor * stripe.sigma_px))
    return found


def _weighted_middles(
    stripe: Stripe, light: GreyValues, crest: Ints, noise: NoiseSection
) -> Stripe:
    """The stripe whose centres are the light's weighted first moments; sigma by the noise stated.

    The middle m solves sum of w (x - m) I = 0 with weights w(x - m), so that a pixel moves it by
    w (x - m) over the sum of w I (1 - (x - m)² / s²).
    """
    at = np.flatnonzero(stripe.status == Status.OK)
    row = np.rint(stripe.centre_px[at]).astype(int)
    scale = max(peaks.line_width(light, at, crest[at]), _FINEST_PX) if len(at) else _FINEST_PX
    steps = np.arange(-int(np.ceil(3 * scale)) - 2, int(np.ceil(3 * scale)) + 3)
    grey = peaks.windows(light, at, row, steps)
    line = grey - grey[:, [0, 1, -2, -1]].mean(axis=1, keepdims=True)
    middle = stripe.centre_px[at] - row
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in range(2 * _STEPS):
            off = steps - middle[:, None]
            weighted = np.exp(-0.5 * (off / scale) ** 2) * line
            moved = (weighted * off).sum(axis=1) / weighted.sum(axis=1)
            middle = middle + np.clip(2 * moved, -scale, scale)
        by_pixel = np.exp(-0.5 * (off / scale) ** 2) * off
        by_pixel /= (weighted * (1 - (off / scale) ** 2)).sum(axis=1)[:, None]
        variance = stated_noise(noise, 0.0).variance(np.maximum(grey, 0.0))
        # Speckle is the laser's: the ground has none.
        variance += noise.speckle**2 * (np.maximum(line, 0.0) ** 2 - np.maximum(grey, 0.0) ** 2)
        sigma = np.sqrt((by_pixel**2 * variance).sum(axis=1))
    good = np.isfinite(middle) & (np.abs(middle) < scale + 1) & (sigma > 0) & np.isfinite(sigma)
    status = np.full(len(stripe.status), int(Status.NO_PEAK))
    centre_px, sigma_px = np.full((2, len(status)), np.nan)
    kept = at[good]
    status[kept], centre_px[kept], sigma_px[kept] = Status.OK, (row + middle)[good], sigma[good]
    return replace(stripe, centre_px=centre_px, sigma_px=sigma_px, status=status)


def _widen_sigma(stripe: Stripe, lag: int) -> Stripe:
    """The same of a stripe whose columns share errors along ``lag`` columns."""
    run, sigma_px = peaks.pieces(stripe), stripe.sigma_px.copy()
    for status in (Status.OK, Status.SATURATED):
        kept = stripe.status == status
        if np.count_nonzero(kept) > _FEWEST_DIFFERENCES:
            sigma_px[kept] *= excess(stripe, np.where(kept, run, -1), lag)
    return replace(stripe, sigma_px=sigma_px)


def excess(stripe: Stripe, run: Ints, lag: int) -> float:
    """Scatter of the centres over the one that sigma_px states, at least 1.

    The largest that is seen at the lag or a shorter one: of errors that columns share, short
    lags see less.  At a lag of 1 the noise may be as stated, and an excess within chance, four
    standard deviations of it, counts as none.

    Parameters
    ----------
    stripe : Stripe, px, of N entries
    run : (N,) array, number of the piece each entry belongs to (peaks.py), -1 for none
    lag : int, columns, from which on the centres' errors are independent; lags are left out at
        which the pieces hold fewer than 32 third differences, or less than eight stretches
    """
    chance, ratio = _BEYOND_CHANCE if lag == 1 else 0.0, 0.0
    while lag >= 1:
        at = _in_one_piece(run, lag)
        count = np.count_nonzero(at)
        if count >= max(_FEWEST_DIFFERENCES, _SPANS * lag):
            first, second, third, last = _apart(stripe.sigma_px**2, lag)
            stated = np.sqrt(first + last + 9 * (second + third))[at]
            seen = _third_differences(stripe.centre_px, lag)[at]
            ratio = max(ratio, robust_variance(seen / stated))
            chance *= np.sqrt(2 * _REPEATED / count)
        lag = 3 * lag // 4
    return float(np.sqrt(ratio)) if ratio > 1 + chance else 1.0


def shared_columns(seen: Sequence[SeenLine]) -> list[int]:
    """Columns along which the pixels of each picture share their errors, 1 where each has its own.

    The lag, of 1, 2, 4, 8 and 16, beyond which the third differences of the line's width grow
    no more.  Where that is beyond 1 it is at least three widths of the line, over which some
    extractors smooth along it; it is 1 too where none grows by more than chance, four standard
    deviations of it.

    Parameters
    ----------
    seen : sequence of SeenLine, of one picture each, in which some columns have a value
    """
    scales = [
        peaks.line_width(light, at := _known_columns(one), crest[at]) for one, light, crest in seen
    ]
    widths = _variances(seen, [max(scale, _FINEST_PX) for scale in scales]) if seen else []
    each = zip(seen, widths, scales, strict=True)
    return [_lag(stripe, width, scale) for (stripe, *_), width, scale in each]


def _known_columns(stripe: Stripe) -> Ints:
    return np.flatnonzero(has_value(stripe.status))


def _lag(stripe: Stripe, width: Floats, scale: float) -> int:
    """The same of one picture, from the line's variance (N,) in each of its columns."""
    run = np.where(np.isfinite(width), peaks.pieces(stripe), -1)
    growths: list[float] = []
    by_chance, last = True, np.inf
    for lag in _LAGS:
        values = _third_differences(width, lag)[_in_one_piece(run, lag)]
        if len(values) < _FEWEST_DIFFERENCES:
            continue
        scatter = robust_variance(values)
        growths.append(scatter / max(last, np.finfo(float).tiny))
        if len(growths) == 2 and growths[1] <= _SETTLED:
            return 1
        # Two variances are compared, each of as many values as the second has, or more.
        by_chance &= growths[-1] <= 1 + _BEYOND_CHANCE * np.sqrt(4 * _REPEATED / len(values))
        last = scatter
    if by_chance:
        return 1
    settled = int(np.append(np.array(growths[1:]) <= _SETTLED, True).argmax())
    return max(_LAGS[settled], int(np.ceil(_WIDTHS * scale)))


def _variances(seen: Sequence[SeenLine], scales: Sequence[float]) -> list[Floats]:
    """(N,) the light's variance across the line over scale², NaN where there is no line; of each.

    By moments weighted with a Gaussian of the width ``scale``, in px, about as wide as the line.
    Through it half of a line's displacement is seen, so each step to the line's middle goes twice
    as far as the first moment says; and of the variance w² only s² w² / (s² + w²), which is
    turned back.  Along a column a line of slope t is wider than across itself by (1 + t²)^(1/2).

    A weight about the middle m is that about 0 times exp(m k / s²) at the pixel k, but for a factor
    that all have in common, and so for none: of the weights about 0 powers of a number are left.
    """
    valued = [_known_columns(stripe) for stripe, *_ in seen]
    ends = np.cumsum([len(at) for at in valued])
    centre = np.concatenate([one.centre_px[at] for (one, *_), at in zip(seen, valued, strict=True)])
    row = np.rint(centre).astype(int)
    reach = [int(np.ceil(3 * scale)) + 2 for scale in scales]
    weighted = np.zeros((2 * max(reach) + 1, len(row)))  # (n, K): n is short
    for (_, light, _), at, end, far, scale in zip(seen, valued, ends, reach, scales, strict=True):
        part, beside = slice(end - len(at), end), max(reach) - far
        grey = peaks.windows(light, at, row[part], far).T
        weight = np.exp(-0.5 * (np.arange(-far, far + 1) / scale) ** 2)[:, None]
        ground = grey[[0, 1, -2, -1]].mean(axis=0)
        weighted[beside : len(weighted) - beside, part] = weight * (grey - ground)
    spread = np.repeat(scales, [len(at) for at in valued])
    middle = centre - row
    for _ in range(_STEPS):
        about = middle
        zeroth, first, second = _moments(weighted, np.exp(about / spread**2))
        total = np.where(zeroth > 0, zeroth, np.nan)
        moved = (first / total - about) / spread
        middle = about + spread * np.clip(2 * moved, -1.0, 1.0)
    variance = ((second - 2 * about * first) / total + about**2) / spread**2
    across, places = variance / np.where(variance < 1, 1 - variance, np.nan), row + middle
    found = []
    for (stripe, *_), at, end in zip(seen, valued, ends, strict=True):
        squared, line = np.full((2, len(stripe.status)), np.nan)
        squared[at], line[at] = across[end - len(at) : end], places[end - len(at) : end]
        found.append(squared / (1 + np.gradient(line) ** 2))
    return found


def _moments(weighted: Floats, factor: Floats) -> Floats:
    """(3, K) zeroth to second moments of ``weighted`` (n, K) times ``factor`` (K,) ** step.

    All by one factor more, that of the pixels before the middle one.  Horner's scheme.
    """
    total, reach = np.zeros((3, len(factor))), len(weighted) // 2
    for step in range(reach, -reach - 1, -1):
        total *= factor
        light = weighted[step + reach]
        for moment in total:
            moment += light
            light = light * step
    return total


def _apart(values: NDArray[_Number], lag: int) -> list[NDArray[_Number]]:
    """Four times (Q,) values of (N,), each ``lag`` entries after the one before."""
    count = max(len(values) - 3 * lag, 0)
    return [values[k * lag : k * lag + count] for k in range(4)]


def _in_one_piece(run: Ints, lag: int) -> Mask:
    """(Q,) whether four entries ``lag`` apart are all of the same piece; -1 is none."""
    first, second, third, last = _apart(run, lag)
    return (first >= 0) & (first == second) & (first == third) & (first == last)


def _third_differences(values: Floats, lag: int) -> Floats:
    """(Q,) of values (N,), ``lag`` entries apart."""
    first, second, third, last = _apart(values, lag)
    return first - last + 3 * (third - second)


# From a picture to the stripe in it: the one function that everybody calls.


_Value = TypeVar("_Value", bound=np.generic)


def extract_stripe(
    image: Bytes, settings: StripeSection, background: Bytes | None = None
) -> Stripe:
    """The laser line in ``image``: one entry per column, or per row with ``axis="rows"``.

    The highest value of a column must exceed the column's median by more than
    ``threshold_dn``, after the subtraction; NO_PEAK otherwise.  AT_BORDER: the picture's
    edge cuts the window.  SATURATED: a pixel within ``span_px`` of the centre is clipped in
    ``image`` itself (but not in ``background``); sigma_px grows with the clipped width, unless
    the extractor says SATURATED itself, having allowed for it.  AMBIGUOUS: the column holds
    several lines, and it is not known which is meant.  On a lit target sigma_px grows with the
    contrast of the texture beside the line (edges.py).

    Where the settings do not state the noise, sigma_px is at least what the centres are seen to
    scatter about their neighbours along the line.  Where they do, it grows if the light scatters
    more than that noise makes it.  What they state does not hold in a picture that was compressed
    as JPEG is, and is left out there (picture.py).

    Parameters
    ----------
    image : (H, W) or (H, W, 3) array, uint8, DN, grey or RGB
    settings : StripeSection, channel, axis, extractor, threshold and span; which of several lines
        is meant (``returns``); the camera's blur to be corrected for and the smoothing along the
        line, neither of which is done by default
    background : array, optional, same shape, the same view with the laser off, to be subtracted

    Returns
    -------
    Stripe
        Of W entries (or H), px and DN.

    Raises
    ------
    InputError
        For pictures of another shape or type, for an unknown extractor, and for one that fails or
        gives no stripe of the picture.

    Examples
    --------
    >>> import lscan, numpy as np
    >>> image = np.zeros((9, 3), dtype=np.uint8)
    >>> image[3:6] = [[90], [200], [90]]
    >>> lscan.extract_stripe(image, lscan.StripeSection()).centre_px
    array([4., 4., 4.])
    """
    return extract_stripes([(image, background)], settings)[0]


def extract_stripes(
    shown: Iterable[tuple[Bytes, Bytes | None]], settings: StripeSection
) -> list[Stripe]:
    """The laser lines in several pictures, as :func:`extract_stripe` finds that in each.

    Parameters
    ----------
    shown : iterable of tuple, each picture (array, uint8, DN, grey or RGB), and the same view with
        the laser off or None; one is taken after the other
    settings : StripeSection, as for ``extract_stripe``

    Raises
    ------
    InputError
        As ``extract_stripe``.
    """
    extractor = find_extractor(settings.extractor)
    seen = [_seen_picture(image, settings, background) for image, background in shown]
    stripes = _call_extractor(
        extractor, [(one.chosen.image, one.known, one.chosen.clipped) for one in seen]
    )
    return peaks.batch_by_kind(
        _complete_stripes, list(zip(stripes, seen, strict=True)), lambda found: found[1].kind
    )


class _SeenPicture(NamedTuple):
    """The picture with one line in each column, that with all, and the settings for both."""

    chosen: OneReturn
    light: PictureLines
    known: StripeSection

    @property
    def kind(self) -> tuple[object, ...]:
        """Equal for pictures whose columns can stand side by side."""
        return self.known, self.chosen.image.shape, self.light.white is None


def _seen_picture(image: Bytes, settings: StripeSection, background: Bytes | None) -> _SeenPicture:
    light, known = _light(image, settings, background)
    white = light.white is not None and bool(light.white.any())
    return _SeenPicture(choose_return(light.grey.T, known, light.clipped.T, white), light, known)


def _complete_stripes(found: Sequence[tuple[Stripe, _SeenPicture]]) -> list[Stripe]:
    """The stripes that an extractor found, with all that it does not know of the pictures.

    found: of pictures of one kind.
    """
    found_in = [seen for _, seen in found]
    settings, lights = found_in[0].known, [seen.chosen.image.T for seen in found_in]
    white = [seen.light.white for seen in found_in if seen.light.white is not None]
    made_up = np.concatenate(white) if white else None
    clipped = np.concatenate([seen.chosen.clipped.T for seen in found_in])
    whole = peaks.join_stripes([stripe for stripe, _ in found])
    whole = _mark_saturated(whole, clipped, made_up, settings.span_px)
    whole = withhold(whole, np.concatenate([seen.chosen.ambiguous for seen in found_in]))
    stripes = list(map(_doubt_by_target, peaks.split_stripe(whole, len(found)), found_in))
    crests = [seen.chosen.crest for seen in found_in]
    each = list(zip(stripes, lights, crests, strict=True))
    stripes = at_least_seen(each) if settings.noise is None else beyond_stated(each, settings)
    for place, light in enumerate(lights):
        stripe = correct_blur(stripes[place], settings, light)
        stripes[place] = smooth(stripe, settings.smooth_px)
    whole = peaks.join_stripes(stripes)
    return peaks.split_stripe(replace(whole, flux=peaks.core_flux(whole, *lights)), len(found))


def _doubt_by_target(stripe: Stripe, seen: _SeenPicture) -> Stripe:
    """The stripe with what the target about the line makes doubtful."""
    light, threshold_dn = seen.chosen.image.T, seen.known.threshold_dn
    if seen.chosen.textured:
        stripe = peaks.doubt_beside_edge(stripe, light, seen.light.grey, threshold_dn)
    if seen.light.others is not None:
        stripe = peaks.doubt_beside_edge(stripe, light, seen.light.others, threshold_dn)
    return stripe


def _light(
    image: Bytes, settings: StripeSection, background: Bytes | None
) -> tuple[PictureLines, StripeSection]:
    """The picture's lines less those of the background, and the settings with noise and threshold.

    Clipped are the pixels at the end of the range by the laser's doing.
    """
    check_pair(image, background)
    lit = taken = lines_of(image, settings.channel, settings.axis, where="image")
    if settings.gamma != 1:
        # Coding and the end of the range show in the grey values as the camera gave them.
        image, end = (
            linear_picture(image, settings.gamma),
            linear_dn(settings.gamma)[lit.clipping_dn],
        )
        lit = lines_of(image, settings.channel, settings.axis, "image", int(end))
    if settings.channel == "auto" and lit.others is not None:
        coloured = lit.grey if lit.white is None else np.where(lit.white, 0, lit.grey)
        threshold_dn = min(settings.threshold_dn, faint_threshold(coloured))
        settings = settings.model_copy(update={"threshold_dn": threshold_dn})
    if settings.noise is not None and is_coded(taken.grey):
        settings = settings.model_copy(update={"noise": None})
    taken_off: list[GreyValues] = [] if lit.others is None else [lit.others]
    if background is not None:
        background = linear_picture(background, settings.gamma)
        dark = lines_of(background, lit.channel, settings.axis, "background", lit.clipping_dn)
        taken_off.append(dark.grey)
        grey, clipped = lit.grey.astype(np.int16) - dark.grey, lit.clipped & ~dark.clipped
        # The target's edges, which shift the laser's light too, show in the background alone.
        others = dark.grey if lit.others is None else lit.others
        lit = replace(lit, grey=grey, clipped=clipped, others=others)
    for other in taken_off:
        if settings.noise is not None:
            both = difference_noise(settings.noise, float(other.mean()))
            settings = settings.model_copy(update={"noise": both})
    return lit, settings


def _call_extractor(extractor: Extractor, pictures: Sequence[Picture]) -> list[Stripe]:
    """What the extractor says, with the axis set; InputError where it is no extractor.

    An extractor may come from another package: it cannot write into the picture, and its result
    is validated.
    """
    settings = pictures[0][1]
    where, whole = f"extractor {settings.extractor}", takes_integers(extractor)
    given = [
        (_read_only(image if whole else image.astype(np.float64)), known, _read_only(clipped))
        for image, known, clipped in pictures
    ]
    try:
        stripes = stripes_by(extractor, given)
    except LscanError:
        raise
    except Exception as error:
        if isinstance(error, TypeError) and not frames_of_others(error):
            raise InputError(f"cannot be called as an extractor: {error}", where=where) from error
        raise InputError(f"failed: {foreign_error(error)}", where=where) from error
    for stripe, (image, *_) in zip(stripes, pictures, strict=True):
        require_stripe(stripe, image.shape, where)
    return [replace(stripe, axis=settings.axis) for stripe in stripes]


def _read_only(picture: NDArray[_Value]) -> NDArray[_Value]:
    view = picture.view()
    view.flags.writeable = False
    return view


@lru_cache(maxsize=32)
def find_extractor(name: str) -> Extractor:
    """The extractor of a name.

    Parameters
    ----------
    name : str, as registered under ``lscan.extractors``, or ``package.module:function``

    Raises
    ------
    InputError
        Where there is none.
    """
    where = "stripe.extractor"
    return cast(Extractor, find_plugin_or_function("lscan.extractors", name, where))


def _mark_saturated(stripe: Stripe, clipped: Mask, white: Mask | None, span_px: int) -> Stripe:
    """The stripe with its clipped entries SATURATED and their sigma_px enlarged.

    clipped: (N, L) pixels that the laser drove to the end of the camera's range.  Where
    several are, the crest lies somewhere between the first and the last: a uniform
    distribution as wide as they are apart, the whole column considered.  An extractor that
    gave an entry as SATURATED has allowed for that itself, but not for white crests (N, L), whose
    light is made up.
    """
    at = peaks.clipped_near(stripe, clipped, span_px)
    if len(at) == 0:
        return stripe
    made_up = at[:0] if white is None else peaks.clipped_near(stripe, white, span_px)
    at = at[(stripe.status[at] == Status.OK) | np.isin(at, made_up)]
    status, sigma_px = stripe.status.copy(), stripe.sigma_px.copy()
    status[at] = Status.SATURATED
    sigma_px[at] = np.hypot(sigma_px[at], _extent(clipped[at]) / np.sqrt(12))
    return replace(stripe, status=status, sigma_px=sigma_px)


def _extent(clipped: Mask) -> Floats:
    """Distance in px between the first and the last pixel set in each row of (K, L)."""
    last = clipped.shape[1] - 1 - clipped[:, ::-1].argmax(axis=1)
    return (last - clipped.argmax(axis=1)).astype(float)


# The line in a part of the picture, and the two lines of a scanner with two lasers.


SAME_PX = 1.0  # two lines nearer to each other are one, found twice


def extract_within(
    image: Bytes, settings: StripeSection, keep: Mask, background: Bytes | None = None
) -> Stripe:
    """The laser line in a part of the picture; elsewhere the entries say NO_DATA.

    The picture is cropped to the part.  Within the crop, what does not belong to the part is cut
    off at the median of its column (or row) in the part, so that nothing stands out there.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) array, uint8, DN, grey or RGB
    settings : StripeSection, as for ``extract_stripe``
    keep : (H, W) mask, of the pixels in which the line may lie
    background : array, optional, same shape as the image, the same view with the laser off

    Returns
    -------
    Stripe
        Of the whole picture's W entries (or H), px and DN.

    Raises
    ------
    InputError
        Where no pixel is kept, for a mask of another shape or type, or as ``extract_stripe``.

    Examples
    --------
    >>> import lscan, numpy as np
    >>> image = np.zeros((20, 4), dtype=np.uint8)
    >>> image[3:6], image[12:15] = 250, 90
    >>> keep = np.zeros((20, 4), dtype=bool)
    >>> keep[8:, 1:] = True
    >>> extract_within(image, lscan.StripeSection(), keep).centre_px.round(3)
    array([nan, 13., 13., 13.])
    """
    check_pair(image, background)
    where = "part of the picture"
    if keep.dtype != np.bool_ or keep.shape != image.shape[:2]:
        mask, allowed = f"{keep.dtype} {keep.shape}", f"bool {image.shape[:2]}"
        raise InputError("is no mask of the picture", where=where, value=mask, allowed=allowed)
    if not keep.any():
        raise InputError("leaves no pixel of the picture", where=where)
    rows, columns = (np.flatnonzero(keep.any(axis=axis)) for axis in (1, 0))
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    inside, axis = keep[box], settings.axis
    dark = None if background is None else _cut_off(background[box], inside, axis)
    found = extract_stripe(_cut_off(image[box], inside, axis), settings, dark)
    across, along = (rows[0], columns[0]) if axis == "columns" else (columns[0], rows[0])
    whole = image.shape[1] if axis == "columns" else image.shape[0]
    return _stripe_in_picture(_only(found, inside), int(along), float(across), whole)


def told_apart(first: Stripe, last: Stripe) -> tuple[Stripe, Stripe]:
    """The two lines of a scanner with two lasers, from the first and the last line of each column.

    Where they are the same line, nothing tells which of the two it is: AMBIGUOUS.

    Parameters
    ----------
    first, last : Stripe, px, of one picture, with ``returns`` "first" and "last"

    Returns
    -------
    tuple of Stripe
        The upper line and the lower (for rows: the left and the right).
    """
    same = np.abs(first.centre_px - last.centre_px) <= SAME_PX  # False where either is NaN
    return withhold(first, same), withhold(last, same)


def _cut_off(image: Bytes, keep: Mask, axis: Axis) -> Bytes:
    """The picture, at most as bright beyond the part as each column's median within it."""
    if keep.all():
        return image
    across = 0 if axis == "columns" else 1
    inside = keep if image.ndim == 2 else np.repeat(keep[:, :, None], 3, axis=2)
    # Of a masked array: a column of which nothing is kept has the median 0.
    level = np.ma.median(np.ma.array(image, mask=~inside), axis=across, keepdims=True).filled(0)
    cut = np.minimum(image, level.astype(np.uint8))
    return np.where(inside, image, cut)


def _only(stripe: Stripe, keep: Mask) -> Stripe:
    """The stripe with NO_PEAK where its centre lies beyond the part."""
    at = np.flatnonzero(has_value(stripe.status))
    u, v = np.rint(stripe.image_px[at]).astype(int).T
    height, width = keep.shape
    outside = np.zeros(len(stripe.status), dtype=bool)
    outside[at] = ~keep[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)]
    return withhold(stripe, outside, Status.NO_PEAK)


def _stripe_in_picture(stripe: Stripe, along: int, across: float, whole: int) -> Stripe:
    """The stripe of a crop as one of the whole picture.

    along, across: px, where the crop begins.  whole: entries of the whole picture.
    """

    placed: dict[str, Any] = {}
    for name, values in vars(replace(stripe, centre_px=stripe.centre_px + across)).items():
        if isinstance(values, np.ndarray):
            nothing = int(Status.NO_DATA) if name == "status" else np.nan
            placed[name] = np.full(whole, nothing)
            placed[name][along : along + len(values)] = values
    return replace(stripe, **placed)


# The line of one picture as a table.


def save_stripe(path: Path, stripe: Stripe, points: PlanePoints | None = None) -> None:
    """Write the stripe as CSV: one row a column (or row), empty fields where there is no line.

    Parameters
    ----------
    path : Path, of the file
    stripe : Stripe, px and DN, of N entries
    points : PlanePoints, optional, mm, the N points in the laser sheet: five columns more

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    along = "column" if stripe.axis == "columns" else "row"
    heading = f"{along},centre_px,sigma_px,peak_dn,status"
    numbers = np.column_stack([stripe.centre_px, stripe.sigma_px, stripe.peak])
    table = [
        f"{index},{_fields(row)},{Status(status).name}"
        for index, (row, status) in enumerate(zip(numbers, stripe.status, strict=True))
    ]
    if points is not None:
        heading += ",x_mm,z_mm,sigma_x_mm,sigma_z_mm,status_mm"
        in_mm = np.hstack([points.xz_mm, points.sigma_mm])
        table = [
            f"{line},{_fields(row)},{Status(status).name}"
            for line, row, status in zip(table, in_mm, points.status, strict=True)
        ]
    write_atomically(path, ("\n".join([heading, *table]) + "\n").encode())


def _fields(values: np.ndarray) -> str:
    return ",".join("" if np.isnan(value) else repr(float(value)) for value in values)


# Pictures of what an extractor found.


_COLOUR = {
    Status.OK: (0, 255, 0),
    Status.SATURATED: (255, 200, 0),
    Status.AT_BORDER: (255, 0, 255),
    Status.NO_PEAK: (90, 90, 90),
}
_OTHER_COLOUR = (0, 160, 255)
_COLOURS = np.array([_COLOUR.get(code, _OTHER_COLOUR) for code in Status], dtype=np.uint8)
_EDGE_PX = 4


def draw_stripe(image: Bytes, stripe: Stripe) -> Bytes:
    """A copy of ``image`` as (H, W, 3) RGB with the stripe drawn over it.

    The pixel nearest each centre is green, or amber where the line is clipped.  A band of 4
    pixels along the top (for rows: left) edge shows the status of every entry: grey for
    NO_PEAK, magenta for AT_BORDER, blue for any other.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) array, uint8, DN, grey or RGB, the picture the stripe was found in
    stripe : Stripe, px

    Raises
    ------
    InputError
        Where the picture is none or the stripe is not of its size.
    """
    check_picture(image, where="image")
    canvas = np.dstack([image] * 3) if image.ndim == 2 else image.copy()
    # A view with one row per entry of the stripe: what is painted there is in the picture.
    lines = canvas.transpose(1, 0, 2) if stripe.axis == "columns" else canvas
    if len(stripe.status) != len(lines):
        what, allowed = "stripe is not of the picture's size", f"{len(lines)} {stripe.axis}"
        raise InputError(what, where="draw_stripe", value=len(stripe.status), allowed=allowed)
    colours = _COLOURS[stripe.status]
    lines[:, :_EDGE_PX] = colours[:, None]
    valued = np.flatnonzero(has_value(stripe.status))
    nearest = np.rint(stripe.centre_px[valued]).astype(int)
    lines[valued, np.clip(nearest, 0, lines.shape[1] - 1)] = colours[valued]
    return canvas
