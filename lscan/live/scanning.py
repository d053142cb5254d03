"""What the live page begins: a scan in a thread of its own, and the picture of the board."""

import re
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from glob import glob
from pathlib import Path
from typing import Any, Literal

from lscan.acquisition.run import MANIFEST, TABLE, most_table_bytes, read_manifest, require_same_rig
from lscan.acquisition.scan import acquire_into
from lscan.acquisition.writer import RunWriter, create_run, resume_run
from lscan.board import read_board
from lscan.calibration.calibrate import calibrate
from lscan.calibration.calibrationfile import save_calibration
from lscan.calibration.check import map_for_rig
from lscan.calibration.planemap import PlaneMap
from lscan.config.rig import Plan, RigFile, parse_rig
from lscan.devices.api import Limited, Track
from lscan.errors import DeviceError, InputError, LscanError
from lscan.files.disk import read_bytes
from lscan.live.devices import LiveDevices, NotNow, one_line
from lscan.pipeline import require_board

# Start, pause, resume and stop of a scan, which runs in a thread of its own.

State = Literal["idle", "scanning", "paused", "stopping", "done", "failed"]
SOON = "after this frame, or once a camera or track that hangs is given up"
KEPT = "frames are kept; Resume goes on"
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")


class Scanning:
    """The scan of the live page: one at a time, each into a folder of ``output``.

    A run of the same rig that lies there unfinished can be resumed, the newest of them.
    """

    def __init__(self, rig_file: RigFile, devices: LiveDevices, output: Path) -> None:
        self._rig_file, self._devices, self._output = rig_file, devices, output
        self._lock = threading.Lock()
        self._state: State = "idle"
        self._after: State = "idle"  # the state after a requested stop
        self._by_device = False
        left = find_unfinished(output, rig_file)
        self._folder, self._done = left or (None, 0)  # type: Path | None, int
        self._message = KEPT if left else ""
        self._begun_at, self._began_s, self._earlier_s = 0, 0.0, 0.0
        self._thread: threading.Thread | None = None

    @property
    def active(self) -> bool:
        """Whether a scan is going on, or about to end."""
        return self._state in ("scanning", "stopping")

    @property
    def under_way(self) -> bool:
        """Whether a scan has begun that is to end with these very optics and settings."""
        return self._state in ("scanning", "stopping", "paused", "failed")

    def state(self) -> dict[str, Any]:
        """How far the scan is now, in JSON types.

        left_s: None before any frame is taken.  by_device: whether the scan failed by a fault
        of the camera or the track, which report it themselves.
        """
        with self._lock:
            planned = self._rig_file.rig.plan.frames
            session_s = time.monotonic() - self._began_s if self.active else 0.0
            taken = self._done - self._begun_at
            left_s = session_s / taken * (planned - self._done) if self.active and taken else None
            return {
                "state": self._state,
                "folder": str(self._folder) if self._folder else None,
                "done": self._done,
                "planned": planned,
                "elapsed_s": round(self._earlier_s + session_s, 1),
                "left_s": None if left_s is None else round(left_s, 1),
                "message": self._message,
                "by_device": self._by_device,
            }

    def start(self, name: str | None = None) -> None:
        """Begin a scan into a new folder, ``scan-NNN`` where no name is given.

        The caller ensures that none goes on.  Raises InputError for a name that is none or a
        folder that cannot be made, DeviceError where the track does not come back.
        """
        if name and not NAME.fullmatch(name):
            allowed = "letters, digits, '.', '_' and '-', the first a letter or a digit"
            raise InputError("not a folder name", where="name", value=name, allowed=allowed)
        folder = self._output / (name or next_name(self._output, "scan"))
        self._devices.ready()
        self._earlier_s = 0.0
        self._begin(create_run(folder, self._rig_file))

    def resume(self) -> None:
        """Go on with the scan that was paused, stopped or failed.

        Errors as start, and NotNow where there is none.
        """
        if self._folder is None or self._state == "done":
            raise NotNow("there is no scan to go on with")
        self._devices.ready()
        self._begin(resume_run(self._folder, self._rig_file))

    def pause(self) -> None:
        """End after the frame being taken, to be resumed.  Raises NotNow where none goes on."""
        if self._state != "scanning":
            raise NotNow("no scan is going on")
        self._stop("paused", f"pausing {SOON}")

    def stop(self) -> None:
        """End after the frame being taken.  Raises NotNow where no scan goes on or is paused."""
        if self._state == "paused":
            with self._lock:
                self._state, self._message = "idle", KEPT
        elif self.active:
            self._stop("idle", f"stopping {SOON}")
        else:
            raise NotNow("no scan is going on")

    def close(self) -> Path | None:
        """Stop a scan and wait for its end; the folder of a scan that is not finished."""
        if self.active:
            self._stop("idle", f"stopping {SOON}")
        if self._thread is not None:
            self._thread.join()
        unfinished = self._thread and self._done < self._rig_file.rig.plan.frames
        return self._folder if unfinished else None

    def _stop(self, after: State, message: str) -> None:
        with self._lock:
            if self.active:
                self._state, self._after, self._message = "stopping", after, message

    def _begin(self, writer: RunWriter) -> None:
        with self._lock:
            self._state, self._after, self._message = "scanning", "idle", ""
            self._folder, self._done, self._begun_at = writer.path, writer.written, writer.written
            self._began_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, args=(writer,), name="scan")
        self._thread.start()

    def _run(self, writer: RunWriter) -> None:
        try:
            with writer, self._devices.for_scan() as (camera, track):
                run = acquire_into(
                    writer, camera, track, self._count, lambda: self._state == "scanning"
                )
        except Exception as error:
            kept = f"{writer.written} of {writer.planned} {KEPT}"
            self._by_device = isinstance(error, DeviceError)
            self._end("failed", f"{one_line(error)}. {kept}")
        else:
            if run.state == "complete":
                self._end("done", "")
            else:
                self._end(self._after, KEPT)

    def _count(self, done: int, planned: int) -> None:
        with self._lock:
            self._done = done

    def _end(self, state: State, message: str) -> None:
        with self._lock:
            self._earlier_s += time.monotonic() - self._began_s
            self._state, self._message = state, message


def next_name(output: Path, stem: str) -> str:
    """``stem-NNN``, the number above the greatest there is in the folder ``output``."""
    taken = [0]
    for name in glob(f"{stem}-*", root_dir=output):  # noqa: PTH207 - takes any text
        with suppress(ValueError):
            taken.append(int(name.partition(".")[0][len(stem) + 1 :]))
    return f"{stem}-{max(taken) + 1:03d}"


def find_unfinished(output: Path, rig_file: RigFile) -> tuple[Path, int] | None:
    """Of this very rig's runs in ``output`` the last written to, if unfinished, and its frames.

    None where that one is complete or there is none: an older one is left to ``lscan scan
    --resume``.  Reads only; what a kill left of a frame is cleared away once it is resumed.
    """
    tables = [output / name for name in glob(f"*/{TABLE}", root_dir=output)]  # noqa: PTH207
    for table in sorted(tables, key=_written_s, reverse=True):
        with suppress(LscanError, OSError):
            manifest, begun = read_manifest(table.parent)
            require_same_rig(begun, rig_file, where=table.parent / MANIFEST)
            if manifest.state == "complete":
                return None
            held = read_bytes(table, most_table_bytes(manifest.plan), within=table.parent)
            rows = held.count(b"\n") - 1  # under the header, a torn one left out
            return table.parent, max(rows, 0)
    return None


def _written_s(file: Path) -> float:
    try:
        return file.stat().st_mtime
    except OSError:  # gone meanwhile
        return 0.0


# The board picture taken from the live page, and the plane map solved from it.


@dataclass(frozen=True)
class LiveCalibration:
    """The plane map in use, and the file it is from.

    Attributes
    ----------
    path : Path, of the calibration file
    plane_map : PlaneMap, pixels to the plane of the sheet
    """

    path: Path
    plane_map: PlaneMap


def use_map(path: Path, plane_map: PlaneMap, rig_file: RigFile) -> LiveCalibration:
    """A plane map as the live page uses it: carried to the rig's water.

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
    return LiveCalibration(path, map_for_rig(plane_map, rig_file.rig))


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
