"""What is measured of one picture for the live page."""

from dataclasses import dataclass, replace

import numpy as np

from lscan.config.rig import StripeSection
from lscan.live.maptable import LiveProfile, MapTable
from lscan.records import Bytes, Floats, GreyValues, Ints, Stripe, has_value
from lscan.stripe import extract_stripe
from lscan.stripe.noise import constant_variance
from lscan.stripe.peaks import crests, line_width
from lscan.stripe.picture import PictureLines, lines_of

FULL_WIDTH = 2 * np.sqrt(2 * np.log(2))
"""Full width at half height of a Gaussian of unit standard deviation."""

FOCUS_REACH_PX = 24
"""Pixels to either side of the line that its sharpness is measured over."""

BAND_PX = 48
"""Pixels kept to either side of the line: several times its width, so that a column's median
is still that of its background."""

LEAST_LIGHT = 5.0
"""Standard deviations by which the energy of the light must exceed that of the noise."""


@dataclass(frozen=True)
class StripeFigures:
    """The line in one picture.

    width_px: full width at half height of its columns laid over each other; snr: median of
    its peaks over the standard deviation of a dark pixel; slope: px across it for each px along
    it, as :func:`slope_of`.  None where there is no line.
    """

    stripe: Stripe
    width_px: float | None
    snr: float | None
    slope: float | None = None


@dataclass(frozen=True)
class Figures:
    """One picture measured.

    saturated_percent: pixels of the stripe's channel at the end of the camera's range.
    focus: as :func:`sharpness`.  line: None in board mode.  profile: None without a map.
    """

    saturated_percent: float
    focus: float
    line: StripeFigures | None
    profile: LiveProfile | None


def measure_line(image: Bytes, settings: StripeSection, table: MapTable | None) -> Figures:
    """The line, the profile and the figures of one picture, (H, W) or (H, W, 3) RGB uint8.

    All but saturation and noise is taken from the band of the picture that holds the line, which is
    quicker; a column's background is then the band's, not the whole column's.
    Raises InputError for another shape or type and for an extractor that cannot be used.
    """
    whole = lines_of(image, settings.channel, settings.axis)
    band = band_of_line(whole.grey, settings.threshold_dn)
    part = image[band] if settings.axis == "columns" else image[:, band]
    stripe = extract_stripe(part, settings)
    grey, at = whole.grey[:, band], np.flatnonzero(has_value(stripe.status))
    variance = constant_variance(whole.grey)
    focus = sharpness(_light_about(grey, stripe.centre_px[at], at), variance)
    line = StripeFigures(
        stripe=replace(stripe, centre_px=stripe.centre_px + band.start),
        width_px=FULL_WIDTH * line_width(grey, at, crests(grey)[at]) if len(at) else None,
        snr=float(np.median(stripe.peak[at]) / np.sqrt(variance)) if len(at) else None,
        slope=slope_of(stripe.centre_px),
    )
    profile = None if table is None else table.profile(line.stripe)
    return Figures(_saturated_percent(whole), focus, line, profile)


def band_of_line(grey: GreyValues, threshold_dn: float) -> slice:
    """The part of the lines (N, L) within BAND_PX of any pixel above the threshold.

    As an extractor does, the median of each line is taken for its background, here that of
    every eighth pixel.  All of it where nothing is above.
    """
    ground = np.median(grey[:, ::8], axis=1, keepdims=True)
    bright = np.flatnonzero((grey > ground + threshold_dn).any(axis=0))
    if len(bright) == 0:
        return slice(0, grey.shape[1])
    return slice(max(int(bright[0]) - BAND_PX, 0), min(int(bright[-1]) + BAND_PX, grey.shape[1]))


def measure_picture(image: Bytes, settings: StripeSection) -> Figures:
    """Saturation and focus of a picture without a line, such as the board's."""
    lines = lines_of(image, settings.channel, settings.axis)
    grey = lines.grey.astype(np.float64)
    focus = sharpness(grey - grey.mean(), constant_variance(grey))
    return Figures(_saturated_percent(lines), focus, None, None)


def sharpness(light: Floats, variance: float) -> float:
    """How sharp a picture is: the energy of its gradient over that of its light, in 1000/px².

    light: (N, L) in DN above the ground, differences taken along the last axis.  variance: of
    the noise of a pixel, DN², whose part in both energies is taken off.  0 where the light
    does not exceed the noise.

    The energy of the image gradient is one of the measures of Subbarao, Choi and Nikzad,
    "Focusing techniques", Opt. Eng. 32 (1993) 2824; over the energy of the light it does not
    change with exposure.  A Gaussian line of standard deviation s px has
    2000 (1 - exp(-1 / (4 s²))), about 500 / s².
    """
    if light.size == 0:
        return 0.0
    steps = np.diff(light, axis=-1)
    energy = float(np.vdot(light, light)) - light.size * variance
    if energy <= LEAST_LIGHT * variance * np.sqrt(2 * light.size):
        return 0.0
    rough = float(np.vdot(steps, steps)) - 2 * steps.size * variance
    return 1000 * max(rough, 0.0) / energy


def slope_of(centre_px: Floats) -> float | None:
    """Slope of the straight line through centres (N,), one a column, NaN where there is none.

    The median slope of the pairs of columns half the picture apart: a quarter of the columns
    may hold something else (Sen, "Estimates of the regression coefficient based on Kendall's
    tau", J. Am. Stat. Assoc. 63 (1968) 1379, on fewer pairs).  None where there is no pair.
    """
    apart = len(centre_px) // 2
    rises = centre_px[apart:] - centre_px[: len(centre_px) - apart]
    known = rises[np.isfinite(rises)]
    return float(np.median(known) / apart) if len(known) and apart else None


def _saturated_percent(lines: PictureLines) -> float:
    return 100 * float(lines.clipped.mean())


def _light_about(grey: GreyValues, centre_px: Floats, at: Ints) -> Floats:
    """(K, L) DN above the column's median, about the line's centres (K,) in the columns ``at``."""
    middle = np.rint(centre_px).astype(np.int64)[:, None]
    rows = middle + np.arange(-FOCUS_REACH_PX, FOCUS_REACH_PX + 1)
    window = grey[at[:, None], np.clip(rows, 0, grey.shape[1] - 1)].astype(np.float64)
    return window - np.median(grey[at], axis=1, keepdims=True)
