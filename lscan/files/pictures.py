"""Picture files: read strictly, written whole or not at all; colour is RGB everywhere else.

All that decodes a stranger's picture does it here, once its header says that it is not too large.
"""

import io
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, cast

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from lscan.errors import InputError
from lscan.files.disk import read_bytes, write_atomically
from lscan.records import Axis, Bytes, Floats, GreyValues, Picture

# How large the picture in a file is, read from its header before anything is decoded.
#
# A file of a megabyte may decode to gigabytes.  The formats are those that pictures are read in;
# what is none of them, or whose header does not say its size, is no picture.
#
# References
# ----------
# PNG: ISO/IEC 15948, 11.2.2.  JPEG: ISO/IEC 10918-1, annex B.  BMP: Microsoft, BITMAPINFOHEADER.
# TIFF: Adobe, revision 6.0, and Adobe Photoshop TIFF Technical Notes for BigTIFF.  WebP: RFC 9649.


Format = Literal["PNG", "JPEG", "BMP", "TIFF", "WebP"]


@dataclass(frozen=True)
class PictureHeader:
    """What a picture's file says of itself.

    width_px, height_px: of a TIFF of tiles, or of the tile where it is larger, since the whole
    tile is decoded.  depth_bits: of a channel of a pixel; 8 where it is fewer.  spans: whether
    a PNG of 16 bits says how many of them, the uppermost, tell something (sBIT, 11.3.2.5): its
    numbers then span the whole range.
    """

    format: Format
    width_px: int
    height_px: int
    depth_bits: int = 8
    spans: bool = False


def read_header(data: bytes) -> PictureHeader | None:
    """The header of a picture's file; None where it is of no known format or cut short.

    Parameters
    ----------
    data
        The whole file: where a JPEG or TIFF file says its size differs.

    Returns
    -------
    PictureHeader or None
        Its width and height are above 0.
    """
    readers = (reader for start, reader in _READERS.items() if data.startswith(start))
    try:
        header = next((reader(data) for reader in readers), None)
    except (struct.error, IndexError):
        return None
    return header if header and header.width_px > 0 and header.height_px > 0 else None


def _png(data: bytes) -> PictureHeader | None:
    names = _chunks(data)
    if data[12:16] != b"IHDR" or b"IDAT" not in names:
        return None
    width, height, depth = struct.unpack_from(">IIB", data, 16)
    return PictureHeader("PNG", width, height, max(8, depth), b"sBIT" in names and depth == 16)


def _chunks(data: bytes) -> set[bytes]:
    """The names of a PNG file's chunks; none where they are not all there, to an empty last one.

    A decoder takes memory for as long a chunk as the file states.
    """
    place, names = 8, set[bytes]()
    while place + 12 <= len(data):
        length, name = struct.unpack_from(">I", data, place)[0], data[place + 4 : place + 8]
        place += 12 + length
        if name == b"IEND":
            return names if length == 0 else set()
        names.add(name)
    return set()


_LONE_MARKERS = frozenset({0x00, 0x01, *range(0xD0, 0xD8)})  # no segment follows
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0 to SOF15
_PIXELS_OR_END = (0xDA, 0xD9)  # SOS, EOI


def _jpeg(data: bytes) -> PictureHeader | None:
    place = 2
    while True:
        place = data.find(b"\xff", place)  # decoders pass over what is no marker
        if place < 0:
            return None
        while data[place] == 0xFF:
            place += 1
        marker, place = data[place], place + 1
        if marker in _PIXELS_OR_END:
            return None
        if marker in _FRAMES:
            depth, height, width = struct.unpack_from(">BHH", data, place + 2)
            return PictureHeader("JPEG", width, height, depth)
        if marker not in _LONE_MARKERS:
            place += struct.unpack_from(">H", data, place)[0]


def _bmp(data: bytes) -> PictureHeader | None:
    (size,) = struct.unpack_from("<I", data, 14)
    width, height = struct.unpack_from("<HH" if size == 12 else "<ii", data, 18)
    return PictureHeader("BMP", abs(width), abs(height))


def _webp(data: bytes) -> PictureHeader | None:
    kind = data[12:16]
    if data[8:12] != b"WEBP" or len(data) < 30:
        return None
    if kind == b"VP8X":
        width, height = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
    elif kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        width, height = ((bits >> shift & 0x3FFF) + 1 for shift in (0, 14))
    elif kind == b"VP8 ":
        width, height = (side & 0x3FFF for side in struct.unpack_from("<HH", data, 26))
    else:
        return None
    return PictureHeader("WebP", width, height)


_WIDTHS, _HEIGHTS = (256, 322), (257, 323)  # ImageWidth, TileWidth; ImageLength, TileLength
_BITS, _CHANNELS = 258, 277  # BitsPerSample, SamplesPerPixel
_TIFF_INTEGERS = {1: "B", 3: "H", 4: "I", 16: "Q"}  # BYTE, SHORT, LONG, LONG8
_MOST_CHANNELS = 4


def _tiff(data: bytes) -> PictureHeader | None:
    order = "<" if data[:2] == b"II" else ">"
    big = struct.unpack_from(f"{order}H", data, 2)[0] == 43
    (place,) = struct.unpack_from(f"{order}{'Q' if big else 'I'}", data, 8 if big else 4)
    (entries,) = struct.unpack_from(f"{order}{'Q' if big else 'H'}", data, place)
    place += 8 if big else 2
    wanted: dict[int, int] = {}
    for _ in range(entries):
        tag, kind, count = struct.unpack_from(f"{order}HH{'Q' if big else 'I'}", data, place)
        if tag in (*_WIDTHS, *_HEIGHTS, _BITS, _CHANNELS):
            value = _largest(data, order, kind, count, place + (12 if big else 8), big)
            wanted[tag] = max(value, wanted.get(tag, 0))
        place += 20 if big else 12
    if 256 not in wanted or 257 not in wanted or wanted.get(_CHANNELS, 1) > _MOST_CHANNELS:
        return None
    width, height = (max(wanted.get(tag, 0) for tag in tags) for tags in (_WIDTHS, _HEIGHTS))
    return PictureHeader("TIFF", width, height, max(8, wanted.get(_BITS, 1)))


def _largest(data: bytes, order: str, kind: int, count: int, place: int, big: bool) -> int:
    """The largest of an entry's numbers, which stand at ``place`` or where it points to."""
    if kind not in _TIFF_INTEGERS or not 1 <= count <= _MOST_CHANNELS:
        raise struct.error("not a few whole numbers")
    numbers = f"{order}{count}{_TIFF_INTEGERS[kind]}"
    if struct.calcsize(numbers) > (8 if big else 4):
        (place,) = struct.unpack_from(f"{order}{'Q' if big else 'I'}", data, place)
    return max(struct.unpack_from(numbers, data, place))


_READERS: dict[bytes, Callable[[Any], PictureHeader | None]] = {
    b"\x89PNG\r\n\x1a\n": _png,
    b"\xff\xd8\xff": _jpeg,
    b"BM": _bmp,
    b"II\x2a\0": _tiff,
    b"MM\0\x2a": _tiff,
    b"II\x2b\0": _tiff,
    b"MM\0\x2b": _tiff,
    b"RIFF": _webp,
}


# Picture files: read strictly, written whole or not at all; colour is RGB everywhere else.


FORMATS = "PNG, JPEG, BMP, TIFF or WebP, 8 or 16 bit"
MOST_PX = 2**25
"""Of a picture whose size no rig states; finding a line in it takes 60 bytes a pixel."""
MOST_BYTES = 4 * MOST_PX + 2**20
"""Of a picture's file: four channels of 8 bit, stored plainly, and what stands around them."""


def read_picture(path: Path, bits: int | None = None) -> Picture:
    """The picture in a file, (H, W) grey or (H, W, 3) RGB, uint8, or uint16 of a file of 16 bit.

    Parameters
    ----------
    path : Path, a file of FORMATS
    bits : int, optional, of the camera that took a picture of 16 bit; by default as the file says,
        or found as ``aligned`` does

    Raises
    ------
    InputError
        The file is missing, is no picture, is not of 8 or 16 bit, holds more than the camera's
        bits, or is larger than ``MOST_PX``, which is known before it is decoded.
    """
    data = read_bytes(path, MOST_BYTES)
    header = read_header(data)
    if header is not None and header.depth_bits not in (8, 16):
        value = f"{header.depth_bits} bit"
        raise InputError("has the wrong depth", where=path, value=value, allowed=FORMATS)
    if header is not None and too_large(header):
        raise InputError(
            "is too large a picture",
            where=path,
            value=f"{header.width_px} by {header.height_px} px",
            allowed=f"{MOST_PX} px in all, as 8192 by 4096",
        )
    image = None if header is None else decode(data)
    if image is None:
        raise InputError("is not a picture that can be read", where=path, allowed=FORMATS)
    image = image if image.ndim == 2 else _rgb(image)
    spans = image.dtype == np.uint8 or (header is not None and header.spans and bits is None)
    return image if spans else aligned(image, bits, where=path)


def display_turn(path: Path) -> str:
    """How viewers turn the picture that is taken as it is stored; empty where they do not.

    Parameters
    ----------
    path : Path, a file that ``read_picture`` has read

    References
    ----------
    CIPA DC-008 (Exif 2.32), 4.6.4.A, tag Orientation.
    """
    with Image.open(io.BytesIO(read_bytes(path, MOST_BYTES))) as picture:
        return _TURNS.get(picture.getexif().get(ExifTags.Base.Orientation, 1), "")


_TURNS = {
    2: "mirrored",
    3: "turned by 180 degrees",
    4: "mirrored and turned by 180 degrees",
    5: "mirrored and turned by 90 degrees to the left",
    6: "turned by 90 degrees to the right",
    7: "mirrored and turned by 90 degrees to the right",
    8: "turned by 90 degrees to the left",
}


def read_png(
    data: bytes,
    where: object,
    size_px: tuple[int, int] | None = None,
    *,
    whose: str = "",
    depth_bits: Literal[8, 16] | None = 8,
) -> Picture:
    """The picture, (H, W) grey or (H, W, 3) RGB, uint8 or uint16, of a PNG file that lscan wrote.

    Parameters
    ----------
    data : bytes, of the file
    where : the file, for the error
    size_px : tuple or None, (width, height), px, that it must have; None: ``MOST_PX`` at most
    whose : str, who states that size, such as ", as in the rig", for the error
    depth_bits : int or None, 8, or 16 for a picture of more than 8 bits; None: either

    Raises
    ------
    InputError
        It is no PNG of that depth, or of another size, which is known before it is decoded.
    """
    header, image = read_header(data), None
    depths = (8, 16) if depth_bits is None else (depth_bits,)
    if header is not None and header.format == "PNG" and header.depth_bits in depths:
        size = header.width_px, header.height_px
        if size_px is not None and size != size_px:
            value, allowed = "{} by {} px".format(*size), "{} by {} px".format(*size_px)
            raise InputError("wrong picture size", where=where, value=value,
                             allowed=f"{allowed}{whose}")  # fmt: skip
        image = decode(data) if size_px is not None or not too_large(header) else None
    if image is None or image.shape[2:] not in ((), (3,)):
        kind = {8: "an 8-bit", 16: "a 16-bit", None: "an 8- or 16-bit"}[depth_bits]
        what = f"is not {kind} grey or RGB picture, or too large"
        raise InputError(what, where=where, allowed=f"PNG of {MOST_PX} px at most")
    return image if image.ndim == 2 else _rgb(image)


def _rgb(image: Picture) -> Picture:
    """(H, W, 3) of what OpenCV decoded, without alpha; NumPy would take four times as long."""
    code = cv2.COLOR_BGRA2RGB if image.shape[2] == 4 else cv2.COLOR_BGR2RGB
    return cast(Picture, cv2.cvtColor(image, code))


def too_large(header: PictureHeader) -> bool:
    """Whether a picture has more than ``MOST_PX`` pixels.

    Parameters
    ----------
    header : PictureHeader, its size, px
    """
    return header.width_px * header.height_px > MOST_PX


def decode(data: bytes | Bytes, flags: int = cv2.IMREAD_UNCHANGED) -> Picture | None:
    """The picture of a file whose header has been looked at, colour as BGR.

    Parameters
    ----------
    data
        The whole file.
    flags
        As ``cv2.imdecode`` takes them.

    Returns
    -------
    (H, W), (H, W, 3) or (H, W, 4) uint8 or uint16, or None
        None where it cannot be decoded, or not to 8 or 16 bit.
    """
    try:
        image: Any = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:  # such as of sizes that OpenCV itself refuses
        return None
    return image if image is not None and image.dtype in (np.uint8, np.uint16) else None


def encode_picture(
    image: Picture, ending: str, parameters: Sequence[int] = (), where: object = None
) -> bytes:
    """The file of a picture in a format.

    Parameters
    ----------
    image : (H, W) grey or (H, W, 3) RGB array, uint8 or uint16
    ending : str, of the format, such as ".png"
    parameters : sequence, as ``cv2.imencode`` takes them
    where : the file, for the error

    Raises
    ------
    InputError
        There is no such format, or it cannot hold a picture of that shape.
    """
    bgr = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    try:
        done, data = cv2.imencode(ending, bgr, parameters)
    except cv2.error:
        done = False
    if not done and not cv2.haveImageWriter(f"x{ending}"):
        allowed = ".png, .jpg, .bmp, .tif, .webp"
        raise InputError("unknown picture format", where=where, allowed=allowed)
    if not done:
        raise InputError(f"a picture cannot be written as {ending}", where=where, value=image.shape)
    return data.tobytes()


def write_picture(path: Path, image: Picture) -> None:
    """Write a picture in the format that the file's ending names; PNG without one.

    Parameters
    ----------
    path : Path, the file; replaced where it is there
    image : (H, W) grey or (H, W, 3) RGB array, uint8, or uint16 with its camera's bits the
        uppermost, of which a PNG then says how many

    Raises
    ------
    InputError
        There is no such format, it cannot hold a picture of that shape, or the disk refuses.
    """
    data = encode_picture(image, path.suffix or ".png", where=path)
    write_atomically(path, with_bits(data, image))


def with_bits(data: bytes, image: Picture) -> bytes:
    """The PNG file of a picture of 16 bits with how many of them tell something; others as is.

    Whoever reads the picture by itself, without its camera, then knows its range.

    Parameters
    ----------
    data : bytes, of the file
    image : (H, W) or (H, W, 3) array, uint8 or uint16, its camera's bits the uppermost

    References
    ----------
    ISO/IEC 15948, 11.3.2.5 (sBIT).
    """
    if image.dtype == np.uint8 or data[12:16] != b"IHDR":
        return data
    used = int(np.bitwise_or.reduce(image, axis=None))
    bits = max(16 - (used & -used).bit_length() + 1, 1) if used else 16
    chunk = b"sBIT" + bytes([bits]) * (1 if image.ndim == 2 else image.shape[2])
    whole = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return data[:HEADER_END] + whole + data[HEADER_END:]


# Pictures of more than 8 bits.


HEADER_END = 33  # of a PNG's signature and first chunk
STEPS_PER_DN = 256
"""Of a uint16 picture, whose range is that of 256 DN, as every picture's."""
CAMERA_BITS = (10, 12, 14, 16)


def grey_dn(picture: Picture) -> GreyValues:
    """The grey values in DN, same shape: a picture of 8 bits itself, a deeper one as float32.

    Parameters
    ----------
    picture : array of any shape, uint8 or uint16
    """
    if picture.dtype == np.uint8:
        return picture
    return picture.astype(np.float32) * np.float32(1 / STEPS_PER_DN)


def step_of(grey: GreyValues) -> float:
    """The steps in DN in which grey values come: 1 of a picture of 8 bits, less of a deeper one.

    1 too where they come in none, as those of a picture that was smoothed.

    Parameters
    ----------
    grey : array of any shape, DN, as ``grey_dn`` gives them, or their differences

    Examples
    --------
    >>> import numpy as np
    >>> step_of(grey_dn(np.array([0, 16, 65520], np.uint16)))
    0.0625
    """
    if np.issubdtype(grey.dtype, np.integer):
        return 1.0
    fine = grey * np.float32(STEPS_PER_DN)
    with np.errstate(invalid="ignore"):
        steps = fine.astype(np.int32)
    used = int(np.bitwise_or.reduce(steps, axis=None)) if (steps == fine).all() else 0
    return min(used & -used or STEPS_PER_DN, STEPS_PER_DN) / STEPS_PER_DN  # of the lowest bit used


def eight_bit(picture: Picture) -> Bytes:
    """The picture as a camera of 8 bits gives it, same shape; one of 8 bits itself.

    Parameters
    ----------
    picture : array of any shape, uint8 or uint16
    """
    if picture.dtype == np.uint8:
        return cast(Bytes, picture)
    return (picture // STEPS_PER_DN).astype(np.uint8)


def aligned(picture: Picture, bits: int | None = None, where: object = None) -> Picture:
    """A picture of 16-bit numbers with its camera's bits the uppermost, same shape, uint16.

    Programs and cameras store 12 bits either as numbers up to 4095 or as multiples of 16; the
    lowest bits of the latter are all 0, which tells them.  Where the bits are not stated, numbers
    that need 10, 12 or 14 bits are taken for those of such a camera: state the bits of pictures so
    dark that they need fewer.

    Parameters
    ----------
    picture : array of any shape, uint16
    bits : int, optional, of the camera, 10 to 16; found from the picture by default
    where : the file or camera, for the error

    Raises
    ------
    InputError
        The picture holds larger numbers than the camera's bits give.

    References
    ----------
    Unpacked in the lower bits: PFNC 2.4 of EMVA, such as Mono12.  In the upper ones: ISO/IEC
    15948 (PNG), 13.12, which scales samples to the full depth.

    Examples
    --------
    >>> import numpy as np
    >>> aligned(np.array([0, 17, 4095], np.uint16))
    array([    0,   272, 65520], dtype=uint16)
    """
    used = int(np.bitwise_or.reduce(picture, axis=None))
    lowest = used & -used
    if lowest >= 2 ** (16 - (bits or CAMERA_BITS[-2])):
        return picture  # aligned already
    bits = bits or next(each for each in CAMERA_BITS if used < 2**each)
    if used >= 2**bits:
        value, allowed = int(picture.max()), f"{2**bits - 1} at most, of {bits} bits"
        raise InputError("has too large a grey value", where=where, value=value, allowed=allowed)
    return picture * np.uint16(2 ** (16 - bits))


# A camera's tone curve, undone.


def linear_picture(picture: Picture, gamma: float | Literal["srgb"]) -> Picture:
    """The picture as the same camera would have taken it with grey values in proportion to light.

    Rounded to whole steps, as a linear camera's are: at the dark end that is coarser than what the
    curve had kept, by no more than the rounding that every noise here holds.

    Parameters
    ----------
    picture : (H, W) or (H, W, 3) array, uint8 or uint16
    gamma : float or "srgb", the curve as ``stripe.gamma`` states it

    References
    ----------
    sRGB: IEC 61966-2-1:1999, section 5.2.

    Examples
    --------
    >>> import numpy as np
    >>> linear_picture(np.array([[0, 128, 255]], dtype=np.uint8), "srgb")
    array([[  0,  55, 255]], dtype=uint8)
    """
    if gamma == 1:
        return picture
    if picture.dtype == np.uint8:
        return np.asarray(cv2.LUT(picture, linear_dn(gamma)), dtype=np.uint8)
    return _linear_steps(gamma)[picture]


@lru_cache(maxsize=16)
def linear_dn(gamma: float | Literal["srgb"]) -> Bytes:
    """(256,) uint8, DN of a linear camera for each grey value behind a tone curve.

    Parameters
    ----------
    gamma : float or "srgb", as of ``linear_picture``
    """
    return np.rint(255 * _linear_share(np.arange(256) / 255, gamma)).astype(np.uint8)


@lru_cache(maxsize=4)
def _linear_steps(gamma: float | Literal["srgb"]) -> NDArray[np.uint16]:
    """(65536,) the same for each of a deep picture's steps; what lies beyond 255 DN is clipped."""
    share = np.minimum(np.arange(2**16) / (255 * STEPS_PER_DN), 1.0)
    return np.rint(255 * STEPS_PER_DN * _linear_share(share, gamma)).astype(np.uint16)


def _linear_share(share: Floats, gamma: float | Literal["srgb"]) -> Floats:
    """Light for each grey value, both from 0 to 1."""
    if gamma == "srgb":
        return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return share**gamma


# Colours of half the resolution.


_LUMA = {"red": 0.299, "green": 0.587, "blue": 0.114}
_HALVED = 8, 0.25  # every so many pixels along the line; steps within pairs, of those between them


def colour_shift_px(picture: Picture, channel: str, axis: Axis) -> float:
    """How far, at most, colours of half the resolution move a line that is read in one, across it.

    Coded as YUYV, NV12 and their like, two pixels share their colour, which is that of the first,
    of the second, or their mean: the colour lies half a pixel aside of the luma, or not, and the
    line of one colour by the part of it that is no luma.  0 where neighbours have colours of their
    own, which those of a JPEG picture have again once they are interpolated.

    Parameters
    ----------
    picture : (H, W) or (H, W, 3) array, uint8 or uint16, grey or RGB
    channel : str, as ``stripe.channel``
    axis : str, "columns" or "rows", as ``stripe.axis``

    References
    ----------
    Luma: ITU-R BT.601.  Where colours lie: C. Poynton, Digital Video and HD, 2nd ed. (2012),
    "Introduction to luma and chroma".

    Examples
    --------
    >>> import numpy as np
    >>> pairs = np.random.default_rng(1).integers(0, 99, (80, 40, 3), np.uint8).repeat(2, axis=1)
    >>> colour_shift_px(pairs, "red-excess", "rows"), colour_shift_px(pairs, "grey", "rows")
    (0.5, 0.0)
    """
    if picture.ndim == 2 or channel == "grey":
        return 0.0
    every, most = _HALVED
    across = picture[::every] if axis == "rows" else picture[:, ::every].transpose(1, 0, 2)
    steps = np.abs(np.diff(across[..., 0].astype(np.int32) - across[..., 2], axis=1))
    within, between = sorted((steps[:, ::2].sum(), steps[:, 1::2].sum()))
    luma = _LUMA.get(channel, 0.0)  # in an excess of one colour over others there is none
    return (1 - luma) / 2 if within < most * between else 0.0
