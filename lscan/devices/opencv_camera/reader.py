"""A camera opened, and read in a thread of its own, so that no call can hang the scan."""

import itertools
import logging
import os
import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2

from lscan.config.rig import CameraSection
from lscan.devices.opencv_camera.jpeg import JpegStream
from lscan.devices.opencv_camera.options import (
    Capture,
    OpenCapture,
    OpencvOptions,
    Settings,
    apply_settings,
    fourcc_text,
    reason_unopened,
)
from lscan.errors import DeviceError
from lscan.records import Picture

# How a capture is opened for a device, a stream or a video file.

_log = logging.getLogger(__name__)


def open_capture(options: OpencvOptions) -> Capture:
    """The OpenCV capture that ``options`` names, opened or not.

    Raises DeviceError for a stream whose pictures are late by an unknown time, and for a camera of
    libcamera or a pipeline where OpenCV was built without GStreamer, as it is for pip.
    """
    _silence_libraries()
    pipeline = re.search(r"^libcamera|^/base/| ! ", str(options.device))
    if pipeline and not cv2.videoio_registry.hasBackend(cv2.CAP_GSTREAMER):
        raise DeviceError(
            f"{options.name}: this OpenCV has neither libcamera nor GStreamer; let the camera send "
            "an MJPEG stream (picamera2, rpicam-vid), and state camera.options.url"
        )
    if options.device is not None:
        if isinstance(options.device, int):
            return cv2.VideoCapture(options.device)
        linux = options.device.startswith("/dev/")
        return cv2.VideoCapture(options.device, cv2.CAP_V4L2 if linux else cv2.CAP_ANY)
    if options.url is not None:
        return _open_stream(options.url, options)
    return cv2.VideoCapture(options.file or "", cv2.CAP_FFMPEG)


def _silence_libraries() -> None:
    """Keep OpenCV and its FFmpeg from writing to the terminal what is reported here in one line.

    Whoever sets OPENCV_LOG_LEVEL or OPENCV_FFMPEG_LOGLEVEL gets what they ask for.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # AV_LOG_QUIET; read by its first capture
    if "OPENCV_LOG_LEVEL" not in os.environ:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


def _open_stream(url: str, options: OpencvOptions) -> Capture:
    """The stream, as its own JPEG pictures where it is made of them and can be had so.

    It is given the timeout too, so that a reader that was given up ends by itself.  It is
    decoded by one thread: with n of them FFmpeg hands pictures out n - 1 pictures late.
    """
    limit_ms = max(1, round(1000 * options.timeout_s))
    parameters = {
        cv2.CAP_PROP_OPEN_TIMEOUT_MSEC: limit_ms,
        cv2.CAP_PROP_READ_TIMEOUT_MSEC: limit_ms,
        cv2.CAP_PROP_N_THREADS: 1,
    }
    pairs = [number for pair in parameters.items() for number in pair]
    capture = cv2.VideoCapture(url, cv2.CAP_FFMPEG, pairs)
    if not capture.isOpened():
        return capture
    code = (fourcc_text(capture.get(cv2.CAP_PROP_FOURCC)) or "unknown").upper()
    if code == "MJPG" and capture.set(cv2.CAP_PROP_FORMAT, -1):
        return JpegStream(capture, options.name)
    if not options.waits_for_change:
        capture.release()
        raise DeviceError(
            f"{options.name}: coded as {code}, whose pictures come late by what the camera's "
            "encoder and B-frames hold back, which cannot be seen from here: state "
            "camera.options.flush_ms, not below the time from a change in view to its picture "
            "(mostly 200 to 3000; `lscan devices RIG --test` measures it), or choose MJPEG where "
            "the camera has it"
        )
    _log.warning(
        "%s: coded as %s: a change of the picture size while it runs, or a picture sent again and "
        "again, would go unseen; choose MJPEG where the camera has it",
        options.name,
        code,
    )
    return capture


# Reading a camera in a thread of its own, so that no call can hang the scan.
#
# A live camera is read without pause: its buffers stay empty, and of what it sent only the newest
# picture is kept.  A file is read one picture at a time, when the one before has been taken. Every
# call to the capture, opening and releasing included, is made by that thread.


OLDEST_STAMP_S = 60.0
"""A camera's own time stamp is on this machine's clock if it lies this near before arrival."""

MOST_SAME_STAMPS = 2
"""Pictures that follow one of the same time stamp, in a row, before stamps are of no use."""

FAILED_WAIT_S = 0.02
"""Between a reading that failed and the next: a lost device fails at once, again and again."""

QUIET_WAIT_S = 1.0
"""A wait for a camera to let go that is longer is spoken of."""

LIGHT = "check cable, power and light, or raise camera.options.timeout_s"
ADDRESS = "check that pictures are sent from that address, or raise camera.options.timeout_s"
RECONNECT = "check cable and power, then scan with --resume"


class DeviceLost(DeviceError):
    """The camera hung, vanished or did not open: opening it again may help."""


@dataclass(frozen=True)
class TimedPicture:
    """A picture as read.  image: uint8 or uint16, (H, W) or (H, W, 3) blue first.

    time_s: on the monotonic clock of this machine, when the camera says it took the picture,
    else when it arrived; of a file, when it was asked for.  arrived_s: when it arrived, on the
    same clock.  file: the JPEG file it was decoded from, where that is at hand.
    """

    image: Picture
    time_s: float
    arrived_s: float
    file: bytes | None = None


class Reader:
    """One opened camera and the thread that reads it.

    Once it is given up, whoever waits for a picture gets a DeviceError at once.

    Parameters
    ----------
    section, options
        What is read, and how it is set.
    open_capture
        Opens the capture.
    check
        Raises DeviceError for a picture of the wrong size or kind.
    """

    def __init__(
        self,
        section: CameraSection,
        options: OpencvOptions,
        open_capture: OpenCapture,
        check: Callable[[object], Picture],
    ) -> None:
        self._section, self._options = section, options
        self._open_capture, self._check = open_capture, check
        self._changed = threading.Condition()
        self._settings: Settings | None = None
        self._picture: TimedPicture | None = None
        self._newest: TimedPicture | None = None  # stays when it has been taken
        self._repeats = 0
        self._codes_changes = False
        self._stamp_s, self._same_stamps = 0.0, 0  # the camera's last, and how often it came again
        self._fault: DeviceError | None = None
        self._given_up = False
        self._thread = threading.Thread(target=self._run, name=options.name, daemon=True)
        self._thread.start()

    def settings_read_back(self) -> Settings:
        """The settings as read back, once the first picture has come.  Raises DeviceError."""
        deadline_s = time.monotonic() + self._options.timeout_s
        late = f"gave no first picture within {self._options.timeout_s:g} s"
        with self._changed:
            while self._picture is None or self._settings is None:
                self._wait(deadline_s, late)
            return self._settings

    def take(self, after_s: float) -> TimedPicture:
        """The newest picture later than ``after_s``; each is given once.

        Raises DeviceLost where none comes in time or the camera is gone, DeviceError where it
        sends the same picture, byte for byte, more than ``retries`` times.
        """
        options = self._options
        deadline_s = time.monotonic() + options.timeout_s
        old: TimedPicture | None = None
        with self._changed:
            while True:
                picture, self._picture = self._picture, None
                self._changed.notify_all()
                if picture is not None and not options.live:
                    # Read ahead, maybe long before it was wanted: it counts as taken now.
                    return replace(picture, time_s=time.monotonic())
                if picture is not None and picture.time_s > after_s:
                    return picture
                old = picture or old
                if self._repeats > options.retries:
                    raise DeviceError(
                        f"{options.name}: sent the same picture {self._repeats + 1} times; "
                        f"it is stuck: plug it in anew or restart the stream; where it smooths "
                        "all noise of a still scene away, camera.options.repeated = 'accept'"
                    )
                self._wait(deadline_s, *_late(old, after_s, options.timeout_s))

    def peek(self, after_s: float) -> TimedPicture:
        """The newest picture, later than ``after_s``, which can still be taken.

        A file's stands until the next is read: it is given as it is.  Raises DeviceLost where
        none comes in time or the camera is gone.
        """
        timeout_s = self._options.timeout_s
        deadline_s = time.monotonic() + timeout_s
        with self._changed:
            while True:
                picture = self._newest
                if picture is not None and (picture.time_s > after_s or not self._options.live):
                    return picture
                self._wait(deadline_s, f"sent no new picture within {timeout_s:g} s")

    def is_stuck(self, image: Picture, last: Picture) -> bool:
        """Whether the camera sent its last picture again, though it should have changed."""
        return not self._codes_changes and self._options.is_stuck(image, last)

    def give_up(self) -> None:
        """Let the thread release the camera and end; one that hangs is left to itself."""
        with self._changed:
            self._given_up = True
            self._changed.notify_all()
        timeout_s = self._options.timeout_s
        self._thread.join(min(QUIET_WAIT_S, timeout_s))
        if self._thread.is_alive() and timeout_s > QUIET_WAIT_S:
            _log.warning("%s: hangs; it is waited for up to %g s", self._options.name, timeout_s)
            self._thread.join(timeout_s - QUIET_WAIT_S)

    def _wait(self, deadline_s: float, late: str, remedy: str = "") -> None:
        """Wait for a change; raises the reader's fault, or DeviceLost past the deadline.

        remedy: what to do then; "" where only the silence is known.
        """
        if self._fault is not None:
            raise self._fault
        if self._given_up:
            raise DeviceError(f"{self._options.name}: is closed, or being opened anew")
        left_s = deadline_s - time.monotonic()
        if left_s <= 0:
            silence = LIGHT if self._options.url is None else ADDRESS
            raise DeviceLost(f"{self._options.name}: {late}; {remedy or silence}")
        self._changed.wait(left_s)

    def _run(self) -> None:
        capture: Capture | None = None
        fault: DeviceError | None = None
        try:
            capture = self._open_capture(self._options)
            if not capture.isOpened():
                raise DeviceLost(f"{self._options.name}: {reason_unopened(self._options.url)}")
            # Such a stream, MPEG-4 or H.264, sends the same picture where nothing changes.
            self._codes_changes = bool(self._options.url) and not isinstance(capture, JpegStream)
            settings = apply_settings(capture, self._section, self._options)
            with self._changed:
                self._settings = settings
            self._read(capture)
        except DeviceError as error:
            fault = error
        # Whatever a back end raises must reach the one who waits, not die with this thread.
        except Exception as error:
            said = " ".join(str(error).split())
            fault = DeviceLost(f"{self._options.name}: failed: {said}; {RECONNECT}")
        finally:
            if capture is not None:
                capture.release()
            with self._changed:
                self._fault = fault
                self._changed.notify_all()

    def _read(self, capture: Capture) -> None:
        options = self._options
        skip = options.warm_up_frames if options.live else 0
        last: Picture | None = None
        for count in itertools.count():
            raw = self._read_one(capture)
            if self._given_up:
                return
            if raw is None:
                raise DeviceLost(f"{options.name}: {self._end_reason(capture, count)}")
            now_s = time.monotonic()
            image = self._check(raw)
            stuck = last is not None and self.is_stuck(image, last)
            time_s = now_s if stuck or options.device is None else self._taken_s(capture, now_s)
            if count < skip:
                continue
            last = image
            file = capture.file if isinstance(capture, JpegStream) else None
            with self._changed:
                while not options.live and self._picture is not None and not self._given_up:
                    self._changed.wait()
                self._repeats = self._repeats + 1 if stuck else 0
                if not stuck:
                    self._picture = self._newest = TimedPicture(image, time_s, now_s, file)
                self._changed.notify_all()

    def _read_one(self, capture: Capture) -> object | None:
        """A picture; None where as many readings fail in a row as a live camera is allowed."""
        for _ in range(1 + (self._options.retries if self._options.live else 0)):
            ok, raw = capture.read()
            if (ok and raw is not None) or self._given_up:
                return raw
            time.sleep(FAILED_WAIT_S)
        return None

    def _end_reason(self, capture: Capture, count: int) -> str:
        """Why no further picture can be read after ``count``."""
        if not self._options.live:
            return f"holds no more pictures than {count}; plan fewer frames"
        early = capture.early_end if isinstance(capture, JpegStream) else ""
        return early or f"is gone after {count} pictures; {RECONNECT}"

    def _taken_s(self, capture: Capture, now_s: float) -> float:
        """When a device says that it took its last picture; ``now_s`` where its clock is another.

        From where one stamp came for several pictures on, it is ``now_s`` too: the clock stands
        still or counts whole seconds, and tells no old picture from a new one.
        """
        stamp_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        if not now_s - OLDEST_STAMP_S < stamp_s <= now_s or self._same_stamps > MOST_SAME_STAMPS:
            return now_s
        self._same_stamps = self._same_stamps + 1 if stamp_s == self._stamp_s else 0
        self._stamp_s = stamp_s
        if self._same_stamps > MOST_SAME_STAMPS:
            said = "%s: gives one time stamp to many pictures; from now on their arrival counts"
            _log.warning(said, self._options.name)
            return now_s
        return stamp_s


def _late(old: TimedPicture | None, after_s: float, timeout_s: float) -> tuple[str, str]:
    """Why no picture could be taken in time, and what to do, "" where only the silence is known.

    old: the last picture refused as too old.  One may be under way when the call comes; only
    a camera that goes on sending such pictures has a wrong clock.
    """
    if old is None or old.arrived_s < time.monotonic() - timeout_s / 2:
        return f"sent no new picture within {timeout_s:g} s", ""
    return (
        f"sends pictures stamped {after_s - old.time_s:.3g} s before they were asked for; its "
        "clock was set back or it holds old pictures",
        "plug it in anew, then scan with --resume",
    )
