"""Streams of JPEG pictures: their true size, whole files only, and no backlog."""

import re
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import example, given, strategies as st
from loopback import listening

from lscan.config.rig import CameraSection
from lscan.devices.opencv_camera import (
    OpencvCamera,
    OpencvOptions,
    jpeg as jpegstream,
    open_capture,
)
from lscan.devices.opencv_camera.jpeg import (
    LEAST_WAIT_S,
    MOST_BROKEN,
    MOST_WAITING,
    JpegStream,
    decode_jpeg,
    is_whole,
    jpeg_file,
)
from lscan.errors import DeviceError
from lscan.records import Bytes

SIZE_PX = (64, 48)
BITS = 12
"""A picture's number is written into its top rows, a bit in each 4 columns, and survives JPEG."""


def picture(number: int, size_px: tuple[int, int] = SIZE_PX) -> Bytes:
    """Grey noise with the number in its first 16 rows, (H, W, 3)."""
    generator = np.random.default_rng(number)
    image = np.repeat(generator.integers(60, 190, (*size_px[::-1], 1), dtype=np.uint8), 3, axis=2)
    for bit in range(BITS):
        image[:16, 4 * bit : 4 * bit + 4] = 255 * (number >> bit & 1)
    return image


def number_of(image: Bytes) -> int:
    return sum((image[:16, 4 * bit : 4 * bit + 4].mean() > 127) << bit for bit in range(BITS))


def jpeg(
    image: Bytes,
    quality: int = 90,
    restart: int = 0,
    sampling: int = 0x221111,
    progressive: bool = False,
) -> bytes:
    parameters = {
        cv2.IMWRITE_JPEG_QUALITY: quality,
        cv2.IMWRITE_JPEG_RST_INTERVAL: restart,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR: sampling,
        cv2.IMWRITE_JPEG_PROGRESSIVE: progressive,
    }
    ok, data = cv2.imencode(".jpg", image, [int(n) for pair in parameters.items() for n in pair])
    assert ok
    return data.tobytes()


def packet(data: bytes) -> Bytes:
    return np.frombuffer(data, dtype=np.uint8)


# ---- one packet -------------------------------------------------------------------------


@examples(30)
@given(width=st.integers(1, 90), height=st.integers(1, 90), pad=st.sampled_from([b"", b"\0\0\r\n"]))
def test_a_packet_has_the_size_it_says(width: int, height: int, pad: bytes) -> None:
    image = decode_jpeg(jpeg_file(packet(jpeg(np.full((height, width, 3), 90, np.uint8)) + pad)))
    assert image is not None and image.shape == (height, width, 3)
    # A uniform picture has no coefficient but the mean's: 90 is off by rounding alone.
    assert np.abs(image.astype(int) - 90).max() <= 1


PADDED = {
    "zeros to 512": lambda data: data + bytes(-len(data) % 512 + 512),
    "0xFF to 4": lambda data: data + b"\xff" * (-len(data) % 4 + 4),
    "line ends around": lambda data: b"\r\n" + data + b"\r\n\r\n",
    "an older picture behind": lambda data: data + jpeg(picture(3))[200:],
    "zeros before": lambda data: bytes(500) + data,
    "spaces": lambda data: data + b" " * 700,
    "fill bytes before a marker": lambda data: data[:-2] + b"\xff\xff" + data[-2:],
}


@pytest.mark.parametrize("way", PADDED)
@pytest.mark.parametrize("restart", [0, 3])
def test_a_padded_packet_is_its_picture(way: str, restart: int) -> None:
    data = jpeg(picture(7), restart=restart)
    file = jpeg_file(packet(PADDED[way](data)))
    image = decode_jpeg(file)
    assert file is not None and image is not None
    np.testing.assert_array_equal(image, cv2.imdecode(packet(data), cv2.IMREAD_COLOR))
    assert is_whole(file)


SAMPLING = (0x411111, 0x221111, 0x211111, 0x121111, 0x111111)
"""Luma blocks to one of chroma: 4:1:1, 4:2:0, 4:2:2, 4:4:0, 4:4:4."""


# The last unit of a run is as grey as what decoders fill in where data are missing.
@example(size_px=(5, 90), quality=5, restart=3, sampling=0x111111, flat=False, progressive=False)
@examples(60)
@given(
    size_px=st.tuples(st.integers(1, 90), st.integers(1, 90)),
    quality=st.integers(5, 100),
    restart=st.integers(0, 9),
    sampling=st.sampled_from(SAMPLING),
    flat=st.booleans(),
    progressive=st.booleans(),
)
def test_no_whole_picture_is_taken_for_a_broken_one(
    size_px: tuple[int, int],
    quality: int,
    restart: int,
    sampling: int,
    flat: bool,
    progressive: bool,
) -> None:
    image = np.full((*size_px, 3), 90, np.uint8) if flat else picture(7, (90, 90))[: size_px[0]]
    data = jpeg(image, quality, restart, sampling, progressive)
    file = jpeg_file(packet(data))
    seen = decode_jpeg(file)
    assert file == data and seen is not None and is_whole(file)


BROKEN_PICTURES = 20


def line_picture() -> Bytes:
    """A bright line on a dark, noisy ground, as a scan sees it, (H, W, 3)."""
    generator = np.random.default_rng(1)
    rows, columns = np.arange(240)[:, None], np.arange(320)
    line = 200 * np.exp(-0.5 * ((rows - 120 - 40 * np.sin(columns / 60)) / 2.5) ** 2)
    grey = np.clip(20 + line + generator.normal(0, 3, line.shape), 0, 255)
    return (grey[..., None] * (0.17, 0.2, 1)).astype(np.uint8)


@pytest.mark.parametrize(
    ("way", "restart"), [("lost", 0), ("lost", 20), ("zeros", 0), ("another", 20)]
)
def test_most_pictures_broken_inside_are_known(way: str, restart: int) -> None:
    """What a lost packet leaves.  The format has no checksum: a decoder may find its place again
    with all blocks counted.  Of 200 at 640 by 480 px that was so for 0 to 5, 2.5 %; of 20 then
    for 0.5, and for more than 4 in one seed of five thousand (Poisson)."""
    generator = np.random.default_rng(8)
    data = jpeg(line_picture(), restart=restart)
    whole = decode_jpeg(jpeg_file(packet(data)))
    assert whole is not None
    wrong_pictures = taken = 0
    for _ in range(BROKEN_PICTURES):
        length = int(generator.integers(16, len(data) // 8))
        start = int(generator.integers(len(data) // 4, len(data) - 2 - length))
        lost = {"lost": b"", "zeros": bytes(length), "another": generator.bytes(length)}[way]
        file = jpeg_file(packet(data[:start] + lost + data[start + length :]))
        image = decode_jpeg(file)
        if file is None or image is None or image.shape != whole.shape:
            continue
        wrong = (np.abs(image.astype(int) - whole).max(axis=2) > 30).sum() > 64
        wrong_pictures += wrong
        taken += wrong and is_whole(file)
    assert wrong_pictures > BROKEN_PICTURES // 2
    assert taken <= 4


@examples(60)
@given(share=st.floats(0, 1, exclude_max=True))
def test_a_packet_cut_short_is_no_picture(share: float) -> None:
    data = jpeg(picture(7))
    assert decode_jpeg(jpeg_file(packet(data[: int(share * len(data))]))) is None


@pytest.mark.parametrize("data", [b"", b"\xff\xd8", b"\xff\xd8\xff\xd9", b"<html>busy</html>"])
def test_what_is_no_jpeg_is_no_picture(data: bytes) -> None:
    assert decode_jpeg(jpeg_file(packet(data))) is None


def test_a_picture_is_not_turned_on_its_side() -> None:
    """An EXIF mark "turn by a quarter" (orientation 6, tag 0x0112) is a wish of viewers only."""
    tiff = b"II*\0\x08\0\0\0" + b"\x01\0" + b"\x12\x01\x03\0\x01\0\0\0\x06\0\0\0" + b"\0\0\0\0"
    body = b"Exif\0\0" + tiff
    data = jpeg(picture(7))
    marked = data[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + data[2:]
    turned = cv2.imdecode(packet(marked), cv2.IMREAD_COLOR)
    assert turned is not None and turned.shape[:2] == SIZE_PX  # the mark is understood
    image = decode_jpeg(jpeg_file(packet(marked)))
    assert image is not None and image.shape[:2] == SIZE_PX[::-1]


# ---- packets in a row, on a clock of the test's own ---------------------------------------


class _Packets:
    """Packets by their script: each with the seconds it must be waited for."""

    isOpened = get = set = release = getBackendName = None  # noqa: N815 - OpenCV's names

    def __init__(self, script: Sequence[tuple[float, bytes]]) -> None:
        self._script, self.now_s = iter(script), 0.0

    def read(self) -> tuple[bool, Any]:
        for wait_s, data in self._script:
            self.now_s += wait_s
            return True, packet(data).reshape(1, -1)
        return False, None


def stream_of(
    monkeypatch: pytest.MonkeyPatch, script: Sequence[tuple[float, bytes]]
) -> Callable[[], tuple[bool, Any]]:
    """The ``read`` of a stream on that script."""
    packets = _Packets(script)
    monkeypatch.setattr(jpegstream, "time", SimpleNamespace(monotonic=lambda: packets.now_s))
    return JpegStream(packets, "camera x").read  # type: ignore[arg-type]


WAIT_S = 10 * LEAST_WAIT_S


def test_only_what_was_waited_for_is_handed_out(monkeypatch: pytest.MonkeyPatch) -> None:
    waits = {3: WAIT_S, 4: WAIT_S, 9: WAIT_S}
    script = [(waits.get(number, 0.0), jpeg(picture(number))) for number in range(11)]
    read = stream_of(monkeypatch, script)
    assert [number_of(read()[1]) for _ in range(3)] == [3, 4, 9]
    assert read() == (False, None)


def test_a_broken_picture_is_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = jpeg(picture(5))
    read = stream_of(monkeypatch, [(WAIT_S, whole[:-9])] * (MOST_BROKEN - 1) + [(WAIT_S, whole)])
    assert number_of(read()[1]) == 5


def test_nothing_but_broken_pictures_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    read = stream_of(monkeypatch, [(WAIT_S, jpeg(picture(5))[:-9])] * MOST_BROKEN)
    with pytest.raises(DeviceError, match=f"camera x: sent {MOST_BROKEN} broken JPEG"):
        read()


def test_a_stream_that_never_needs_to_be_waited_for_is_a_fault(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    read = stream_of(monkeypatch, [(0.0, b"")] * MOST_WAITING)
    with pytest.raises(DeviceError, match=r"camera x: sends more than 1000 .*options\.file"):
        read()


# ---- a stream over HTTP -------------------------------------------------------------------


class _Served:
    """What is sent: pictures of rising number, 100 a second; from ``change_at`` on half as
    large.  count: how many have been sent."""

    def __init__(self, change_at: int | None = None) -> None:
        self.change_at, self.count, self.period_s = change_at, 0, 0.01

    def part(self, data: bytes) -> bytes:
        """What is sent of a picture."""
        return data

    def send(self, write: Callable[[bytes], Any]) -> None:
        for number in range(1, 1 << BITS):
            image = picture(number)
            if self.change_at is not None and number >= self.change_at:
                image = image[::2, ::2]
            data = self.part(jpeg(image))
            head = f"--part\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
            write(head.encode() + data + b"\r\n")
            self.count = number
            time.sleep(self.period_s)


@contextmanager
def http(send: Callable[[Callable[[bytes], Any]], None], kind: str) -> Iterator[str]:
    """The address at which what ``send`` writes is served."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.end_headers()
            with suppress(OSError):  # the reader has gone
                send(self.wfile.write)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    with listening(Handler) as address:
        yield f"{address}/a"


MULTIPART = "multipart/x-mixed-replace; boundary=part"


def camera_at(url: str, **options: Any) -> OpencvCamera:
    section = CameraSection(driver="opencv", width_px=SIZE_PX[0], height_px=SIZE_PX[1])
    return OpencvCamera(section, OpencvOptions(url=url, timeout_s=120, **options))


def test_without_lengths_a_picture_comes_when_the_next_begins() -> None:
    """As rpicam-vid sends JPEG files over TCP, one after the other: hence flush_frames of 3."""
    served = _Served()

    def send(listener: socket.socket) -> None:
        connection, _ = listener.accept()
        with connection, suppress(OSError):  # the reader has gone
            for number in range(1, 1 << BITS):
                connection.sendall(jpeg(picture(number)))
                served.count = number
                time.sleep(served.period_s)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=send, args=(listener,), daemon=True).start()
        url = f"tcp://127.0.0.1:{listener.getsockname()[1]}"
        capture = open_capture(OpencvOptions(url=url, timeout_s=120))
        assert isinstance(capture, JpegStream)
        for _ in range(5):
            ok, image = capture.read()
            number = number_of(image)
            assert ok and served.count >= number  # so the next had been begun
            assert np.array_equal(image, decode_jpeg(jpeg(picture(number))))
        capture.release()


def test_a_size_that_changes_in_mid_stream_is_refused() -> None:
    """Every picture until then is one that was sent, to the byte; after it there is none."""
    served = _Served(change_at=60)
    with http(served.send, MULTIPART) as url:
        camera = camera_at(url)
        grabbed: list[Bytes] = []
        with pytest.raises(DeviceError, match=r"pictures are 32 by 24 px; the rig says 64 by 48"):
            while served.count < 1000:
                grabbed.append(camera.grab().image)
        camera.close()
    assert grabbed
    for image in grabbed:
        number = number_of(image)
        assert number < 60
        sent = cv2.imdecode(packet(jpeg(picture(number))), cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(image, sent[..., ::-1])


class _HalfBroken(_Served):
    """Of two pictures one ends in the middle, and all are padded with zeros to 512."""

    def part(self, data: bytes) -> bytes:
        if self.count % 2:
            data = data[: len(data) // 2] + data[-2:]
        return data + bytes(-len(data) % 512)


def test_broken_pictures_of_a_stream_are_dropped_and_counted(
    caplog: pytest.LogCaptureFixture,
) -> None:
    with http(_HalfBroken().send, MULTIPART) as url:
        camera = camera_at(url)
        for _ in range(8):
            image = camera.grab().image
            sent = cv2.imdecode(packet(jpeg(picture(number_of(image)))), cv2.IMREAD_COLOR)
            np.testing.assert_array_equal(image, sent[..., ::-1])
        camera.close()
    assert re.search(r"[1-9]\d* broken pictures were dropped", caplog.text)


def test_a_rig_that_says_another_size_is_refused_at_once() -> None:
    with (
        http(_Served(change_at=0).send, MULTIPART) as url,
        pytest.raises(DeviceError, match="pictures are 32 by 24 px"),
    ):
        camera_at(url)


def test_after_two_pictures_a_backlog_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody reads while 40 pictures are sent: the third read is of one sent since.

    From then on a picture comes each second, and what is read within 0.3 s has lain in a buffer:
    a busy machine does not make the one look like the other.
    """
    served = _Served()
    with http(served.send, MULTIPART) as url:
        capture = open_capture(OpencvOptions(url=url, timeout_s=120))
        assert isinstance(capture, JpegStream)
        assert capture.read()[0]
        held_up_until = served.count + 40
        while served.count < held_up_until:
            time.sleep(0.01)
        served.period_s = 1.0
        monkeypatch.setattr(jpegstream, "LEAST_WAIT_S", 0.3)
        sent = served.count
        numbers = [number_of(capture.read()[1]) for _ in range(3)]
        capture.release()
    assert numbers[2] > sent, numbers


@pytest.fixture
def ffv1(tmp_path: Path) -> bytes:
    """Pictures 1 to 12 in a lossless codec, as an AVI file."""
    path = tmp_path / "a.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 10, SIZE_PX)
    for number in range(1, 13):
        writer.write(picture(number))
    writer.release()
    return path.read_bytes()


def test_another_codec_is_read_as_before_and_said(
    ffv1: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    with http(lambda write: write(ffv1), "video/avi") as url:
        capture = open_capture(OpencvOptions(url=url, timeout_s=120, flush_ms=100))
        assert "coded as FFV1: a change of the picture size" in caplog.text
        np.testing.assert_array_equal(capture.read()[1], picture(1))
        capture.release()


def test_another_codec_needs_its_delay_stated(ffv1: bytes) -> None:
    known = r"coded as FFV1, whose pictures come late .* state camera\.options\.flush_ms"
    with (
        http(lambda write: write(ffv1), "video/avi") as url,
        pytest.raises(DeviceError, match=known),
    ):
        camera_at(url)


def test_a_still_scene_is_no_stuck_camera_where_changes_are_coded(tmp_path: Path) -> None:
    """An encoder of changes codes "nothing changed": the decoded pictures are the same bytes."""
    path = tmp_path / "a.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25, SIZE_PX)
    for _ in range(300):
        writer.write(picture(5))
    writer.release()
    data = path.read_bytes()
    starts = [match.start() for match in re.finditer(b"00dc", data)]

    def send(write: Callable[[bytes], Any]) -> None:
        for begin, end in pairwise([0, *starts]):
            write(data[begin:end])
            time.sleep(0.002)

    with http(send, "video/avi") as url:
        camera = camera_at(url, retries=4, flush_ms=20)
        first, second = camera.grab().image, camera.grab().image
        camera.close()
    assert number_of(first) == number_of(second) == 5


def test_equal_jpeg_pictures_are_accepted_where_that_is_stated() -> None:
    part = jpeg(picture(5))

    def send(write: Callable[[bytes], Any]) -> None:
        for _ in range(1000):
            head = f"--part\r\nContent-Type: image/jpeg\r\nContent-Length: {len(part)}\r\n\r\n"
            write(head.encode() + part + b"\r\n")
            time.sleep(0.005)

    with http(send, MULTIPART) as url:
        camera = camera_at(url, retries=4, repeated="accept")
        np.testing.assert_array_equal(camera.grab().image, camera.grab().image)
        camera.close()
        refused = camera_at(url, retries=4)
        with pytest.raises(DeviceError, match=r"it is stuck: .*camera\.options\.repeated"):
            refused.grab()
        refused.close()


def test_another_codec_is_decoded_without_delay(ffv1: bytes) -> None:
    """FFmpeg's decoders of n threads hold n - 1 pictures back; of an AVI file, FFmpeg hands out
    a picture when the next is there.  So of 11 sent 10 can be read before more is sent."""
    sent, readable = 11, 10
    end = [match.start() for match in re.finditer(b"00dc", ffv1)][sent]
    all_read = threading.Event()
    in_time: list[bool] = []

    def send(write: Callable[[bytes], Any]) -> None:
        write(ffv1[:end])
        in_time.append(all_read.wait(60))
        write(ffv1[end:])

    with http(send, "video/avi") as url:
        capture = open_capture(OpencvOptions(url=url, timeout_s=120, flush_ms=100))
        numbers = [number_of(capture.read()[1]) for _ in range(readable)]
        all_read.set()
        capture.release()
        while not in_time:
            time.sleep(0.01)
    assert numbers == list(range(1, readable + 1))
    assert in_time == [True]
