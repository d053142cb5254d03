"""Reading a camera in a thread of its own, so that no call can hang the scan.

A live camera is read without pause: its buffers stay empty, and of what it sent only the newest
picture is kept.  A file is read one picture at a time, when the one before has been taken.
Every call to the capture, opening and releasing included, is made by that thread.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from lscan.devices.opencv_camera.capture import Capture
from lscan.devices.opencv_camera.settings import Settings
from lscan.errors import DeviceError
from lscan.records import Bytes

OLDEST_STAMP_S = 60.0
"""A camera's own time stamp is on this machine's clock if it lies this near before arrival."""

LIGHT = "check cable, power and light, or raise camera.options.timeout_s"
RECONNECT = "check cable and power, then scan with --resume"


class DeviceLost(DeviceError):
    """The camera hung, vanished or did not open: opening it again may help."""


@dataclass(frozen=True)
class Picture:
    """A picture as read.  image: uint8, (H, W) or (H, W, 3) blue first.

    time_s: on the monotonic clock of this machine, when the camera says it took the picture,
    else when it arrived; of a file, when it was asked for.  arrived_s: when it arrived, on the
    same clock.
    """

    image: Bytes
    time_s: float
    arrived_s: float


@dataclass(frozen=True)
class Source:
    """What a reader reads.

    name: for messages.  start: opens the capture and sets it; raises DeviceError.
    check: raises DeviceError for a picture of the wrong size or kind.
    live: pictures come unasked.  stamped: its POS_MSEC tells when a picture was taken.
    may_repeat: whether a picture may be the one before to the byte.
    skip: pictures dropped at the start.
    """

    name: str
    start: Callable[[], tuple[Capture, Settings]]
    check: Callable[[object], Bytes]
    may_repeat: Callable[[Bytes], bool]
    live: bool
    stamped: bool
    skip: int


class Reader:
    """One opened camera and the thread that reads it.

    Once it is given up, whoever waits for a picture gets a DeviceError at once.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._changed = threading.Condition()
        self._settings: Settings | None = None
        self._picture: Picture | None = None
        self._newest: Picture | None = None  # stays when it has been taken
        self._repeats = 0
        self._fault: DeviceError | None = None
        self._given_up = False
        self._thread = threading.Thread(target=self._run, name=source.name, daemon=True)
        self._thread.start()

    def started(self, timeout_s: float) -> Settings:
        """The settings as read back, once the first picture has come.  Raises DeviceError."""
        deadline_s = time.monotonic() + timeout_s
        with self._changed:
            while self._picture is None or self._settings is None:
                self._wait(deadline_s, f"gave no first picture within {timeout_s:g} s")
            return self._settings

    def take(self, after_s: float, timeout_s: float, retries: int) -> Picture:
        """The newest picture later than ``after_s``; each is given once.

        Raises DeviceLost where none comes in time or the camera is gone, DeviceError where it
        sends the same picture, byte for byte, more than ``retries`` times.
        """
        deadline_s = time.monotonic() + timeout_s
        old: Picture | None = None
        with self._changed:
            while True:
                picture, self._picture = self._picture, None
                self._changed.notify_all()
                if picture is not None and not self._source.live:
                    # Read ahead, maybe long before it was wanted: it counts as taken now.
                    return replace(picture, time_s=time.monotonic())
                if picture is not None and picture.time_s > after_s:
                    return picture
                old = picture or old
                if self._repeats > retries:
                    raise DeviceError(
                        f"{self._source.name}: sent the same picture {self._repeats + 1} times; "
                        f"it is stuck: plug it in anew or restart the stream"
                    )
                self._wait(deadline_s, *_late(old, after_s, timeout_s))

    def peek(self, after_s: float, timeout_s: float) -> Picture:
        """The newest picture, later than ``after_s``, which can still be taken.

        A file's stands until the next is read: it is given as it is.  Raises DeviceLost where
        none comes in time or the camera is gone.
        """
        deadline_s = time.monotonic() + timeout_s
        with self._changed:
            while True:
                picture = self._newest
                if picture is not None and (picture.time_s > after_s or not self._source.live):
                    return picture
                self._wait(deadline_s, f"sent no new picture within {timeout_s:g} s")

    def give_up(self, wait_s: float) -> None:
        """Let the thread release the camera and end; one that hangs is left to itself."""
        with self._changed:
            self._given_up = True
            self._changed.notify_all()
        self._thread.join(wait_s)

    def _wait(self, deadline_s: float, late: str, remedy: str = LIGHT) -> None:
        """Wait for a change; raises the reader's fault, or DeviceLost past the deadline."""
        if self._fault is not None:
            raise self._fault
        if self._given_up:
            raise DeviceError(f"{self._source.name}: is closed, or being opened anew")
        left_s = deadline_s - time.monotonic()
        if left_s <= 0:
            raise DeviceLost(f"{self._source.name}: {late}; {remedy}")
        self._changed.wait(left_s)

    def _run(self) -> None:
        capture: Capture | None = None
        fault: DeviceError | None = None
        try:
            capture, settings = self._source.start()
            with self._changed:
                self._settings = settings
            self._read(capture)
        except DeviceError as error:
            fault = error
        # Whatever a back end raises must reach the one who waits, not die with this thread.
        except Exception as error:
            said = " ".join(str(error).split())
            fault = DeviceLost(f"{self._source.name}: failed: {said}; {RECONNECT}")
        finally:
            if capture is not None:
                capture.release()
            with self._changed:
                self._fault = fault
                self._changed.notify_all()

    def _read(self, capture: Capture) -> None:
        source = self._source
        last: Bytes | None = None
        count = 0
        while not self._given_up:
            ok, raw = capture.read()
            if not ok or raw is None:
                raise DeviceLost(f"{source.name}: {_ended(source.live, count)}")
            now_s = time.monotonic()
            time_s = _time_s(capture, source.stamped, now_s)
            count += 1
            if count <= source.skip:
                continue
            image = source.check(raw)
            same = last is not None and np.array_equal(image, last)
            last = image
            self._deliver(Picture(image, time_s, now_s), same and not source.may_repeat(image))

    def _deliver(self, picture: Picture, repeated: bool) -> None:
        with self._changed:
            while not self._source.live and self._picture is not None and not self._given_up:
                self._changed.wait()
            self._repeats = self._repeats + 1 if repeated else 0
            if not repeated:
                self._picture = self._newest = picture
            self._changed.notify_all()


def _time_s(capture: Capture, stamped: bool, now_s: float) -> float:
    if not stamped:
        return now_s
    stamp_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
    return stamp_s if now_s - OLDEST_STAMP_S < stamp_s <= now_s else now_s


def _late(old: Picture | None, after_s: float, timeout_s: float) -> tuple[str, str]:
    """Why no picture could be taken in time, and what to do.

    old: the last picture refused as too old.  One may be under way when the call comes; only
    a camera that goes on sending such pictures has a wrong clock.
    """
    if old is None or old.arrived_s < time.monotonic() - timeout_s / 2:
        return f"sent no new picture within {timeout_s:g} s", LIGHT
    return (
        f"sends pictures stamped {after_s - old.time_s:.3g} s before they were asked for; its "
        "clock was set back or it holds old pictures",
        "plug it in anew, then scan with --resume",
    )


def _ended(live: bool, count: int) -> str:
    if live:
        return f"is gone after {count} pictures; {RECONNECT}"
    return f"holds no more pictures than {count}; plan fewer frames"
