"""The true board: closed forms of print and bend, in space, as meshes, and in the truth."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from places import SCENES
from truth_scenes import tank

from lscan.calibration.calibrate import calibrate
from lscan.config.board import Board
from lscan.config.rig import load_rig, parse_rig
from lscan.errors import InputError
from lscan.records import Floats, Status
from sim.meshes import scene_parts
from sim.meshes.target import board_parts, plate_mesh
from sim.scene import Scene, load_scene, scene_of
from sim.scene.errors import FACET_MM, BoardErrors, TrueBoard, parabola
from sim.truth import board_truth, project, stripe_truth

GRID = {"columns": 4, "rows": 3, "pitch_mm": 50.0, "dot_diameter_mm": 5.0}
DOCUMENT: dict[str, Any] = {
    "grid": GRID,
    "ruler": [{"direction": "vertical", "at_mm": 75.0, "first_mm": 0.0, "last_mm": -100.0}],
    "dot": [{"name": "A1", "x_mm": 60.0, "z_mm": -30.0}],
    "ring": [{"name": "E", "x_mm": 30.0, "z_mm": -70.0, "diameter_mm": 28.4}],
}
BOARD = Board.model_validate(DOCUMENT)
MIDDLE, WIDTH, HEIGHT = np.array([75.0, -50.0]), 210.0, 160.0  # of the plate
MARKS = 12 + 11 + 1 + 1
bends = st.floats(-4, 4)
scales = st.floats(-2e4, 2e4)


def board(document: dict[str, Any] = DOCUMENT, at: Any = (0.0, 0.0, 0.0), **errors: float) -> Scene:
    """The board in the sheet, or moved by ``at``, seen by a distorting lens."""
    return tank(
        board=document,
        board_errors=errors,
        target={"shape": "board", "position_mm": list(at)},
        lens={"k1": -0.22, "k2": 0.06},
    )


def seen_px(scene: Scene) -> Floats:
    """Centroids of all marks, px."""
    read = board_truth(scene).centroids
    rings = [ring.image_px for ring in read.rings.values()]
    dots = [dot.image_px[np.newaxis] for dot in read.dots.values()]
    rulers = [ruler.marks.image_px for ruler in read.rulers]
    return np.concatenate([read.grid.image_px, *rulers, *dots, *rings])


@given(x=scales, z=scales, shear=st.floats(-5, 5))
def test_a_print_s_scale_and_shear(x: float, z: float, shear: float) -> None:
    """The middle stays; a row is as much longer; a column is as much longer, and leans."""
    true = TrueBoard(BOARD, BoardErrors(scale_x_ppm=x, scale_z_ppm=z, shear_deg=shear))
    places = MIDDLE + np.array([[0, 0], [100, 0], [0, 100]])
    middle, right, up = true.printed_places(places, np.zeros(2))
    np.testing.assert_allclose(middle, MIDDLE, atol=1e-12)
    np.testing.assert_allclose(right - middle, [100 * (1 + 1e-6 * x), 0], atol=1e-12)
    leans = np.array([np.sin(np.radians(shear)), np.cos(np.radians(shear))])
    np.testing.assert_allclose(up - middle, 100 * (1 + 1e-6 * z) * leans, atol=1e-12)


def test_marks_are_misplaced_each_by_itself() -> None:
    """Variance of 2 N draws within 5 of its own standard deviations, sqrt(2 / 2N)."""
    true = load_scene(SCENES / "paper" / "board.toml").with_tank(board_errors={"dot_noise_mm": 0.2})
    drawn = np.concatenate(true.true_board().shifts_mm())
    assert len(drawn) == 100 + 5 * 46 + 16 + 3
    assert abs(drawn.var() / 0.04 - 1) < 5 / np.sqrt(len(drawn))
    assert abs(drawn.mean()) < 5 * 0.2 / np.sqrt(2 * len(drawn))
    other = true.with_tank(board_errors={"seed": 2}).true_board()
    assert not np.isin(np.concatenate(other.shifts_mm()), drawn).any()


@given(x=bends, z=bends)
def test_a_bent_plate_s_middle_and_ends(x: float, z: float) -> None:
    """The sagitta, and facets that lie within a micrometre of the parabola."""
    true = TrueBoard(BOARD, BoardErrors(bend_x_mm=x, bend_z_mm=z))
    part = np.linspace(-1, 1, 997)
    u, w = (grid.ravel() for grid in np.meshgrid(part, part[::71]))
    flat = np.column_stack([MIDDLE[0] + u * WIDTH / 2, 0 * u, MIDDLE[1] + w * HEIGHT / 2])
    bent = true.bent(flat)
    np.testing.assert_allclose(
        bent[:, 1], x * (1 - u**2) + z * (1 - w**2), rtol=0, atol=2 * FACET_MM
    )
    for axis, bend, ends in ((0, x, (-30, 180)), (2, z, (-130, 30))):
        fine, _ = parabola(np.array([ends[0], *np.sort(flat[:, axis]), ends[1]]), bend)
        np.testing.assert_allclose(np.sort(bent[:, axis]), fine[1:-1], rtol=0, atol=FACET_MM)


@given(bend=bends.filter(lambda mm: abs(mm) > 1e-3))
def test_bending_along_one_axis_does_not_stretch(bend: float) -> None:
    """The way along many chords is the arc length, less the chords' (k h)²/24 of it."""
    nodes = np.linspace(0.0, WIDTH, 2001)
    along, behind = parabola(nodes, bend)
    length = np.hypot(np.diff(along), np.diff(behind)).sum()
    assert length == pytest.approx(WIDTH, rel=1e-8)
    assert behind[1000] == pytest.approx(bend)
    # To the second order in the slope: Lagrange's 8 b² / 3 L.
    assert WIDTH - (along[-1] - along[0]) == pytest.approx(8 * bend**2 / 3 / WIDTH, rel=2e-3)


def test_a_bent_board_s_parts_fit() -> None:
    """Plate and marks cover the facets once, no more than they are wide apart; areas by facet."""
    given_errors = BoardErrors(bend_x_mm=-2.0, bend_z_mm=3.0, dot_noise_mm=0.3)
    true = TrueBoard(BOARD, given_errors)
    plate, marks, body = (p.mesh for p in board_parts(BOARD, 0.8, 0.1, given_errors))
    slab = plate_mesh(true)
    assert slab.is_watertight and body.is_watertight and slab.volume > 0
    x, z = true.facets_mm()
    front = slab.area_faces[: 2 * (len(x) - 1) * (len(z) - 1)].sum()
    assert plate.area + marks.area == pytest.approx(front, rel=1e-9)
    flat = board_parts(BOARD, 0.8, 0.1, BoardErrors(dot_noise_mm=0.3))[1].mesh
    # An area grows by half the slopes' squares where both bend.
    assert marks.area == pytest.approx(flat.area, rel=(4 * 3.0 / HEIGHT) ** 2)
    assert np.all(plate.face_normals[:, 1] < 0)


def test_no_errors_change_nothing() -> None:
    plain, same = board(at=(0.0, 7.0, 0.0)), board(at=(0.0, 7.0, 0.0), seed=3)
    assert seen_px(plain).tobytes() == seen_px(same).tobytes()
    for one, other in zip(scene_parts(plain), scene_parts(same), strict=True):
        assert one.mesh.vertices.tobytes() == other.mesh.vertices.tobytes()
        assert one.mesh.faces.tobytes() == other.mesh.faces.tobytes()


def test_the_board_at_fault_is_seen_where_its_marks_are() -> None:
    """All errors at once, put together anew: print, shift, bend, projection."""
    errors = {"scale_x_ppm": 5000.0, "shear_deg": 1.0, "dot_noise_mm": 0.2, "bend_z_mm": 2.0}
    scene = board(**errors)
    read = board_truth(scene).centres.grid
    off = read.board_mm - MIDDLE
    lean = np.radians(1.0)
    plan = MIDDLE + np.column_stack([1.005 * off[:, 0] + np.sin(lean) * off[:, 1],
                                     np.cos(lean) * off[:, 1]])  # fmt: skip
    drawn = np.random.Generator(np.random.SFC64(1)).standard_normal((MARKS, 2))
    plan += 0.2 * drawn[:12]
    behind = 2.0 * (1 - ((plan[:, 1] - MIDDLE[1]) / (HEIGHT / 2)) ** 2)
    nodes = np.linspace(-130.0, 30.0, 4001)
    height = np.interp(plan[:, 1], nodes, parabola(nodes, 2.0)[0])
    expected = project(scene, np.column_stack([plan[:, 0], behind, height]))
    assert read.found.all()
    # Facets lie 0.5 µm off, 1 mm is about 1 px here.
    np.testing.assert_allclose(read.image_px, expected, rtol=0, atol=1e-3)


def test_a_calibration_errs_by_the_print() -> None:
    """0.1 % too large, 400 mm of the sheet are measured as 400 / 1.001.

    Without noise the map errs by what its own bar in test_refractive.py allows at most, 0.03 mm
    rms, at either end.
    """
    scene = load_scene(SCENES / "best" / "board.toml")
    wrong = scene.with_tank(board_errors={"scale_x_ppm": 1000.0, "scale_z_ppm": 1000.0})
    solved = calibrate(board_truth(wrong).centres, "refractive", scene.rig.optics)
    ends = np.array([[25.0, 0, -225], [425, 0, -225], [225, 0, -25], [225, 0, -425]])
    answer = solved.plane_map.to_plane(project(scene, ends))
    assert np.all(answer.status == Status.OK)
    measured = np.linalg.norm(np.diff(answer.xz_mm.reshape(2, 2, 2), axis=1)[:, 0], axis=1)
    np.testing.assert_allclose(measured, 400 / 1.001, rtol=0, atol=2 * 0.03)
    assert np.abs(measured - 400).min() > 0.3


@pytest.mark.parametrize(("lean", "bend"), [(-50.0, 3.0), (-30.0, -2.0)])
def test_the_line_on_a_bent_board(lean: float, bend: float) -> None:
    """What lies y behind the face of a board leant by t about x meets the sheet at y / sin t."""
    across, down = np.sin(np.radians(lean)), np.cos(np.radians(lean))
    at = [-75.0, -50 * across, 50 * down]  # of O: the middle is in the head's origin
    pose = {"position_mm": at, "tilt_x_deg": lean}
    scene = tank(
        board=DOCUMENT, board_errors={"bend_x_mm": bend}, target={"shape": "board", **pose}
    )
    truth = stripe_truth(scene, 0.0)
    shown = truth.status == Status.OK
    assert shown.sum() > 150
    x, z = truth.xz_mm[shown].T
    nodes = np.linspace(0.0, WIDTH, 4001) - WIDTH / 2
    behind = np.interp(x, *parabola(nodes, bend))
    # (y cos t - w sin t = 0, z = y sin t + w cos t) with w along the board: z = y / sin t.
    slack = 2 * FACET_MM / abs(across)
    np.testing.assert_allclose(z, behind / across, rtol=0, atol=slack)
    assert truth.continues[np.flatnonzero(shown)[:-1]].all(), "facets are no creases"
    assert not truth.multiple.any()


def test_a_board_cannot_be_bent_like_a_bow() -> None:
    with pytest.raises(InputError, match=r"board_errors\.bend_z_mm.*5\.0.*at most 4 "):
        board(bend_z_mm=5.0)
    with pytest.raises(InputError, match=r"board_errors\.scale_x_ppm"):
        board(scale_x_ppm=1e5)
    with pytest.raises(InputError, match="beyond the plate"):
        scene_parts(board(dot_noise_mm=30.0))


def test_a_scene_without_a_board_takes_board_errors() -> None:
    """So that one file may state the board's errors for calibration and scan."""
    file = load_rig(SCENES / "paper" / "groove.toml")
    document = {**file.document, "board_errors": {"bend_x_mm": 2.0}}
    assert scene_of(parse_rig(document, source="groove")).tank.board_errors.bend_x_mm == 2.0
