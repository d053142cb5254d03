"""Stated over observed sigma of the line's centres in pictures as cameras make them.

Drawn pictures have been through a colour filter, sharpening and JPEG, so that neighbouring
pixels share their errors, and their truth is known.  Of a photograph nobody knows the truth:
there a centre is held against a parabola through its neighbours.
"""

from pathlib import Path

import cv2
import numpy as np

from lscan.benchmark.run import registered_extractors
from lscan.config.rig import StripeSection
from lscan.files.pictures import read_picture
from lscan.records import Bytes, Floats, Status, Stripe, has_value
from lscan.stripe import extract_stripe
from lscan.stripe.fit import lines, parameters_of
from lscan.stripe.peaks import neighbours, pieces
from sim.scene.instrument import Sensor
from sim.sensor.noise import ColourFilter, digitise, through_jpeg
from sim.validation.field.effort import FieldEffort
from sim.validation.rows import Row, row

SHAPE = (128, 640)
WIDTH_PX, PEAK_DN, GROUND_DN = 1.8, 150.0, 12.0
SLOPE, BEND_PX, BEND_COLUMNS = 0.023, 6.0, 400.0  # of the line: relief far longer than any window
SPECKLE = 0.15
SENSOR = Sensor(bayer="RGGB", jpeg_quality=90)
SHARPENED, SHARPENING_PX = 0.7, 1.2  # an unsharp mask such as webcams apply

NEAR, FAR = 4, 24
"""Columns to either side between which the neighbours lie that a centre is held against: beyond
those that share its errors, not so far that the line is no parabola."""
FEWEST = 6  # neighbours on either side
_MAD = 1.4826  # of the median absolute deviation, for the standard deviation of a normal


def sigma_rows(scenes: Path, effort: FieldEffort) -> list[Row]:
    """The ratio of every extractor on drawn pictures, and on the laser photograph if there is one.

    Parameters
    ----------
    scenes : Path, folder of the scene files; none is needed
    effort : FieldEffort, its seeds and the folder of photographs
    """
    drawn = {name: _over_truth(name, effort.seeds) for name in registered_extractors()}
    rows = _rows("drawn, through a camera's processing", f"truth, {effort.seeded}", drawn)
    if effort.photographs is None:
        return rows
    folder = effort.photographs / "webcam"
    lit, dark = (read_picture(folder / f"bust_laser_{state}.png") for state in ("on", "off"))
    seen = {name: _over_neighbours(name, lit, dark) for name in registered_extractors()}
    reference = f"a parabola through every other column {NEAR} to {FAR} beside it"
    return rows + _rows("laser photograph", reference, seen)


def _rows(pictures: str, reference: str, ratios: dict[str, float]) -> list[Row]:
    """One row for each extractor, and one for the least of their ratios."""
    of_each = [
        row("sigma-stated", ratio, extractor=name, pictures=pictures, against=reference)
        for name, ratio in ratios.items()
    ]
    least = min(ratios.values())
    return [*of_each, row("sigma-stated-least", least, pictures=pictures, against=reference)]


# -- drawn --------------------------------------------------------------------------------


def camera_picture(generator: np.random.Generator) -> tuple[Bytes, Floats]:
    """A picture (H, W, 3) of a red line as a cheap camera delivers it, and its centres (W,), px.

    Speckle, shot noise and reading noise on the pixels of a colour filter; colours filled in,
    8 bit, sharpened, JPEG.

    Parameters
    ----------
    generator : Generator, all noise comes from it, and the line's place
    """
    column = np.arange(float(SHAPE[1]))
    centre: Floats = SHAPE[0] / 2 + generator.uniform(-2, 2) + SLOPE * (column - SHAPE[1] / 2)
    centre += BEND_PX * np.sin(2 * np.pi * column / BEND_COLUMNS)
    light = PEAK_DN * _unit_line(centre) * _speckle(generator)
    colours = np.array([1.0, SENSOR.laser_response.green / SENSOR.laser_response.red, 0.02])
    mean = GROUND_DN + light[..., None] * colours
    filtered = ColourFilter(SENSOR.bayer, SHAPE)
    electrons = filtered.mosaic((mean * SENSOR.full_well_e / 255).astype(np.float32))
    seen = generator.poisson(electrons) + generator.normal(0, SENSOR.dark_noise_e, SHAPE)
    image = digitise(seen.astype(np.float32), SENSOR, filtered)
    return through_jpeg(_sharpened(image), SENSOR), centre


def _unit_line(centre: Floats) -> Floats:
    """(H, W) line of height 1 averaged over each pixel."""
    level = np.zeros(len(centre))
    rows = np.arange(SHAPE[0], dtype=float)
    shape = parameters_of(centre, level + WIDTH_PX, level + 1.0, level, level)
    return lines(shape, rows).light.T


def _speckle(generator: np.random.Generator) -> Floats:
    return generator.gamma(SPECKLE**-2, SPECKLE**2, SHAPE)


def _sharpened(image: Bytes) -> Bytes:
    soft = cv2.GaussianBlur(image, (0, 0), SHARPENING_PX)
    return np.asarray(cv2.addWeighted(image, 1 + SHARPENED, soft, -SHARPENED, 0), np.uint8)


def _over_truth(extractor: str, seeds: tuple[int, ...]) -> float:
    """Rms of the sigmas stated over that of the errors, all columns of all seeds."""
    settings = StripeSection(extractor=extractor, threshold_dn=30.0)
    errors, stated = [], []
    for seed in seeds:
        image, true = camera_picture(np.random.default_rng(seed))
        stripe = extract_stripe(image, settings)
        found = has_value(stripe.status)
        errors.append((stripe.centre_px - true)[found])
        stated.append(stripe.sigma_px[found])
    squares = [float(np.mean(np.square(np.concatenate(part)))) for part in (stated, errors)]
    return float(np.sqrt(squares[0] / squares[1]))


# -- photographs --------------------------------------------------------------------------


def _over_neighbours(extractor: str, lit: Bytes, dark: Bytes) -> float:
    """The ratio for a photograph's columns that are not clipped, robust against outliers.

    What a clipped crest may hide is in their sigma_px, and no scatter.
    """
    stripe = extract_stripe(lit, StripeSection(axis="rows", extractor=extractor), background=dark)
    return 1 / (_MAD * float(np.median(np.abs(neighbour_pulls(stripe)))))


def neighbour_pulls(stripe: Stripe) -> Floats:
    """What centres differ from the parabola of their neighbours, over the sigma stated for both.

    Of every other column, if it is not clipped.  The neighbours are the columns between, of the
    same piece; those nearer than NEAR and farther than FAR are left out.

    Parameters
    ----------
    stripe : Stripe, px
    """
    apart = np.arange(NEAR, FAR + 1)
    apart = apart[apart % 2 == 1]
    steps = np.concatenate([-apart[::-1], apart])
    at, used = neighbours(pieces(stripe), steps)
    kept = np.all([side.sum(axis=1) >= FEWEST for side in np.split(used, 2, axis=1)], axis=0)
    kept &= stripe.status == Status.OK
    kept[:FAR] = kept[-FAR:] = kept[1::2] = False
    at, used = at[kept], used[kept]
    powers = (steps / FAR)[:, None] ** np.arange(3)
    normal = np.einsum("ks,si,sj->kij", used.astype(float), powers, powers)
    # How each neighbour moves the value in the middle, which is the first coefficient.
    influence = np.linalg.inv(normal)[:, 0] @ powers.T * used
    expected = (influence * np.nan_to_num(stripe.centre_px[at])).sum(axis=1)
    variance = (influence**2 * np.nan_to_num(stripe.sigma_px[at]) ** 2).sum(axis=1)
    sigma = np.sqrt(stripe.sigma_px[kept] ** 2 + variance)
    return np.asarray((stripe.centre_px[kept] - expected) / sigma)
