"""The same scan through the drivers of real devices and through the tank's own."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from lscan.acquisition.run import MANIFEST, Run
from lscan.acquisition.scan import scan
from lscan.benchmark.methods import timed
from lscan.calibration.planemap import PlaneMap
from lscan.config.documents import Document, merge
from lscan.config.rig import Rig, RigFile, load_rig, parse_rig
from lscan.config.targets import Sandwave
from lscan.files.disk import make_folder
from lscan.paper.experiment import measure_board
from lscan.paper.published import CHOSEN_MAP
from lscan.pipeline import build_surface, place, reconstruct
from lscan.records import Floats, Surface
from lscan.stripe import extract_stripe
from lscan.surface import Alignment, resample
from lscan.surface.surface import to_profile
from sim.emulators import EmulatedHardware, ServeOptions
from sim.scene import scene_of
from sim.sensor.noise import from_jpeg, jpeg_bytes
from sim.validation.robustness.effort import HardwareEffort
from sim.validation.rows import Row, row

STEP_MM = 2.0


def agreement_rows(scenes: Path, folder: Path, effort: HardwareEffort) -> list[Row]:
    """Rms differences in height between scans of the sandwave, taken through different drivers.

    The opencv and grbl drivers on the served tank, the sim drivers' pictures through JPEG alone,
    and the sim drivers with other noise, each against the same scan by the sim drivers.

    Parameters
    ----------
    scenes : Path
        Folder that holds paper/board.toml and paper/sandwave.toml.
    folder : Path
        Where the runs go; it is made, and earlier runs in it are replaced.
    effort : HardwareEffort
        Frames of each scan, how they are rendered, and whether heights are compared on the
        slices, which takes a hundred frames, or where they were measured.

    Raises
    ------
    InputError
        Where a scene is wrong.
    """
    make_folder(folder)
    board_rig = _changed(load_rig(scenes / "paper" / "board.toml"), render=effort.render)
    board = _fresh(board_rig, folder / "board")
    plane_map = measure_board(board, (CHOSEN_MAP,)).calibrations[CHOSEN_MAP].plane_map
    changes = {"plan": {"frames": effort.scan_frames, "step_mm": STEP_MM}, "render": effort.render}
    rig_file = _changed(load_rig(scenes / "paper" / "sandwave.toml"), **changes)
    scene = scene_of(rig_file)
    seed = scene.tank.sensor.seed
    simulated = _fresh(rig_file, folder / "simulated")
    repeated = _fresh(_changed(rig_file, sensor={"seed": seed + 1}), folder / "repeated")
    options = ServeOptions(prepare=True)
    with EmulatedHardware(scene, options) as hardware:
        seconds, served = timed(lambda: _fresh(hardware.rig_file(), folder / "served"))
    built = reconstruct(simulated, plane_map)
    alignment = built.require_alignment() if effort.aligned else None
    surfaces = {
        "served-scan": reconstruct(served, plane_map).raw,
        "jpeg-alone": _coded(simulated, plane_map, options),
        "noise-alone": reconstruct(repeated, plane_map).raw,
    }
    words: dict[str, Any] = {
        "seed": seed,
        "other": seed + 1,
        "where": "slices" if effort.aligned else "columns",
        "coding": f"JPEG quality {options.quality}, {options.subsampling}",
        "frames": effort.scan_frames,
        "frame_ms": 1000 * seconds / effort.scan_frames,
    }
    expected_mm = _heights_mm(built.raw, rig_file.rig, alignment)
    rows = []
    for key, raw in surfaces.items():
        difference_mm = _heights_mm(raw, rig_file.rig, alignment) - expected_mm
        rows.append(row(key, float(np.sqrt(np.nanmean(difference_mm**2))), **words))
    return rows


def _changed(rig_file: RigFile, **sections: Document) -> RigFile:
    """The rig with these sections laid over its own."""
    return parse_rig(merge(rig_file.document, sections), source=rig_file.source)


def _heights_mm(raw: Surface, rig: Rig, alignment: Alignment | None) -> Floats:
    """Heights on the sandwave's slices, placed by the alignment; without one those of all points.

    NaN where there is no value.
    """
    if alignment is None:
        return raw.xyz_mm[..., 2]
    assert isinstance(rig.workpiece, Sandwave)
    placed = place(raw, alignment, rig)
    return np.concatenate(
        [resample(placed, ends).z_mm for ends in rig.workpiece.slices_mm().values()]
    )


def _coded(run: Run, plane_map: PlaneMap, options: ServeOptions) -> Surface:
    """The raw surface of the run's pictures, each through the served camera's JPEG."""
    profiles = []
    for frame in run.frames():
        image = from_jpeg(jpeg_bytes(frame.image, options.quality, options.subsampling))
        stripe = extract_stripe(image, run.rig_file.rig.stripe)
        profiles.append(to_profile(stripe, plane_map, frame.position_mm))
    return build_surface(profiles, run.rig_file.rig)


def _fresh(rig_file: RigFile, folder: Path) -> Run:
    """A new run in the folder, in the place of an earlier one."""
    if (folder / MANIFEST).exists():
        shutil.rmtree(folder)
    return scan(rig_file, folder)
