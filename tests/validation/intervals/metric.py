"""The metric route: how often the 95 % intervals of camera and sheet hold, whatever is shared.

Boards that are bent, one or each picture's own, lines that are scatter in one view or more,
fisheyes, thick slabs: what is not refused is to hold.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import binomtest

from lscan.calibration.metric.solve import calibrate_metric
from lscan.calibration.metric.views import CalibrationView, LinePoints
from lscan.camera import CameraModel, PortModel
from lscan.camera.posedboards import CAMERA
from lscan.config.rig import OpticsSection
from lscan.errors import MeasurementError
from lscan.records import Floats, Status
from tests.support.metricviews import (
    COLUMNS,
    PITCH_MM,
    ROWS,
    SIZE,
    Pose,
    Rig,
    bends_of,
    known,
    line_of,
    marks_of,
    paper_rig,
    poses,
    views_of,
    with_noise,
)
from tests.validation.rows import Row, row

SEED, NOISE_PX = 58, 0.03
COVER = 0.95
SETS, FEW_SETS = 50, 4
FEWEST, MOST = 3, 10  # views of a set
PLACES_PX = np.array([[250.0, 200.0], [390.0, 280.0]])
INDEX_SIGMA = 0.003  # of the water, where it is found
SCATTER_PX, FISHEYE_PX = 80.0, 290.0
SLAB_MM, SLAB_DEG = 260.0, 10.0


@dataclass(frozen=True)
class ViewSet:
    """A set of views, what is known of their camera, and the truth by the parameter's name.

    Attributes
    ----------
    views : list of CalibrationView
    optics : OpticsSection, what is known
    truth : mapping of float, of the camera's parameters that are judged
    rig : Rig or None, whose places in the sheet are judged as well
    """

    views: list[CalibrationView]
    optics: OpticsSection
    truth: Mapping[str, float]
    rig: Rig | None = None


def metric_rows(quick: bool) -> list[Row]:
    """Coverage of focal length, index and places, and the sets refused, for each kind of set.

    Parameters
    ----------
    quick : bool, four sets of a kind in place of 50
    """
    return list(_rows(FEW_SETS if quick else SETS))


def _rows(count: int) -> Iterator[Row]:
    for what, drawn in KINDS.items():
        held, refused = [], 0
        for number in range(count):
            rng = np.random.default_rng([SEED, number])
            views = drawn(rng, int(rng.integers(FEWEST, MOST + 1)))
            try:
                held += _held(views)
            except MeasurementError:
                refused += 1
        share = float(np.mean(held)) if held else COVER
        low, high = binomtest(sum(held), max(len(held), 1)).proportion_ci(method="wilson")
        yield row(
            "metric-intervals",
            100 * abs(share - COVER),
            seed=SEED,
            what=what,
            percent=100 * share,
            low=100 * low,
            high=100 * high,
            count=len(held),
            refused=refused,
            sets=count,
        )


def _held(drawn: ViewSet) -> list[bool]:
    """Whether each 95 % interval of a set's solution holds."""
    found = calibrate_metric(drawn.views, drawn.optics, SIZE)
    at = [CAMERA.index(name) for name in drawn.truth]
    off = (found.theta[at] - list(drawn.truth.values())) / found.sigma[at]
    if drawn.rig is not None:
        plane = found.plane_map
        truth = replace(drawn.rig.truth, origin_px=plane.origin_px).locate(PLACES_PX)
        places = plane.to_plane(PLACES_PX)
        seen = places.status == Status.OK
        off = np.append(off, ((places.xz_mm - truth) / places.sigma_mm)[seen])
    return [bool(abs(z) <= 1.96) for z in off]


def _boards(common: bool | None, water: bool) -> Callable[[np.random.Generator, int], ViewSet]:
    """Sets of boards that are flat (None), bent alike, or each by itself."""

    def drawn(rng: np.random.Generator, count: int) -> ViewSet:
        rig = paper_rig(water)
        bends = None if common is None else bends_of(rng, count, common)
        views = views_of(rig, poses(rig, rng, count), bends)
        noisy = [with_noise(view, NOISE_PX, rng) for view in views]
        truth = {"focal_px": rig.camera.focal_px}
        if rig.camera.port is not None:
            truth["water_index"] = rig.camera.port.water_index
        return ViewSet(noisy, known(rig, INDEX_SIGMA), truth, rig)

    return drawn


def _scattered(rng: np.random.Generator, count: int) -> ViewSet:
    """One to four of at least four views hold points at random in place of the line."""
    drawn = _boards(None, False)(rng, max(count, 4))
    for number in rng.permutation(len(drawn.views))[: rng.integers(1, 5)]:
        line = drawn.views[number].line
        assert line is not None
        off = rng.uniform(-SCATTER_PX, SCATTER_PX, (len(line.image_px), 1)) * line.across
        line = replace(line, image_px=line.image_px + off)
        drawn.views[number] = replace(drawn.views[number], line=line)
    return drawn


def _fisheye_px(points_mm: Floats) -> Floats:
    across = np.hypot(*points_mm[:, :2].T)
    radius = FISHEYE_PX * np.arctan2(across, points_mm[:, 2])
    return (np.array(SIZE) - 1) / 2 + points_mm[:, :2] * (radius / across)[:, None]


def _by_fisheye(rng: np.random.Generator, count: int) -> ViewSet:
    """Boards 150 to 500 mm before an equidistant fisheye, to 15 to 50 degrees off its axis."""
    rig, near, wide = paper_rig(water=False), rng.uniform(150, 500), rng.uniform(0.5, 2.2)
    q_per_mm = rig.q_per_mm * 1000 / near
    views = []
    for number, pose in enumerate(poses(rig, rng, count)):
        x, y = rng.uniform(-1, 1, 2) * [0.45, 0.35] * near * wide
        place = np.array([x, y, (1 - q_per_mm[:2] @ [x, y]) / q_per_mm[2]])
        marks = marks_of(rig, pose)
        middle = np.array([COLUMNS - 1, 1 - ROWS]) * PITCH_MM / 2
        local = (marks.board_mm - middle) * [1.0, -1.0]
        along = np.cross(pose.rotation[:, 2], q_per_mm)
        reach = np.linspace(-60, 60, 80)[:, None] * along / np.linalg.norm(along)
        line_px = _fisheye_px(place + reach)
        marks = replace(marks, image_px=_fisheye_px(local @ pose.rotation[:, :2].T + place))
        level = np.ptp(line_px[:, 0]) >= np.ptp(line_px[:, 1])
        line = LinePoints(line_px, np.full(80, NOISE_PX), "columns" if level else "rows")
        views.append(with_noise(CalibrationView(f"{number}", marks, line), NOISE_PX, rng))
    return ViewSet(views, OpticsSection(port="none"), {"focal_px": FISHEYE_PX})


def _through_slab(rng: np.random.Generator, count: int) -> ViewSet:
    """Boards in air through 260 mm of glass, tilted by 10 degrees, said to be 100 to 400."""
    side, near = rng.uniform(0, 2 * np.pi), rng.uniform(400, 600)
    tilt = SLAB_DEG * np.array([np.cos(side), np.sin(side)])
    port = PortModel(20.0, SLAB_MM, 1.49, 1.0, *tilt.tolist())
    camera = CameraModel(700.0, (319.5, 239.5), -0.1, 0.02, port=port)
    rig, views = Rig(camera, paper_rig().q_per_mm * 1000 / near), []
    for number, pose in enumerate(poses(rig, rng, count)):
        x, y = rng.uniform(-1, 1, 2) * [0.15, 0.1] * near
        there = np.array([x, y, (1 - rig.q_per_mm[:2] @ [x, y]) / rig.q_per_mm[2]])
        posed = Pose(pose.rotation, there)
        view = CalibrationView(f"{number}", marks_of(rig, posed), line_of(rig, posed))
        views.append(with_noise(view, NOISE_PX, rng))
    optics = OpticsSection(
        gap_mm=(20.0, 0.0),
        thickness_mm=(rng.uniform(100.0, 400.0), 300.0),
        glass_index=(1.49, 0.0),
        water_index=(1.0, 0.0),
        tilt_x_deg=(0.0, 20.0),
        tilt_y_deg=(0.0, 20.0),
    )
    return ViewSet(views, optics, {"focal_px": 700.0, "thickness_mm": SLAB_MM}, rig)


KINDS = {
    "flat boards": _boards(None, False),
    "flat boards in water": _boards(None, True),
    "one board, bent by 0.2 mm": _boards(True, False),
    "boards each bent by 0.2 mm": _boards(False, False),
    "boards each bent by 0.2 mm, in water": _boards(False, True),
    "scatter in place of one to four lines": _scattered,
    "an equidistant fisheye": _by_fisheye,
    "a slab of 260 mm": _through_slab,
}
