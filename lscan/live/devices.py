"""The rig's camera and track on the live page: opened once, shared, opened again after a failure.

A camera that can be looked at (api.Previewing) is shown all the time.  Any other is shown by
grabs while no scan goes on, and by the scan's own pictures while one does, so that a scan
gets the pictures it would get without the page.  A track is asked now and then whether it still
answers, and opened again by the next command that needs it.
"""

import contextlib
import math
import threading
from collections.abc import Callable, Iterator

from lscan.acquisition.scan import open_camera, open_track
from lscan.config.rig import RigFile
from lscan.devices.api import (
    LASER_MAY_BE_LIT,
    Camera,
    Describing,
    Grab,
    LaserSwitch,
    Previewing,
    Track,
    longest_grab_s,
)
from lscan.errors import DeviceError, InputError, LscanError
from lscan.stripe.picture import check_picture

# Errors of the live page: what it refuses beyond bad input, and any error in one line.


class NotNow(LscanError):
    """A valid command that the present state of the session does not allow."""

    exit_code = 1


def one_line(error: Exception) -> str:
    """The error as one line.  A thread of the page reports any, for it must not end by it."""
    if isinstance(error, LscanError):
        return str(error)
    return " ".join(f"{type(error).__name__}: {error}".split())


# The rig's camera and track on the live page: opened once, shared, opened again after a failure.


Show = Callable[[Grab], None]


class LiveDevices:
    """The devices of a rig.  Opening raises InputError and DeviceError, as open_devices does.

    laser: True where the laser was switched on here, until it is known to be off; None where it
    never was.
    """

    def __init__(self, rig_file: RigFile, show: Show) -> None:
        """show: called with every picture to be shown; it must not block."""
        self._rig_file, self._show = rig_file, show
        self._looking = threading.Lock()  # while one looks, reopens, or begins to scan
        self._using = threading.RLock()  # while one uses the track; taken before _looking
        self._scanning = False
        self.laser: bool | None = None
        self._laser_stuck = self._closed = False
        self.camera_error = ""
        self.track = open_track(rig_file)
        try:
            self._camera = open_camera(rig_file, self.track)
        except BaseException:
            self.track.close()
            raise

    # ---- looking ------------------------------------------------------------------------

    def look(self) -> bool:
        """Show one picture; False where there is none to be had now: camera_error says why.

        After a failure the camera is opened anew first, unless a scan has it.
        """
        with self._looking:
            if self._scanning and not isinstance(self._camera, Previewing):
                return False
            try:
                if self.camera_error and not self._scanning:
                    self._reopen_camera()
                camera = self._camera
                grab = camera.preview() if isinstance(camera, Previewing) else camera.grab()
                self._require_sound(grab)
            except Exception as error:
                self.camera_error = one_line(error)
                return False
            self.camera_error = ""
        self._show(grab)
        return True

    def _require_sound(self, grab: Grab) -> None:
        """Raise InputError or DeviceError for what is no picture or not of the rig's size.

        DeviceError also for a number that is not finite: no browser could read it.
        """
        check_picture(grab.image, "the camera's picture")
        height, width = grab.image.shape[:2]
        if (width, height) != self._camera.size_px:
            raise DeviceError(f"the camera's picture is {width} by {height} px")
        for name in ("time_s", "exposure_ms"):
            if not math.isfinite(getattr(grab, name)):
                raise DeviceError(f"the camera reported {name} that is not finite")

    def _show_sound(self, grab: Grab) -> None:
        """Show a scan's picture; one that is not sound the acquisition itself refuses."""
        with contextlib.suppress(LscanError):
            self._require_sound(grab)
            self.camera_error = ""  # of a look before the scan: none is taken meanwhile
            self._show(grab)

    def _reopen_camera(self) -> None:
        self._camera.close()
        self._camera = open_camera(self._rig_file, self.track)

    # ---- the track and the laser --------------------------------------------------------

    @property
    def position_mm(self) -> float | None:
        """The position that the track reports; None where it does not know it."""
        return self._track_says()[0]

    @property
    def track_error(self) -> str:
        """Why the track cannot move before it is opened again; "" where it can."""
        return self._track_says()[1]

    def _track_says(self) -> tuple[float | None, str]:
        try:
            if math.isfinite(position_mm := self.track.position_mm):
                return position_mm, ""
            return None, "the track reports a position that is not finite"
        except DeviceError as error:
            return None, str(error)

    def check_track(self) -> None:
        """Ask a track that is not in use whether it still answers; if not, track_error says so."""
        if not self._using.acquire(blocking=False):
            return
        try:
            self._ask_track()
        finally:
            self._using.release()

    def _ask_track(self) -> None:
        """A line that broke while nothing was sent is known of only once something is."""
        if isinstance(self.track, Describing) and not self.track_error:
            with contextlib.suppress(DeviceError):  # the track remembers it
                self.track.describe()

    def ready(self) -> None:
        """Open the track again where it does not answer; only ever when asked to move or switch.

        Opening may home, so it moves; a simulated camera goes with its track.  A laser that was
        on when the track was lost is off then.
        Raises DeviceError where it does not open, or all is closed.
        """
        with self._using:
            if self._closed:  # by then a command may have waited for the track
                raise DeviceError("the page is closed")
            self._ask_track()
            if not self.track_error:
                return
            with self._looking:
                self.track.close()
                self.track = open_track(self._rig_file)
                self.laser_off()
                self._reopen_camera()

    def move_to(self, position_mm: float) -> None:
        """Move the head; DeviceError."""
        with self._using:
            self.ready()
            self.track.move_to(position_mm)

    @property
    def can_switch_laser(self) -> bool:
        """Whether the track's controller switches the laser."""
        return isinstance(self.track, LaserSwitch)

    def switch_laser(self, on: bool) -> None:
        """Switch the laser.  Raises DeviceError, InputError where the track has no switch."""
        with self._using:
            self.ready()
            track: Track | LaserSwitch = self.track
            if not isinstance(track, LaserSwitch):
                what = "the track cannot switch the laser"
                raise InputError(what, where="track.driver", value=self._rig_file.rig.track.driver)
            self.laser = True
            if on:
                track.laser_on()
            else:
                self.laser_off()

    def laser_off(self) -> None:
        """Switch off a laser that is or may be on, once what uses the track has ended.

        Raises DeviceError; ``laser_warning`` says then what to do.
        """
        if not self.can_switch_laser:
            return  # without waiting, as for one who cranks the head by hand
        with self._using:
            if not self.laser or not isinstance(self.track, LaserSwitch):
                return
            try:
                self.track.laser_off()
            except BaseException:
                self._laser_stuck = True
                raise
            self.laser = self._laser_stuck = False

    @property
    def laser_warning(self) -> str:
        """What to do about a laser that may be lit and cannot be switched off, else ""."""
        stuck = self.laser and (self._laser_stuck or self.track_error)
        return LASER_MAY_BE_LIT if stuck else ""

    @contextlib.contextmanager
    def laser_dark(self) -> Iterator[None]:
        """Within the block a laser that was switched on is off."""
        lit = self.laser is True
        if lit:
            self.switch_laser(False)
        try:
            yield
        finally:
            if lit:
                self.switch_laser(True)

    # ---- scanning -----------------------------------------------------------------------

    @contextlib.contextmanager
    def for_scan(self) -> Iterator[tuple[Camera, Track]]:
        """Camera and track as an acquisition uses them."""
        with self._using:
            with self._looking:
                self._scanning = True
            switched = self._rig_file.rig.plan.laser != "untouched"
            try:
                self.laser = switched or self.laser
                yield _ScanCamera(self._camera, self._show_sound), self.track
                if switched:
                    self.laser = self._laser_stuck = False
            except BaseException as error:
                if switched:
                    notes = getattr(error, "__notes__", ())
                    self.laser = self._laser_stuck = LASER_MAY_BE_LIT in notes
                raise
            finally:
                with self._looking:
                    self._scanning = False

    def close(self) -> None:
        """The laser off and both devices released; closing twice is harmless."""
        self._closed = True  # no command begins from here on
        with contextlib.suppress(Exception):  # of any driver; laser_warning says it
            self.laser_off()
        self._camera.close()
        self.track.close()


class _ScanCamera:
    """The camera of a scan, whose pictures are shown where it gives no preview meanwhile."""

    def __init__(self, camera: Camera, show: Show) -> None:
        self._camera, self._show = camera, show

    @property
    def size_px(self) -> tuple[int, int]:
        return self._camera.size_px

    @property
    def longest_grab_s(self) -> float:
        return longest_grab_s(self._camera)

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        # A camera that knows nothing of dark pictures serves scans without them.
        grab = self._camera.grab(frame, dark=True) if dark else self._camera.grab(frame)
        if not isinstance(self._camera, Previewing):
            self._show(grab)
        return grab

    def close(self) -> None:
        """It stays open for the page."""
