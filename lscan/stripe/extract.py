"""From a picture to the stripe in it: the one function that everybody calls."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from importlib import import_module
from typing import cast

import numpy as np

from lscan.errors import InputError
from lscan.records import Bytes, Floats, Mask, Status, Stripe, has_value
from lscan.rig import StripeSection, find_plugin
from lscan.stripe.api import Extractor
from lscan.stripe.lines import lines_of


def extract_stripe(
    image: Bytes, settings: StripeSection, background: Bytes | None = None
) -> Stripe:
    """The laser line in ``image``: one entry per column, or per row with ``axis="rows"``.

    image: (H, W) grey or (H, W, 3) RGB uint8, in DN.
    settings: channel, axis, extractor, threshold and span.
    background: the same view with the laser off, same shape; subtracted where given.

    The highest value of a column must exceed the column's median by more than
    ``threshold_dn``, after the subtraction; NO_PEAK otherwise.  AT_BORDER: the picture's
    edge cuts the window.  SATURATED: a pixel within ``span_px`` of the centre is clipped in
    ``image`` itself (but not in ``background``); sigma_px grows with the clipped width.

    Raises InputError for pictures of another shape or type and for an unknown extractor.
    """
    extractor = find_extractor(settings.extractor)
    lit = lines_of(image, settings.channel, settings.axis, where="image")
    grey, clipped = lit.grey.astype(float), lit.clipped
    if background is not None:
        if background.shape != image.shape:
            raise InputError(
                "is not of the picture's shape",
                where="background",
                value=background.shape,
                allowed=str(image.shape),
            )
        dark = lines_of(background, settings.channel, settings.axis, where="background")
        grey -= dark.grey
        clipped &= ~dark.clipped
    stripe = _called(extractor, settings, grey.T)
    if len(stripe.centre_px) != len(grey):
        raise InputError(
            "gave a stripe of the wrong length",
            where=f"extractor {settings.extractor}",
            value=len(stripe.centre_px),
            allowed=str(len(grey)),
        )
    return _mark_saturated(stripe, clipped, settings.span_px)


def _called(extractor: Extractor, settings: StripeSection, columns: Floats) -> Stripe:
    """What the extractor says, with the axis set; InputError where it is no extractor."""
    where = f"extractor {settings.extractor}"
    try:
        stripe = extractor(columns, settings)
    except TypeError as error:
        raise InputError(f"cannot be called as an extractor: {error}", where=where) from error
    if not isinstance(stripe, Stripe):
        raise InputError("gave no Stripe", where=where, value=type(stripe).__name__)
    return replace(stripe, axis=settings.axis)


@lru_cache(maxsize=32)
def find_extractor(name: str) -> Extractor:
    """The extractor registered under ``name``, or the function ``package.module:function``.

    Raises InputError where there is none.
    """
    if ":" not in name:
        return cast(Extractor, find_plugin("lscan.extractors", name, where="stripe.extractor"))
    module, _, function = name.partition(":")
    try:
        found = getattr(import_module(module), function)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise InputError(
            "no such extractor",
            where="stripe.extractor",
            value=name,
            allowed=f"a name that can be imported: {error}",
        ) from error
    if not callable(found):
        raise InputError(
            "no such extractor", where="stripe.extractor", value=name, allowed="a function"
        )
    return cast(Extractor, found)


def _mark_saturated(stripe: Stripe, clipped: Mask, span_px: int) -> Stripe:
    """The stripe with its clipped entries SATURATED and their sigma_px enlarged.

    clipped: (N, L) pixels that the laser drove to the end of the camera's range.  Where
    several are, the crest lies somewhere between the first and the last: a uniform
    distribution as wide as they are apart, the whole column considered.
    """
    valued = np.flatnonzero(has_value(stripe.status))
    middle = np.rint(stripe.centre_px[valued]).astype(int)[:, None]
    window = np.clip(middle + np.arange(-span_px, span_px + 1), 0, clipped.shape[1] - 1)
    at = valued[clipped[valued[:, None], window].any(axis=1)]
    status, sigma_px = stripe.status.copy(), stripe.sigma_px.copy()
    status[at] = Status.SATURATED
    sigma_px[at] = np.hypot(sigma_px[at], _extent(clipped[at]) / np.sqrt(12))
    return replace(stripe, status=status, sigma_px=sigma_px)


def _extent(clipped: Mask) -> Floats:
    """Distance in px between the first and the last pixel set in each row of (K, L)."""
    last = clipped.shape[1] - 1 - clipped[:, ::-1].argmax(axis=1)
    return (last - clipped.argmax(axis=1)).astype(float)
