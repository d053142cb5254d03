"""Boards held into the sheet: what the poses promise, and the files that come of them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from places import SCENES

from lscan.calibration.metric.views import Charuco, Chessboard, load_views, read_views
from lscan.config.board import Board, Grid, Plate, load_board
from lscan.config.documents import write_toml
from lscan.errors import InputError
from lscan.files.pictures import read_picture
from lscan.records import Status
from sim.datasets.files import (
    MOST_DEG,
    MOST_DISTANCE_MM,
    held_scenes,
    load_held_board,
    write_views,
)
from sim.scene import Scene, load_scene, target_pose
from sim.truth import board_truth, project, sheet_of, stripe_truth

METRIC = SCENES / "metric"
WATER, AIR = load_scene(METRIC / "water.toml"), load_scene(METRIC / "air.toml")


def changed(scene: Scene, section: str, **update: object) -> Scene:
    """The scene with some keys of a section changed."""
    part = getattr(scene.tank, section).model_copy(update=update)
    return replace(scene, tank=scene.tank.model_copy(update={section: part}))


def small(scene: Scene) -> Scene:
    """The scene with a quarter of the pixels and one sample for each."""
    camera = scene.rig.camera.model_copy(update={"width_px": 320, "height_px": 240})
    lens = {"focal_px": 425.0, "centre_px": (159.5, 119.5)}
    scene = replace(scene, rig=scene.rig.model_copy(update={"camera": camera}))
    return changed(changed(scene, "lens", **lens), "render", samples=1)


@examples(8)
@given(seed=st.integers(0, 2**31 - 1), scene=st.sampled_from([WATER, AIR]))
def test_every_board_is_wholly_in_view_and_crossed_by_the_line(seed: int, scene: Scene) -> None:
    """By the truth: all dots and the plate's corners show, and the line is lit on the face."""
    board = scene.rig.board
    assert board is not None
    left, right, bottom, top = board.outline_mm()
    corners = np.array([[left, 0, bottom], [right, 0, bottom], [right, 0, top], [left, 0, top]])
    for held in held_scenes(scene, 6, seed):
        assert (board_truth(held).centres.grid.status == Status.OK).all()
        pixels = project(held, target_pose(held).apply(corners) @ _yaw(held))
        assert (pixels >= 0).all() and (pixels <= [639, 479]).all()
        assert (stripe_truth(held, 0.0).status == Status.OK).sum() >= 20  # columns with a line


def _yaw(scene: Scene) -> np.ndarray:
    """(3, 3) world to head frame for row vectors: the head stands at 0, only turned."""
    yaw = np.radians(scene.tank.head.yaw_deg)
    return np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])


@examples(8)
@given(seed=st.integers(0, 2**31 - 1))
def test_poses_keep_to_their_ranges_and_differ(seed: int) -> None:
    middle = np.array([[90.0, 0.0, -60.0]])  # of the dots of metric/dots.toml
    targets = [held.tank.target for held in held_scenes(WATER, 10, seed)]
    turn, tilt = np.array([[t.turn_deg, t.tilt_x_deg] for t in targets]).T
    assert np.abs(turn).max() <= MOST_DEG[0] and np.abs(tilt).max() <= MOST_DEG[1]
    assert np.ptp(turn) > MOST_DEG[0]  # half of the range at least
    poses = [target_pose(held).apply(middle) @ _yaw(held) for held in held_scenes(WATER, 10, seed)]
    off = sheet_of(WATER).clearance_mm(np.vstack(poses))
    assert np.abs(off).max() <= MOST_DISTANCE_MM
    places = np.vstack([project(WATER, p) for p in poses])
    assert (np.ptp(places, axis=0) > [200, 150]).all()  # spread over the view


def test_the_seed_decides() -> None:
    first, again, other = (
        [held.tank.target for held in held_scenes(WATER, 5, seed)] for seed in (3, 3, 4)
    )
    assert first == again
    assert first != other


def test_files_are_what_the_instrument_reads(tmp_path: Path) -> None:
    files = write_views(small(WATER), tmp_path, count=2, seed=5)
    names = {
        "board.toml",
        "views.toml",
        *(f"pose-{k}{e}.png" for k in (0, 1) for e in ("", "-laser")),
    }
    assert {path.name for path in tmp_path.iterdir()} == names
    assert set(files.values()) == {tmp_path / name for name in names}
    assert load_board(tmp_path / "board.toml") == WATER.rig.board
    document = load_views(tmp_path / "views.toml").document
    assert document.optics == WATER.rig.optics
    assert document.stripe == WATER.rig.stripe
    assert [(v.picture, v.laser, v.background) for v in document.view] == [
        (f"pose-{k}.png", f"pose-{k}-laser.png", f"pose-{k}.png") for k in (0, 1)
    ]


def test_the_two_pictures_of_a_pose_differ_by_the_line(tmp_path: Path) -> None:
    """Red light is added along the true line; away from it only noise is, 5 sigma of 1.5 DN.

    Shot and reading noise of either picture are 1.1 DN at the plate's 70 DN or less.
    """
    scene = small(WATER)
    files = write_views(scene, tmp_path, count=1, seed=6)
    dark, lit = (read_picture(files[f"pose-0{end}"]).astype(float) for end in ("", "-laser"))
    truth = stripe_truth(held_scenes(scene, 1, 6)[0], 0.0)
    column = np.flatnonzero(truth.status == Status.OK)
    row = np.rint(truth.centre_px[column]).astype(int)
    more = (lit - dark)[..., 0]
    assert np.median(more[row, column]) > 20
    far = np.ones(more.shape, dtype=bool)
    for r, c in zip(row, column, strict=True):
        far[max(r - 25, 0) : r + 26, max(c - 25, 0) : c + 26] = False
    assert abs(np.median(more[far])) <= 7.5


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (changed(WATER, "target", shape="none"), "target is not the board"),
        (changed(WATER, "light", ambient_w_m2_sr=0.0), "light"),
        (changed(WATER, "laser", on=False), "laser.on"),
        (
            changed(WATER, "laser", apex_mm=(225.0, -2000.0, 250.0)),
            "poses of the board",
        ),  # behind the camera
    ],
)
def test_refusals_leave_nothing_behind(scene: Scene, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        write_views(scene, tmp_path / "views")
    assert not (tmp_path / "views").exists()


SQUARES = {"columns": 7, "rows": 5, "square_mm": 26.0}
CHESSBOARD = Chessboard(kind="chessboard", **SQUARES)
CHARUCO = Charuco(kind="charuco", **SQUARES, marker_mm=19.0, dictionary="DICT_5X5_100")


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO])
def test_a_printed_board_is_read_where_it_is_held(
    board: Chessboard | Charuco, tmp_path: Path
) -> None:
    """Whatever stood in the scene; the print is drawn to a tenth of a pixel of the picture.

    The corners are off by 0.02 px (chessboard) and 0.03 px rms, by noise: the mean of 35 by less
    than 0.01 each way.  A picture that is turned, mirrored or off by a texel has another.
    """
    scene = changed(changed(WATER, "render", samples=4), "target", shape="none")
    files = write_views(scene, tmp_path, count=1, seed=3, board=board)
    assert set(files) == {"board", "views", "pose-0", "pose-0-laser"}
    views = load_views(files["views"])
    stated = board.model_copy(update={"margin_mm": 52.0})  # two squares
    assert views.document.board == stated
    (view,), _ = read_views(views)
    assert view.marks is not None and view.line is not None and len(view.line.image_px) > 100
    corners = Grid(columns=7, rows=5, pitch_mm=26.0, dot_diameter_mm=1.0)
    plate = Board(grid=corners, plate=Plate(margin_mm=52.0))
    rig = scene.rig.model_copy(update={"board": plate})
    (held,) = held_scenes(changed(replace(scene, rig=rig), "target", shape="board"), 1, 3)
    truth = board_truth(held).centres.grid.image_px
    off = view.marks.image_px - truth
    assert np.sqrt(np.mean(off**2)) < 0.06 and (np.abs(off.mean(axis=0)) < 0.03).all()


def test_a_file_says_which_board_is_held(tmp_path: Path) -> None:
    file = tmp_path / "held.toml"
    write_toml(file, {"board": CHARUCO.model_dump(exclude_none=True)})
    assert load_held_board(file) == CHARUCO
    dots = (METRIC / "dots.toml").as_posix()
    write_toml(file, {"board": {"kind": "dots", "file": dots, "margin_mm": 25.0}})
    scene = small(changed(WATER, "target", shape="none"))
    files = write_views(scene, tmp_path, count=1, board=load_held_board(file))
    assert load_board(files["board"]) == WATER.rig.board
    assert load_views(files["views"]).document.board.margin_mm == 25.0


@pytest.mark.parametrize(
    ("board", "words"),
    [
        (
            CHESSBOARD.model_copy(update={"margin_mm": 25.0}),
            r"less than the outer squares \(got 25",
        ),
        (CHARUCO.model_copy(update={"marker_mm": 26.0}), "marker_mm: bad size"),
        (CHARUCO.model_copy(update={"dictionary": "DICT_9"}), "no such dictionary"),
        (CHESSBOARD.model_copy(update={"columns": 70}), "poses of the board"),
    ],
)
def test_a_board_that_cannot_be_held_leaves_nothing_behind(
    board: Chessboard | Charuco, words: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=words):
        write_views(WATER, tmp_path / "views", board=board)
    assert not (tmp_path / "views").exists()


@pytest.mark.parametrize("count", [0, -1, 10_000])
def test_counts_of_poses_that_cannot_be(count: int) -> None:
    with pytest.raises(InputError, match="poses of the board"):
        held_scenes(WATER, count)
