"""Pictures of strangers: their size is known before they are decoded, and nothing crashes."""

import struct
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from PIL import Image
from png_files import HUGE, chunk, grey_png

from lscan.devices.opencv_camera.jpeg import decode_jpeg
from lscan.errors import DeviceError, InputError
from lscan.files import pictures
from lscan.files.pictures import (
    MOST_PX,
    PictureHeader,
    display_turn,
    eight_bit,
    grey_dn,
    read_header,
    read_picture,
    step_of,
    write_picture,
)

ENDINGS = {".png": "PNG", ".jpg": "JPEG", ".bmp": "BMP", ".tif": "TIFF", ".webp": "WebP"}


def jpeg_of(width: int, height: int) -> bytes:
    """A JPEG file, whole but for its size, which is as said."""
    data = bytearray(encoded(".jpg", (16, 16)))
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", height, width)
    return bytes(data)


def tiff_of(*entries: tuple[int, int]) -> bytes:
    """A TIFF file of LONGs and no more: (tag, value)."""
    body = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in entries)
    return b"II\x2a\0" + struct.pack("<IH", 8, len(entries)) + body + bytes(4)


def webp_of(width: int, height: int) -> bytes:
    canvas = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    return b"RIFF" + struct.pack("<I", 22) + b"WEBPVP8X" + struct.pack("<I", 10) + bytes(4) + canvas


def bmp_of(width: int, height: int) -> bytes:
    shape = struct.pack("<IiiHH", 40, width, height, 1, 24)
    return b"BM" + struct.pack("<IHHI", 54, 0, 0, 54) + shape + bytes(40)


def encoded(ending: str, shape: tuple[int, ...], seed: int = 1) -> bytes:
    image = np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)
    done, data = cv2.imencode(ending, image)
    assert done
    return data.tobytes()


BOMBS: dict[str, tuple[bytes, int, int]] = {
    "png": (grey_png(HUGE, HUGE, b""), HUGE, HUGE),
    "png beyond OpenCV's limit": (grey_png(2**16, 2**15, b""), 2**16, 2**15),
    "png as wide as can be": (grey_png(2**31 - 1, 1, b""), 2**31 - 1, 1),
    "jpeg": (jpeg_of(65_500, 65_500), 65_500, 65_500),
    "bmp": (bmp_of(HUGE, -HUGE), HUGE, HUGE),
    "tiff": (tiff_of((256, HUGE), (257, HUGE)), HUGE, HUGE),
    "tiff of one huge tile": (tiff_of((256, 9), (257, 9), (322, HUGE), (323, HUGE)), HUGE, HUGE),
    "tiff of two widths": (tiff_of((256, 9), (256, HUGE), (257, HUGE)), HUGE, HUGE),
    "webp": (webp_of(16_383, 16_383), 16_383, 16_383),
}


@pytest.mark.parametrize(
    ("name", "width", "message"),
    [
        ("x.jpg", 70_000, r"x\.jpg: .* cannot be written as \.jpg \(got \(1, 70000\)\)$"),
        (
            "x.webp",
            20_000,
            r"x\.webp: .* cannot be written as \.webp \(got \(1, 20000\)\)$",
        ),
        ("x.jqg", 9, r"x\.jqg: unknown picture format \(allowed: \.png, \.jpg, .*, \.webp\)$"),
    ],
)
def test_a_picture_that_cannot_be_written_says_why(
    tmp_path: Path, name: str, width: int, message: str
) -> None:
    """JPEG takes 65,500 px in OpenCV, WebP 16,383."""
    with pytest.raises(InputError, match=message):
        write_picture(tmp_path / name, np.zeros((1, width), np.uint8))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", BOMBS)
def test_a_huge_picture_is_refused_by_its_header(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    def reached(*_: Any) -> None:
        raise AssertionError("it was decoded")

    monkeypatch.setattr(cv2, "imdecode", reached)
    content, width, height = BOMBS[kind]
    (tmp_path / "bomb").write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_picture(tmp_path / "bomb")
    assert f"bomb: is too large a picture (got '{width} by {height} px'; allowed: {MOST_PX} px" in (
        str(caught.value)
    )


def test_a_png_without_pixels_has_no_header() -> None:
    """Nor one whose last chunk is not empty: a decoder looks for pixels as far as it says."""
    whole = grey_png(16, 16, zlib.compress(bytes(17 * 16)))
    assert read_header(whole) is not None
    start, end = whole.index(b"IDAT") - 4, whole.index(b"IEND") - 4
    assert read_header(whole[:start] + whole[end:]) is None
    long_end = chunk(b"IEND", b"", length=2**32 - 16)
    assert read_header(whole[:end] + long_end) is None
    assert read_header(whole[:start] + long_end) is None


@pytest.mark.parametrize(("ending", "name"), ENDINGS.items())
@pytest.mark.parametrize("shape", [(18, 23), (18, 23, 3), (1, 1, 3)])
def test_the_header_states_the_size_and_kind(
    ending: str, name: str, shape: tuple[int, ...]
) -> None:
    data = encoded(ending, shape)
    assert read_header(data) == PictureHeader(name, shape[1], shape[0])  # type: ignore[arg-type]


def test_other_ways_to_write_a_header() -> None:
    """Big-endian and BigTIFF, lossless WebP, BMP of OS/2, JPEG with what is no marker in it."""
    big = struct.pack(">2sHIHHHIHHHHIHH", b"MM", 42, 8, 2, 256, 3, 1, 7, 0, 257, 3, 1, 9, 0)
    assert read_header(big) == PictureHeader("TIFF", 7, 9)
    entries = struct.pack("<HHQQHHQQ", 256, 16, 1, 7, 257, 16, 1, 9)
    bigtiff = struct.pack("<2sHHHQQ", b"II", 43, 8, 0, 16, 2) + entries
    assert read_header(bigtiff) == PictureHeader("TIFF", 7, 9)
    lossless = cv2.imencode(".webp", np.zeros((9, 7, 3), np.uint8), [cv2.IMWRITE_WEBP_QUALITY, 101])
    assert read_header(lossless[1].tobytes()) == PictureHeader("WebP", 7, 9)
    os2 = b"BM" + bytes(12) + struct.pack("<IHHHH", 12, 7, 9, 1, 24)
    assert read_header(os2) == PictureHeader("BMP", 7, 9)
    jpeg = jpeg_of(7, 9)
    assert read_header(jpeg[:2] + b"\xff\xff\xff\x01\0\0" + jpeg[2:]) == PictureHeader("JPEG", 7, 9)


@pytest.mark.parametrize("ending", [".png", ".tif"])
@pytest.mark.parametrize("bits", [10, 12, 14, 16])
@pytest.mark.parametrize("colour", [False, True])
def test_sixteen_bits_are_read_whatever_part_a_camera_fills(
    tmp_path: Path, ending: str, bits: int, colour: bool
) -> None:
    """As other programs write them: numbers up to 2^bits - 1, or these as the uppermost bits."""
    shape = (8, 8, 3) if colour else (8, 8)
    numbers = np.random.default_rng(bits).integers(0, 2**bits, shape).astype(np.uint16)
    numbers[0, 0] = 2**bits - 1
    upper = numbers * np.uint16(2 ** (16 - bits))
    for name, stored in (("low", numbers), ("high", upper)):
        cv2.imwrite(str(tmp_path / f"{name}{ending}"), stored[..., ::-1] if colour else stored)
        for stated in (None, bits):
            assert np.array_equal(read_picture(tmp_path / f"{name}{ending}", stated), upper)
    assert display_turn(tmp_path / f"low{ending}") == ""


def test_a_dark_picture_of_twelve_bits_needs_them_stated(tmp_path: Path) -> None:
    dark = np.array([[0, 5, 1000]], np.uint16)
    cv2.imwrite(str(tmp_path / "dark.png"), dark)
    assert read_picture(tmp_path / "dark.png").max() == 1000 * 64  # as if of 10 bits
    assert read_picture(tmp_path / "dark.png", 12).max() == 1000 * 16
    cv2.imwrite(str(tmp_path / "full.png"), np.array([[1, 5000]], np.uint16))
    with pytest.raises(InputError, match=r"full.png: has .*5000; allowed: 4095 at most, of 12"):
        read_picture(tmp_path / "full.png", 12)


@pytest.mark.parametrize("colour", [False, True])
@pytest.mark.parametrize("bits", [10, 12, 16])
def test_a_dark_picture_of_our_own_says_its_range(tmp_path: Path, bits: int, colour: bool) -> None:
    """By its sBIT chunk, which OpenCV passes over and Pillow reads as many numbers from."""
    dark = np.array([[0, 1, 3]], np.uint16) * np.uint16(2 ** (16 - bits))
    dark = np.dstack([dark, 2 * dark, dark]) if colour else dark
    write_picture(tmp_path / "dark.png", dark)
    assert np.array_equal(read_picture(tmp_path / "dark.png"), dark)
    assert np.array_equal(read_picture(tmp_path / "dark.png", bits), dark)
    data = (tmp_path / "dark.png").read_bytes()
    at = data.index(b"sBIT")
    assert data[at + 4 : at + 4 + (3 if colour else 1)] == bytes([bits]) * (3 if colour else 1)
    assert struct.unpack_from(">I", data, at - 4)[0] == (3 if colour else 1)
    assert cv2.imread(str(tmp_path / "dark.png"), cv2.IMREAD_UNCHANGED).dtype == np.uint16
    with Image.open(tmp_path / "dark.png") as opened:  # which checks each chunk's sum
        opened.load()


def test_a_picture_of_eight_bits_is_written_as_ever(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png", np.zeros((2, 2), np.uint8))
    assert b"sBIT" not in (tmp_path / "a.png").read_bytes()


def test_a_deep_picture_as_grey_values() -> None:
    """Closed form: 256 steps to a DN, of which 12 bits use every sixteenth."""
    deep = np.array([[0, 16, 4096, 65520]], np.uint16)
    assert grey_dn(deep).tolist() == [[0.0, 0.0625, 16.0, 255.9375]]
    assert eight_bit(deep).tolist() == [[0, 0, 16, 255]]
    assert step_of(grey_dn(deep)) == 1 / 16
    assert step_of(np.array([7.0, 9.0])) == step_of(np.array([0.1])) == step_of(np.zeros(3)) == 1


@pytest.mark.parametrize(
    "content",
    [b"GIF89a" + struct.pack("<HH", 60_000, 60_000) + bytes(99), b"P5 9 9 255 ", b"", b"B"],
)
def test_other_formats_are_refused(tmp_path: Path, content: bytes) -> None:
    """OpenCV reads more formats; those the documentation names are those whose size is checked."""
    (tmp_path / "other").write_bytes(content)
    with pytest.raises(InputError, match=r"other: is not a picture that can be read .*PNG, JPEG"):
        read_picture(tmp_path / "other")


@examples(300)
@given(
    start=st.sampled_from(
        [b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"BM", b"II\x2a\0", b"RIFF"]
    ),
    rest=st.binary(max_size=200),
)
def test_a_header_of_random_bytes_is_none_or_of_some_size(start: bytes, rest: bytes) -> None:
    header = read_header(start + rest)
    assert header is None or min(header.width_px, header.height_px) > 0


def test_a_picture_from_the_network_is_refused_by_its_header(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def reached(*_: Any) -> None:
        raise AssertionError("it was decoded")

    monkeypatch.setattr(pictures.cv2, "imdecode", reached)
    with pytest.raises(DeviceError, match="web: sent a picture of 65500 by 65500 px; allowed"):
        decode_jpeg(jpeg_of(65_500, 65_500), "web")
