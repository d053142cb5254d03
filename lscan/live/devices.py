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
from lscan.config.rigfile import RigFile
from lscan.devices.api import Camera, Describing, Grab, LaserSwitch, Previewing, Track
from lscan.errors import DeviceError, InputError, LscanError
from lscan.live.errors import one_line
from lscan.stripe.lines import check_picture

Show = Callable[[Grab], None]


class LiveDevices:
    """The devices of a rig.  Opening raises InputError and DeviceError, as open_devices does.

    laser: whether the laser was switched on or off here; None where it is not known.
    """

    def __init__(self, rig_file: RigFile, show: Show) -> None:
        """show: called with every picture to be shown; it must not block."""
        self._rig_file, self._show = rig_file, show
        self._looking = threading.Lock()  # while one looks, reopens, or begins to scan
        self._using = threading.RLock()  # while one uses the track; taken before _looking
        self._scanning = False
        self.laser: bool | None = None
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

        Opening may home, so it moves; a simulated camera goes with its track.
        Raises DeviceError where it does not open.
        """
        with self._using:
            self._ask_track()
            if not self.track_error:
                return
            with self._looking:
                self.track.close()
                self.laser = None
                self.track = open_track(self._rig_file)
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
                raise InputError(
                    "the track cannot switch the laser",
                    where="track.driver",
                    value=self._rig_file.rig.track.driver,
                )
            if on:
                track.laser_on()
            else:
                track.laser_off()
            self.laser = on

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
            try:
                yield _ScanCamera(self._camera, self._show_sound), self.track
            finally:
                with self._looking:
                    self._scanning = False
                    if self._rig_file.rig.plan.laser != "untouched":
                        self.laser = False  # as a scan that switches it leaves it

    def close(self) -> None:
        """The laser off and both devices released; closing twice is harmless."""
        if self.laser and isinstance(self.track, LaserSwitch):
            with contextlib.suppress(DeviceError):
                self.track.laser_off()
        self.laser = None
        self._camera.close()
        self.track.close()


class _ScanCamera:
    """The camera of a scan, whose pictures are shown where it gives no preview meanwhile."""

    def __init__(self, camera: Camera, show: Show) -> None:
        self._camera, self._show = camera, show

    @property
    def size_px(self) -> tuple[int, int]:
        return self._camera.size_px

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        # A camera that knows nothing of dark pictures serves scans without them.
        grab = self._camera.grab(frame, dark=True) if dark else self._camera.grab(frame)
        if not isinstance(self._camera, Previewing):
            self._show(grab)
        return grab

    def close(self) -> None:
        """It stays open for the page."""
