"""The laser's plane from the line seen on boards whose poses are known.

Each line point is the place where its pixel's ray meets the board.  A plane cuts a board in a
straight line, so that what a view says of the sheet is two numbers: how far its line lies off
the sheet, and how it leans against it.  Errors of the board's pose and of the camera, which
all points of a view share, are counted with those two numbers, not with each point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lscan.calibration.multiview.bundle import Adjusted, Bundle, Prior
from lscan.calibration.multiview.equations import SheetEquations, undetermined
from lscan.calibration.multiview.lines import (
    FEWEST_POINTS,
    Sight,
    distance_mm,
    line_ends,
    on_board,
    straight,
)
from lscan.errors import MeasurementError
from lscan.records import Floats, Mask

WRONG = 6.0  # sigmas: beyond them a view's line is wrong
MEDIAN_CHI_SQUARE = 2 * np.log(2)  # of two degrees of freedom
LEAST_ANGLE_DEG = 10.0  # between board and sheet; the line's place on the board is unsure below
MOST_TILT_DEG = 1.0  # standard uncertainty of the sheet's tilt beyond which it is not known


@dataclass(frozen=True)
class Sheet:
    """The laser's plane q . X = 1 in the camera frame.

    q_per_mm: (3,) its normal over its distance from the pinhole.
    root: (14 + 3, P), root @ root.T is the covariance of the camera's theta and of q together.
    good: by view, the mask of the line points it rests on.  faults: by view, why a line was
        set aside.  distances_mm: by view, of its line points from the plane.
    """

    q_per_mm: Floats
    root: Floats
    good: dict[int, Mask]
    faults: dict[int, str]
    distances_mm: dict[int, Floats]


def find_sheet(adjusted: Adjusted, prior: Prior, sights: list[Sight]) -> Sheet:
    """The plane of generalised least squares through the lines of all views but wrong ones.

    A view is wrong where its two numbers lie more than WRONG standard uncertainties (or of
    their usual size, where all are larger) from the plane of the others.  The covariance is
    scaled up by chi squared per degree of freedom of those two numbers where above 1.

    Raises MeasurementError where fewer than two lines are left or where they do not tell the
    plane: all in one line, or on boards nearly parallel to the sheet.
    """
    bundle = adjusted.bundle
    masks = {sight.view: straight(bundle, sight) for sight in sights}
    faults = {
        sight.view: f"only {int(masks[sight.view].sum())} points of the line lie in one line"
        for sight in sights
        if masks[sight.view].sum() < FEWEST_POINTS
    }
    usable = [sight.only(masks[sight.view]) for sight in sights if sight.view not in faults]
    _require_two(usable, faults)
    q = _agreed_plane(bundle, usable)
    for sight in usable:
        angle = _angle_deg(bundle, sight.view, q)
        if angle < LEAST_ANGLE_DEG:
            faults[sight.view] = f"the board lies {angle:.1f} deg from the sheet: too near it"
    usable = [sight for sight in usable if sight.view not in faults]
    while True:
        _require_two(usable, faults)
        fitted = SheetEquations(adjusted, prior, usable)
        q, takes = fitted.solve(q)
        whole, chi = fitted.chi_squares(q, takes)
        usual = max(1.0, float(np.median(chi)) / MEDIAN_CHI_SQUARE)
        worst = int(chi.argmax())
        if len(usable) < 3 or chi[worst] <= WRONG**2 * usual:
            break
        view = usable[worst].view
        off = distance_mm(on_board(bundle, usable[worst].image_px, view), q)
        faults[view] = f"its line lies {_rms(off):.3f} mm rms off the sheet of the other views"
        del usable[worst]
    own = fitted.own_root(q, takes) * np.sqrt(max(1.0, whole / (2 * len(usable) - 3)))
    _require_sure(q, own)
    root = fitted.joint_root(q, takes, own)
    far = {s.view: distance_mm(on_board(bundle, s.image_px, s.view), q) for s in sights}
    good = {s.view: masks[s.view] & (s.view not in faults) for s in sights}
    return Sheet(q, root, good, faults, far)


def _agreed_plane(bundle: Bundle, sights: list[Sight]) -> Floats:
    """(3,) q of the plane through two views' lines that the median view lies nearest to."""
    thirds = [on_board(bundle, s.image_px, s.view) for s in sights]
    ends = np.stack([line_ends(points) for points in thirds])  # (V, 2, 3)
    best, least = None, np.inf
    for i in range(len(ends)):
        for j in range(i + 1, len(ends)):
            four = np.vstack([ends[i], ends[j]])
            normal = np.linalg.svd(four - four.mean(axis=0))[2][2]
            height = float(four.mean(axis=0) @ normal)
            off = np.sqrt((((ends @ normal) - height) ** 2).mean(axis=1))
            score = float(np.median(np.sort(off)))
            if score < least and abs(height) > 1e-6:
                best, least = normal / height, score
    if best is None:
        raise MeasurementError("the laser lines lie in no plane before the camera")
    return best


def _angle_deg(bundle: Bundle, view: int, q: Floats) -> float:
    cosine = abs(bundle.rotation[view][:, 2] @ q) / np.linalg.norm(q)
    return float(np.degrees(np.arccos(min(cosine, 1.0))))


def _require_two(usable: list[Sight], faults: dict[int, str]) -> None:
    if len(usable) < 2:
        reasons = "; ".join(sorted(set(faults.values())))
        raise MeasurementError(
            f"the laser's plane needs its line on two boards, usable {len(usable)}"
            + (f" ({reasons})" if reasons else "")
        )


def _require_sure(q: Floats, root: Floats) -> None:
    """Refuse a plane whose normal is known to no better than MOST_TILT_DEG."""
    length = np.linalg.norm(q)
    unit = q / length
    turning = (np.eye(3) - np.outer(unit, unit)) @ root / length
    if not np.linalg.norm(turning, 2) <= np.radians(MOST_TILT_DEG):
        raise undetermined()


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))
