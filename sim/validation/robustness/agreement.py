"""The same scan through the drivers of real devices and through the tank's own."""

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from lscan.acquisition.run import MANIFEST, Run
from lscan.acquisition.scan import scan
from lscan.calibration.api import PlaneMap
from lscan.config.documents import merge
from lscan.config.rigfile import RigFile, load_rig, parse_rig
from lscan.config.targets import Sandwave
from lscan.files.disk import make_folder
from lscan.paper.experiment import measure_board
from lscan.paper.published import CHOSEN_MAP
from lscan.pipeline import build_surface, place, reconstruct
from lscan.records import Floats, Surface
from lscan.stripe import extract_stripe
from lscan.surface import Alignment, resample
from lscan.surface.profile import to_profile
from sim.emulators import EmulatedHardware, ServeOptions
from sim.scene import scene_of
from sim.sensor.coding import from_jpeg, jpeg_bytes
from sim.validation.rows import Row, row

STEP_MM = 2.0

Difference = Callable[[Surface, Surface], float]


def agreement_rows(
    scenes: Path, frames: int, aligned: bool, output: Path = Path("out/hardware/agreement")
) -> list[Row]:
    """Slices of the sandwave scanned by the opencv and grbl drivers on the served tank, against
    the same scan by the sim drivers, and what JPEG alone and other noise alone do to the latter.

    scenes: folder that holds paper/board.toml and paper/sandwave.toml.  frames: of the scan.
    aligned: whether heights are compared on the slices, which takes a hundred frames, or where
    they were measured.  output: folder for the runs; those of an earlier time are replaced.
    Raises InputError where a scene is wrong.
    """
    board = _fresh(load_rig(scenes / "paper" / "board.toml"), output / "board")
    plane_map = measure_board(board, (CHOSEN_MAP,)).calibrations[CHOSEN_MAP].plane_map
    plan = {"plan": {"frames": frames, "step_mm": STEP_MM}}
    loaded = load_rig(scenes / "paper" / "sandwave.toml")
    rig_file = parse_rig(merge(loaded.document, plan), source=loaded.source)
    simulated = _fresh(rig_file, output / "simulated")
    noise = {"sensor": {"seed": scene_of(rig_file).tank.sensor.seed + 1}}
    again = parse_rig(merge(rig_file.document, noise), source=loaded.source)
    repeated = _fresh(again, output / "repeated")
    options = ServeOptions(prepare=True)
    with EmulatedHardware(scene_of(rig_file), options) as hardware:
        began_s = time.monotonic()
        served = _fresh(hardware.rig_file(), output / "served")
        frame_ms = 1000 * (time.monotonic() - began_s) / frames
    return _rows(simulated, repeated, served, plane_map, options, frame_ms, aligned)


def _rows(
    simulated: Run,
    repeated: Run,
    served: Run,
    plane_map: PlaneMap,
    options: ServeOptions,
    frame_ms: float,
    aligned: bool,
) -> list[Row]:
    rig_file = simulated.rig_file
    built = reconstruct(simulated, plane_map)
    reference = built.raw
    rms_mm = _on_slices(built.require_alignment(), rig_file) if aligned else _as_measured
    where = "slices" if aligned else "columns"
    seed = scene_of(rig_file).tank.sensor.seed
    coding = f"JPEG quality {options.quality}, {options.subsampling}"
    words: dict[str, Any] = {"seed": seed, "where": where, "coding": coding}
    figures = {
        "served-scan": reconstruct(served, plane_map).raw,
        "jpeg-alone": _coded(simulated, plane_map, options),
        "noise-alone": reconstruct(repeated, plane_map).raw,
    }
    words |= {"frames": len(served), "frame_ms": frame_ms, "other": seed + 1}
    return [row(key, rms_mm(raw, reference), **words) for key, raw in figures.items()]


def _on_slices(alignment: Alignment, rig_file: RigFile) -> Difference:
    """How to compare raw surfaces on the slices, all placed by one alignment."""
    piece = rig_file.rig.workpiece
    assert isinstance(piece, Sandwave)

    def rms_mm(surface: Surface, other: Surface) -> float:
        heights = [
            np.concatenate([resample(moved, ends).z_mm for ends in piece.slices_mm().values()])
            for moved in (place(raw, alignment, rig_file.rig) for raw in (surface, other))
        ]
        return _rms(heights[0] - heights[1])

    return rms_mm


def _as_measured(surface: Surface, other: Surface) -> float:
    """Rms difference in height of two raw surfaces, frame by frame and column by column, mm."""
    return _rms(surface.xyz_mm[..., 2] - other.xyz_mm[..., 2])


def _rms(difference: Floats) -> float:
    """Rms of the differences, where both have a value."""
    return float(np.sqrt(np.nanmean(difference**2)))


def _coded(run: Run, plane_map: PlaneMap, options: ServeOptions) -> Surface:
    """The raw surface of the run's pictures, each through the served camera's JPEG."""
    profiles = []
    for frame in run.frames():
        image = from_jpeg(jpeg_bytes(frame.image, options.quality, options.subsampling))
        stripe = extract_stripe(image, run.rig_file.rig.stripe)
        profiles.append(to_profile(stripe, plane_map, frame.position_mm))
    return build_surface(profiles, run.rig_file.rig)


def _fresh(rig_file: RigFile, folder: Path) -> Run:
    """A new run; an earlier one in the same folder is replaced, nothing else is."""
    if (folder / MANIFEST).exists():
        shutil.rmtree(folder)
    make_folder(folder.parent)
    return scan(rig_file, folder)
