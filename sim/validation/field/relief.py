"""Relief as fine as the sheet is thick: how much of its height is measured, and what is stated.

Ripples with sharp crests and a rough bed are scanned once in the tank without noise, each line
taken as the centroid of all its light; noise of the heights is then drawn, many times.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import trimesh

from lscan.config.rig import SheetSection
from lscan.files.disk import write_atomically
from lscan.records import Floats, Mask, Surface
from lscan.surface.thickness import correct_thickness
from sim.meshes.parts import grid_faces, plain_mesh
from sim.studies.concavity import ShortScan, mesh_scene, sheet_of, short_scan
from sim.validation.accuracy.intervals import share_inside
from sim.validation.field.effort import FieldEffort
from sim.validation.rows import Row, row

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
