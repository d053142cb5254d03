"""The line in a part of the picture, and the two lines of a scanner with two lasers."""

from dataclasses import replace
from typing import Any

import numpy as np

from lscan.config.rig import StripeSection
from lscan.errors import InputError
from lscan.records import Axis, Bytes, Mask, Status, Stripe, has_value
from lscan.stripe.extract import extract_stripe
from lscan.stripe.lines import check_pair
from lscan.stripe.returns import withhold

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
    >>> extract_within(image, lscan.StripeSection(), keep).centre_px
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
    return _placed(_only(found, inside), int(along), float(across), whole)


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


def _placed(stripe: Stripe, along: int, across: float, whole: int) -> Stripe:
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
