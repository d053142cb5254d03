"""One session of the live page: devices, the threads that look and measure, and the commands."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar

from lscan.acquisition.run import laser_warning_repeated
from lscan.config.rig import RigFile
from lscan.devices.api import Grab
from lscan.live.analysis import (
    BestFocus,
    BoardFigures,
    Figures,
    board_json,
    figures_json,
    jpeg_of,
    measure_line,
    measure_picture,
    picture_answer,
    read_live_board,
)
from lscan.live.devices import LiveDevices, NotNow, one_line
from lscan.live.scanning import LiveCalibration, Scanning, find_unfinished, next_name, take_board
from lscan.pipeline import build_surface, require_board
from lscan.records import Profile
from lscan.surface.recording import LiveRecording

# A place for the newest of a kind: whoever is slow misses the ones between, and holds up none.


T = TypeVar("T")

RATE_OVER_S = 2.0


class Newest(Generic[T]):
    """The newest value put here, numbered from 1."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._value: T | None = None
        self._number = 0
        self._times_s: deque[float] = deque()
        self._listener: Callable[[], None] = lambda: None

    def put(self, value: T) -> None:
        """Replace the value, wake those who wait and call the listener."""
        with self._changed:
            self._value, self._number = value, self._number + 1
            self._times_s.append(time.monotonic())
            self._changed.notify_all()
        self._listener()

    def listen(self, listener: Callable[[], None]) -> None:
        """Call ``listener``, which must not block, after each value put from now on."""
        self._listener = listener

    def after(self, number: int, timeout_s: float = 0.0) -> tuple[int, T] | None:
        """The newest value and its number where that is above ``number``; None if not in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._number > number, timeout_s)
            if self._number <= number or self._value is None:
                return None
            return self._number, self._value

    def rate_hz(self) -> float:
        """Values per second over the last RATE_OVER_S."""
        with self._changed:
            while self._times_s and self._times_s[0] < time.monotonic() - RATE_OVER_S:
                self._times_s.popleft()
            return len(self._times_s) / RATE_OVER_S


# One session of the live page: devices, the threads that look and measure, and the commands.


Mode = Literal["stripe", "board"]
Phase = Literal["alignment", "calibrated", "scan"]
"""What goes on, by which advice holds: optics are turned in alignment alone, because a
calibration and a scan are those of the optics that they began with."""

SHORTEST_PERIOD_S = 1 / 30
"""Between two pictures looked at: more is not seen, and takes time from a scan."""

RETRY_S = 1.0
"""Between two attempts to open a camera that failed."""

CHECK_S = 1.0
"""Between two questions to a resting track whether it still answers."""

REST_PER_READING = 1.0
"""How long the reading of boards rests, over how long a reading takes."""

WAIT_S = 0.2
"""How long a thread waits before it looks whether the page is being closed."""


@dataclass(frozen=True)
class LivePicture:
    """A picture and where the head stood, by the track, when it came; taken_s: monotonic."""

    grab: Grab
    position_mm: float | None
    taken_s: float


class Session:
    """Everything behind the live page but the server: devices, measurements and commands.

    Parameters
    ----------
    rig_file : RigFile
        Its camera and track are opened, and pictures are taken and measured from then on.
    output : Path
        Folder for the run folders of scans and of board pictures.
    calibration : LiveCalibration, optional
        The plane map of the profiles; without one there are none until a board picture is taken.
    recording : LiveRecording, optional
        To which each picture that is measured is added.  It ends with the first failure, which
        :meth:`state` reports.

    Raises
    ------
    InputError, DeviceError
        Where a device does not open.  A device that fails later is reported by :meth:`state`,
        and opened again.
    """

    def __init__(
        self,
        rig_file: RigFile,
        output: Path,
        calibration: LiveCalibration | None = None,
        recording: LiveRecording | None = None,
    ) -> None:
        self._rig_file, self._output, self._calibration = rig_file, output, calibration
        self._pictures: Newest[LivePicture] = Newest()
        self._mode: Mode = "stripe"
        self._focus = BestFocus()
        self._board_read: tuple[BoardFigures, float] | None = None  # and when its picture came
        self._fault = self.recording_fault = ""
        self._recording, self._since_1970_ns = recording, time.time_ns() - time.monotonic_ns()
        self._task, self._task_message, self._task_failed = "", "", False
        self._commands = threading.Lock()
        self._closing = threading.Event()
        self.frames: Newest[bytes] = Newest()
        folder, _ = find_unfinished(output, rig_file) or (output, 0)
        with laser_warning_repeated(folder):
            self._devices = LiveDevices(rig_file, self._show)
        self.scanning = Scanning(rig_file, self._devices, output)
        self._task_thread: threading.Thread | None = None
        loops = (self._look, self._measure, self._read_boards, self._check_track)
        self._threads = [threading.Thread(target=loop, name=loop.__name__) for loop in loops]
        for thread in self._threads:
            thread.start()

    def close(self) -> Path | None:
        """Stop a scan after its frame, switch the laser off and release the devices.

        Returns
        -------
        Path or None
            The run folder of a scan that is not finished; None where there is no such scan.
        """
        unfinished = self.scanning.close()
        with suppress(Exception):  # tried again in the end
            self._devices.laser_off()  # before threads are waited for that wait for a camera
        self._closing.set()
        for thread in (*self._threads, self._task_thread):
            if thread is not None:
                thread.join()
        self._devices.close()
        return unfinished

    @property
    def laser_warning(self) -> str:
        """What to do about a laser that may be lit and cannot be switched off, else ""."""
        return self._devices.laser_warning

    # ---- commands -----------------------------------------------------------------------

    def set_mode(self, mode: Mode) -> None:
        """Choose what is looked for in the pictures.

        Parameters
        ----------
        mode : Mode, what is looked for

        Raises
        ------
        InputError
            The rig has no board.
        """
        if mode == "board":
            require_board(self._rig_file)
        self._mode, self._board_read = mode, None
        self._focus.forget()
        if self._task_failed:  # it says nothing of the other mode
            self._task_message = ""

    def take_board(self) -> None:
        """Begin the board picture; NotNow while a scan or another command goes on."""
        with self._exclusive():
            require_board(self._rig_file)
            folder = self._output / next_name(self._output, "board")
            self._task, self._task_message = "board picture", f"taking it into {folder}"
            self._task_failed = False
            self._task_thread = threading.Thread(target=self._run_task, args=(folder,))
            self._task_thread.start()

    def start_scan(self, name: str | None = None) -> None:
        """Begin a scan; errors as Scanning.start, and NotNow beside another command or a scan.

        Parameters
        ----------
        name : str or None, of the run folder; ``scan-NNN`` where it is None
        """
        with self._exclusive():
            self.scanning.start(name)
            self._task_message = ""  # of a board picture before it

    def resume_scan(self) -> None:
        """Go on with a scan.

        Errors as Scanning.resume, and NotNow beside another command or a scan.
        """
        with self._exclusive():
            self.scanning.resume()
            self._task_message = ""

    def move_to(self, position_mm: float) -> None:
        """Move the head.

        Parameters
        ----------
        position_mm : float, mm, along the track

        Raises
        ------
        DeviceError
            The track fails or refuses.
        NotNow
            Something else moves it.
        """
        with self._exclusive():
            self._devices.move_to(position_mm)

    def switch_laser(self, on: bool) -> None:
        """Switch the laser.

        Parameters
        ----------
        on : bool, lit, or dark

        Raises
        ------
        InputError
            The track cannot switch it.
        NotNow
            A scan uses it.
        """
        with self._exclusive():
            self._devices.switch_laser(on)

    @contextmanager
    def _exclusive(self) -> Iterator[None]:
        """One command at a time, and none beside a scan or a board picture."""
        if not self._commands.acquire(blocking=False):
            raise NotNow("another command is being carried out")
        try:
            if self.scanning.active:
                raise NotNow("a scan is going on: pause or stop it first")
            if self._task:
                raise NotNow(f"wait for the {self._task}")
            yield
        finally:
            self._commands.release()

    def _run_task(self, folder: Path) -> None:
        try:
            self._calibration, message = take_board(self._rig_file, self._devices, folder)
        except Exception as error:
            self._task_failed, message = True, one_line(error)
        self._task, self._task_message = "", message

    # ---- the threads --------------------------------------------------------------------

    def _show(self, grab: Grab) -> None:
        self._pictures.put(LivePicture(grab, self._devices.position_mm, time.monotonic()))

    def _look(self) -> None:
        while not self._closing.is_set():
            began_s = time.monotonic()
            shown = self._devices.look()
            failed = not shown and not self.scanning.active
            period_s = RETRY_S if failed else SHORTEST_PERIOD_S
            self._closing.wait(max(0.0, began_s + period_s - time.monotonic()))

    def _check_track(self) -> None:
        while not self._closing.wait(CHECK_S):
            self._devices.check_track()

    def _measure(self) -> None:
        number, shown = 0, 0  # of pictures come, and of those measured: browsers count these
        while not self._closing.is_set():
            if (newest := self._pictures.after(number, WAIT_S)) is not None:
                number, picture = newest
                shown += 1
                self.frames.put(self._frame(shown, picture))

    def _read_boards(self) -> None:
        number = 0
        while not self._closing.is_set():
            newest = self._pictures.after(number, WAIT_S)
            board = self._rig_file.rig.board
            if newest is None or self._mode != "board" or board is None:
                self._closing.wait(WAIT_S)
                continue
            number, picture = newest
            calibration = self._calibration
            plane_map = calibration.plane_map if calibration else None
            try:
                image = picture.grab.image
                read = read_live_board(image, board, self._rig_file.rig, plane_map)
            except Exception as error:
                self._fault = one_line(error)
                continue
            if self._mode == "board":
                self._board_read = read, picture.taken_s
            self._closing.wait(REST_PER_READING * (time.monotonic() - picture.taken_s))

    def _frame(self, number: int, picture: LivePicture) -> bytes:
        """The picture measured and packed for the browsers, once for all of them."""
        mode = self._mode
        figures = self._figures(picture, mode)
        self._record(picture, figures)
        best = self._focus.among(figures.focus, picture.position_mm)
        image, board = picture.grab.image, self._board_read
        document = {
            "number": number,
            "time_s": picture.grab.time_s,
            "size_px": [image.shape[1], image.shape[0]],
            "rate_hz": self.frames.rate_hz(),
            "camera_hz": self._pictures.rate_hz(),
            "exposure_ms": picture.grab.exposure_ms,
            "position_mm": picture.position_mm,
            "mode": mode,
            "phase": self._phase(),
            **figures_json(figures),
            "focus_best": round(best, 2),
            "board": board and board_json(board[0], time.monotonic() - board[1]),
        }
        return picture_answer(document, jpeg_of(image))

    def _record(self, picture: LivePicture, figures: Figures) -> None:
        if self._recording is None:
            return
        calibration, surface = self._calibration, None
        stamp = self._since_1970_ns + round(1e9 * picture.taken_s)
        try:
            if calibration and figures.profile and figures.line and picture.position_mm is not None:
                brightness = figures.line.stripe.peak
                profile = Profile(picture.position_mm, figures.profile, brightness)
                surface = build_surface([profile], self._rig_file.rig)
            plane_map = calibration.plane_map if calibration else None
            self._recording.add(stamp, picture.grab.image, picture.position_mm, surface, plane_map)
        except Exception as error:
            self._recording, self.recording_fault = None, f"recording ended: {one_line(error)}"

    def _phase(self) -> Phase:
        if self.scanning.under_way:
            return "scan"
        return "calibrated" if self._calibration else "alignment"

    def _figures(self, picture: LivePicture, mode: Mode) -> Figures:
        settings, calibration = self._rig_file.rig.stripe, self._calibration
        try:
            if mode == "board":
                figures = measure_picture(picture.grab.image, settings)
            else:
                plane_map = calibration.plane_map if calibration else None
                figures = measure_line(picture.grab.image, settings, plane_map)
        except Exception as error:
            self._fault = one_line(error)
            return Figures(0.0, 0.0, None, None)
        self._fault = ""
        return figures

    # ---- the state ----------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """The state of all as the page shows it, in JSON types."""
        rig, devices, calibration = self._rig_file.rig, self._devices, self._calibration
        newest = self._pictures.after(0)
        seen_s_ago = None if newest is None else round(time.monotonic() - newest[1].taken_s, 1)
        return {
            "rig": rig.name,
            "source": self._rig_file.source,
            "camera": {
                "driver": rig.camera.driver,
                "size_px": list(rig.camera.size_px),
                "error": devices.camera_error or self._fault or self.recording_fault,
                "gone": bool(devices.camera_error),
                "seen_s_ago": seen_s_ago,
            },
            "track": {
                "driver": rig.track.driver,
                "position_mm": devices.position_mm,
                "error": devices.track_error,
            },
            "can_switch_laser": devices.can_switch_laser,
            "laser": {True: "on", False: "off", None: None}[devices.laser],
            "laser_warning": devices.laser_warning,
            "calibration": str(calibration.path) if calibration else None,
            "board": rig.board is not None,
            "mode": self._mode,
            "plan": rig.plan.model_dump(include={"start_mm", "step_mm", "frames"}),
            "scan": self.scanning.state(),
            "task": {"name": self._task, "message": self._task_message},
        }
