"""Where least squares begins: a pinhole in the water's stead.

Behind a port, rays near the axis are those of a pinhole with water_index times the focal length.
"""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from lscan.camera.boards import FACING, PosedBoards, towards
from lscan.camera.fit import WRONG, BoardMarks, fit_within_limits
from lscan.camera.parameters import COUNT, CameraPriors, PortKind
from lscan.camera.projection import rays
from lscan.records import Floats, select

START_WIDTHS = (1.2, 0.7, 2.0)  # focal lengths over the width to start from where none is known
START_PX = 10.0  # residuals above this count linearly while the start is sought
EVALUATIONS = 15
TOLERANCE = 1e-9  # relative change of the sum of squares


def best_start(
    marks: BoardMarks, priors: CameraPriors, port: PortKind, width: int
) -> PosedBoards | None:
    """Rough camera and poses; None where no board's marks are a picture of a plane.

    The best of several, one for each focal length that may be.  The first that explains the
    marks within their uncertainties is as good as any.

    Parameters
    ----------
    marks : BoardMarks, mm on the boards, px in the pictures
    priors : CameraPriors, what is known of the camera beforehand
    port : str, "flat", or "none" for a camera in air
    width : int, px, of the picture
    """
    focals = [priors.mean[0]] if priors.focal_given else [share * width for share in START_WIDTHS]
    robust = START_PX / float(np.median(marks.sigma_px))
    best, least = None, np.inf
    for focal in focals:
        posed = posed_boards(np.array([focal, *priors.mean[1:]]), port, marks)
        if posed is None:
            continue
        tried = fit_within_limits(posed, marks, priors, TOLERANCE, robust, EVALUATIONS)
        size = float(np.median(marks.lengths(tried)))
        if size < least:
            best, least = tried, size
        if least < WRONG:
            break
    return best


def posed_boards(theta: Floats, port: PortKind, marks: BoardMarks) -> PosedBoards | None:
    """The camera and the boards where a pinhole of its angle of view has them.

    Each board's homography gives its pose.  None where the marks of a board give none.

    Parameters
    ----------
    theta : (14 or more,) array, the camera in the order of parameters.CAMERA
    port : str, "flat", or "none" for a camera in air
    marks : BoardMarks, mm on the boards, px in the pictures

    References
    ----------
    Z. Zhang, "A flexible new technique for camera calibration", IEEE PAMI 22 (2000), Sec. 3.1.
    """
    alone = PosedBoards(theta[:COUNT], marks.board_mm.mean(axis=0), port)
    poses = []
    for number in range(int(marks.board.max()) + 1):
        pose = _pose(alone, select(marks, marks.board == number))
        if pose is None:
            return None
        poses.append(pose)
    return PosedBoards(np.concatenate([alone.theta, *poses]), alone.centre_mm, port)


def _pose(alone: PosedBoards, marks: BoardMarks) -> Floats | None:
    """(6,) the pose of one board before a camera alone."""
    centre_px, apparent = np.array(alone.camera.centre_px), alone.apparent_focal_px
    plane = marks.board_mm - alone.centre_mm
    homography, _ = cv2.findHomography(plane, (marks.image_px - centre_px) / apparent)
    if homography is None:
        return None
    homography = homography / np.linalg.norm(homography[:, :2], axis=0).mean()
    homography *= np.sign(homography[2, 2])
    x, z, shift = homography.T
    u, _, vt = np.linalg.svd(np.column_stack([x, np.cross(z, x), z]))
    axes = u @ vt
    seen = centre_px + apparent * shift[:2] / shift[2]
    sight = rays(alone.camera, seen[None]).direction
    if np.linalg.det(axes) < 0 or np.isnan(sight).any():
        return None
    turn = Rotation.from_matrix(towards(sight)[0].T @ axes @ FACING.T).as_rotvec()
    return np.array([*turn, *seen, np.linalg.norm(shift) / apparent])
