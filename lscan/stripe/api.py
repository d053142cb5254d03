"""What a stripe extractor is, and the one way to call it."""

from __future__ import annotations

from typing import Protocol

from lscan.records import Floats, Mask, Stripe
from lscan.rig import StripeSection


class Extractor(Protocol):
    """Finds the line's centre in each column of a grey picture.

    Registered under the entry-point group ``lscan.extractors``, or named in the rig file as
    ``package.module:function``.
    """

    def __call__(self, image: Floats, settings: StripeSection, clipped: Mask) -> Stripe:
        """The line across the columns of ``image``, (H, W) grey values in DN.

        Values may be negative where a background picture has been subtracted.
        clipped: (H, W), the pixels that the laser drove to the end of the camera's range:
        they may have seen any amount of light from their grey value upwards.
        ``image.T`` and ``clipped.T`` are contiguous in memory.

        An extractor gives a column without a line NaN and NO_PEAK (or AT_BORDER), every
        other one OK or, where it has allowed for clipped pixels in its own sigma_px,
        SATURATED; ``extract_stripe`` marks the clipped ones that are OK, and enlarges theirs.
        Always works along columns; ``extract_stripe`` turns pictures whose line runs down.
        """
        ...
