"""Where the bundle adjustment begins: a pinhole in the water's stead."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np

from lscan.calibration.maps.refractivefit import priors
from lscan.calibration.multiview.bundle import NAMES, Bundle, Observations, Prior
from lscan.config.rig import Known, OpticsSection
from lscan.errors import InputError, MeasurementError

FOCAL, K1, WATER = NAMES.index("focal_px"), NAMES.index("k1"), NAMES.index("water_index")


def prior_of(optics: OpticsSection, k3: Known, image_size: tuple[int, int]) -> Prior:
    """What the file says of the camera, k3 in its place among the rest.

    Of focal length and centre nothing is assumed that the file does not say: several poses
    tell them.  Raises InputError where a value is out of its range.
    """
    known = priors(optics, image_size)
    after = NAMES.index("k3")
    mean = np.insert(known.mean[: len(NAMES) - 1], after, k3[0])
    sigma = np.insert(known.sigma[: len(NAMES) - 1], after, k3[1])
    for index, given in enumerate((optics.focal_px, optics.centre_u_px, optics.centre_v_px)):
        if given is None:
            sigma[index] = np.inf
    if optics.port == "none":
        mean[WATER] = 1.0
    if not np.isfinite(mean).all():
        raise InputError("is not finite", where="k3", value=k3)
    return Prior(mean, sigma)


def start_bundle(
    marks: Observations,
    count: int,
    prior: Prior,
    port: Literal["flat", "none"],
    size: tuple[int, int],
) -> Bundle:
    """A bundle of ``count`` views close enough to the marks for least squares to go on from.

    Behind a port, rays near the axis are those of a pinhole with water_index times the focal
    length; OpenCV's solver finds it and the poses.  size: (width, height) of the pictures.
    Raises MeasurementError where no pinhole explains the pictures.
    """
    mean, sigma = prior.mean, prior.sigma
    apparent = mean[FOCAL] * mean[WATER]
    matrix = np.array([[apparent, 0, mean[1]], [0, apparent, mean[2]], [0, 0, 1.0]])
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2
    flags |= cv2.CALIB_FIX_K3 | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_USE_INTRINSIC_GUESS
    if np.isfinite(sigma[FOCAL]):
        flags |= cv2.CALIB_FIX_FOCAL_LENGTH
    each = [marks.view == number for number in range(count)]
    try:
        _, matrix, bent, turns, places = cv2.calibrateCamera(
            [marks.board_mm[mask].astype(np.float32) for mask in each],
            [marks.image_px[mask].astype(np.float32) for mask in each],
            size,
            matrix,
            np.zeros(5),
            flags=flags,
        )
    except cv2.error as error:
        raise MeasurementError("no camera explains the views of the board") from error
    place = np.array(places, dtype=np.float64).reshape(count, 3)
    if not np.isfinite(matrix).all() or not np.isfinite(place).all() or (place[:, 2] <= 0).any():
        raise MeasurementError("no camera explains the views of the board")
    theta = mean.copy()
    if not np.isfinite(sigma[FOCAL]):
        theta[FOCAL] = matrix[0, 0] / mean[WATER]
    if port == "none" and sigma[K1] > 0:
        theta[K1] = float(np.ravel(bent)[0])
    rotation = np.array([cv2.Rodrigues(turn)[0] for turn in turns], dtype=np.float64)
    return Bundle(theta, port, rotation, place)
