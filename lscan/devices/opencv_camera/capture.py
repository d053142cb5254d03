"""The few calls of ``cv2.VideoCapture`` that are used."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

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
