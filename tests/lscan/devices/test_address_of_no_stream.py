"""An address that sends a picture, a page or noise is distinguished from a camera that is gone."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from http.server import BaseHTTPRequestHandler
from typing import Any

import cv2
import numpy as np
import pytest
from loopback import listening

from lscan.config.rig import CameraSection
from lscan.devices.opencv_camera import OpencvCamera, OpencvOptions, open_capture
from lscan.errors import DeviceError

WIDTH_PX, HEIGHT_PX = 64, 48
NOISE = np.random.default_rng(0).integers(0, 256, 20_000, dtype=np.uint8)


def jpeg() -> bytes:
    picture = NOISE[: HEIGHT_PX * WIDTH_PX * 3].reshape(HEIGHT_PX, WIDTH_PX, 3)
    return bytes(cv2.imencode(".jpg", picture)[1])


@contextmanager
def served(body: bytes, kind: str, code: int = 200, name: str = "stream") -> Iterator[str]:
    """The address of a server that answers every question with ``body``.

    name: its path; of one that ends in .jpg FFmpeg takes whatever comes for JPEG pictures.
    """

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(code)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    with listening(Handler) as address:
        yield f"{address}/{name}"


def refusal_of(url: str) -> str:
    section = CameraSection(driver="opencv", width_px=WIDTH_PX, height_px=HEIGHT_PX)
    options = OpencvOptions(url=url, timeout_s=120, reconnects=0)
    with pytest.raises(DeviceError) as caught:
        OpencvCamera(section, options)
    message = str(caught.value)
    assert message.startswith(f"camera opencv ({url}): ")
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    "device",
    ["libcamerasrc ! videoconvert ! appsink", "libcamera", "/base/soc/i2c0mux/i2c@1/imx708@1a"],
)
def test_a_pipeline_is_refused_where_there_is_no_gstreamer(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = []
    monkeypatch.setattr(cv2, "VideoCapture", lambda *how: opened.append(how))
    for known in (False, True):  # as in the OpenCV of pip; in one built with it
        monkeypatch.setattr(cv2.videoio_registry, "hasBackend", lambda _, known=known: known)
        with nullcontext() if known else pytest.raises(DeviceError, match=r"MJPEG.*options\.url"):
            open_capture(OpencvOptions(device=device))
    assert opened == [(device, cv2.CAP_ANY)]


@pytest.mark.parametrize("name", ["stream", "snapshot.jpg"])
def test_one_picture_is_no_stream(name: str) -> None:
    with served(jpeg(), "image/jpeg", name=name) as url:
        message = refusal_of(url)
    assert "the address gave 1 picture and ended; needed: a stream, such as MJPEG" in message
    assert "cable" not in message


@pytest.mark.parametrize(
    ("body", "kind", "code", "found"),
    [
        (b"<html><body>Sign in</body></html>" * 20, "text/html", 200, "text/html"),
        (NOISE.tobytes(), "application/octet-stream", 200, "application/octet-stream"),
        (b"", "image/jpeg", 200, "image/jpeg"),
        (b"no such page", "text/plain", 404, "404 Not Found"),
    ],
    ids=["page", "noise", "nothing", "missing"],
)
def test_the_message_says_what_the_address_sends(
    body: bytes, kind: str, code: int, found: str
) -> None:
    with served(body, kind, code) as url:
        message = refusal_of(url)
    assert f"what the address sends is no stream of pictures ({found}); needed: " in message


@pytest.mark.parametrize("body", [b"<html></html>" * 50, NOISE.tobytes()], ids=["page", "noise"])
def test_what_is_called_a_picture_and_is_none(body: bytes) -> None:
    with served(body, "image/jpeg", name="snapshot.jpg") as url:
        assert "what the address sends is no stream of pictures; needed: " in refusal_of(url)


def test_a_stream_that_holds_no_picture_yet_is_not_called_none() -> None:
    with served(b"", "multipart/x-mixed-replace; boundary=part") as url:
        message = refusal_of(url)
    assert "no stream" not in message
    assert "the address answers (multipart/x-mixed-replace)" in message


def test_an_address_where_nothing_answers() -> None:
    with served(b"", "text/plain") as url:
        pass
    assert "cannot be opened; check that the camera is on" in refusal_of(url)
