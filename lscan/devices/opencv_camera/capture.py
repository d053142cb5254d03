"""The few calls of ``cv2.VideoCapture`` that are used, and how it is opened."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import cv2

from lscan.devices.opencv_camera.options import OpencvOptions


class Capture(Protocol):
    """What the driver needs of a ``cv2.VideoCapture``; tests put a faulty one in its place."""

    def isOpened(self) -> bool: ...  # noqa: N802 - OpenCV's name

    def read(self) -> tuple[bool, Any]: ...

    def get(self, propId: int, /) -> float: ...  # noqa: N803 - OpenCV's name

    def set(self, propId: int, value: float, /) -> bool: ...  # noqa: N803 - OpenCV's name

    def release(self) -> None: ...

    def getBackendName(self) -> str: ...  # noqa: N802 - OpenCV's name


OpenCapture = Callable[[OpencvOptions], Capture]


def open_capture(options: OpencvOptions) -> Capture:
    """The OpenCV capture that ``options`` names, opened or not; never raises by itself.

    Streams are given the timeout too, so that a reader that was given up ends by itself.
    """
    if options.device is not None:
        if isinstance(options.device, int):
            return cv2.VideoCapture(options.device)
        linux = options.device.startswith("/dev/")
        return cv2.VideoCapture(options.device, cv2.CAP_V4L2 if linux else cv2.CAP_ANY)
    if options.url is not None:
        limit_ms = max(1, round(1000 * options.timeout_s))
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, limit_ms, cv2.CAP_PROP_READ_TIMEOUT_MSEC]
        return cv2.VideoCapture(options.url, cv2.CAP_FFMPEG, [*limits, limit_ms])
    return cv2.VideoCapture(options.file or "", cv2.CAP_FFMPEG)
