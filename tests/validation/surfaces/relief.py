"""Relief as fine as the sheet is thick, and stated beside observed sigmas of the line.

Ripples with sharp crests and a rough bed are scanned once in the tank without noise, each line
taken as the centroid of all its light; noise of the heights is then drawn, many times.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import trimesh

from lscan.benchmark.run import registered_extractors
from lscan.config.rig import SheetSection, StripeSection
from lscan.files.disk import write_atomically
from lscan.files.pictures import read_picture
from lscan.records import Floats, Mask, Picture, Status, Stripe, Surface, has_value
from lscan.stripe import extract_stripe
from lscan.stripe.fit import lines, parameters_of
from lscan.stripe.peaks import neighbours, pieces
from lscan.surface.thickness import correct_thickness
from sim.meshes.parts import grid_faces, plain_mesh
from sim.scene.instrument import Sensor
from sim.sensor.webcam import ColourFilter, digitise, through_jpeg
from sim.studies.concavity import ShortScan, mesh_scene, sheet_of, short_scan
from tests.validation.exposures import share_inside
from tests.validation.rows import Row, row
from tests.validation.surfaces.drawn import FieldEffort

# Relief as fine as the sheet is thick: how much of its height is measured, and what is stated.

NOISE_MM = 0.04
"""Of a height: half of what the best extractor leaves of the sandwave with speckle."""

HALF_MM, GRID_MM = 70.0, 0.25  # the patch, and its triangles: a twelfth of the finest wave
CREST_MM, RIPPLE_MM = 4.0, 20.0  # height and length of the ripples
ROUGH_MM, FINEST_PER_MM, COARSEST_PER_MM, STEEPNESS = 0.8, 0.3, 0.008, 3.5
WAVES = 250
FRAMES = 100  # 1 mm apart
WINDOW_PX = (220, 290, 200, 130)
"""Left, top, width and height of the part of the picture that is rendered: it shows the patch."""

FEWER, COARSE_MM, NARROW_PX = 66, 1.0, (290, 290, 60, 130)
"""The same three of a quick run: a spectrum takes 64 frames."""

ENDS = 8  # frames at either end that only serve as neighbours
SEED = 3
BANDS: Mapping[str, tuple[float, float]] = {"60 to 120": (0.06, 0.12), "120 to 250": (0.12, 0.25)}

RIPPLES = "ripples of 20 x 4 mm"

Shape = Callable[[Floats, Floats], Floats]


@dataclass(frozen=True)
class ReliefScan:
    """A scan without noise, where it can be judged, and what the correction has to know."""

    scan: ShortScan
    sheet: SheetSection
    yaw_rad: float

    @property
    def judged(self) -> Mask:
        """(F, N) points of the patch, clear of shadows, away from the scan's ends."""
        clear = self.scan.clear & np.isfinite(self.scan.surface.xyz_mm[..., 2])
        clear[:ENDS] = clear[-ENDS:] = False
        return clear


def relief_rows(scenes: Path, effort: FieldEffort) -> list[Row]:
    """Height gain by wavenumber, and intervals, of ripples and of a rough bed.

    Parameters
    ----------
    scenes : Path, holds paper/groove, whose rig is taken
    effort : FieldEffort, its seeds are those of the noise
    """
    rows = []
    for name, shape in ((RIPPLES, ripples), ("rough bed", rough_bed)):
        found = _scanned(scenes, shape, effort)
        rows += _judged(name, found, effort)
    return rows


def ripples(x_mm: Floats, y_mm: Floats) -> Floats:
    """Ripples across the track with sharp crests and round troughs, mm."""
    return CREST_MM * (1 - np.abs(np.sin(np.pi * y_mm / RIPPLE_MM))) + 0 * x_mm


def rough_bed(x_mm: Floats, y_mm: Floats) -> Floats:
    """A bed whose spectrum follows a power law, from 125 mm to 3.3 mm, mm."""
    generator = np.random.default_rng(SEED)
    low, high = np.log(COARSEST_PER_MM), np.log(FINEST_PER_MM)
    height = np.zeros_like(x_mm)
    for _ in range(WAVES):
        k, turn, phase = np.exp(generator.uniform(low, high)), *generator.uniform(0, 2 * np.pi, 2)
        along = x_mm * np.cos(turn) + y_mm * np.sin(turn)
        height += k ** (1 - STEEPNESS / 2) * np.cos(2 * np.pi * k * along + phase)
    return ROUGH_MM * height / height.std()


def _scanned(scenes: Path, shape: Shape, effort: FieldEffort) -> ReliefScan:
    """The patch of that shape, rendered and read without noise."""
    frames, grid_mm, window_px = FRAMES, GRID_MM, WINDOW_PX
    if effort.plain:
        frames, grid_mm, window_px = FEWER, COARSE_MM, NARROW_PX
    with TemporaryDirectory() as folder:
        path = Path(folder) / "patch.ply"
        write_atomically(path, _patch(shape, grid_mm).export(file_type="ply"))
        scene = mesh_scene(scenes, path, -330.0, window_px)
        positions = np.arange(frames) - (frames - 1) / 2
        scan = short_scan(scene, tuple(positions.tolist()))
    return ReliefScan(scan, *sheet_of(scene))


def _patch(shape: Shape, grid_mm: float) -> trimesh.Trimesh:
    """The triangles of a height field."""
    side = np.arange(-HALF_MM, HALF_MM + grid_mm / 2, grid_mm)
    x, y = np.meshgrid(side, side)
    vertices = np.column_stack([x.ravel(), y.ravel(), shape(x, y).ravel()])
    return plain_mesh(vertices, grid_faces(*x.shape))


def _judged(name: str, found: ReliefScan, effort: FieldEffort) -> list[Row]:
    """Rows of one target over all seeds."""
    judged, errors, sigmas = found.judged, [], []
    measured: dict[str, list[tuple[float, float]]] = {band: [] for band in BANDS}
    for seed in effort.seeds:
        noisy = _noisy(found.scan.surface, np.random.default_rng([SEED, seed]))
        moved = correct_thickness(noisy, found.sheet, found.yaw_rad)
        errors.append((moved.xyz_mm[..., 2] - found.scan.true_z_mm)[judged])
        sigmas.append(moved.sigma_z_mm[judged])
        for band, limits in BANDS.items():
            heights = noisy.xyz_mm[..., 2], moved.xyz_mm[..., 2]
            gains = [_gain(height, found.scan.true_z_mm, judged, limits) for height in heights]
            measured[band].append((gains[0], gains[1]))
    error, sigma = np.concatenate(errors), np.concatenate(sigmas)
    percent = 100 * share_inside(error, sigma)
    words: dict[str, Any] = {"target": name, "seeded": effort.seeded}
    told = {"percent": percent, "count": len(error), "rms": float(np.sqrt(np.mean(error**2)))}
    rows = [row("relief-intervals", abs(percent - 95), seed=effort.seeds[0], **told, **words)]
    if name == RIPPLES:
        rows.append(_ripple_height(found, errors, effort))
    for band, pairs in measured.items():
        raw, corrected = np.mean(pairs, axis=0)
        key = "relief-gain"
        rows.append(row(key, corrected, seed=effort.seeds[0], band=band, raw=raw, **words))
    return rows


def _ripple_height(found: ReliefScan, errors: list[Floats], effort: FieldEffort) -> Row:
    """How far the height of the ripples, sqrt(8) times the rms of their heights, is off.

    The mean over the seeds leaves the shape as it is measured; its noise adds less than 1e-4.
    """
    true = found.scan.true_z_mm[found.judged]
    measured = true + np.mean(errors, axis=0)
    height, nominal = (float(np.sqrt(8) * np.std(part)) for part in (measured, true))
    return row(
        "ripple-height",
        100 * abs(height / nominal - 1),
        seed=effort.seeds[0],
        height=height,
        nominal=nominal,
        seeded=effort.seeded,
    )


def _noisy(surface: Surface, generator: np.random.Generator) -> Surface:
    xyz, sigma = surface.xyz_mm.copy(), np.full(surface.status.shape, NOISE_MM)
    xyz[..., 2] += generator.normal(0.0, NOISE_MM, sigma.shape)
    return replace(surface, xyz_mm=xyz, sigma_x_mm=0 * sigma, sigma_z_mm=sigma)


def _gain(height: Floats, true: Floats, judged: Mask, band: tuple[float, float]) -> float:
    """Height measured over true height of the waves along the track in a band, 1/mm."""
    rows = slice(ENDS, len(height) - ENDS)
    whole = np.flatnonzero(judged[rows].all(axis=0))
    window = np.hanning(len(height[rows]))[:, None]
    seen, is_there = (
        np.fft.rfft((part[rows][:, whole] - part[rows][:, whole].mean(axis=0)) * window, axis=0)
        for part in (height, true)
    )
    wavenumber = np.fft.rfftfreq(len(window), 1.0)
    within = (wavenumber > band[0]) & (wavenumber <= band[1])
    shared = np.real(seen * is_there.conj())[within].sum()
    return float(shared / (np.abs(is_there[within]) ** 2).sum())


# Stated over observed sigma of the line's centres in pictures as cameras make them.
#
# Drawn pictures have been through a colour filter, sharpening and JPEG, so that neighbouring pixels
# share their errors, and their truth is known.  Of a photograph nobody knows the truth: there a
# centre is held against a parabola through its neighbours.


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


def camera_picture(generator: np.random.Generator) -> tuple[Picture, Floats]:
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


def _sharpened(image: Picture) -> Picture:
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


def _over_neighbours(extractor: str, lit: Picture, dark: Picture) -> float:
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
