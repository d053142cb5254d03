"""How a capture is opened for a device, a stream or a video file."""

import logging
import os

import cv2

from lscan.devices.opencv_camera.jpegstream import JpegStream
from lscan.devices.opencv_camera.options import Capture, OpencvOptions
from lscan.devices.opencv_camera.settings import fourcc_text
from lscan.errors import DeviceError

_log = logging.getLogger(__name__)


def open_capture(options: OpencvOptions) -> Capture:
    """The OpenCV capture that ``options`` names, opened or not.

    Raises DeviceError for a stream whose pictures are late by an unknown time.
    """
    _silence_libraries()
    if options.device is not None:
        if isinstance(options.device, int):
            return cv2.VideoCapture(options.device)
        linux = options.device.startswith("/dev/")
        return cv2.VideoCapture(options.device, cv2.CAP_V4L2 if linux else cv2.CAP_ANY)
    if options.url is not None:
        return _open_stream(options.url, options)
    return cv2.VideoCapture(options.file or "", cv2.CAP_FFMPEG)


def _silence_libraries() -> None:
    """Keep OpenCV and its FFmpeg from writing to the terminal what is reported here in one line.

    Whoever sets OPENCV_LOG_LEVEL or OPENCV_FFMPEG_LOGLEVEL gets what they ask for.
    """
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # AV_LOG_QUIET; read by its first capture
    if "OPENCV_LOG_LEVEL" not in os.environ:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


def _open_stream(url: str, options: OpencvOptions) -> Capture:
    """The stream, as its own JPEG pictures where it is made of them and can be had so.

    It is given the timeout too, so that a reader that was given up ends by itself.  It is
    decoded by one thread: with n of them FFmpeg hands pictures out n - 1 pictures late.
    """
    limit_ms = max(1, round(1000 * options.timeout_s))
    parameters = {
        cv2.CAP_PROP_OPEN_TIMEOUT_MSEC: limit_ms,
        cv2.CAP_PROP_READ_TIMEOUT_MSEC: limit_ms,
        cv2.CAP_PROP_N_THREADS: 1,
    }
    pairs = [number for pair in parameters.items() for number in pair]
    capture = cv2.VideoCapture(url, cv2.CAP_FFMPEG, pairs)
    if not capture.isOpened():
        return capture
    code = (fourcc_text(capture.get(cv2.CAP_PROP_FOURCC)) or "unknown").upper()
    if code == "MJPG" and capture.set(cv2.CAP_PROP_FORMAT, -1):
        return JpegStream(capture, options.name)
    if not options.waits_for_change:
        capture.release()
        raise DeviceError(
            f"{options.name}: coded as {code}, whose pictures come late by what the camera's "
            "encoder and B-frames hold back, which cannot be seen from here: state "
            "camera.options.flush_ms, not below the time from a change in view to its picture "
            "(mostly 200 to 3000; `lscan devices RIG --test` measures it), or choose MJPEG where "
            "the camera has it"
        )
    _log.warning(
        "%s: coded as %s: a change of the picture size while it runs, or a picture sent again and "
        "again, would go unseen; choose MJPEG where the camera has it",
        options.name,
        code,
    )
    return capture
