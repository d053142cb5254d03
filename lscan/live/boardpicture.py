"""The board picture taken from the live page, and the plane map solved from it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lscan.acquire import acquire_into
from lscan.controlpoints import read_board
from lscan.errors import InputError
from lscan.live.devices import LiveDevices
from lscan.live.maptable import MapTable, tabulate
from lscan.planemap.api import PlaneMap
from lscan.planemap.calibration import calibrate, save_calibration
from lscan.rig import RigFile, parse_rig
from lscan.runwriter import create_run


@dataclass(frozen=True)
class LiveCalibration:
    """The plane map in use, the file it is from, and its table."""

    path: Path
    plane_map: PlaneMap
    table: MapTable


def use_map(path: Path, plane_map: PlaneMap, rig_file: RigFile) -> LiveCalibration:
    """A plane map as the live page uses it, for pictures of the rig's size."""
    camera = rig_file.rig.camera
    table = tabulate(plane_map, (camera.width_px, camera.height_px))
    return LiveCalibration(path, plane_map, table)


def take_board(
    rig_file: RigFile, devices: LiveDevices, folder: Path
) -> tuple[LiveCalibration, str]:
    """The calibration from a board picture taken where the head stands, and a line about it.

    The picture goes into the run folder ``folder``, with a laser that was switched on off, and
    the calibration into ``folder.json``; ``lscan calibrate folder`` gives the same.
    Raises DeviceError, BoardNotFound (the picture is kept), InputError.
    """
    rig = rig_file.rig
    if rig.board is None:
        raise InputError("has no section [board]", where=rig_file.source)
    devices.ready()
    standing = _one_picture(rig_file, devices.track.position_mm)
    with (
        create_run(folder, standing) as writer,
        devices.laser_dark(),
        devices.for_scan() as (camera, track),
    ):
        run = acquire_into(writer, camera, track)
    reading = read_board(run.frame(0).image, rig.board, channel=rig.calibration.channel)
    solved = calibrate(reading, rig.calibration.plane_map, rig.optics)
    path = folder.with_name(f"{folder.name}.json")
    save_calibration(path, solved)
    told = (
        f"{int(reading.grid.found.sum())} control points in {folder}; "
        f"{solved.name}, {solved.rms_px:.3f} px rms, in {path}"
    )
    return use_map(path, solved.plane_map, rig_file), told


def _one_picture(rig_file: RigFile, position_mm: float) -> RigFile:
    """The rig with the plan of one picture where the head stands."""
    plan = {**rig_file.document.get("plan", {}), "start_mm": position_mm, "frames": 1}
    document = {**rig_file.document, "plan": plan}
    return parse_rig(document, source=rig_file.source, trusted=True)
