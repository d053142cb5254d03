"""From a picture to the stripe in it: the one function that everybody calls."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from lscan.config.plugins import find_plugin_or_function, frames_of_others, raised
from lscan.config.rig import StripeSection
from lscan.errors import InputError, LscanError
from lscan.records import Bytes, Floats, GreyValues, Mask, Status, Stripe
from lscan.stripe.api import Extractor, Picture, require_stripe, stripes_by, takes_integers
from lscan.stripe.core import core_flux
from lscan.stripe.corrections.blur import correct_blur
from lscan.stripe.corrections.smoothing import smooth
from lscan.stripe.edges import doubted
from lscan.stripe.lines import PictureLines, check_pair, faint_threshold, lines_of
from lscan.stripe.noise.along import at_least_seen
from lscan.stripe.noise.coding import is_coded
from lscan.stripe.noise.model import difference_noise
from lscan.stripe.peaks import clipped_near
from lscan.stripe.returns import OneReturn, choose_return, withhold
from lscan.stripe.sidebyside import in_one, joined, parted

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
    scatter about their neighbours along the line (noise/along.py).  What they state does not hold
    in a picture that was compressed as JPEG is, and is left out there (noise/coding.py).

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
    seen = [_seen(image, settings, background) for image, background in shown]
    stripes = _called(
        extractor, [(one.chosen.image, one.known, one.chosen.clipped) for one in seen]
    )
    return in_one(_finished, list(zip(stripes, seen, strict=True)), lambda found: found[1].kind)


class _SeenPicture(NamedTuple):
    """The picture with one line in each column, that with all, and the settings for both."""

    chosen: OneReturn
    light: PictureLines
    known: StripeSection

    @property
    def kind(self) -> tuple[object, ...]:
        """Equal for pictures whose columns can stand side by side."""
        return self.known, self.chosen.image.shape, self.light.white is None


def _seen(image: Bytes, settings: StripeSection, background: Bytes | None) -> _SeenPicture:
    light, known = _light(image, settings, background)
    white = light.white is not None and bool(light.white.any())
    return _SeenPicture(choose_return(light.grey.T, known, light.clipped.T, white), light, known)


def _finished(found: Sequence[tuple[Stripe, _SeenPicture]]) -> list[Stripe]:
    """The stripes that an extractor found, with all that it does not know of the pictures.

    found: of pictures of one kind.
    """
    found_in = [seen for _, seen in found]
    settings, lights = found_in[0].known, [seen.chosen.image.T for seen in found_in]
    white = [seen.light.white for seen in found_in if seen.light.white is not None]
    made_up = np.concatenate(white) if white else None
    clipped = np.concatenate([seen.chosen.clipped.T for seen in found_in])
    whole = joined([stripe for stripe, _ in found])
    whole = _mark_saturated(whole, clipped, made_up, settings.span_px)
    whole = withhold(whole, np.concatenate([seen.chosen.ambiguous for seen in found_in]))
    stripes = list(map(_by_target, parted(whole, len(found)), found_in))
    if settings.noise is None:
        crests = [seen.chosen.crest for seen in found_in]
        stripes = at_least_seen(list(zip(stripes, lights, crests, strict=True)))
    for place, light in enumerate(lights):
        stripe = correct_blur(stripes[place], settings, light)
        stripes[place] = smooth(stripe, settings.smooth_px)
    whole = joined(stripes)
    return parted(replace(whole, flux=core_flux(whole, *lights)), len(found))


def _by_target(stripe: Stripe, seen: _SeenPicture) -> Stripe:
    """The stripe with what the target about the line makes doubtful."""
    light, threshold_dn = seen.chosen.image.T, seen.known.threshold_dn
    if seen.chosen.textured:
        stripe = doubted(stripe, light, seen.light.grey, threshold_dn)
    if seen.light.others is not None:
        stripe = doubted(stripe, light, seen.light.others, threshold_dn)
    return stripe


def _light(
    image: Bytes, settings: StripeSection, background: Bytes | None
) -> tuple[PictureLines, StripeSection]:
    """The picture's lines less those of the background, and the settings with noise and threshold.

    Clipped are the pixels at the end of the range by the laser's doing.
    """
    check_pair(image, background)
    lit = lines_of(image, settings.channel, settings.axis, where="image")
    if settings.channel == "auto" and lit.others is not None:
        coloured = lit.grey if lit.white is None else np.where(lit.white, 0, lit.grey)
        threshold_dn = min(settings.threshold_dn, faint_threshold(coloured))
        settings = settings.model_copy(update={"threshold_dn": threshold_dn})
    if settings.noise is not None and is_coded(lit.grey):
        settings = settings.model_copy(update={"noise": None})
    taken_off: list[GreyValues] = [] if lit.others is None else [lit.others]
    if background is not None:
        dark = lines_of(background, lit.channel, settings.axis, "background", lit.clipping_dn)
        taken_off.append(dark.grey)
        grey, clipped = lit.grey.astype(np.int16) - dark.grey, lit.clipped & ~dark.clipped
        lit = replace(lit, grey=grey, clipped=clipped)
    for other in taken_off:
        if settings.noise is not None:
            both = difference_noise(settings.noise, float(other.mean()))
            settings = settings.model_copy(update={"noise": both})
    return lit, settings


def _called(extractor: Extractor, pictures: Sequence[Picture]) -> list[Stripe]:
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
        raise InputError(f"failed: {raised(error)}", where=where) from error
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
    at = clipped_near(stripe, clipped, span_px)
    if len(at) == 0:
        return stripe
    made_up = at[:0] if white is None else clipped_near(stripe, white, span_px)
    at = at[(stripe.status[at] == Status.OK) | np.isin(at, made_up)]
    status, sigma_px = stripe.status.copy(), stripe.sigma_px.copy()
    status[at] = Status.SATURATED
    sigma_px[at] = np.hypot(sigma_px[at], _extent(clipped[at]) / np.sqrt(12))
    return replace(stripe, status=status, sigma_px=sigma_px)


def _extent(clipped: Mask) -> Floats:
    """Distance in px between the first and the last pixel set in each row of (K, L)."""
    last = clipped.shape[1] - 1 - clipped[:, ::-1].argmax(axis=1)
    return (last - clipped.argmax(axis=1)).astype(float)
