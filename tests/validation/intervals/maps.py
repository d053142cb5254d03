"""Steps, tilts and widths measured by maps of rigs of one's own, and what their intervals hold.

Rigs are drawn within reason and calibrated from one board in closed form: two cameras, behind a
flat port or a dome, the board 20 to 65 degrees off its normal, 10 to 40 mm from dot to dot.  The
board lies, bends and is as large as [optics] lets it.  Then each map by hand, and ``auto``.
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lscan.benchmark.drawn import seen_marks
from lscan.calibration.calibrate import calibrate
from lscan.calibration.planemap import PlaneMap
from lscan.camera import project
from lscan.camera.posedboards import CAMERA, GREATEST, LEAST, camera_of, priors_of
from lscan.config.rig import OpticsSection
from lscan.records import BoardReading, Floats
from tests.validation.exposures import COVER
from tests.validation.intervals.water import EXACT_BOARD, NOISE_PX
from tests.validation.rows import Row, row

MAPS = ("auto", "refractive", "spline", "graticule-2", "graticule-bspline", "polynomial-4",
        "projective")  # fmt: skip
STATED: dict[str, Any] = {
    "k1": (-0.13, 0.07), "k2": (0.03, 0.02), "gap_mm": (11.0, 1.0), "thickness_mm": (6.0, 0.1),
    "glass_index": (1.489, 0.002), "water_index": (1.3327, 2e-4), "tilt_x_deg": (0.0, 0.5),
    "tilt_y_deg": (0.0, 0.5), **EXACT_BOARD,
}  # fmt: skip
LEFT_OUT = {"window's tilt": ("tilt_x_deg", "tilt_y_deg"), "gap": ("gap_mm",),
            "glass": ("thickness_mm", "glass_index"), "water's index": ("water_index",),
            "board": tuple(EXACT_BOARD)}  # fmt: skip
MADE = {"centre_u_px": 10.0, "centre_v_px": 10.0, "p1": 2e-4, "p2": 2e-4}  # better than is known
COLUMNS = 100  # of each of two stretches of a line, seen to PIXEL_PX each
PIXEL_PX = 0.05


def errors_of(
    maps: tuple[str, ...], left_out: tuple[str, ...], rng: np.random.Generator
) -> dict[str, Floats]:
    """(3,) of each map, of one rig: errors of a step, a tilt and a width over their sigmas.

    Parameters
    ----------
    maps : tuple of str, full names
    left_out : tuple of str, keys of [optics] that are not stated and as uncertain as it says then
    rng : Generator, of NumPy
    """
    wide, dome = rng.random(2) < 0.5
    size, focal_px = ((1920, 1080), 1700.0) if wide else ((640, 480), 850.0)
    known = {name: value for name, value in STATED.items() if name not in left_out}
    focal_px *= known.get("water_index", (1.333,))[0] if dome else 1.0
    optics = OpticsSection.model_validate(
        known | {"focal_px": (focal_px, 0.05 * focal_px), "port": "none" if dome else "flat"}
    )
    priors = priors_of(optics, size)
    least = [MADE.get(name, np.inf) for name in CAMERA]
    theta = rng.normal(priors.mean, np.minimum(priors.sigma, least))
    camera = camera_of(np.clip(theta, LEAST, GREATEST), optics.port)
    turn = Rotation.from_euler("zx", [rng.uniform(-30, 30), -rng.uniform(20, 65)], degrees=True)
    axes = np.asarray(turn.as_matrix()) @ [[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]
    pitch, (columns, rows) = rng.uniform(10, 40), ((13, 7), (10, 10))[rng.integers(2)]
    x, z = np.meshgrid(np.arange(columns) * pitch, -np.arange(rows) * pitch)
    half = np.array([np.ptp(x), np.ptp(z)]) / 2
    board = np.column_stack([x.ravel(), z.ravel()]) + half * [-1, 1]

    tilt, bend = rng.normal(0, np.radians(optics.board_tilt_deg), 2), rng.normal(0, 1, 3)
    across, up = (board / half).T
    behind = rng.normal(0, 1) * optics.board_offset_mm + board @ tilt
    behind += optics.board_bend_mm * np.stack([across**2, across * up, up**2], axis=1) @ bend
    lying = board * (1 + rng.normal(0, optics.board_scale_percent / 100))
    lying = np.insert(lying, 1, behind, axis=1) @ axes.T
    ahead = np.array([0.0, 0.0, 1.0])
    for distance in pitch * np.geomspace(3, 400, 400):  # the nearest at which all of it is seen
        image = project(camera, lying + distance * ahead)
        if ((image > 8) & (image < np.array(size) - 9)).all():
            break
    marks = seen_marks(board, image, size, NOISE_PX, rng)
    reading = BoardReading(size, pitch, (rows, columns), marks)
    line = np.linspace(0, 0.6 * half[0], COLUMNS) + half[0] * rng.uniform(-0.9, 0.3)
    low, height = half[1] * rng.uniform(-0.9, 0.4), pitch * rng.uniform(0.3, 1.2)
    places = np.vstack([np.column_stack([line, np.full(COLUMNS, low + up)]) for up in (0, height)])
    seen = project(camera, np.insert(places, 1, 0, axis=1) @ axes.T + distance * ahead)
    seen[:, 1] += PIXEL_PX * rng.standard_normal(len(seen))
    return {
        name: _ratios(calibrate(reading, name, optics).plane_map, seen, places) for name in maps
    }


def _ratios(plane_map: PlaneMap, seen_px: Floats, true_mm: Floats) -> Floats:
    points = plane_map.to_plane(seen_px, np.full(len(seen_px), PIXEL_PX))
    assert points.modes_mm is not None
    weights = np.zeros((3, *true_mm.shape))
    weights[0, :, 1] = np.repeat([-1 / COLUMNS, 1 / COLUMNS], COLUMNS)  # step
    lever = true_mm[:COLUMNS, 0] - true_mm[:COLUMNS, 0].mean()
    weights[1, :COLUMNS, 1] = lever / (lever @ lever)  # tilt
    weights[2, [0, COLUMNS - 1], 0] = -1, 1  # width
    own = np.maximum(points.sigma_mm**2 - (points.modes_mm**2).sum(axis=2), 0)
    common = np.einsum("qnc,ncm->qm", weights, points.modes_mm)
    variance = (common**2).sum(axis=1) + np.einsum("qnc,nc->q", weights**2, own)
    return np.einsum("qnc,nc->q", weights, points.xz_mm - true_mm) / np.sqrt(variance)


def map_rows(rigs: int = 40, seed: int = 3) -> list[Row]:
    """By how much fewer than 95 % of the intervals hold: each map, then what is not stated.

    Parameters
    ----------
    rigs : int, of each
    seed : int, of the draws
    """
    cases = {("what is stated", ()): MAPS} | {
        (f"no {what}", keys): ("refractive", "spline") for what, keys in LEFT_OUT.items()
    }
    rows = []
    for number, ((what, keys), maps) in enumerate(cases.items()):
        seeds = [np.random.default_rng([seed, number, rig]) for rig in range(rigs)]
        drawn = [errors_of(maps, keys, rng) for rng in seeds]
        for name in maps:
            ratios = np.abs([one[name] for one in drawn])
            percent = 100 * float(np.mean(ratios <= COVER))
            words: dict[str, Any] = {"name": name, "statement": what, "rigs": rigs}
            words |= {"count": ratios.size, "percent": percent, "worst": float(ratios.max())}
            rows.append(row("map-intervals", max(95.0 - percent, 0.0), seed=seed, **words))
    return rows
