"""Acquisition: from a rig and its scan plan to a run folder."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from lscan.devices.api import Camera, Grab, Track
from lscan.errors import DeviceError
from lscan.records import Frame
from lscan.rig import CameraSection, RigFile, find_plugin
from lscan.run import Run
from lscan.runwriter import RunWriter, create_run, refuse_existing, resume_run

Progress = Callable[[int, int], None]


def scan(
    rig_file: RigFile, path: Path, *, resume: bool = False, progress: Progress | None = None
) -> Run:
    """The complete run of the rig's plan, written to the folder ``path``.

    resume: go on with the run in ``path``, losing no frame and repeating none; one that is
        complete is returned as it is, one that does not exist is begun.
    progress: called with (frames done, frames planned) at the start and after each frame.
    Raises InputError where the folder cannot be used, DeviceError where a device fails;
    what was recorded until then can be resumed.  Devices are closed in all cases.
    """
    if resume:
        with resume_run(path, rig_file) as writer:
            if writer.written == writer.planned:
                return writer.finish()
            with open_devices(rig_file) as (camera, track):
                return acquire_into(writer, camera, track, progress)
    # Devices first: where they do not open, no empty folder is in the next scan's way.
    refuse_existing(path)
    with open_devices(rig_file) as (camera, track), create_run(path, rig_file) as writer:
        return acquire_into(writer, camera, track, progress)


@contextmanager
def open_devices(rig_file: RigFile) -> Iterator[tuple[Camera, Track]]:
    """The rig's camera and track, opened by their drivers and closed at the end of the block.

    Raises InputError where a driver is unknown or refuses its options, DeviceError where a
    device does not open or the camera's pictures are not of the rig's size.
    """
    rig = rig_file.rig
    track_driver = find_plugin("lscan.tracks", rig.track.driver, where="track.driver")
    camera_driver = find_plugin("lscan.cameras", rig.camera.driver, where="camera.driver")
    with ExitStack() as opened:
        track = track_driver.open(rig_file)
        opened.callback(track.close)
        camera = camera_driver.open(rig_file, track)
        opened.callback(camera.close)
        if camera.size_px != (rig.camera.width_px, rig.camera.height_px):
            raise _wrong_size(camera.size_px, rig.camera)
        yield camera, track


def acquire_into(
    writer: RunWriter, camera: Camera, track: Track, progress: Progress | None = None
) -> Run:
    """The complete run: the frames still missing from ``writer`` are taken and written.

    Each picture and its row are on disk, synced, before the track moves on.  Raises
    DeviceError where a device fails or delivers what a run cannot hold (nothing of that
    frame is recorded), InputError where the disk refuses.  The devices stay open.
    """
    positions_mm = writer.rig_file.rig.plan.positions_mm()
    last_time_s = -math.inf
    if progress is not None:
        progress(writer.written, writer.planned)
    while writer.written < writer.planned:
        frame = _take(writer.written, positions_mm[writer.written], camera, track)
        _check(frame, writer.rig_file.rig.camera, last_time_s)
        writer.append(frame)
        last_time_s = frame.time_s
        if progress is not None:
            progress(writer.written, writer.planned)
    return writer.finish()


def _take(index: int, commanded_mm: float, camera: Camera, track: Track) -> Frame:
    position_mm = track.move_to(commanded_mm)
    grab: Grab = camera.grab(index)
    return Frame(
        image=grab.image,
        index=index,
        commanded_mm=commanded_mm,
        position_mm=position_mm,
        time_s=grab.time_s,
        exposure_ms=grab.exposure_ms,
    )


def _check(frame: Frame, section: CameraSection, last_time_s: float) -> None:
    """Raise DeviceError where a device delivered what a run folder cannot hold."""
    image = frame.image
    if image.dtype != np.uint8 or image.ndim < 2 or image.shape[2:] not in ((), (3,)):
        raise DeviceError(
            f"camera {section.driver!r}: frame {frame.index} is {image.dtype} of shape "
            f"{image.shape}; allowed: uint8, (H, W) or (H, W, 3)"
        )
    height, width = image.shape[:2]
    if (width, height) != (section.width_px, section.height_px):
        raise _wrong_size((width, height), section)
    for name in ("position_mm", "time_s", "exposure_ms"):
        if not math.isfinite(getattr(frame, name)):
            raise DeviceError(f"frame {frame.index}: a device reported {name} that is not finite")
    if frame.time_s <= last_time_s:
        raise DeviceError(
            f"camera {section.driver!r}: frame {frame.index} is an old picture: its time, "
            f"{frame.time_s} s, is not after that of the frame before, {last_time_s} s"
        )


def _wrong_size(size_px: tuple[int, int], section: CameraSection) -> DeviceError:
    return DeviceError(
        f"camera {section.driver!r}: pictures are {size_px[0]} by {size_px[1]} px; "
        f"the rig says {section.width_px} by {section.height_px} px"
    )
