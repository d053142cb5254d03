"""Lengths after a calibration was carried to the water of a scan, and what they hold.

Rigs are drawn from what is known of one and calibrated from marks in closed form (lscan.camera,
which tests/sim/truth/camera holds against the tank's truth); then the same rig sees places of its
sheet through other water.  What is counted is how often a length lies in its 95 % interval.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from lscan.benchmark.drawn import seen_marks
from lscan.calibration.calibrate import calibrate
from lscan.calibration.check import in_water_of
from lscan.calibration.metric.solve import calibrate_metric
from lscan.calibration.metric.views import CalibrationView, LinePoints
from lscan.calibration.physical import BoardKnown, PhysicalMap
from lscan.camera import CameraModel, PortModel, project
from lscan.config.rig import Known, OpticsSection
from lscan.records import BoardReading, Floats, Status
from tests.validation.exposures import COVER, band_miss_percent
from tests.validation.rows import Row, row

SIZE = (640, 480)
NOISE_PX = 0.03
FOCAL_PX, GAP_MM, GLASS_MM, GLASS = (850.0, 40.0), (11.0, 3.0), (6.0, 0.3), (1.489, 0.002)
TILT_DEG = 2.0  # what [optics] says where it is not stated
UNKNOWN: Known = (1.333, 0.003)  # likewise of the water
SIGMA = 2e-4  # of an index that was measured, by two degrees or a psu
EXACT_BOARD: dict[str, Any] = dict.fromkeys(BoardKnown.__annotations__, 0.0)  # as they are drawn
WATERS = (1.3313, 1.3327, 1.3360, 1.3390)  # fresh of 20 and 5 C, brackish, sea
VIEWS = 9
Statement = Literal["measured", "vague", "none"]
Route = Literal["refractive", "metric"]
ROUTES: tuple[Route, ...] = ("refractive", "metric")
STATEMENTS: tuple[Statement, ...] = ("measured", "vague", "none")


@dataclass(frozen=True)
class WaterRig:
    """A camera behind its window, and the sheet before it, the plane q . X = 1.

    Attributes
    ----------
    camera : CameraModel, in the water of the calibration
    axes : (3, 3) array, of the sheet: x, y (away from the camera) and z (up), camera frame
    place_mm : (3,) array, mm, camera frame, the origin of the sheet's places
    """

    camera: CameraModel
    axes: Floats
    place_mm: Floats

    def seen_px(self, xz_mm: Floats, index: float) -> Floats:
        """(N, 2) px at which places of the sheet are seen through water of that index."""
        assert self.camera.port is not None
        camera = replace(self.camera, port=replace(self.camera.port, water_index=index))
        return project(camera, self.place_mm + xz_mm @ self.axes[:, [0, 2]].T)


def drawn_water_rig(index: float, rng: np.random.Generator) -> WaterRig:
    """A rig as far off what is known of it as that is uncertain, a metre before its sheet.

    Parameters
    ----------
    index : float, of the water of the calibration
    rng : Generator, of NumPy
    """
    gap, glass, n_glass = (rng.normal(*known) for known in (GAP_MM, GLASS_MM, GLASS))
    port = PortModel(max(gap, 1.0), glass, n_glass, index, *rng.normal(0.0, TILT_DEG, 2))
    centre = (319.5 + rng.normal(0, 5), 239.5 + rng.normal(0, 5))
    camera = CameraModel(rng.normal(*FOCAL_PX), centre, -0.26, 0.06, port=port)
    lean = Rotation.from_euler("xyz", [-30 + rng.normal(0, 5), rng.normal(0, 5), 0], degrees=True)
    axes = np.asarray(lean.as_matrix()) @ [[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]
    return WaterRig(camera, axes, np.array([0.0, 0.0, 1000.0]))


def stated_optics(water: Known | None) -> OpticsSection:
    """What is known of every rig, and the water that is stated.

    Parameters
    ----------
    water : tuple of float or None, index and its standard uncertainty
    """
    return OpticsSection(
        focal_px=FOCAL_PX, gap_mm=GAP_MM, thickness_mm=GLASS_MM, glass_index=GLASS,
        water_index=water, **EXACT_BOARD,
    )  # fmt: skip


def solved_map(
    route: Route, rig: WaterRig, index: float, optics: OpticsSection, rng: np.random.Generator
) -> tuple[PhysicalMap, Floats]:
    """The map of a rig by a route, and (N, 2) places of the sheet, mm, that it covers.

    Parameters
    ----------
    route : str, "refractive" or "metric"
    rig : WaterRig, in the water of the calibration
    index : float, of that water
    optics : OpticsSection, what is known of the rig
    rng : Generator, of NumPy, of the marks' noise
    """
    x, z = np.meshgrid(np.arange(-120.0, 121, 40), np.arange(-120.0, 121, 40))
    places = np.column_stack([x.ravel(), z.ravel()])
    if route == "refractive":
        marks = seen_marks(places * 1.25, rig.seen_px(places * 1.25, index), SIZE, NOISE_PX, rng)
        reading = BoardReading(SIZE, 50.0, x.shape, marks, (), {}, {})
        solved = calibrate(reading, "refractive", optics).plane_map
    else:
        solved = calibrate_metric(_views(rig, rng), optics, SIZE).plane_map
    assert isinstance(solved, PhysicalMap)
    return solved, places


def _views(rig: WaterRig, rng: np.random.Generator) -> list[CalibrationView]:
    """Views of a hand board of 8 by 6 dots, all over the sheet and tilted to all sides."""
    x, z = np.meshgrid(np.arange(-87.5, 88, 25), np.arange(62.5, -63, -25))
    board, found = np.column_stack([x.ravel(), z.ravel()]), []
    for number in range(VIEWS):
        side, tilt = 2 * np.pi * (number + rng.uniform(-0.3, 0.3)) / VIEWS, rng.uniform(25, 40)
        turn = Rotation.from_rotvec(np.radians(tilt) * np.array([np.cos(side), np.sin(side), 0]))
        across, up = turn.as_matrix().T[:2] * [[1.0], [-1.0]]
        at = rig.place_mm + rig.axes[:, [0, 2]] @ rng.uniform(-110, 110, 2)
        image = project(rig.camera, at + board @ np.stack([across, up]))
        along = np.cross(np.cross(across, up), rig.axes[:, 1])
        reach = np.linspace(-60.0, 60.0, 80)[:, None] * along / np.linalg.norm(along)
        line = project(rig.camera, at + reach) + NOISE_PX * rng.standard_normal((80, 2))
        level = np.ptp(line[:, 0]) >= np.ptp(line[:, 1])
        found.append(
            CalibrationView(
                f"pose-{number}",
                seen_marks(board, image, SIZE, NOISE_PX, rng),
                LinePoints(line, np.full(80, NOISE_PX), "columns" if level else "rows"),
            )
        )
    return found


def length_ratios(
    plane_map: PhysicalMap, image_px: Floats, true_mm: Floats, rng: np.random.Generator
) -> Floats:
    """(K,) errors of lengths between places taken in pairs, over their standard uncertainties.

    Parameters
    ----------
    plane_map : PhysicalMap, by which they are measured
    image_px : (N, 2) array, px, where the places are seen
    true_mm : (N, 2) array, mm, where they are
    rng : Generator, of NumPy, which pairs them
    """
    points = plane_map.to_plane(image_px)
    assert points.modes_mm is not None
    valued = rng.permutation(np.flatnonzero(points.status == Status.OK))
    one, other = valued[: len(valued) // 2], valued[len(valued) // 2 :][: len(valued) // 2]
    apart, true = points.xz_mm[one] - points.xz_mm[other], true_mm[one] - true_mm[other]
    length = np.hypot(*apart.T)
    along = apart / length[:, None]
    modes = np.einsum("nc,ncm->nm", along, points.modes_mm[one] - points.modes_mm[other])
    own = np.maximum(points.sigma_mm**2 - (points.modes_mm**2).sum(axis=2), 0.0)
    variance = (modes**2).sum(axis=1) + (along**2 * (own[one] + own[other])).sum(axis=1)
    return (length - np.hypot(*true.T)) / np.sqrt(variance)


def carried_ratios(route: Route, statement: Statement, rigs: int, seed: int) -> Floats:
    """(rigs, 4) lengths' errors over their uncertainties, one of each rig in each of WATERS.

    One length each, as the errors of a rig are nearly one.

    Parameters
    ----------
    route : str, "refractive" or "metric"
    statement : str, of the calibration on its water: "measured", to SIGMA; "vague", that it is
        water; or "none"
    rigs, seed : int
    """
    found = np.full((rigs, len(WATERS)), np.nan)
    for number in range(rigs):
        rng = np.random.default_rng([seed, number])
        index = rng.normal(*UNKNOWN)
        said = {"measured": (rng.normal(index, SIGMA), SIGMA), "vague": UNKNOWN, "none": None}
        rig = drawn_water_rig(index, rng)
        solved, places = solved_map(route, rig, index, stated_optics(said[statement]), rng)
        for at, water in enumerate(WATERS):
            there = in_water_of(solved, stated_optics((rng.normal(water, SIGMA), SIGMA)))
            assert isinstance(there, PhysicalMap)
            ratios = length_ratios(there, rig.seen_px(places, water), places, rng)
            found[number, at] = ratios[0]
    return found


def water_interval_rows(rigs: int = 20, seed: int = 1) -> list[Row]:
    """How far from 95 % the shares are, and the largest error in sigmas.

    Parameters
    ----------
    rigs : int, of each route and statement
    seed : int, of the draws
    """
    rows = []
    for route in ROUTES:
        for statement in STATEMENTS:
            ratios = np.abs(carried_ratios(route, statement, rigs, seed))
            share = float(np.mean(ratios <= COVER))
            words: dict[str, Any] = {
                "name": route, "statement": statement, "rigs": rigs, "seed": seed,
                "chance": 100 * np.sqrt(0.95 * 0.05 / rigs), "percent": 100 * share,
            }  # fmt: skip
            rows.append(row("carried-lengths", band_miss_percent(share), **words))
            rows.append(row("carried-worst", float(ratios.max()), **words))
    return rows
