"""Lines in pictures that a camera has compressed: bent, unevenly bright, red, of 1.2 to 3 px."""

from itertools import product
from typing import Any

import cv2
import numpy as np

from lscan.config.plugins import installed
from lscan.config.rig import NoiseSection, StripeSection
from lscan.records import Bytes, Floats
from lscan.stripe import extract_stripe
from tests.support.lines_drawn import drawn
from tests.validation.exposures import COVER
from tests.validation.rows import Row, row

SHAPE, READ_DN, GAIN, DARK_DN = (200, 640), 1.0, 1 / 80, 6.0  # a gain of 1 DN for 80 electrons
LEAK = (1.0, 0.12, 0.05)  # of a red laser's light into each colour
CODERS = {
    "no": [("", 0)],
    "JPEG": [(".jpg", 70), (".jpg", 85), (".jpg", 95)],
    "WebP": [(".webp", 60), (".webp", 75), (".webp", 90)],
}
KNOWN = NoiseSection(read_dn=float(np.hypot(READ_DN, 12**-0.5)), dn_per_electron=GAIN)
SMOOTH_PX = 4.0


def coded_rows(quick: bool) -> list[Row]:
    """By how much fewer than 95 % of the columns' intervals hold, as found and smoothed.

    Parameters
    ----------
    quick : bool, whether the default extractor and few lines will do
    """
    default = StripeSection().extractor
    names = (default,) if quick else installed("lscan.extractors")
    rows = []
    for name, coder, smooth_px in product(names, CODERS, (0.0, SMOOTH_PX)):
        settings = StripeSection(extractor=name, threshold_dn=30.0, smooth_px=smooth_px)
        inside = [
            share
            for coding, noise in product(CODERS[coder], (None, KNOWN))
            for share in _shares(
                settings.model_copy(update={"noise": noise}), *coding, 3 if quick else 20
            )
        ]
        words: dict[str, Any] = {"extractor": name, "coder": coder, "smooth": smooth_px}
        words |= {"percent": 100 * float(np.mean(inside)), "lines": len(inside)}
        words["worst"] = 100 * min(inside)
        rows.append(row("coded-intervals", max(95 - words["percent"], 0.0), seed=0, **words))
    return rows


def _shares(settings: StripeSection, kind: str, quality: int, count: int) -> list[float]:
    """The share of columns of each line whose interval holds it."""
    found = list[float]()
    for number in range(count):
        centre, picture = line_picture(number)
        if kind:
            flag = cv2.IMWRITE_JPEG_QUALITY if kind == ".jpg" else cv2.IMWRITE_WEBP_QUALITY
            data = cv2.imencode(kind, picture[..., ::-1], [flag, quality])[1]
            picture = np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)[..., ::-1].copy()
        stripe = extract_stripe(picture, settings)
        at = np.isfinite(stripe.centre_px)
        error = (stripe.centre_px - centre)[at]
        found.append(float(np.mean(np.abs(error) <= COVER * stripe.sigma_px[at])))
    return found


def line_picture(seed: int) -> tuple[Floats, Bytes]:
    """The centres of a line, px, and its picture in colours, not coded.

    Parameters
    ----------
    seed : int, of the line and of the noise
    """
    rng, column = np.random.default_rng([58, seed]), np.arange(SHAPE[1], dtype=np.float64)
    turn, phases = 2 * np.pi / rng.uniform(150, 400), rng.uniform(0, 2 * np.pi, 2)
    centre: Floats = SHAPE[0] / 2 + rng.uniform(-0.15, 0.15) * (column - SHAPE[1] / 2)
    centre += 6 * np.sin(turn * column + phases[0])
    height: Floats = rng.uniform(80, 200) * (1 + 0.2 * np.sin(2 * np.pi * column / 60 + phases[1]))
    light = drawn(centre, rng.uniform(1.2, 3.0), SHAPE[0], height)[..., None] * LEAK + DARK_DN
    grey = GAIN * rng.poisson(light / GAIN) + rng.normal(0, READ_DN, light.shape)
    return centre, np.clip(np.rint(grey), 0, 255).astype(np.uint8)
