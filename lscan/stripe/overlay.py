"""Pictures of what an extractor found."""

import numpy as np

from lscan.errors import InputError
from lscan.records import Bytes, Status, Stripe, has_value
from lscan.stripe.lines import check_picture

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
        raise InputError(
            "stripe is not of the picture's size",
            where="draw_stripe",
            value=len(stripe.status),
            allowed=f"{len(lines)} {stripe.axis}",
        )
    colours = _COLOURS[stripe.status]
    lines[:, :_EDGE_PX] = colours[:, None]
    valued = np.flatnonzero(has_value(stripe.status))
    nearest = np.rint(stripe.centre_px[valued]).astype(int)
    lines[valued, np.clip(nearest, 0, lines.shape[1] - 1)] = colours[valued]
    return canvas
