"""JPEG pictures as a camera sends them: one, checked to be whole, and a stream of them.

The format has no checksum.  A bit that turned within a coefficient is seen by nobody; what made the
decoder lose its place mostly leaves it with data too few or too many at the end, which is looked
for here (:func:`is_whole`).

References
----------
ISO/IEC 10918-1, annexes B (markers, restart intervals) and F.2.2 (decoding the coded data).
"""

import logging
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import cv2
import numpy as np
from PIL import Image

from lscan.devices.opencv_camera.options import Capture, ended_early
from lscan.errors import DeviceError
from lscan.files.pictures import MOST_PX, decode, eight_bit, read_header, too_large
from lscan.records import Bytes

# One JPEG picture as a camera sends it: where it ends, and whether it came whole.

BEGIN, END = b"\xff\xd8", b"\xff\xd9"  # SOI and EOI, table B.1
PADDING = b"\0\r\n\t \xff"
"""What may stand before a picture; after its end, anything may."""

TAIL = 8
"""Bytes at the end of a run of coded data that are exchanged to see whether they are needed."""

FILLERS = tuple(bytes.fromhex(each) * (TAIL // 2) for each in ("5a3c", "c391", "2e71"))
"""Coded data of no meaning; one or another happens to decode to what was there, not all."""

FILLED = 128  # grey value of what is missing

_AS_STORED = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
_LARGEST_START = 512  # a sector of zeros before the picture
_MARKER = re.compile(rb"\xff+([^\x00\xff])")  # in coded data, 0xFF stands as 0xFF00 (B.1.1.5)
_SEQUENTIAL = (0xC0, 0xC1)  # SOF0, SOF1: Huffman coding, all in one pass over the picture
_LONE = frozenset({0x01, *range(0xD0, 0xD8)})


@dataclass(frozen=True)
class _Layout:
    """How a picture's coded data are divided.

    start: place of the first byte of them.  block_px: (height, width) of a coded unit (MCU).
    units: (rows, columns) of them.  restart: units in a run between restart markers, all where
    there are none.
    """

    start: int
    block_px: tuple[int, int]
    units: tuple[int, int]
    restart: int

    @property
    def last_units(self) -> list[int]:
        """Number of the last unit of each run."""
        count = self.units[0] * self.units[1]
        return [
            min(end, count) - 1 for end in range(self.restart, count + self.restart, self.restart)
        ]


def jpeg_file(packet: Bytes) -> bytes | None:
    """The JPEG file in a packet, without what was padded; None where it has no beginning or end.

    packet: (N,) uint8.
    """
    data = packet.tobytes()
    begin = data.find(BEGIN, 0, _LARGEST_START + len(BEGIN))
    if begin < 0 or data[:begin].strip(PADDING):
        return None
    data = data[begin:]
    coded = next((place for marker, place in _segments(data) if marker == 0xDA), None)
    if coded is None:
        return None
    # Progressive pictures have tables between their runs, so the first EOI is looked for.
    end = next((m.end() for m in _MARKER.finditer(data, coded) if m[1] == END[1:]), None)
    return None if end is None else data[:end]


def decode_jpeg(data: bytes | None, name: str = "the stream") -> Bytes | None:
    """The picture of a JPEG file, (H, W, 3) uint8, blue first; None where it cannot be decoded.

    name: of the stream, in messages.
    Raises DeviceError, before it is decoded, where it is larger than any camera's.
    """
    header = None if data is None else read_header(data)
    if data is None or header is None:
        return None
    if too_large(header):
        raise DeviceError(
            f"{name}: sent a picture of {header.width_px} by {header.height_px} px; allowed: "
            f"{MOST_PX} px in all; choose a smaller one in the camera"
        )
    image = decode(np.frombuffer(data, np.uint8), _AS_STORED)
    return None if image is None else eight_bit(image)


def is_whole(data: bytes) -> bool:
    """Whether each run of a picture's coded data is as long as its decoding needs.

    A decoder that lost its place goes on to the end of its data in silence, and fills what is
    missing with grey.  So the data are decoded with bytes appended, which must change nothing, and
    with the last bytes exchanged, which must change the last unit.  A picture coded in several
    passes (progressive), as no camera does, is taken as it is.

    Pillow decodes, since OpenCV's decoder writes of each such byte to the terminal.

    Parameters
    ----------
    data : a JPEG file, from its beginning to its end, that ``decode_jpeg`` can decode
    """
    if (layout := _layout(data)) is None:
        return True
    runs = _runs(data[layout.start :])
    if len(runs) != len(layout.last_units):
        return False
    head = data[: layout.start]
    try:
        image = _decode_runs(head, runs)
        # Where a unit is as grey as what decoders fill in, exchanged bytes may change nothing.
        needed = np.array([bool((image[place] == FILLED).all()) for place in _places(layout)])
        if not np.array_equal(image, _decode_runs(head, [run + FILLERS[0] for run in runs])):
            return False
        for filler in FILLERS:
            # Where the cut parts a 0xFF from its 0x00, the 0xFF would begin a marker.
            other = _decode_runs(head, [run[:-TAIL].rstrip(b"\xff") + filler for run in runs])
            needed |= [bool((image[place] != other[place]).any()) for place in _places(layout)]
            if needed.all():
                return True
    except (OSError, ValueError):  # Pillow's of what it cannot decode
        pass
    return False


def _segments(data: bytes) -> Iterator[tuple[int, int]]:
    """Marker and place of the content of each segment, up to that of the first coded data.

    The content of SOS, the last, is what follows its own header: the coded data.
    """
    place = len(BEGIN)
    while found := _MARKER.search(data, place):
        marker, place = found[1][0], found.end()
        if marker in _LONE:
            continue
        length = int.from_bytes(data[place : place + 2], "big")
        if marker == END[1] or length < 2 or place + length > len(data):
            return
        yield marker, place + (length if marker == 0xDA else 2)
        if marker == 0xDA:
            return
        place += length


def _layout(data: bytes) -> _Layout | None:
    """How the coded data are divided; None where they are not of one sequential pass."""
    segments = dict(_segments(data))
    frame = next((segments[marker] for marker in _SEQUENTIAL if marker in segments), None)
    if frame is None or len(data) < frame + 9:
        return None
    height, width = (int.from_bytes(data[frame + n : frame + n + 2], "big") for n in (1, 3))
    components = data[frame + 5]
    factors = data[frame + 7 : frame + 6 + 3 * components : 3]
    # A picture of one component is coded block by block, whatever its factors (A.2.2).
    wide, high = (
        (max(each >> 4 for each in factors), max(each & 15 for each in factors))
        if components > 1
        else (1, 1)
    )
    units = -(-height // (8 * high)), -(-width // (8 * wide))
    interval = segments.get(0xDD)
    restart = 0 if interval is None else int.from_bytes(data[interval : interval + 2], "big")
    return _Layout(segments[0xDA], (8 * high, 8 * wide), units, restart or units[0] * units[1])


def _runs(coded: bytes) -> list[bytes]:
    """The runs of coded data between restart markers; [] where those are not in their order."""
    runs, place = [], 0
    for found in _MARKER.finditer(coded):
        runs.append(coded[place : found.start()])
        place = found.end()
        if found[1] == END[1:]:
            return runs if runs[-1] else runs[:-1]  # some cameras close the last run with a marker
        if found[1][0] != 0xD0 + (len(runs) - 1) % 8:
            return []
    return []


def _decode_runs(head: bytes, runs: list[bytes]) -> Bytes:
    """The picture whose coded data are these runs.  Raises OSError or ValueError."""
    markers = [bytes([0xFF, 0xD0 + number % 8]) for number in range(len(runs) - 1)] + [END]
    coded = b"".join(part for pair in zip(runs, markers, strict=True) for part in pair)
    return np.asarray(Image.open(BytesIO(head + coded), formats=["JPEG"]))


def _places(layout: _Layout) -> Iterator[tuple[slice, slice]]:
    """Rows and columns of the last unit of each run."""
    high, wide = layout.block_px
    for last in layout.last_units:
        row, column = divmod(last, layout.units[1])
        yield slice(high * row, high * (row + 1)), slice(wide * column, wide * (column + 1))


# A stream of JPEG pictures, taken packet by packet and decoded here.
#
# When a stream's pictures change their size, OpenCV's FFmpeg back end goes on scaling them to the
# size of the first.  A packet is a JPEG file and says itself how large its picture is.
#
# A packet that need not be waited for has lain in a buffer, for an unknown time: the program was
# held up, or has just opened the stream.  It is dropped undecoded, so that a backlog of seconds is
# gone within milliseconds.  Of what was sent before the program went on, two pictures can still be
# handed out: the one that was waited for when it was held up, and the one that had been sent in
# part. Dropping two (``flush_frames``) leaves none.
#
# Not guaranteed: what the camera or the network holds back is sent late, and looks new; and a
# program whose other threads keep the interpreter busy sees waits (sys.getswitchinterval, 5 ms)
# where there were none.  ``flush_ms`` and the track's settling time then cover what they are set
# to.


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
        first = None if self._first is None else decode_jpeg(jpeg_file(self._first), self._name)
        return ended_early(0 if first is None else self._count)

    def read(self) -> tuple[bool, Any]:
        """True and the next picture that was waited for, (H, W, 3) uint8, blue first, of the
        size it was sent in; (False, None) where no packet comes: the stream may have ended.

        Raises DeviceError where packets are broken or never need to be waited for.
        """
        for _ in range(MOST_BROKEN):
            if (packet := self._next_packet()) is None:
                return False, None
            file = jpeg_file(packet)
            image = decode_jpeg(file, self._name)
            if file is not None and image is not None:
                self.file = file
                return True, image
            self._broken += 1
        raise DeviceError(
            f"{self._name}: sent {MOST_BROKEN} broken JPEG pictures in a row; check the network "
            "and the camera, then scan with --resume"
        )

    def _next_packet(self) -> Bytes | None:
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
