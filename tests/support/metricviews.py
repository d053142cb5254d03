"""Synthetic views of a hand board crossing a laser sheet, with their truth.

The marks' places come from lscan.camera, which tests/sim/truth/camera/test_independence.py
checks against the tank's truth; what is tested with them is the adjustment, not the optics.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal

import cv2
import numpy as np
from hypothesis import strategies as st

from lscan.calibration.metric.planemap import SheetView
from lscan.calibration.metric.views import CalibrationView, LinePoints
from lscan.camera import CameraModel, PortModel, project
from lscan.config.rig import BENDS, OpticsSection
from lscan.records import Floats, Marks, Status

SIZE = (640, 480)
COLUMNS, ROWS, PITCH_MM = 8, 6, 25.0
LINE_POINTS = 80
VIEWS = 8
STATED_PX = 0.02  # uncertainty that exact marks and lines state of themselves
SCATTER_PX, FISHEYE_PX, SLAB_MM = 80.0, 290.0, 260.0


@dataclass(frozen=True)
class Rig:
    """A camera and a sheet: the plane ``q . X = 1`` of the camera frame."""

    camera: CameraModel
    q_per_mm: Floats

    @property
    def truth(self) -> SheetView:
        """The map as it truly is."""
        c, port = self.camera, self.camera.port
        window = port or PortModel(10.0, 5.0, 1.49, 1.0)
        theta = [c.focal_px, *c.centre_px, *(getattr(c, name) for name in BENDS), c.fisheye]
        theta += [window.gap_mm, window.thickness_mm, window.glass_index, window.water_index]
        theta += [window.tilt_x_deg, window.tilt_y_deg]
        kind: Literal["flat", "none"] = "flat" if port else "none"
        middle = (np.array(SIZE) - 1) / 2
        return SheetView(np.array(theta, dtype=float), kind, self.q_per_mm, middle)


@dataclass(frozen=True)
class Pose:
    """A board in the camera frame: its axes as columns, and the middle of its marks, mm."""

    rotation: Floats
    place_mm: Floats


@st.composite
def rigs(draw: st.DrawFn, water: bool) -> Rig:
    """A webcam, its lens and port anywhere in the usual range, the sheet 0.8 to 1.2 m away."""

    def number(low: float, high: float) -> float:
        return draw(st.floats(low, high))

    port = PortModel(number(5, 30), number(3, 10), 1.49, number(1.33, 1.345)) if water else None
    centre = (number(310, 330), number(230, 250))
    camera = CameraModel(
        number(700, 1000), centre, number(-0.3, 0.05), number(-0.05, 0.1), port=port
    )
    lean, side = np.radians(number(15, 45)), np.radians(number(-10, 10))
    normal = np.array([np.sin(side), np.sin(lean) * np.cos(side), np.cos(lean) * np.cos(side)])
    return Rig(camera, normal / (number(800, 1200) * normal[2]))


def paper_rig(water: bool = True) -> Rig:
    """The paper's camera, port and depression, a metre from the sheet."""
    port = PortModel(10.0, 6.0, 1.488, 1.3313) if water else None
    camera = CameraModel(850.0, (319.5, 239.5), -0.26, 0.06, port=port)
    lean = np.radians(30.0)
    normal = np.array([0.0, np.sin(lean), np.cos(lean)])
    return Rig(camera, normal / (1000.0 * normal[2]))


def known(rig: Rig, water_sigma: float = 0.0) -> OpticsSection:
    """What a user knows of the rig: window and water, and of the lens nothing at all.

    The widths of what is not known are so large that they draw on nothing.
    """
    port = rig.camera.port
    free: dict[str, Any] = dict.fromkeys(("k1", "k2"), (0.0, 1e4)) | dict.fromkeys(
        ("p1", "p2"), (0.0, 1e2)
    )
    free["board_scale_percent"] = 0.0
    if port is None:
        return OpticsSection(port="none", **free)
    return OpticsSection(
        **free,
        gap_mm=(port.gap_mm, 0.0),
        thickness_mm=(port.thickness_mm, 0.0),
        glass_index=(port.glass_index, 0.0),
        water_index=(port.water_index, water_sigma),
        tilt_x_deg=(port.tilt_x_deg, 0.0),
        tilt_y_deg=(port.tilt_y_deg, 0.0),
    )


def poses(rig: Rig, rng: np.random.Generator, count: int = VIEWS) -> list[Pose]:
    """Boards in the sheet, tilted by 25 to 40 degrees to all sides, all over the picture."""
    found = []
    for number in range(count):
        tilt = np.radians(rng.uniform(25, 40))
        side = 2 * np.pi * (number + rng.uniform(-0.3, 0.3)) / count
        turn = np.array([tilt * np.cos(side), tilt * np.sin(side), rng.uniform(-0.1, 0.1)])
        place = np.array([*rng.uniform(-110, 110, 1), *rng.uniform(-80, 80, 1), 0.0])
        place[2] = (1 - rig.q_per_mm[:2] @ place[:2]) / rig.q_per_mm[2]
        found.append(Pose(np.array(cv2.Rodrigues(turn)[0]), place))
    return found


FLAT = np.zeros(3)
"""The bend of a flat board: a, b, c of its height a x^2 + b x z + c z^2, 1/mm."""


def height_mm(places: Floats, bend: Floats) -> Floats:
    """(N,) mm, height of a bent board at places (N, 2) from its middle; 0 on average at its marks.

    bend: (3,) 1/mm.
    """
    x, z = places.T
    column, row = np.meshgrid(
        np.arange(COLUMNS) - (COLUMNS - 1) / 2, np.arange(ROWS) - (ROWS - 1) / 2
    )
    u, v = PITCH_MM * column.ravel(), PITCH_MM * row.ravel()
    on_average = np.mean(np.column_stack([u * u, u * v, v * v]) @ bend)
    return np.column_stack([x * x, x * z, z * z]) @ bend - on_average


def marks_of(rig: Rig, pose: Pose, bend: Floats = FLAT) -> Marks:
    """The exact marks of a board; sigma_px is STATED_PX."""
    column, row = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))
    board = PITCH_MM * np.column_stack([column.ravel(), -row.ravel()]).astype(np.float64)
    local = board - board.mean(axis=0)
    flat = local * [1.0, -1.0]
    places = np.column_stack([flat, height_mm(flat, bend)])
    image = project(rig.camera, places @ pose.rotation.T + pose.place_mm)
    status = np.full(len(board), int(Status.OK), dtype=np.int64)
    return Marks(board, image, np.full(len(board), STATED_PX), status)


def line_of(rig: Rig, pose: Pose, bend: Floats = FLAT) -> LinePoints:
    """The exact line of the sheet on a board whose middle lies in it; sigma_px is STATED_PX."""
    away = pose.rotation[:, 2]
    along = np.cross(away, rig.q_per_mm)
    along /= np.linalg.norm(along)
    across = np.cross(away, along)
    places = pose.place_mm + np.linspace(-60, 60, LINE_POINTS)[:, None] * along
    for _ in range(4 if bend.any() else 0):  # to where the bent board meets the sheet
        on_board = (places - pose.place_mm) @ pose.rotation
        places += (height_mm(on_board[:, :2], bend) - on_board[:, 2])[:, None] * away
        places -= ((places @ rig.q_per_mm - 1) / (across @ rig.q_per_mm))[:, None] * across
    image = project(rig.camera, places)
    level = np.ptp(image[:, 0]) >= np.ptp(image[:, 1])
    return LinePoints(image, np.full(len(image), STATED_PX), "columns" if level else "rows")


def views_of(rig: Rig, boards: list[Pose], bends: Floats | None = None) -> list[CalibrationView]:
    """Exact views, marks and lines; bends: (V, 3) 1/mm, of the boards, flat without."""
    each = np.zeros((len(boards), 3)) if bends is None else bends
    return [
        CalibrationView(f"pose-{number}", marks_of(rig, pose, bend), line_of(rig, pose, bend))
        for number, (pose, bend) in enumerate(zip(boards, each, strict=True))
    ]


def bends_of(rng: np.random.Generator, count: int, common: bool, sag_mm: float = 0.2) -> Floats:
    """(count, 3) 1/mm: boards bent to part of a cylinder by so much over 210 mm, one or each."""
    lean = rng.uniform(0, np.pi, (1 if common else count, 1))
    curved = np.hstack([np.cos(lean) ** 2, np.sin(2 * lean), np.sin(lean) ** 2])
    side = rng.choice([-1.0, 1.0], lean.shape)
    return np.broadcast_to(side * 4 * sag_mm / 210**2 * curved, (count, 3))


def with_noise(view: CalibrationView, sigma_px: float, rng: np.random.Generator) -> CalibrationView:
    """The view with white noise of ``sigma_px`` on marks and, across it, on the line."""
    assert view.marks is not None and view.line is not None
    marks, line = view.marks, view.line
    shaken = marks.image_px + sigma_px * rng.standard_normal(marks.image_px.shape)
    across = 1 if line.axis == "columns" else 0
    moved = line.image_px.copy()
    moved[:, across] += sigma_px * rng.standard_normal(len(moved))
    return replace(
        view,
        marks=replace(marks, image_px=shaken, sigma_px=np.full(len(shaken), sigma_px)),
        line=replace(line, image_px=moved, sigma_px=np.full(len(moved), sigma_px)),
    )


def scattered(
    view: CalibrationView, rng: np.random.Generator, count: int = LINE_POINTS
) -> CalibrationView:
    """The view with so many points all over SCATTER_PX to either side in its line's place."""
    assert view.line is not None
    line, some = view.line, np.linspace(0, len(view.line.image_px) - 1, count).astype(int)
    off = rng.uniform(-SCATTER_PX, SCATTER_PX, (count, 1)) * line.across
    return replace(
        view,
        line=replace(line, image_px=line.image_px[some] + off, sigma_px=line.sigma_px[some]),
    )


def fisheye_px(points_mm: Floats) -> Floats:
    """(N, 2) px at which an equidistant fisheye of FISHEYE_PX sees points of the camera frame."""
    across = np.hypot(*points_mm[:, :2].T)
    radius = FISHEYE_PX * np.arctan2(across, points_mm[:, 2])
    return (np.array(SIZE) - 1) / 2 + points_mm[:, :2] * (radius / across)[:, None]


def fisheye_views(
    rng: np.random.Generator, count: int, near_mm: float, aside: float, noise_px: float
) -> list[CalibrationView]:
    """Boards in a sheet, all round the axis of a fisheye; aside: so far of their distance."""
    rig = paper_rig(water=False)
    q_per_mm = rig.q_per_mm * 1000 / near_mm
    middle = np.array([COLUMNS - 1, 1 - ROWS]) * PITCH_MM / 2
    views = []
    for number, pose in enumerate(poses(rig, rng, count)):
        side = 2 * np.pi * number / count
        x, y = near_mm * aside * np.array([np.cos(side), 0.8 * np.sin(side)])
        place = np.array([x, y, (1 - q_per_mm[:2] @ [x, y]) / q_per_mm[2]])
        marks = marks_of(rig, pose)
        local = (marks.board_mm - middle) * [1.0, -1.0]
        along = np.cross(pose.rotation[:, 2], q_per_mm)
        reach = np.linspace(-60, 60, LINE_POINTS)[:, None] * along / np.linalg.norm(along)
        line_px = fisheye_px(place + reach)
        marks = replace(marks, image_px=fisheye_px(local @ pose.rotation[:, :2].T + place))
        level = np.ptp(line_px[:, 0]) >= np.ptp(line_px[:, 1])
        line = LinePoints(line_px, np.full(LINE_POINTS, noise_px), "columns" if level else "rows")
        views.append(with_noise(CalibrationView(f"{number}", marks, line), noise_px, rng))
    return views


def slab_views(
    rng: np.random.Generator, count: int, near_mm: float, noise_px: float
) -> tuple[Rig, list[CalibrationView]]:
    """Boards in air through SLAB_MM of glass, tilted by 10 degrees to any side."""
    side = rng.uniform(0, 2 * np.pi)
    port = PortModel(20.0, SLAB_MM, 1.49, 1.0, *(10 * np.array([np.cos(side), np.sin(side)])))
    camera = CameraModel(700.0, (319.5, 239.5), -0.1, 0.02, port=port)
    rig, views = Rig(camera, paper_rig().q_per_mm * 1000 / near_mm), []
    for number, pose in enumerate(poses(rig, rng, count)):
        x, y = rng.uniform(-1, 1, 2) * [0.15, 0.1] * near_mm
        place = np.array([x, y, (1 - rig.q_per_mm[:2] @ [x, y]) / rig.q_per_mm[2]])
        there = Pose(pose.rotation, place)
        view = CalibrationView(f"{number}", marks_of(rig, there), line_of(rig, there))
        views.append(with_noise(view, noise_px, rng))
    return rig, views


def slab_known(thickness_mm: float, sigma_mm: float) -> OpticsSection:
    """What is known of a slab whose thickness is guessed, and its tilt not even that."""
    return OpticsSection(
        gap_mm=(20.0, 0.0),
        thickness_mm=(thickness_mm, sigma_mm),
        glass_index=(1.49, 0.0),
        water_index=(1.0, 0.0),
        tilt_x_deg=(0.0, 20.0),
        tilt_y_deg=(0.0, 20.0),
    )
