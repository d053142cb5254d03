"""The paper's sandwave, scanned in the tank: the line spectrum of its profiles against eq. (4)."""

from pathlib import Path

import numpy as np

from lscan.config.targets import Sandwave
from lscan.roughness import Patch, patch_of
from lscan.surface import grid_cells
from sim.scene import load_scene
from tests.validation.exposures import read_scan
from tests.validation.instrument.board import calibrations
from tests.validation.instrument.workpieces import BORDER_MM, aligned_surface, every_frame
from tests.validation.roughness.fields import RoughnessEffort
from tests.validation.roughness.profiles import profile_waves
from tests.validation.rows import Row, row

CELL_MM = 3.0
STEP_MM = 1.0  # between frames
BAND_ROWS = 4  # whose amplitudes are averaged: 12 mm of the block
SEED = 1


def sandwave_rows(scenes: Path, effort: RoughnessEffort) -> list[Row]:
    """Wavelength and amplitudes of the measured surface's profiles along x.

    Parameters
    ----------
    scenes : Path, holds best/sandwave and best/board
    effort : RoughnessEffort
    """
    scene, board = (load_scene(scenes / "best" / f"{name}.toml") for name in ("sandwave", "board"))
    if effort.plain:
        render = {"fineness": 1, "samples": 1, "scatter_samples": 0}
        scene, board = scene.with_tank(render=render), board.with_tank(render=render)
    plane_map = "polynomial-5" if effort.plain else board.rig.calibration.plane_map
    (calibration,) = calibrations(board, (SEED,), plane_map)
    step_mm = 2.0 if effort.plain else STEP_MM
    extractor = "centroid-relative" if effort.plain else scene.rig.stripe.extractor
    stripe = scene.rig.stripe.model_copy(update={"extractor": extractor})
    (reading,) = read_scan(scene, every_frame(scene, step_mm), (SEED,), stripe)
    surface = aligned_surface(scene, reading, calibration.plane_map)
    piece = scene.rig.workpiece
    assert isinstance(piece, Sandwave)
    cell_mm = 2 * CELL_MM if effort.plain else CELL_MM
    grid = grid_cells(surface, cell_mm)
    keep = [
        np.flatnonzero((axis > BORDER_MM) & (axis < piece.side_mm - BORDER_MM))
        for axis in (grid.y_mm, grid.x_mm)
    ]
    whole = patch_of(grid)
    window = np.ix_(*keep)
    waves = profile_waves(Patch(whole.z_cm[window], whole.seen[window], whole.cell_cm))
    true_mm = 2 * np.pi / piece.c_per_mm
    amplitude_mm = piece.a_mm + piece.b * grid.y_mm[keep[0]][waves.row]
    off = 10 * waves.amplitude_cm / amplitude_mm - 1
    bands = np.array_split(off, max(len(off) // BAND_ROWS, 1))
    words = {"frames": len(reading.positions_mm)}
    longer = 1000 * waves.wavelength_cm / true_mm - 100
    return [
        row("roughness-sandwave", abs(longer), bar=1.0, seed=SEED, name="wavelength",
            told=f"{10 * waves.wavelength_cm:.3f} mm, true {true_mm:.3f} mm", **words),
        row("roughness-sandwave", 100 * max(abs(float(band.mean())) for band in bands), bar=2.0,
            seed=SEED, name="amplitudes",
            told=f"the largest of {len(bands)} bands of profiles; mean {100 * off.mean():.2f} %",
            **words),
    ]  # fmt: skip
