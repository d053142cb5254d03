"""Acquisition: from a rig and its scan plan to a run folder."""

import ast
import inspect
import logging
import math
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from lscan.acquisition.run import Run, laser_warning_repeated, open_run
from lscan.acquisition.writer import RunWriter, create_run, refuse_existing, resume_run
from lscan.config.rig import CameraSection, RigFile, drivers_of
from lscan.devices.api import (
    LASER_MAY_BE_LIT,
    Camera,
    ConnectionLost,
    Grab,
    LaserSwitch,
    PlaceChecking,
    Reconnecting,
    Track,
    longest_grab_s,
    require_rigs_picture,
    wrong_size,
)
from lscan.devices.signals import interrupted_by_signals, no_suspending, stop_signals_held
from lscan.errors import DeviceError, InputError
from lscan.records import Frame, Picture, Progress

GoOn = Callable[[], bool]
LIT_ATTEMPTS = 2
"""How often a picture is taken whose laser went off because it was overdue."""
FRAME_ATTEMPTS = 3
"""How often a frame is taken in which the connection to the track breaks and comes back."""

_log = logging.getLogger(__name__)


def scan(
    rig_file: RigFile,
    path: Path | str,
    *,
    resume: bool = False,
    position_restored: bool = False,
    progress: Progress | None = None,
) -> Run:
    """The complete run of the rig's plan, written to the folder ``path``.

    Parameters
    ----------
    rig_file : RigFile
        A real rig or a scene of the tank.
    path : Path or str
        A new folder, unless the run there is resumed.
    resume : bool
        Go on with the run in ``path``, losing no frame and repeating none; one that is complete
        is returned as it is, one that does not exist is begun.
    position_restored : bool
        Go on although the track may have lost its zero, because the user has put the head back
        and says that the position it reports is the true one.
    progress : callable, optional
        Called with (frames done, frames planned) at the start and after each frame.

    Raises
    ------
    InputError
        Where the folder cannot be used.
    DeviceError
        Where a device fails; what was recorded until then can be resumed.  Devices are closed
        in all cases.  A laser that could not be switched off is spoken of in a note, again
        with each error of a resumption, until it is known to be off.
    KeyboardInterrupt
        By a signal that would otherwise end the process with the laser lit, such as SIGTERM or
        SIGHUP, unless the caller handles it.

    Examples
    --------
    >>> import lscan
    >>> run = lscan.scan(lscan.load_rig("board.toml"), "runs/again")
    >>> len(run), run.state
    (1, 'complete')
    """
    path = Path(path)
    if resume:
        with laser_warning_repeated(path), resume_run(path, rig_file) as writer:
            if writer.written == writer.planned and not writer.manifest.laser_may_be_lit:
                return writer.finish()
            with open_devices(rig_file) as (camera, track):
                return acquire_into(
                    writer, camera, track, progress, position_restored=position_restored
                )
    # Devices first: where they do not open, no empty folder is in the next scan's way.
    refuse_existing(path)
    with open_devices(rig_file) as (camera, track), create_run(path, rig_file) as writer:
        return acquire_into(writer, camera, track, progress)


@contextmanager
def open_devices(rig_file: RigFile) -> Iterator[tuple[Camera, Track]]:
    """The rig's camera and track, opened by their drivers and closed at the end of the block.

    A signal that would end the process at once raises KeyboardInterrupt within the block, unless
    it has a handler already; none cuts the closing short.

    Parameters
    ----------
    rig_file : RigFile, names the drivers and their options

    Raises
    ------
    InputError
        A driver is unknown or refuses its options.
    DeviceError
        A device does not open, or the camera's pictures are not of the rig's size.
    """
    with interrupted_by_signals(unhandled_only=True), ExitStack() as opened:
        track = open_track(rig_file)
        opened.callback(_close, track)
        camera = open_camera(rig_file, track)
        opened.callback(_close, camera)
        yield camera, track


def _close(device: Camera | Track) -> None:
    with stop_signals_held(), no_suspending():
        device.close()


def open_track(rig_file: RigFile) -> Track:
    """The rig's track, opened by its driver.

    Parameters
    ----------
    rig_file : RigFile, names the driver and its options

    Raises
    ------
    InputError, DeviceError
        As ``open_devices``.
    """
    _, driver = drivers_of(rig_file.rig, rig_file.source)
    return driver.open(rig_file)


def open_camera(rig_file: RigFile, track: Track) -> Camera:
    """The rig's camera, opened by its driver; closed where its pictures are not of the rig's size.

    Parameters
    ----------
    rig_file : RigFile, names the driver and its options
    track : Track, the rig's, opened

    Raises
    ------
    InputError, DeviceError
        As ``open_devices``.
    """
    section = rig_file.rig.camera
    driver, _ = drivers_of(rig_file.rig, rig_file.source)
    camera: Camera = driver.open(rig_file, track)
    if camera.size_px != section.size_px:
        camera.close()
        raise wrong_size(camera.size_px, section, f"camera {section.driver!r}")
    return camera


def acquire_into(
    writer: RunWriter,
    camera: Camera,
    track: Track,
    progress: Progress | None = None,
    go_on: GoOn | None = None,
    *,
    position_restored: bool = False,
) -> Run:
    """The complete run: the frames still missing from ``writer`` are taken and written.

    Each frame's pictures and its row are on disk, synced, before the track moves on; a laser
    that the plan switches is off at the end, whatever happened, and off while a picture is overdue
    (``longest_grab_s``).  Where it cannot be switched off, the error says so in a note.  The
    devices stay open.

    Parameters
    ----------
    writer : RunWriter
        Of the rig and its plan.
    camera, track : Camera, Track
        Opened.
    progress : callable, optional
        Called with (frames done, frames planned) at the start and after each frame.
    go_on : callable, optional
        Asked before each frame; where it says no, the run is returned as it is then, to be
        resumed.
    position_restored : bool
        As in ``scan``.

    Raises
    ------
    DeviceError
        Where a device fails or delivers what a run cannot hold; nothing of that frame is
        recorded.
    InputError
        Where the disk refuses.
    """
    plan = writer.rig_file.rig.plan
    positions_mm = plan.positions_mm()
    report = progress or (lambda done, planned: None)
    report(writer.written, writer.planned)
    longest_s = longest_grab_s(camera)
    if writer.manifest.laser_may_be_lit and isinstance(track, LaserSwitch):
        _ScanLaser(track, writer, longest_s).end()
    if writer.written == writer.planned:
        return writer.finish()
    writer.keep_camera(camera)
    # A scan that goes on must not put its frames at shifted places.
    if not position_restored and writer.last_mm is not None and isinstance(track, PlaceChecking):
        next_mm, zero = positions_mm[writer.written], writer.manifest.track_zero
        track.check_place(writer.last_mm, next_mm, zero)
    with _keeping_zero(writer, track), _scan_laser(track, writer, longest_s) as laser:
        devices = _ScanDevices(writer.rig_file.rig.camera, camera, track, laser, plan.paired)
        while writer.written < writer.planned:
            if go_on is not None and not go_on():
                return open_run(writer.path, trusted=True)
            frame = devices.take(writer.written, positions_mm[writer.written])
            with nullcontext() if laser is None else laser.watched("the disk or the screen"):
                writer.append(frame)
                report(writer.written, writer.planned)
    return writer.finish()


@contextmanager
def _keeping_zero(writer: RunWriter, track: Track) -> Iterator[None]:
    """Note in the run which zero its positions count from, and at once if that is lost.

    Where the program is killed first, the track itself no longer has that zero.
    """
    if not isinstance(track, PlaceChecking) or track.zero is None:
        yield
        return
    writer.keep(track_zero=track.zero)
    try:
        yield
    finally:
        with suppress(InputError):  # the first fault is the one to report
            writer.keep(track_zero=track.zero)


@contextmanager
def _scan_laser(track: Track, writer: RunWriter, longest_s: float) -> Iterator["_ScanLaser | None"]:
    """The laser where the plan switches it, else None; at the end it is off.

    For the plan "on" it is lit from the start.  Raises DeviceError where the track has no switch
    and the plan needs one.
    """
    plan = writer.rig_file.rig.plan
    if plan.laser == "untouched":
        yield None
        return
    if not isinstance(track, LaserSwitch):
        raise DeviceError(f"plan.laser = {plan.laser!r}: this track switches no laser")
    laser = _ScanLaser(track, writer, longest_s)
    writer.keep(laser_may_be_lit=True)  # however the program ends
    with no_suspending():
        try:
            if not plan.paired:
                laser.on()
            yield laser
        except BaseException as error:
            laser.end(error)
            raise
        laser.end()


@dataclass
class _ScanLaser:
    """The laser of a scan, which is off while anything takes longer than it may.

    writer: of the run, which keeps whether the laser may be lit.
    longest_s: how long a picture, or anything but a motion, may take while it is lit.
    lit: it is, or may be.
    """

    switch: LaserSwitch
    writer: RunWriter
    longest_s: float
    lit: bool = False

    def on(self) -> None:
        """Light it, where it is not lit."""
        if not self.lit:
            self.lit = True
            self.switch.laser_on()

    def off(self) -> None:
        """Switch it off."""
        self.switch.laser_off()
        self.lit = False

    def end(self, fault: BaseException | None = None) -> None:
        """Switch it off, whatever signal comes meanwhile; where that fails, the fault notes it.

        fault: what ended the scan, and is the one to report; None where all was well.
        """
        with stop_signals_held():
            try:
                self.off()
            except Exception as error:  # of any driver
                (fault or error).add_note(LASER_MAY_BE_LIT)
                if fault is None:
                    raise
            else:
                with suppress(InputError):  # a warning too many does no harm
                    self.writer.keep(laser_may_be_lit=False)

    @contextmanager
    def watched(self, what: str) -> Iterator[None]:
        """Switch it off where the block, in which nothing else uses the track, takes too long."""
        if not self.lit or math.isinf(self.longest_s):
            yield
            return
        timer = threading.Timer(self.longest_s, self._overdue, args=(what,))
        timer.daemon = True
        timer.start()
        try:
            yield
        finally:
            with stop_signals_held():  # the track is of one thread at a time
                timer.cancel()
                timer.join()

    def _overdue(self, what: str) -> None:
        late = f"{what} takes longer than {self.longest_s:g} s"
        try:
            self.switch.laser_off()
            self.lit = False
            _log.warning("%s: the laser is off meanwhile", late)
        except Exception:
            _log.warning("%s: %s", late, LASER_MAY_BE_LIT)


@dataclass
class _ScanDevices:
    """Camera and track at work on one scan.

    laser: where the plan switches it.  paired: whether each frame is a pair.
    last_time_s: of the picture before, which the next must exceed.
    """

    section: CameraSection
    camera: Camera
    track: Track
    laser: _ScanLaser | None
    paired: bool
    last_time_s: float = -math.inf

    def take(self, index: int, commanded_mm: float) -> Frame:
        """The frame taken there, checked; DeviceError where a run cannot hold it.

        Where the connection to the track breaks meanwhile, and the track is reached again with
        its zero kept, all of the frame is taken anew.
        """
        last_time_s = self.last_time_s
        for _ in range(FRAME_ATTEMPTS - 1):
            try:
                return self._take_once(index, commanded_mm)
            except ConnectionLost as lost:
                if not isinstance(self.track, Reconnecting):
                    raise
                lit = f"; meanwhile {LASER_MAY_BE_LIT}" if self.laser and self.laser.lit else ""
                _log.warning("%s; frame %d is taken anew once it is reached%s", lost, index, lit)
                self.track.reconnect()
                if self.laser is not None:
                    self.laser.lit = False
                self.last_time_s = last_time_s
        return self._take_once(index, commanded_mm)

    def _take_once(self, index: int, commanded_mm: float) -> Frame:
        position_mm = self.track.move_to(commanded_mm)
        grab = self.camera.grab(index) if self.laser is None else self._grab_lit(index, self.laser)
        lit = self._check_grab(grab, index)
        background = None
        if self.paired and self.laser is not None:
            background = self._background(index, lit, self.laser)
        _require_finite("position_mm", position_mm, index)
        places_mm = commanded_mm, position_mm
        return Frame(lit.image, index, *places_mm, lit.time_s, lit.exposure_ms, background)

    def _grab_lit(self, index: int, laser: _ScanLaser) -> Grab:
        """A picture with the laser on all the time; one that came too late is taken again."""
        name = f"camera {self.section.driver!r}: frame {index}"
        for _ in range(LIT_ATTEMPTS):
            laser.on()
            with laser.watched(name):
                grab = self.camera.grab(index)
            if laser.lit:
                return grab
        raise DeviceError(
            f"{name} took longer than {laser.longest_s:g} s {LIT_ATTEMPTS} times, and the laser "
            "went off; check the camera, or have it take fewer pictures for a frame"
        )

    def _background(self, index: int, lit: Grab, laser: _ScanLaser) -> Picture:
        """The same view with the laser off, which must have been taken like the lit one."""
        laser.off()
        dark = self._check_grab(self.camera.grab(index, dark=True), index)
        for name, one, other in (
            ("shape", dark.image.shape, lit.image.shape),
            ("exposure_ms", dark.exposure_ms, lit.exposure_ms),
        ):
            if one != other:
                raise DeviceError(
                    f"camera {self.section.driver!r}: frame {index}: its background has {name} "
                    f"{one}, the picture with the laser on {other}; they must be alike: let the "
                    "camera change nothing by itself"
                )
        return dark.image

    def _check_grab(self, grab: Grab, index: int) -> Grab:
        """The picture; DeviceError where it is not what a run folder can hold."""
        section = self.section
        require_rigs_picture(grab.image, section, f"camera {section.driver!r}: frame {index}")
        _require_finite("time_s", grab.time_s, index)
        _require_finite("exposure_ms", grab.exposure_ms, index)
        if grab.time_s <= self.last_time_s:
            raise DeviceError(
                f"camera {section.driver!r}: frame {index} is an old picture: its time, "
                f"{grab.time_s} s, is not after that of the picture before, {self.last_time_s} s"
            )
        self.last_time_s = grab.time_s
        return grab


def _require_finite(name: str, number: float, index: int) -> None:
    if not math.isfinite(number):
        raise DeviceError(f"frame {index}: a device reported {name} that is not finite")


# Work on several pictures at once, whose results come in the pictures' order.


_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_AHEAD = 2  # calls begun or waiting for each thread, so that none waits for the next item


def in_order(work: Callable[[_Item], _Result], items: Iterable[_Item]) -> Iterator[_Result]:
    """The results of a call for each item, in the items' order, made on a thread for each core.

    Threads run at once where OpenCV and NumPy compute: meanwhile these do not hold Python's lock.
    An exception is raised in the place of its result, after all results before it.  Whoever ends
    the iteration early, as Ctrl-C does, waits for the calls that have begun, and no others begin.

    Parameters
    ----------
    work : callable, of one item; it is called from several threads at once
    items : iterable, taken a few ahead of the results

    Examples
    --------
    >>> list(in_order(abs, range(-3, 2)))
    [3, 2, 1, 0, 1]
    """
    threads = cores()
    with ThreadPoolExecutor(threads) as pool:
        begun: deque[Future[_Result]] = deque()
        try:
            for item in items:
                begun.append(pool.submit(work, item))
                if len(begun) >= _AHEAD * threads:
                    yield begun.popleft().result()
            while begun:
                yield begun.popleft().result()
        finally:
            for waiting in begun:
                waiting.cancel()


def cores() -> int:
    """How many cores this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)  # not on macOS and Windows
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def require_guarded_main() -> None:
    """Refuse to start processes from the body of a script, which each of them would run again.

    Python imports the script in every process that it starts, all but what stands beneath
    ``if __name__ == "__main__":``.

    Raises
    ------
    InputError
        The call is made in a script's body; names the line.
    """
    main = sys.modules["__main__"]
    file, spec = getattr(main, "__file__", None), getattr(main, "__spec__", None)
    if file is None or (spec is not None and spec.name.endswith("__main__")):
        return  # typed in, or of a package's __main__: not imported by others
    lines = [
        (one.lineno, one.frame.f_code.co_name)
        for one in inspect.stack(0)
        if one.frame.f_globals is vars(main)
    ]
    if not lines or lines[-1][1] != "<module>":
        return
    body, line = ast.parse(Path(file).read_bytes()).body, lines[-1][0]
    (statement,) = (one for one in body if one.lineno <= line <= (one.end_lineno or line))
    names = {one.id for one in ast.walk(statement) if isinstance(one, ast.Name)}
    if not (isinstance(statement, ast.If) and "__name__" in names):
        what = "starts processes, each of which would run this script again"
        allowed = 'beneath if __name__ == "__main__":'
        raise InputError(what, where=f"{file} line {line}", allowed=allowed)
