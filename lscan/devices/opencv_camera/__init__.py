"""A webcam, a network stream or a video file, read through OpenCV.

    [camera]
    driver = "opencv"
    width_px = 1280
    height_px = 720
    exposure_ms = 20.0
    options = { device = 0, pixel_format = "MJPG", gain = 0, focus = 30, white_balance = 4600 }

In place of ``device``, a number or a path such as "/dev/video0": ``url`` of a stream, or
``file``, a video.  All options: :class:`OpencvOptions`.
"""

from lscan.devices.opencv_camera.camera import OpencvCamera, camera_driver
from lscan.devices.opencv_camera.options import Capture, OpenCapture, OpencvOptions, Setting
from lscan.devices.opencv_camera.reader import open_capture

__all__ = [
    "Capture", "OpenCapture", "OpencvCamera", "OpencvOptions", "Setting", "camera_driver",
    "open_capture",
]  # fmt: skip
