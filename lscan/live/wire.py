"""What goes over the wire for one picture: its figures as JSON, and the picture as JPEG.

4 bytes   length of the JSON, big-endian
JSON      UTF-8; numbers that are not known are null
JPEG      the picture as the camera sees it
"""

import json
import struct
from typing import Any

import cv2
import numpy as np

from lscan.calibration.offsheet import OffSheet
from lscan.files.pictures import encoded
from lscan.live.analysis import Figures, StripeFigures
from lscan.live.boardview import BoardFigures
from lscan.live.maptable import LiveProfile
from lscan.records import Bytes, Floats, Status, has_value, status_counts

JPEG_QUALITY = 80


def packed(document: dict[str, Any], jpeg: bytes) -> bytes:
    """The answer to a browser that asked for a picture."""
    text = json.dumps(document, allow_nan=False, separators=(",", ":")).encode()
    return struct.pack(">I", len(text)) + text + jpeg


def jpeg_of(image: Bytes) -> bytes:
    """The picture, (H, W) grey or (H, W, 3) RGB, as JPEG."""
    return encoded(image, ".jpg", [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY], where="the live page")


def figures_json(figures: Figures) -> dict[str, Any]:
    """Saturation, focus, stripe and profile."""
    return {
        "saturated_percent": round(figures.saturated_percent, 3),
        "focus": round(figures.focus, 2),
        "stripe": figures.line and _stripe_json(figures.line),
        "profile": figures.profile and _profile_json(figures.profile),
    }


def _stripe_json(line: StripeFigures) -> dict[str, Any]:
    status = line.stripe.status
    return {
        "axis": line.stripe.axis,
        "centre_px": _rounded(line.stripe.centre_px, 2),
        "found": int(has_value(status).sum()),
        "of": len(status),
        "clipped": int((status == Status.SATURATED).sum()),
        "clipped_at": np.flatnonzero(status == Status.SATURATED).tolist(),
        "width_px": _rounded(line.width_px, 2),
        "snr": _rounded(line.snr, 1),
        "slope": _rounded(line.slope, 5),
        "status": status_counts(status),
    }


def _profile_json(profile: LiveProfile) -> dict[str, Any]:
    sigma = profile.sigma_mm[np.isfinite(profile.sigma_mm)]
    return {
        "x_mm": _rounded(profile.xz_mm[:, 0], 3),
        "z_mm": _rounded(profile.xz_mm[:, 1], 3),
        "sigma_mm": round(float(np.median(sigma)), 4) if len(sigma) else None,
    }


def board_json(board: BoardFigures, age_s: float) -> dict[str, Any]:
    """The board's reading, ``age_s`` after its picture was taken."""
    rms_mm, _ = board.residual_mm or (None, None)
    rms_px, max_px = board.residual_px or (None, None)
    return {
        "found": board.found,
        "expected": board.expected,
        "message": board.message,
        "marks_px": _rounded(board.marks_px, 2),
        "residual_rms_px": _rounded(rms_px, 4),
        "residual_max_px": _rounded(max_px, 4),
        "residual_rms_mm": _rounded(rms_mm, 4),
        "offset": board.offset and _offset_json(board.offset),
        "offset_message": board.offset_message,
        "age_s": round(age_s, 2),
    }


def _offset_json(offset: OffSheet) -> dict[str, Any]:
    return {
        "distance_mm": _rounded(offset.distance_mm, 3),
        "sigma_mm": _rounded(offset.distance_sigma_mm, 3),
        "tilt_x_deg": _rounded(np.degrees(offset.tilt_x_rad), 4),
        "tilt_x_sigma_deg": _rounded(np.degrees(offset.tilt_x_sigma_rad), 4),
        "tilt_z_deg": _rounded(np.degrees(offset.tilt_z_rad), 4),
        "tilt_z_sigma_deg": _rounded(np.degrees(offset.tilt_z_sigma_rad), 4),
        "corners_mm": _rounded(offset.corners_mm, 3),
    }


def _rounded(values: Floats | float | None, decimals: int) -> Any:
    """A number or an array of any shape in JSON types, None for what is not known."""
    if values is None:
        return None
    numbers = np.round(values, decimals)
    return np.where(np.isnan(numbers), np.array(None), numbers).tolist()
