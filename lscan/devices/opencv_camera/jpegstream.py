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

import time
from typing import Any

import cv2
import numpy as np

from lscan.devices.opencv_camera.address import ended_early
from lscan.devices.opencv_camera.options import Capture
from lscan.devices.opencv_camera.reader import DeviceLost
from lscan.errors import DeviceError
from lscan.files.headers import read_header
from lscan.files.pictures import MOST_PX, decode, too_large
from lscan.records import Bytes

LEAST_WAIT_S = 0.001
"""A packet had sooner than this lay in a buffer.  Taking one takes some 0.01 to 0.1 ms."""

MOST_WAITING = 20_000
"""Packets in a row that lay in a buffer.  Buffers are finite; a file on a server is not live."""

MOST_BROKEN = 30
"""Pictures in a row that are no whole JPEG file, before giving up."""

BEGIN, END = b"\xff\xd8", b"\xff\xd9"  # ISO/IEC 10918-1, table B.1: SOI and EOI
_AS_STORED = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION


class JpegStream:
    """A capture that hands out packets (CAP_PROP_FORMAT -1), as one that hands out pictures."""

    def __init__(self, packets: Capture, name: str) -> None:
        """packets: opened, each of its pictures (1, N) uint8, a JPEG file.  name: in messages."""
        self._packets, self._name = packets, name
        self.isOpened, self.get, self.set = packets.isOpened, packets.get, packets.set
        self.release, self.getBackendName = packets.release, packets.getBackendName
        self._first: Bytes | None = None
        self._count, self._handed_out = 0, False

    def read(self) -> tuple[bool, Any]:
        """True and the next picture that was waited for, (H, W, 3) uint8, blue first, of the
        size it was sent in; (False, None) where the stream has ended.

        Raises DeviceError where packets are broken or never need to be waited for, DeviceLost
        where it ends with its first, or before any could be handed out: it is a file's address.
        """
        for _ in range(MOST_BROKEN):
            packet = self._awaited()
            if packet is None:
                if self._count <= 1 or not self._handed_out:
                    # Where the first packet is no picture, none of the others is likely one.
                    whole = self._first is not None and decoded(self._first, self._name) is not None
                    raise DeviceLost(f"{self._name}: {ended_early(self._count if whole else 0)}")
                return False, None
            image = decoded(packet, self._name)
            if image is not None:
                self._handed_out = True
                return True, image
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


def decoded(packet: Bytes, name: str = "the stream") -> Bytes | None:
    """The picture of a JPEG file, (H, W, 3) uint8, blue first; None where it is not whole.

    packet: (N,) uint8; zeros and line ends after the end of the file are overlooked.  name: of
    the stream, in messages.
    Raises DeviceError, before it is decoded, where it is larger than any camera's.
    """
    tail = packet[-64:].tobytes().rstrip(b"\0\r\n")
    if packet[:2].tobytes() != BEGIN or not tail.endswith(END):
        return None
    header = read_header(packet.tobytes())
    if header is None:
        return None
    if too_large(header):
        raise DeviceError(
            f"{name}: sent a picture of {header.width_px} by {header.height_px} px; allowed: "
            f"{MOST_PX} px in all; choose a smaller one in the camera"
        )
    return decode(packet, _AS_STORED)
