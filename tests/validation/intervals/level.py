"""Lines nearly parallel to the rows: what all their columns err by alike."""

from itertools import product
from typing import Any

import numpy as np

from lscan.config.plugins import installed
from lscan.config.rig import StripeSection
from lscan.records import Bytes, Floats, Stripe, has_value
from lscan.stripe import extract_stripe
from lscan.stripe.peaks import FWHM
from sim.sensor.webcam import ColourFilter
from tests.support.lines_drawn import drawn
from tests.validation.exposures import band_miss_percent, share_inside
from tests.validation.rows import Row, row

HEIGHT, WIDTH = 80, 800
EVERY = 4  # columns: so far apart they share no light behind a mosaic
SLOPE = 0.3 / 640
MONO = "mono"
WIDTHS_PX = {MONO: (0.45, 0.7, 1.1, 2.0, 4.0), "RGGB": (1.1, 2.0, 4.0), "GBRG": (1.1, 2.0, 4.0)}
NOISE_DN = (0.9, 3.0)
PER_DN = 0.017  # a full well of 15,000 electrons
LIGHT_DN, DARK_DN = 150.0, 8.0
EXPOSED_HEIGHT, EXPOSED_PX, TIMES, SPECKLES = 240, (1.0, 4.0, 10.0), (1.0, 4.0, 16.0), (0.0, 0.3)
GLOW, GLOW_PX, GLOW_ASIDE_PX = 0.03, 40.0, 5.0
LEAK = (1.0, 0.08, 0.03)  # of a red laser's light into each colour


def level_rows(quick: bool) -> list[Row]:
    """How often the mean and the slope of 200 columns lie within 95 % intervals of their sigmas.

    Parameters
    ----------
    quick : bool, whether the default extractor at a few phases will do
    """
    phases = 6 if quick else 60
    names = (StripeSection().extractor,) if quick else installed("lscan.extractors")
    rows = []
    for name, colours in product(names, WIDTHS_PX):
        ratios = np.array(
            [
                ratio
                for width_px, noise_dn in product(WIDTHS_PX[colours], NOISE_DN)
                for ratio in level_ratios(name, colours, width_px, noise_dn, phases)
            ]
        )
        share = share_inside(ratios, np.ones_like(ratios)) if ratios.size else np.nan
        key = "level-intervals" if name == StripeSection().extractor else "level-shares"
        words: dict[str, Any] = {
            "extractor": name,
            "colours": colours,
            "lines": len(ratios),
            "phases": phases,
        }
        figure = band_miss_percent(share)
        rows.append(row(key, figure, seed=0, percent=100 * share, **words))
    return rows


def exposure_rows(quick: bool) -> list[Row]:
    """The same of the mean where the line is overexposed, wide, speckled, or lies in its own glow.

    Parameters
    ----------
    quick : bool, whether the default extractor at two places will do
    """
    names = (StripeSection().extractor,) if quick else installed("lscan.extractors")
    rows = []
    for name, glow in product(names, (0.0, GLOW)):
        ratios = np.concatenate(
            [
                _exposed_ratios(name, width_px, times, speckle, glow, 2 if quick else 20)
                for width_px, times, speckle in product(EXPOSED_PX, TIMES, SPECKLES)
            ]
        )
        key = "exposed-intervals" if name == StripeSection().extractor and not glow else "exposed"
        share = share_inside(ratios, np.ones_like(ratios)) if ratios.size else np.nan
        words: dict[str, Any] = {"extractor": name, "glow": 100 * glow, "lines": len(ratios)}
        rows.append(row(key, band_miss_percent(share), seed=0, percent=100 * share, **words))
    return rows


def _exposed_ratios(
    extractor: str, width_px: float, times: float, speckle: float, glow: float, places: int
) -> Floats:
    """(N,) errors of the mean over what independent columns would give it; glow: of the crest."""
    settings = StripeSection(
        extractor=extractor, channel="grey", threshold_dn=15.0, line_width_px=FWHM * width_px
    )
    found, rows = list[float](), np.arange(EXPOSED_HEIGHT)[:, None]
    for number in range(places):
        rng = np.random.default_rng([number, round(10 * width_px), round(times)])
        aside_px = np.arange(WIDTH, dtype=float) - WIDTH / 2
        centre = EXPOSED_HEIGHT / 2 + number / places + SLOPE * aside_px
        light = times * drawn(centre, width_px, EXPOSED_HEIGHT, LIGHT_DN)
        if speckle:
            light *= rng.gamma(speckle**-2, speckle**2, light.shape)
        aside = (rows - centre - GLOW_ASIDE_PX) / GLOW_PX
        light += glow * times * LIGHT_DN * np.exp(-0.5 * aside**2) + DARK_DN
        picture = np.clip(np.rint(_with_noise(light, NOISE_DN[0], rng)), 0, 255).astype(np.uint8)
        stripe = extract_stripe(picture, settings)
        found += [mean for mean, _ in _ratios(stripe, centre)]
    return np.array(found)


def level_ratios(
    extractor: str, colours: str, width_px: float, noise_dn: float, phases: int
) -> Floats:
    """(N, 2) errors of the mean and of the slope, over what independent columns would give them.

    N: of the phases those at which half of the columns have a value.

    Parameters
    ----------
    extractor : str
    colours : str, pattern of the mosaic, "mono" for none
    width_px : float, px, the line's standard deviation
    noise_dn : float, DN, of reading
    phases : int, places of the line, even over two rows
    """
    settings = StripeSection(
        extractor=extractor, channel="grey" if colours == MONO else "red", threshold_dn=15.0
    )
    column, found = np.arange(WIDTH) - WIDTH / 2, list[tuple[float, float]]()
    for number, phase in enumerate(np.linspace(0.0, 2.0, phases, endpoint=False)):
        rng = np.random.default_rng([number, round(100 * width_px), round(100 * noise_dn)])
        centre = HEIGHT / 2 + phase + SLOPE * column
        stripe = extract_stripe(_picture(centre, width_px, colours, noise_dn, rng), settings)
        found += _ratios(stripe, centre)
    return np.array(found).reshape(-1, 2)


def _ratios(stripe: Stripe, centre: Floats) -> list[tuple[float, float]]:
    """The errors of one line's mean and slope; none where most columns have no value."""
    part = np.flatnonzero(has_value(stripe.status))
    part = part[part % EVERY == 0]
    if len(part) < WIDTH / EVERY / 2:
        return []
    error, sigma = (stripe.centre_px - centre)[part], stripe.sigma_px[part]
    aside = part - part.mean()
    return [
        (
            float(error.sum() / np.sqrt((sigma**2).sum())),
            float((aside @ error) / np.sqrt(aside**2 @ sigma**2)),
        )
    ]


def _picture(
    centre: Floats, width_px: float, colours: str, noise_dn: float, rng: np.random.Generator
) -> Bytes:
    """A red line on the dark, as a camera has it."""
    light = drawn(centre, width_px, HEIGHT, LIGHT_DN)
    if colours == MONO:
        grey = _with_noise(light + DARK_DN, noise_dn, rng)
    else:
        sensor = ColourFilter(colours, (HEIGHT, WIDTH))
        seen = sensor.mosaic((light[..., None] * LEAK + DARK_DN).astype(np.float32))
        noisy = _with_noise(seen.astype(float), noise_dn, rng)
        grey = sensor.demosaic(noisy.astype(np.float32)).astype(float)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def _with_noise(light: Floats, noise_dn: float, rng: np.random.Generator) -> Floats:
    return light + rng.normal(0.0, np.sqrt(noise_dn**2 + PER_DN * light))
