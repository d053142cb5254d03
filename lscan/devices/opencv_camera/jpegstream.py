"""A stream of JPEG pictures, taken packet by packet and decoded here.

When a stream's pictures change their size, OpenCV's FFmpeg back end goes on scaling them to the
size of the first.  A packet is a JPEG file and says itself how large its picture is.

A packet that need not be waited for has lain in a buffer, for an unknown time: the program was held
up, or has just opened the stream.  It is dropped undecoded, so that a backlog of seconds is gone
within milliseconds.  Of what was sent before the program went on, two pictures can still be handed
out: the one that was waited for when it was held up, and the one that had been sent in part.
Dropping two (``flush_frames``) leaves none.

Not guaranteed: what the camera or the network holds back is sent late, and looks new; and a
program whose other threads keep the interpreter busy sees waits (sys.getswitchinterval, 5 ms)
where there were none.  ``flush_ms`` and the track's settling time then cover what they are
set to.
"""

import logging
import time
from typing import Any

import numpy as np

from lscan.devices.opencv_camera.address import ended_early
from lscan.devices.opencv_camera.jpegfile import decoded, jpeg_file
from lscan.devices.opencv_camera.options import Capture
from lscan.errors import DeviceError
from lscan.records import Bytes

_log = logging.getLogger(__name__)

LEAST_WAIT_S = 0.001
"""A packet had sooner than this lay in a buffer.  Taking one takes some 0.01 to 0.1 ms."""

MOST_WAITING = 20_000
"""Packets in a row that lay in a buffer.  Buffers are finite; a file on a server is not live."""

MOST_BROKEN = 30
"""Pictures in a row that are no whole JPEG file, before giving up."""


class JpegStream:
    """A capture that hands out packets (CAP_PROP_FORMAT -1), as one that hands out pictures.

    file: the JPEG file of the picture handed out last; b"" before any.
    """

    def __init__(self, packets: Capture, name: str) -> None:
        """packets: opened, each of its pictures (1, N) uint8, a JPEG file.  name: in messages."""
        self._packets, self._name = packets, name
        self.isOpened, self.get, self.set = packets.isOpened, packets.get, packets.set
        self.getBackendName = packets.getBackendName
        self.file = b""
        self._first: Bytes | None = None
        self._count, self._broken = 0, 0

    def release(self) -> None:
        """Release the capture, and say how many pictures were dropped that came cut short."""
        if self._broken:
            _log.warning("%s: %d pictures came cut short, dropped", self._name, self._broken)
        self._packets.release()

    @property
    def early_end(self) -> str:
        """What to say of a stream that ended with its first packet, or before any picture could
        be handed out: it is a file's address.  "" where it was a stream."""
        if self._count > 1 and self.file:
            return ""
        # Where the first packet is no picture, none of the others is likely one.
        first = None if self._first is None else decoded(jpeg_file(self._first), self._name)
        return ended_early(0 if first is None else self._count)

    def read(self) -> tuple[bool, Any]:
        """True and the next picture that was waited for, (H, W, 3) uint8, blue first, of the
        size it was sent in; (False, None) where no packet comes: the stream may have ended.

        Raises DeviceError where packets are broken or never need to be waited for.
        """
        for _ in range(MOST_BROKEN):
            packet = self._awaited()
            if packet is None:
                return False, None
            file = jpeg_file(packet)
            image = decoded(file, self._name)
            if file is not None and image is not None:
                self.file = file
                return True, image
            self._broken += 1
        raise DeviceError(
            f"{self._name}: sent {MOST_BROKEN} broken JPEG pictures in a row; check the network "
            "and the camera, then scan with --resume"
        )

    def _awaited(self) -> Bytes | None:
        """The next packet that had to be waited for; None where the stream has ended."""
        for _ in range(MOST_WAITING):
            asked_s = time.monotonic()
            ok, packet = self._packets.read()
            waited_s = time.monotonic() - asked_s
            if not ok or packet is None:
                return None
            packet = np.asarray(packet, dtype=np.uint8).ravel()
            self._count += 1
            if self._first is None:
                self._first = packet
            if waited_s >= LEAST_WAIT_S:
                return packet
        raise DeviceError(
            f"{self._name}: sends more than {1 / LEAST_WAIT_S:g} pictures a second, which no "
            "camera does; a video goes into camera.options.file"
        )
