"""A block of a given roughness, scanned in the tank: its spectrum, the cutoff, and its echo."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from lscan.pipeline import build_surface
from lscan.records import Floats, Status, Surface
from lscan.roughness import (
    Patch,
    PatchSpectrum,
    PowerLawFit,
    ScannerResponse,
    backscattering_strength,
    by_rings,
    corrected_spectrum,
    most_likely_law,
    patch_of_profiles,
    patch_spectrum,
    response_of,
    roughness_of,
    sediment,
)
from sim.meshes.parts import rough_heights
from sim.scene import Scene, into_world, load_scene, target_pose
from sim.scene.matter import RoughBlock
from tests.validation.exposures import read_scan
from tests.validation.instrument.board import calibrations
from tests.validation.roughness.fields import RoughnessEffort
from tests.validation.rows import Row, row

LOW_PER_MM, HIGH_PER_MM = 0.02, 0.4
EDGE_MM = 3.0  # of the block, left out
RINGS = 32
OFF_DB = 1.0  # where a spectrum leaves the truth
SEED = 1
BOTTOM = "medium sand"
FREQUENCIES_KHZ = (15.0, 30.0, 60.0, 120.0, 200.0, 300.0)
GRAZING_DEG = (10.0, 20.0, 30.0, 45.0, 60.0)


def block_rows(scenes: Path, effort: RoughnessEffort) -> list[Row]:
    """The measured spectrum over the true one, where it leaves it, and the predicted echo.

    Parameters
    ----------
    scenes : Path, holds targets/rough and best/board
    effort : RoughnessEffort, its frames
    """
    scene = load_scene(scenes / "targets" / "rough.toml")
    measured, response = _scanned(scenes, scene, effort)
    patch = patch_of_profiles(measured)
    true = patch_of_profiles(_true_heights(scene, measured))
    found = roughness_of(patch, response)
    told = found.cutoff_per_cm / (20 * np.pi)
    expected = _of_the_same_waves(patch_spectrum(true), found.corrected)
    size, off_db = _off_db(found.corrected, expected)
    inside = (size >= LOW_PER_MM) & (size <= min(HIGH_PER_MM, told))
    # The cutoff is where noise alone lifts the spectrum by so much: it is left in.
    lifted = corrected_spectrum(found.spectrum, replace(patch, noise_cm2=0.0), response)
    _, lifted_db = _off_db(lifted, expected)  # of the same waves, and so of the same rings
    beyond = np.flatnonzero((size >= LOW_PER_MM) & ~(np.abs(lifted_db) <= OFF_DB))
    # The block's own spectrum ends at HIGH_PER_MM.
    leaves = min(float(size[beyond[0]]), HIGH_PER_MM) if len(beyond) else HIGH_PER_MM
    words: dict[str, Any] = {"frames": len(measured.xyz_mm), "cutoff": told}
    worst = float(np.abs(off_db[inside]).max()) if inside.any() else float("nan")
    percent = 100 * (told / leaves - 1)
    return [
        row("roughness-block", worst, seed=SEED, **words),
        row("roughness-cutoff", abs(percent), seed=SEED, leaves=leaves, **words),
        row(
            "roughness-echo", _echo_db(found.fit, true, response), seed=SEED, bottom=BOTTOM, **words
        ),
    ]


def _scanned(
    scenes: Path, scene: Scene, effort: RoughnessEffort
) -> tuple[Surface, ScannerResponse]:
    """The measured surface in the block's frame, placed by the truth, and the rig's response there.

    Heights are those of the line, not corrected for the sheet's thickness: the spectrum is.
    """
    board = load_scene(scenes / "best" / "board.toml")
    plane_map = board.rig.calibration.plane_map
    if effort.plain:
        render = {"fineness": 1, "samples": 1, "scatter_samples": 0}
        scene, board = scene.with_tank(render=render), board.with_tank(render=render)
        plane_map = "polynomial-5"
    (calibration,) = calibrations(board, (SEED,), plane_map)
    middle = scene.tank.target.position_mm[1] + _block(scene).size_mm[1] / 2
    first = middle - effort.step_mm * (effort.frames - 1) / 2
    positions = [first + effort.step_mm * k for k in range(effort.frames)]
    (reading,) = read_scan(scene, positions, (SEED,), scene.rig.stripe)
    surface = build_surface(reading.profiles(calibration.plane_map), scene.rig)
    frames, points, _ = surface.xyz_mm.shape
    flat = surface.xyz_mm * [1.0, 0.0, 1.0]
    position = np.repeat(surface.position_mm, points)
    places = into_world(scene.tank.head, flat.reshape(-1, 3), position)
    own = target_pose(scene).invert(places).reshape(frames, points, 3)
    size = np.array(_block(scene).size_mm)
    with np.errstate(invalid="ignore"):
        inside = ((own[..., :2] > EDGE_MM) & (own[..., :2] < size - EDGE_MM)).all(axis=-1)
        inside &= own[..., 2] > -_block(scene).depth_mm / 2
    status = np.where(inside, surface.status, int(Status.NO_DATA))
    xyz = np.where(inside[..., np.newaxis], own, np.nan)
    placed = replace(surface, xyz_mm=xyz, status=status, frame="workpiece")
    lines = np.stack([stripe.peak for stripe in reading.stripes])
    at_block = replace(surface, status=status)
    return placed, response_of(scene.rig, at_block, float(np.median(lines[inside])))


def _true_heights(scene: Scene, surface: Surface) -> Surface:
    """The same points with the heights that the block has there, without noise."""
    x, y, z = rough_heights(_block(scene))
    height = RegularGridInterpolator((y, x), z, bounds_error=False)(surface.xyz_mm[..., [1, 0]])
    xyz = np.concatenate([surface.xyz_mm[..., :2], height[..., np.newaxis]], axis=-1)
    return replace(surface, xyz_mm=xyz, sigma_z_mm=0 * surface.sigma_z_mm, modes_mm=None)


def _of_the_same_waves(true: PatchSpectrum, measured: PatchSpectrum) -> PatchSpectrum:
    """What is true of the waves that were measured: of a single block, others differ by chance."""
    known = np.isfinite(measured.density_cm4)
    return replace(true, density_cm4=np.where(known, true.density_cm4, np.nan))


def _off_db(measured: PatchSpectrum, true: PatchSpectrum) -> tuple[Floats, Floats]:
    """(K,) sizes of the rings' waves, 1/mm, and dB, measured over true."""
    rings, expected = (by_rings(spectrum, RINGS) for spectrum in (measured, true))
    with np.errstate(invalid="ignore", divide="ignore"):
        off_db = 10 * np.log10(rings.density_cm4 / expected.density_cm4)
    return rings.wavenumber_per_cm / (20 * np.pi), np.asarray(off_db)


def _echo_db(fit: PowerLawFit, true: Patch, response: ScannerResponse) -> float:
    """The largest difference of backscattering strength, of the law measured and the true one.

    Both are fitted to the same waves.
    """
    expected = most_likely_law(true, band=fit.band, known=response.known)
    bottom = sediment(BOTTOM)
    off = [
        backscattering_strength(fit.law, bottom, khz, np.array(GRAZING_DEG))
        - backscattering_strength(expected, bottom, khz, np.array(GRAZING_DEG))
        for khz in FREQUENCIES_KHZ
    ]
    return float(np.abs(off).max())


def _block(scene: Scene) -> RoughBlock:
    block = scene.tank.target.rough
    assert block is not None
    return block
