"""The board picture taken from the live page, and the plane map solved from it."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from lscan.acquisition.scan import acquire_into
from lscan.acquisition.writer import RunWriter, create_run
from lscan.board import read_board
from lscan.calibration.calibrate import calibrate
from lscan.calibration.calibrationfile import save_calibration
from lscan.calibration.check import carried
from lscan.calibration.planemap import PlaneMap
from lscan.config.rig import Plan, RigFile, parse_rig
from lscan.devices.api import Limited, Track
from lscan.errors import DeviceError
from lscan.live.devices import LiveDevices
from lscan.live.maptable import MapTable, tabulate
from lscan.pipeline import require_board


@dataclass(frozen=True)
class LiveCalibration:
    """The plane map in use, the file it is from, and its table.

    Attributes
    ----------
    path : Path, of the calibration file
    plane_map : PlaneMap, pixels to the plane of the sheet
    table : MapTable, the map at a grid of pixels, for the page
    """

    path: Path
    plane_map: PlaneMap
    table: MapTable


def use_map(path: Path, plane_map: PlaneMap, rig_file: RigFile) -> LiveCalibration:
    """A plane map as the live page uses it: carried to the rig's water, tabulated for its pictures.

    Parameters
    ----------
    path : Path
        The calibration file, which the page names.
    plane_map : PlaneMap
        Made for pictures of the rig's size.
    rig_file : RigFile
        The rig whose pictures are mapped.

    Returns
    -------
    LiveCalibration

    Raises
    ------
    InputError
        The map cannot be carried to the water, or the changes, that the rig states.
    """
    plane_map = carried(plane_map, rig_file.rig)
    return LiveCalibration(path, plane_map, tabulate(plane_map, rig_file.rig.camera.size_px))


def take_board(
    rig_file: RigFile, devices: LiveDevices, folder: Path
) -> tuple[LiveCalibration, str]:
    """The calibration from a board picture at the head's present position, and a line about it.

    A head outside its travel goes to the nearest position within.
    The picture goes into the run folder ``folder``, with a laser that was switched on off, and
    the calibration into ``folder.json``; ``lscan calibrate folder`` gives the same.
    Raises DeviceError (no folder is left), BoardNotFound (the picture is kept), InputError.
    """
    rig, board = rig_file.rig, require_board(rig_file)
    devices.ready()
    place_mm = _place_mm(devices.track, rig.plan)
    with (
        _run_if_taken(folder, _one_picture(rig_file, place_mm)) as writer,
        devices.laser_dark(),
        devices.for_scan() as (camera, track),
    ):
        run = acquire_into(writer, camera, track)
    reading = read_board(run.frame(0).image, board, channel=rig.calibration.channel)
    solved = calibrate(reading, rig.calibration.plane_map, rig.optics)
    path = folder.with_name(f"{folder.name}.json")
    save_calibration(path, solved)
    summary = (
        f"{int(reading.grid.found.sum())} control points in {folder}; "
        f"{solved.name}, {solved.rms_px:.3f} px rms, in {path}"
    )
    return use_map(path, solved.plane_map, rig_file), summary


def _place_mm(track: Track, plan: Plan) -> float:
    """The head's position, or the nearest one within the travel.

    After homing it rests at the switch, which may lie outside the travel.  Of a track that
    does not state its travel, the start of the plan is the one other place known to be within.
    """
    present_mm = track.position_mm
    if isinstance(track, Limited):
        low_mm, high_mm = track.limits_mm
        return min(max(present_mm, low_mm), high_mm)
    try:
        track.move_to(present_mm)
    except DeviceError:
        return plan.start_mm
    return present_mm


@contextmanager
def _run_if_taken(folder: Path, rig_file: RigFile) -> Iterator[RunWriter]:
    """A writer of a new run folder, which is removed again where no picture came into it."""
    writer = create_run(folder, rig_file)
    try:
        with writer:
            yield writer
    finally:
        if not writer.written:
            shutil.rmtree(folder, ignore_errors=True)


def _one_picture(rig_file: RigFile, position_mm: float) -> RigFile:
    """The rig with the plan of one picture at that position."""
    plan = {**rig_file.document.get("plan", {}), "start_mm": position_mm, "frames": 1}
    document = {**rig_file.document, "plan": plan}
    return parse_rig(document, source=rig_file.source, trusted=True)
