"""Views files read whole: every printed board, and every way to show the line on it.

The pictures are drawn: a board's print seen by the pinhole of ``metricviews`` in air, lit by
lamps and by a Gaussian laser line where the true sheet meets it.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from metricviews import SIZE, Pose, Rig, known, paper_rig, poses

from lscan.board.chessboard import read_charuco
from lscan.calibration.metric.solve import calibrate_metric
from lscan.calibration.metric.views import CalibrationView, load_views, read_views
from lscan.camera import CameraModel, project
from lscan.errors import BoardNotFound, InputError
from lscan.files.pictures import encode_picture, write_picture
from lscan.records import Bytes, Floats

COLUMNS, ROWS, SQUARE_MM, MARKER_MM = 5, 4, 40.0, 32.0
PRINT_PX_MM = 4  # of the print drawn, some four times finer than the picture
FINER = 3  # the picture is drawn on a raster three times finer than its own
DARK, WHITE = 0.35, 0.9  # albedo of ink and paper
LINE_SIGMA_PX = 1.5
POSES, FEW = 6, 3
CHARUCO = (
    f'[board]\nkind = "charuco"\ncolumns = {COLUMNS}\nrows = {ROWS}\nsquare_mm = {SQUARE_MM}\n'
    f'marker_mm = {MARKER_MM}\ndictionary = "DICT_4X4_50"\n'
)
CHESSBOARD = (
    f'[board]\nkind = "chessboard"\ncolumns = {COLUMNS}\nrows = {ROWS}\nsquare_mm = {SQUARE_MM}\n'
)
STRIPE = '[stripe]\nextractor = "ml"\nthreshold_dn = 40.0\n'
RIG = Rig(CameraModel(850.0, (319.5, 239.5)), paper_rig(water=False).q_per_mm)


def printed(kind: str) -> Floats:
    """Albedo of the print, PRINT_PX_MM a mm, with a rim of half a square."""
    square = int(SQUARE_MM * PRINT_PX_MM)
    size = ((COLUMNS + 1) * square, (ROWS + 1) * square)
    if kind == "charuco":
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
        board = cv2.aruco.CharucoBoard((COLUMNS + 1, ROWS + 1), SQUARE_MM, MARKER_MM, dictionary)
        inner = board.generateImage(size) > 127
    else:
        row, column = np.indices((size[1], size[0])) // square
        inner = (row + column) % 2 == 0  # OpenCV counts from a white square
    paper = np.pad(inner, square // 2, constant_values=True)
    return np.where(paper, WHITE, DARK)


def albedo(print_: Floats, pose: Pose) -> Floats:
    """(H, W) what the camera sees of the print in a pose, ``DARK`` beside it."""
    height, width = print_.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=float)
    local = (corners - [width / 2, height / 2]) / PRINT_PX_MM
    seen = project(RIG.camera, np.column_stack([local, np.zeros(4)]) @ pose.rotation.T
                   + pose.place_mm)  # fmt: skip
    warp = cv2.getPerspectiveTransform(
        (corners - 0.5).astype(np.float32), ((seen + 0.5) * FINER - 0.5).astype(np.float32)
    )
    fine = cv2.warpPerspective(print_, warp, (SIZE[0] * FINER, SIZE[1] * FINER), borderValue=DARK)
    return np.asarray(cv2.resize(fine, SIZE, interpolation=cv2.INTER_AREA), dtype=float)


def true_line(pose: Pose) -> Floats:
    """(W,) row at which each column shows the middle of the sheet's light."""
    along = np.cross(pose.rotation[:, 2], RIG.q_per_mm)
    reach = np.array([[-50.0], [50.0]])
    ends = project(RIG.camera, pose.place_mm + reach * along / np.linalg.norm(along))
    slope = (ends[1, 1] - ends[0, 1]) / (ends[1, 0] - ends[0, 0])
    return np.asarray(ends[0, 1] + slope * (np.arange(SIZE[0]) - ends[0, 0]))


@dataclass(frozen=True)
class Lights:
    """Grey values of white: by the lamps, and by the laser at the middle of its line."""

    lamps: float
    laser: float = 0.0


def picture(seen: Floats, pose: Pose, lights: Lights, rng: np.random.Generator) -> Bytes:
    """What an 8-bit camera with a noise of 1 DN takes; the laser is red."""
    away = np.arange(SIZE[1])[:, None] - true_line(pose)
    light = np.full((SIZE[1], SIZE[0], 3), float(lights.lamps))
    light[:, :, 0] += lights.laser * np.exp(-(away**2) / (2 * LINE_SIGMA_PX**2))
    noise = rng.standard_normal(light.shape)
    return np.clip(np.rint(seen[:, :, None] * light + noise), 0, 255).astype(np.uint8)


def level_poses() -> list[Pose]:
    """Those in which the line runs across the columns."""
    drawn = poses(RIG, np.random.default_rng(5), 2 * POSES)
    along = [np.cross(pose.rotation[:, 2], RIG.q_per_mm) for pose in drawn]
    return [p for p, (x, y, _) in zip(drawn, along, strict=True) if abs(y) < abs(x)][:POSES]


def found(
    folder: Path, kind: str, way: str, count: int = FEW
) -> tuple[list[CalibrationView], list[Pose]]:
    """The views of a file whose line is shown in one of the ways; written and read."""
    for name, content in files(kind, way, count).items():
        (folder / name).write_bytes(content)
    views, size = read_views(load_views(folder / "views.toml"))
    assert size == SIZE
    return views, level_poses()[:count]


@cache
def files(kind: str, way: str, count: int) -> dict[str, bytes]:
    """The views file and its pictures, by name."""
    drawn: dict[str, bytes] = {}

    def add(name: str, seen: Bytes) -> str:
        drawn[name] = encode_picture(seen, ".png")
        return name

    text = (CHARUCO if kind == "charuco" else CHESSBOARD) + STRIPE
    if way == "same":  # a red line across a corner would draw it aside
        text = 'channel = "green"\n' + text
    boards, rng, print_ = level_poses()[:count], np.random.default_rng(6), printed(kind)
    for number, pose in enumerate(boards):
        seen = albedo(print_, pose)
        text += "[[view]]\n"
        if way == "same":
            plain = add(f"plain{number}.png", picture(seen, pose, Lights(60, 200), rng))
            text += f'picture = "{plain}"\nlaser = "same"\n'
            continue
        plain = add(f"plain{number}.png", picture(seen, pose, Lights(220), rng))
        lamps = 220 if way == "pair" else 100
        lit = add(f"lit{number}.png", picture(seen, pose, Lights(lamps, 100), rng))
        text += f'picture = "{plain}"\nlaser = "{lit}"\n'
        if way == "background":
            dim = add(f"dim{number}.png", picture(seen, pose, Lights(100), rng))
            text += f'background = "{dim}"\n'
    return drawn | {"views.toml": text.encode()}


@pytest.mark.parametrize(
    ("kind", "way"),
    [pytest.param("charuco", "same", marks=pytest.mark.slow), ("chessboard", "background")],
)
def test_board_and_line_are_where_they_are(tmp_path: Path, kind: str, way: str) -> None:
    views, boards = found(tmp_path, kind, way)
    assert [view.fault for view in views] == [""] * FEW
    for view, pose in zip(views, boards, strict=True):
        assert view.marks is not None and view.line is not None
        middle = view.marks.board_mm.min(axis=0) / 2 + view.marks.board_mm.max(axis=0) / 2
        local = (view.marks.board_mm - middle)[view.marks.found] * [1, -1]
        true = project(
            RIG.camera, np.column_stack([local, np.zeros(len(local))]) @ pose.rotation.T
            + pose.place_mm,
        )  # fmt: skip
        off = np.linalg.norm(view.marks.image_px[view.marks.found] - true, axis=1)
        # A pixel of the print is 0.25 mm, 0.2 px in the picture, and edges are drawn to the
        # nearest; the noise adds 0.02 px.  Markers as large as these drew corners 0.5 px aside.
        assert len(off) == COLUMNS * ROWS and off.max() < 0.1 + 4 * 0.02
        u = view.line.image_px[:, 0].astype(int)
        miss = view.line.image_px[:, 1] - true_line(pose)[u]
        # On the edge of a square, a dark side of d = 0.39 of the bright one draws the centroid
        # of a line of width s aside by s sqrt(2/pi) (1 - d)/(1 + d) = 0.35 s: half the columns
        # do no worse.  The step of the lamps' light adds to that, but no error is larger than
        # the line is wide.
        assert np.abs(miss).max() < LINE_SIGMA_PX
        assert np.median(np.abs(miss)) < 0.35 * LINE_SIGMA_PX
        assert (view.line.sigma_px > 0).all()


@pytest.mark.slow  # test_files.py has it by the command, of a chessboard
def test_the_sheet_comes_out_of_a_printed_board(tmp_path: Path) -> None:
    """As test_files.py has it out of a chessboard."""
    views, _ = found(tmp_path, "charuco", "pair", POSES)
    solved = calibrate_metric(views, known(RIG), SIZE)
    assert all(view.used for view in solved.views)
    pixels = np.array([[260.0, 180.0], [380.0, 180.0], [320.0, 300.0]])
    truth = RIG.truth.locate(pixels)
    points = solved.plane_map.to_plane(pixels)
    for one, two in ((0, 1), (1, 2), (2, 0)):
        nominal = np.linalg.norm(truth[one] - truth[two])
        length = np.linalg.norm(points.xz_mm[one] - points.xz_mm[two])
        assert points.modes_mm is not None
        sigma = np.linalg.norm(points.modes_mm[one] - points.modes_mm[two])
        assert sigma < 0.01 * nominal  # else agreement says nothing
        assert abs(length - nominal) < 5 * sigma


def test_the_background_named_is_the_one_subtracted(tmp_path: Path) -> None:
    views, boards = found(tmp_path, "chessboard", "background")
    other = tmp_path / "other.png"
    lit = np.zeros((SIZE[1], SIZE[0], 3))
    lit[:, :, 0] = 90 * np.exp(-((np.arange(SIZE[1])[:, None] - true_line(boards[0])) ** 2) / 4.5)
    text = (tmp_path / "views.toml").read_text().replace("dim0.png", other.name)
    (tmp_path / "views.toml").write_text(text)
    dim = cv2.imread(str(tmp_path / "dim0.png"))[:, :, ::-1].astype(float)
    write_picture(other, np.clip(dim + lit, 0, 255).astype(np.uint8))
    again, _ = read_views(load_views(tmp_path / "views.toml"))
    assert views[0].line is not None
    assert again[0].line is None and "above [stripe] threshold_dn" in again[0].fault  # taken away
    assert again[1].line is not None and views[1].line is not None
    np.testing.assert_array_equal(again[1].line.image_px, views[1].line.image_px)


@pytest.mark.slow
def test_a_line_that_is_not_there_is_a_fault_of_its_view(tmp_path: Path) -> None:
    _, boards = found(tmp_path, "chessboard", "background")
    dark = picture(
        albedo(printed("chessboard"), boards[2]), boards[2], Lights(100), np.random.default_rng(9)
    )
    write_picture(tmp_path / "lit2.png", dark)
    again, _ = read_views(load_views(tmp_path / "views.toml"))
    assert [bool(view.fault) for view in again] == [number == 2 for number in range(FEW)]
    assert again[2].marks is not None and again[2].line is None


def test_a_dictionary_must_have_a_marker_for_every_white_square() -> None:
    white = np.full((100, 100), 255, dtype=np.uint8)
    # 10 by 10 squares carry 50 markers, 10 by 11 carry 55.
    with pytest.raises(BoardNotFound):
        read_charuco(white, 9, 9, 20.0, 14.0, "DICT_4X4_50")
    with pytest.raises(InputError, match=r"dictionary: has 50 markers, the board 55.*DICT_4X4_50"):
        read_charuco(white, 9, 10, 20.0, 14.0, "DICT_4X4_50")
