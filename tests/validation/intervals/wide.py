"""Fisheyes, rendered in air and behind a dome: whether camera, sheet and lengths state what holds.

What is found is held to the truth's own projection, and what is left of the marks to what OpenCV's
fisheye calibration leaves of the same.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.stats import binomtest

from lscan.calibration.metric.solve import MetricCalibration
from lscan.records import Floats
from sim.scene import Scene, camera_pose, load_scene
from sim.truth import project, sheet_of
from tests.validation.instrument.metric import calibrated
from tests.validation.rows import Row, row

SEED, COVER, POSES = 60, 0.95, 12
MEDIA = {"in air": "fisheye-air", "behind a dome": "fisheye"}
SHARES = np.array([[0.3, 0.3], [0.7, 0.3], [0.3, 0.7], [0.7, 0.7], [0.5, 0.5]])  # of the picture
PAIRS = [(0, 1), (2, 3), (0, 2), (1, 3), (0, 3), (1, 2)]  # whose distances are measured


@dataclass(frozen=True)
class WideRig:
    """What one rig gave.

    Attributes
    ----------
    z : (K,) array, errors over their standard uncertainties: of focal length, centre, distance and
        angle of the sheet, and lengths on it, as far as the map holds
    rms_ratio : float, rms of the marks over that of OpenCV's calibration
    lens : str, the model that was chosen
    found, views : int, boards found, and held
    """

    z: Floats
    rms_ratio: float
    lens: str
    found: int
    views: int


def wide_rows(scenes: Path, rigs: int) -> list[Row]:
    """Coverage, rms against OpenCV's, and the model chosen, over random rigs.

    Parameters
    ----------
    scenes : Path, of the scene files
    rigs : int, of each angle of view in each medium
    """
    return list(_rows(scenes, rigs))


def _rows(scenes: Path, rigs: int) -> Iterator[Row]:
    ratios, lenses, found, views = list[float](), list[str](), 0, 0
    for where, name in MEDIA.items():
        each = [
            wide_rig(load_scene(scenes / "metric" / f"{name}.toml"), degrees, number)
            for degrees in (120.0, 150.0)
            for number in range(rigs)
        ]
        share = float(np.mean([np.mean(np.abs(rig.z) <= 1.96) for rig in each]))
        low, high = binomtest(round(share * len(each)), len(each)).proportion_ci(method="wilson")
        yield row(
            "wide-intervals",
            100 * abs(share - COVER),
            seed=SEED,
            # A rig's numbers hold its one camera: rigs count, not numbers.
            sigma=100 * np.sqrt(COVER * (1 - COVER) / len(each)),
            where=where,
            percent=100 * share,
            low=100 * low,
            high=100 * high,
            rigs=len(each),
        )
        ratios += [rig.rms_ratio for rig in each]
        lenses += [rig.lens for rig in each]
        found, views = found + sum(r.found for r in each), views + sum(r.views for r in each)
    yield row("wide-rms", max(ratios), seed=SEED, rigs=len(ratios), least=min(ratios))
    wrong = sum(lens != "fisheye" for lens in lenses)
    yield row("wide-lens", wrong, seed=SEED, rigs=len(lenses))
    yield row("wide-boards", 100 * (1 - found / views), seed=SEED, found=found, views=views)


def wide_rig(scene: Scene, degrees: float, number: int) -> WideRig:
    """One fisheye drawn, its board held all over the picture, and what came of it.

    Parameters
    ----------
    scene : Scene, with a fisheye
    degrees : float, its angle of view from corner to corner
    number : int, of the draw
    """
    rng = np.random.default_rng([SEED, number, round(degrees)])
    width, height = scene.rig.camera.size_px
    k1, k2, k3, k4 = rng.uniform(-1, 1, 4) * [0.04, 0.008, 0.002, 0.0004]
    half = np.radians(degrees / 2)
    bent = half * (1 + half**2 * (k1 + half**2 * (k2 + half**2 * (k3 + half**2 * k4))))
    centre = (np.array([width, height]) - 1) / 2 + rng.normal(0, 5, 2)
    focal_px = float(np.hypot(width, height) / 2 / bent)
    scene = scene.with_tank(
        lens={
            "focal_px": focal_px, "centre_px": tuple(centre.tolist()),
            "k1": k1, "k2": k2, "k3": k3, "k4": k4,
        }
    )  # fmt: skip
    found = calibrated(scene, POSES, number)
    truth = np.array([focal_px, *centre])
    camera = (found.theta[:3] - truth) / found.sigma[:3]
    used = sum(view.used for view in found.views)
    z = np.concatenate([camera, _sheet_z(scene, found), _lengths_z(scene, found)])
    return WideRig(
        z[np.isfinite(z)],
        found.rms_px / opencv_rms_px(found),
        found.lens,
        used,
        len(found.views),
    )


def _sheet_z(scene: Scene, found: MetricCalibration) -> Floats:
    """(2,) of the sheet's distance from the pinhole and its angle to the camera's axis."""
    sheet, camera = sheet_of(scene).pose, camera_pose(scene.tank.head)
    normal = camera.rotation.T @ sheet.rotation[:, 1]
    distance_mm = abs(float(normal @ camera.invert(sheet.origin_mm)))
    truth = {"sheet_distance_mm": distance_mm, "sheet_angle_deg": _degrees(abs(normal[2]))}
    known = found.plane_map.quantities()
    return np.array([(known[name][0] - true) / known[name][1] for name, true in truth.items()])


def _degrees(cosine: float) -> float:
    return float(np.degrees(np.arccos(cosine)))


def _lengths_z(scene: Scene, found: MetricCalibration) -> Floats:
    """(K,) of distances between places of the sheet, as the map has them."""
    size = np.array(scene.rig.camera.size_px)
    places = _on_sheet(scene, SHARES * (size - 1))
    seen = project(scene, places)
    located = found.plane_map.to_plane(seen).xz_mm
    modes = found.plane_map.error_modes(seen)  # (N, 2, M)
    z = []
    for one, two in PAIRS:
        across = located[one] - located[two]
        length = float(np.hypot(*across))
        sigma = float(np.linalg.norm(across / length @ (modes[one] - modes[two])))
        true = float(np.linalg.norm(places[one] - places[two]))
        z.append((length - true) / sigma)
    return np.array(z)


def _on_sheet(scene: Scene, pixels: Floats) -> Floats:
    """(N, 3) mm, head frame, places of the sheet seen within some px of pixels."""
    sheet = sheet_of(scene).pose
    u, v = np.meshgrid(np.linspace(-600, 600, 241), np.linspace(-600, 600, 241))
    plane = np.column_stack([u.ravel(), np.zeros(u.size), v.ravel()])
    there = sheet.origin_mm + plane @ sheet.rotation.T
    seen = project(scene, there)
    off = np.linalg.norm(seen[:, None] - pixels, axis=2)
    return np.asarray(there[np.nanargmin(off, axis=0)])


def opencv_rms_px(found: MetricCalibration) -> float:
    """What OpenCV's fisheye calibration leaves of the marks that ours rests on, px rms.

    Parameters
    ----------
    found : MetricCalibration
    """
    used = [view.marks for view in found.views if view.used and view.marks is not None]
    boards = [np.column_stack([m.board_mm, np.zeros(len(m.board_mm))])[m.found] for m in used]
    pictures = [marks.image_px[marks.found] for marks in used]
    rms, *_ = cv2.fisheye.calibrate(
        [board[None] for board in boards],
        [picture[None] for picture in pictures],
        found.image_size,
        np.eye(3),
        np.zeros(4),
        flags=cv2.CALIB_RECOMPUTE_EXTRINSIC | cv2.CALIB_FIX_SKEW,
    )
    return float(rms)
