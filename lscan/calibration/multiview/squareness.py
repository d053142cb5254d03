"""Whether a camera's pixels are square, as the camera's model takes them to be.

Pixels that are not, as of a picture squeezed to another format, make a camera of square pixels
that fits badly and is wrong in silence: with pixels a third too wide the focal length was
two and a half times too long.  What the marks themselves say of the pixels is seen by fitting a
pinhole with distortion to them, once with square pixels and once with any.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from lscan.camera.resection import CameraFit
from lscan.records import Floats

POOR = 1.2  # times the marks' own uncertainty, from which a misfit is looked into
BETTER = 1.1  # times less must be left with pixels of another shape
NEARLY_SQUARE = 0.005  # of a side: what a bent board may look like; costs 2 sigmas of focal length


@dataclass(frozen=True)
class PinholeFit:
    """A pinhole with distortion in the place of the camera.

    Attributes
    ----------
    rms_px : float, px, what it leaves of the marks
    height : float, of a pixel, over its width
    """

    rms_px: float
    height: float


def oblong_pixels(fit: CameraFit, image_size: tuple[int, int], own_px: Floats) -> str:
    """Of what shape pixels are that the marks show not to be square, and what to do; else "".

    Parameters
    ----------
    fit : CameraFit, camera and poses, with square pixels
    image_size : tuple of int, (width, height) of the pictures, px
    own_px : (N,) array, px, standard uncertainty of each mark as it was read

    References
    ----------
    Z. Zhang, "A flexible new technique for camera calibration", IEEE PAMI 22 (2000).
    """
    left_px = float(np.sqrt(np.mean(fit.marks.missed_px(fit.boards)[fit.good] ** 2)))
    if left_px < POOR * float(np.median(own_px)):
        return ""
    square = _pinhole(fit, image_size, cv2.CALIB_FIX_ASPECT_RATIO)
    shaped = _pinhole(fit, image_size, 0)
    if square.rms_px < BETTER * shaped.rms_px or abs(shaped.height - 1) < NEARLY_SQUARE:
        return ""
    width, height = image_size
    return (
        f"the camera's pixels are not square: {shaped.height:.4f} times as high as wide, the marks "
        f"fit to {shaped.rms_px:.2f} px rms, as squares to {square.rms_px:.2f} px; use a format of "
        f"the camera that does not squeeze its pictures, or scale them all to {width} x "
        f"{round(height * shaped.height)} px"
    )


def _pinhole(fit: CameraFit, image_size: tuple[int, int], flags: int) -> PinholeFit:
    marks, boards = fit.marks, np.unique(fit.marks.board)
    each = [fit.good & (marks.board == board) for board in boards]
    on_board = np.column_stack([marks.board_mm, np.zeros(len(marks.board_mm))]).astype(np.float32)
    try:
        rms, camera, *_ = cv2.calibrateCamera(
            [on_board[used] for used in each],
            [marks.image_px[used].astype(np.float32) for used in each],
            image_size,
            np.eye(3),
            np.zeros(5),
            flags=flags | cv2.CALIB_FIX_K3,
        )
    except cv2.error:  # poses that give it no start
        return PinholeFit(np.inf, 1.0)
    return PinholeFit(float(rms), float(camera[0, 0] / camera[1, 1]))
