"""What a stripe extractor is, and the one way to call it."""

from typing import Any, Protocol

import numpy as np

from lscan.config.rig import StripeSection
from lscan.errors import InputError
from lscan.records import Floats, Mask, Status, Stripe, has_value

_MARK, _SMOOTHS = "takes_integers", "smooths_along"
_GIVEN = (Status.OK, Status.SATURATED, Status.NO_PEAK, Status.AT_BORDER, Status.AMBIGUOUS)
_CODES = np.array([[code] for code in _GIVEN])


class Extractor(Protocol):
    """Finds the line's centre in each column of a grey picture.

    Registered under the entry-point group ``lscan.extractors``, or named in the rig file as
    ``package.module:function``.  Several threads may call it at once, each with a picture.

    Examples
    --------
    >>> import lscan, numpy as np
    >>> from lscan.stripe import find_extractor
    >>> image = np.zeros((9, 3))
    >>> image[4] = 200.0
    >>> find_extractor("centroid")(image, lscan.StripeSection(), image > 254).centre_px
    array([4., 4., 4.])
    """

    def __call__(self, image: Floats, settings: StripeSection, clipped: Mask) -> Stripe:
        """The line across the columns of a picture.

        An extractor gives a column without a line NaN and NO_PEAK (or AT_BORDER), every other one
        OK or, where it has allowed for clipped pixels in its own sigma_px, SATURATED;
        ``extract_stripe`` marks the clipped ones that are OK, and enlarges theirs.  It always works
        along columns; ``extract_stripe`` turns pictures whose line runs down.

        Parameters
        ----------
        image : (H, W) array, DN, grey values; negative ones where a background has been subtracted.
            ``image.T`` and ``clipped.T`` are contiguous in memory.
        settings : StripeSection, of the rig file; an extractor uses what it needs of it
        clipped : (H, W) mask, the pixels that the laser drove to the end of the camera's range:
            they may have seen any amount of light from their grey value upwards

        Returns
        -------
        Stripe
            Of W entries, px and DN; its axis is not used.
        """
        ...


def on_integers(extractor: Extractor) -> Extractor:
    """Mark an extractor that takes a camera's grey values as they come, which is quicker.

    Others are given floats: in these no sum and no difference of grey values overflows.

    Parameters
    ----------
    extractor : Extractor, for whose picture uint8 and int16 will do as well as floats

    Examples
    --------
    >>> from lscan.stripe import find_extractor
    >>> takes_integers(find_extractor("centroid"))
    True
    """
    setattr(extractor, _MARK, True)
    return extractor


def takes_integers(extractor: Extractor) -> bool:
    """Whether an extractor is marked by :func:`on_integers`.

    Parameters
    ----------
    extractor : Extractor, any
    """
    return bool(getattr(extractor, _MARK, False))


def along_the_line(extractor: Extractor) -> Extractor:
    """Mark an extractor that reads a column's centre from its neighbours' light too.

    How its centres scatter from one column to the next says little of their errors then.

    Parameters
    ----------
    extractor : Extractor, any
    """
    setattr(extractor, _SMOOTHS, True)
    return extractor


def smooths_along(extractor: Extractor) -> bool:
    """Whether an extractor is marked by :func:`along_the_line`.

    Parameters
    ----------
    extractor : Extractor, any
    """
    return bool(getattr(extractor, _SMOOTHS, False))


def require_stripe(stripe: Any, shape: tuple[int, ...], where: str) -> None:
    """Refuse what is not a stripe of a picture, as Extractor promises it.

    Parameters
    ----------
    stripe : object, what an extractor gave
    shape : tuple of int, (H, W) of the picture, px
    where : str, how the message names the extractor

    Raises
    ------
    InputError
        Names ``where``, the first column at fault and its value.
    """
    if not isinstance(stripe, Stripe):
        raise InputError("gave no Stripe", where=where, value=type(stripe).__name__)
    height, width = shape
    for name in ("centre_px", "sigma_px", "peak", "status"):
        values = getattr(stripe, name)
        if not isinstance(values, np.ndarray):
            found = type(values).__name__
            raise InputError(f"gave no array as {name}", where=where, value=found)
        if values.shape != (width,):
            raise InputError(
                "gave a stripe of the wrong length",
                where=f"{where}: {name}",
                value=len(values) if values.ndim == 1 else values.shape,
                allowed=str(width),
            )
    unknown = ~(stripe.status == _CODES).any(axis=0)
    names = ", ".join(f"{status:d} {status.name}" for status in _GIVEN)
    _refuse(where, "status", stripe.status, unknown, names)
    valued = has_value(stripe.status)
    inside = (stripe.centre_px >= -0.5) & (stripe.centre_px <= height - 0.5)
    _refuse(where, "centre_px", stripe.centre_px, valued & ~inside, f"-0.5 to {height - 0.5}")
    sure = (stripe.sigma_px > 0) & np.isfinite(stripe.sigma_px)
    _refuse(where, "sigma_px", stripe.sigma_px, valued & ~sure, "finite, above 0")


def _refuse(where: str, name: str, values: Any, wrong: Mask, allowed: str) -> None:
    """InputError for the first column that is wrong, if one is."""
    if wrong.any():
        column = int(wrong.argmax())
        what = f"gave a bad {name} in column {column}"
        raise InputError(what, where=where, value=values[column].item(), allowed=allowed)
