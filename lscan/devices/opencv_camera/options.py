"""What ``[camera.options]`` of a rig file may say to the opencv driver, and what a capture is."""

from collections.abc import Callable
from typing import Annotated, Any, Literal, Protocol, Self

import numpy as np
from pydantic import Field, model_validator

from lscan.config.documents import Strict
from lscan.records import Bytes

_OF_A_DEVICE = ("pixel_format", "fps", "gain", "focus", "white_balance", "auto_exposure")

Url = Annotated[
    str,
    Field(
        pattern=r"^(https?|rtsps?|rtmp|udp|tcp)://\S+$",
        description="an address that begins with http, https, rtsp, rtsps, rtmp, udp or tcp ://",
    ),
]
FourLetters = Annotated[
    str, Field(pattern=r"^[ -~]{4}$", description='four letters such as "MJPG" or "YUYV"')
]


class OpencvOptions(Strict):
    """Which camera, how it is set, and what is done with its pictures.

    One of: device, a number or a path; url, of a stream; file, of a video, whose pictures come
    one by one in their order.  A device and a stream are *live*: they go on without being asked.

    For a device only; what is left out is left as the camera has it:
    pixel_format: four letters, such as "MJPG" or "YUYV".  fps: pictures per second.
    gain, focus, white_balance: in the camera's own units (white balance mostly in kelvin);
    a stated focus or white balance switches the automatic one off.  auto_exposure: lets the
    camera choose, in place of ``camera.exposure_ms``.
    strict_settings: refuse a camera that does not do as it is set, instead of reporting it.

    For live cameras only:
    warm_up_frames: dropped after opening, while the camera settles.
    flush_frames: dropped after the call, since a picture that arrives after it may have been
    exposed before it; flush_ms: only what arrives this long after the call is looked at.  A stream
    that is not of JPEG pictures needs flush_ms stated: an encoder that codes changes holds
    pictures back (B-frames, looking ahead), by a time that only a change in view shows.
    Should the program be held up for seconds, a device's own time stamps and, on a stream of
    JPEG pictures, flush_frames of 2 keep out what queued meanwhile (see jpegstream for what is
    not guaranteed); on a stream of another codec only flush_ms or the track's settle_s do.
    retries: black, broken or repeated pictures and failed readings in a row that are passed over
    before giving up.
    repeated: what becomes of a picture that is the one before, byte for byte: "refuse" it, since
    noise makes pictures differ and a camera that repeats one is stuck, or "accept" it, where the
    camera smooths all noise away.  A stream that codes changes repeats what does not change, and
    is always accepted.
    reconnects: how often in one grab a camera that hung or vanished is opened again, each time
    after reconnect_wait_s: a cable just plugged in takes a second.

    average_frames: pictures averaged into one, pixel by pixel, rounded.
    timeout_s: how long to wait for the camera to open, and for each picture.
    black: what becomes of a picture with no pixel above black_dn: "refuse" it, "report" it
    with a warning, or "accept" it (the cap is on, the laser is off in a dark room).
    """

    device: Annotated[int, Field(ge=0, le=63)] | Annotated[str, Field(min_length=1)] | None = None
    url: Url | None = None
    file: Annotated[str, Field(min_length=1)] | None = None

    pixel_format: FourLetters | None = None
    fps: Annotated[float, Field(gt=0, le=1000)] | None = None
    gain: Annotated[float, Field(ge=0, le=1e6)] | None = None
    focus: Annotated[float, Field(ge=0, le=1e6)] | None = None
    white_balance: Annotated[float, Field(ge=0, le=1e6)] | None = None
    auto_exposure: bool = False
    strict_settings: bool = False

    warm_up_frames: Annotated[int, Field(ge=0, le=1000)] = 5
    flush_frames: Annotated[int, Field(ge=0, le=100)] = 2
    flush_ms: Annotated[float, Field(ge=0, le=60_000)] = 0.0
    retries: Annotated[int, Field(ge=0, le=1000)] = 30
    reconnects: Annotated[int, Field(ge=0, le=100)] = 2
    reconnect_wait_s: Annotated[float, Field(ge=0, le=600)] = 1.0

    average_frames: Annotated[int, Field(ge=1, le=256)] = 1
    timeout_s: Annotated[float, Field(ge=0.02, le=600)] = 5.0
    black: Literal["refuse", "report", "accept"] = "refuse"
    black_dn: Annotated[float, Field(ge=0, le=254)] = 1.0
    repeated: Literal["refuse", "accept"] = "refuse"

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        sources = (self.device, self.url, self.file)
        if sum(source is not None for source in sources) != 1:
            raise ValueError("needs exactly one of device, url and file")
        stated = sorted(self.model_fields_set & set(_OF_A_DEVICE))
        if self.device is None and stated:
            raise ValueError(f"{stated[0]} can only be set on a device, not on a url or a file")
        return self

    @property
    def live(self) -> bool:
        """Whether pictures come without being asked: a device or a stream."""
        return self.file is None

    @property
    def waits_for_change(self) -> bool:
        """Whether it is stated how long a picture that arrives may be older than the call."""
        return "flush_ms" in self.model_fields_set

    @property
    def pictures_per_grab(self) -> int:
        """How many pictures of a live camera one grab waits for."""
        return self.flush_frames + self.average_frames

    @property
    def exposure_settable(self) -> bool:
        """Whether ``exposure_ms`` is set: of a device that does not choose by itself."""
        return self.device is not None and not self.auto_exposure

    @property
    def name(self) -> str:
        """What messages call the camera."""
        if self.device is not None:
            return f"camera opencv (device {self.device})"
        return f"camera opencv ({self.url or self.file})"

    def is_black(self, image: Bytes) -> bool:
        """Whether no pixel is above ``black_dn``.

        Parameters
        ----------
        image : (H, W) or (H, W, 3) uint8 array
        """
        return int(image.max()) <= self.black_dn

    def is_stuck(self, image: Bytes, last: Bytes) -> bool:
        """Whether a live camera sent its last picture again.

        Black ones hold no noise to compare, and have a rule of their own.

        Parameters
        ----------
        image, last : (H, W) or (H, W, 3) uint8 array, the picture and the one before
        """
        meant = self.repeated == "accept" or not self.live
        return not meant and np.array_equal(image, last) and not self.is_black(image)


class Capture(Protocol):
    """What the driver needs of a ``cv2.VideoCapture``; tests put a faulty one in its place."""

    def isOpened(self) -> bool: ...  # noqa: N802 - OpenCV's name

    def read(self) -> tuple[bool, Any]: ...

    def get(self, propId: int, /) -> float: ...  # noqa: N803 - OpenCV's name

    def set(self, propId: int, value: float, /) -> bool: ...  # noqa: N803 - OpenCV's name

    def release(self) -> None: ...

    def getBackendName(self) -> str: ...  # noqa: N802 - OpenCV's name


OpenCapture = Callable[[OpencvOptions], Capture]
