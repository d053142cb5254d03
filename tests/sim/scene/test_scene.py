"""Scene files: what they merge, what they refuse, and the frames they define."""

from pathlib import Path

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from places import SCENES

from lscan.errors import InputError
from sim.scene import Head, camera_pose, head_pose, load_scene, target_pose
from sim.scene.instrument import response_at

PAPER = SCENES / "paper"
NAMES = ["board", "groove", "sandwave"]


def test_the_papers_scenes_share_one_rig() -> None:
    board, groove, sandwave = (load_scene(PAPER / f"{name}.toml") for name in NAMES)
    for other in (groove, sandwave):
        for section in ("lens", "head", "port", "water", "sensor"):
            assert getattr(other.tank, section) == getattr(board.tank, section)
        assert other.rig.board == board.rig.board
    assert not board.tank.laser.on
    assert groove.tank.laser.on


def variant(tmp_path: Path, old: str, new: str, name: str = "groove") -> Path:
    """The scene with one text replaced, its include made absolute."""
    text = (PAPER / f"{name}.toml").read_text() + "\n[sensor]\n"
    assert old in text
    path = tmp_path / "scene.toml"
    path.write_text(text.replace(old, new).replace('"rig.toml"', f'"{PAPER / "rig.toml"}"'))
    return path


@pytest.mark.parametrize(
    ("nm", "brightest"), [(450, "blue"), (520, "green"), (532, "green"), (635, "red"), (650, "red")]
)
def test_a_webcam_sees_a_laser_in_its_own_colour(tmp_path: Path, nm: int, brightest: str) -> None:
    scene = load_scene(variant(tmp_path, "[sensor]", f"[laser]\nwavelength_nm = {nm}\n[sensor]"))
    response = scene.tank.sensor.laser_response
    shares = {colour: getattr(response, colour) for colour in ("red", "green", "blue")}
    assert max(shares, key=lambda colour: shares[colour]) == brightest
    if nm == 650:  # the paper's webcam, to the last bit
        assert shares == {"red": 0.40, "green": 0.03, "blue": 0.01}


def test_a_response_that_is_stated_is_kept(tmp_path: Path) -> None:
    stated = "laser_response = { red = 0.4, green = 0.03, blue = 0.01 }"
    text = f"[laser]\nwavelength_nm = 520\n[sensor]\n{stated}"
    assert load_scene(variant(tmp_path, "[sensor]", text)).tank.sensor.laser_response.red == 0.4


@given(nm=st.floats(400, 699))
def test_the_response_has_no_jump(nm: float) -> None:
    """Steepest between 560 and 580 nm, where red pixels begin to see: 0.0136 a nanometre."""
    one, next_to_it = response_at(nm), response_at(nm + 0.1)
    for colour in ("red", "green", "blue"):
        assert abs(getattr(one, colour) - getattr(next_to_it, colour)) < 0.1 * 0.02


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("samples = 16", "samples = 15", r"render.*square number"),
        ("step_mm = 0.5", "step_mm = 1e6", r"leaves the track's travel.*-1000 to 1000 mm"),
        ("[sensor]", "[board.grid]\ndot_diameter_mm = 49.0", r"marks overlap at"),
        (
            "[sensor]",
            "[[board.ring]]\nname='X'\nx_mm=0\nz_mm=0\ndiameter_mm=100",
            r"ring X runs over",
        ),
        (
            "[sensor]",
            "[[board.ruler]]\ndirection='vertical'\nat_mm=1\nfirst_mm=0\nlast_mm=9\n"
            "step_mm=1e-9\nmark_diameter_mm=1e-10",
            r"at most 10000 marks",
        ),
        ("[floor]", "[flor]", r"flor: unknown section"),
        ("[sensor]", '[port]\nkind = "dome"\ncentre_mm = [0, 0, 80]', r"centre_mm must lie"),
        ("[sensor]", '[water]\nkind = "coastal"\nscattering_per_m = 1.0', r"exclude each other"),
        ("[sensor]", "[lens]\nk1 = -3.0", r"folds the picture"),
        ("[sensor]", '[camera]\ndriver = "kodak"', r"no such camera.*kodak.*sim"),
        ("[sensor]", "[board]\nfile = 'nowhere.toml'", r"nowhere\.toml.*cannot be read"),
        ("[sensor]", "[sensor", r"not valid TOML"),
    ],
)
def test_one_wrong_field_is_one_clear_line(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    path = variant(tmp_path, old, new)
    with pytest.raises(InputError, match=message) as caught:
        from lscan.config.rig import load_rig

        load_rig(path)
    assert "\n" not in str(caught.value)


def test_a_missing_section_is_named(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text('[camera]\ndriver = "sim"\n[track]\ndriver = "sim"\n')
    with pytest.raises(InputError, match=r"lens: field required; see also head, laser, target \("):
        load_scene(path)


@pytest.mark.parametrize(
    ("added", "message"),
    [
        ("", r"target: field required: this is a rig in the tank with nothing to scan"),
        ("[water]\ntemperature_c = -500", r"water\.temperature_c: must be .*-500"),
        ("[sensor]\nprnu = -0.1\n[target]\nalbedo = 0.5", r"target\.shape: field required"),
    ],
)
def test_nothing_to_scan_is_said_where_the_target_alone_is_missing(
    tmp_path: Path, added: str, message: str
) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(f'include = "{PAPER / "rig.toml"}"\n{added}\n')
    with pytest.raises(InputError, match=message) as caught:
        load_scene(path)
    assert ("nothing to scan" in str(caught.value)) == (added == "")


def test_a_scene_that_includes_itself(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text('include = "scene.toml"\n')
    with pytest.raises(InputError, match="includes itself"):
        load_scene(path)


def test_the_camera_looks_down_at_the_sheet_from_a_metre() -> None:
    """The axis of the paper's camera meets the sheet 1 m away, 30 degrees below the horizon."""
    head = load_scene(PAPER / "board.toml").tank.head
    pose = camera_pose(head)
    right, down, forward = pose.rotation.T
    assert right == pytest.approx([1, 0, 0])
    assert forward == pytest.approx([0, np.cos(np.radians(30)), -0.5])
    assert down[2] < 0
    reach = -pose.origin_mm[1] / forward[1]
    assert reach == pytest.approx(1000, abs=1e-3)


@examples(50)
@given(yaw=st.floats(-40, 40), position=st.floats(-500, 500))
def test_the_track_runs_along_y_and_the_sheet_is_yawed(yaw: float, position: float) -> None:
    """In the head frame the track's direction is (sin yaw, cos yaw, 0)."""
    head = Head(camera_mm=(0, 0, 0), yaw_deg=yaw)
    start, moved = head_pose(head, position), head_pose(head, position + 1)
    np.testing.assert_allclose(moved.origin_mm - start.origin_mm, [0, 1, 0], atol=1e-12)
    track_in_head = start.rotation.T @ [0, 1, 0]
    angle = np.radians(yaw)
    np.testing.assert_allclose(track_in_head, [np.sin(angle), np.cos(angle), 0], atol=1e-12)


@examples(30)
@given(
    depression=st.floats(-80, 80), heading=st.floats(-180, 180), roll=st.floats(-180, 180),
    x=st.floats(-1e3, 1e3),
)  # fmt: skip
def test_poses_are_rigid_and_invert(
    depression: float, heading: float, roll: float, x: float
) -> None:
    pose = camera_pose(
        Head(camera_mm=(x, 2, 3), depression_deg=depression, heading_deg=heading, roll_deg=roll)
    )
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose.rotation) == pytest.approx(1)
    points = np.array([[1.0, 2, 3], [x, -x, 0]])
    np.testing.assert_allclose(pose.invert(pose.apply(points)), points, atol=1e-9)
    inner = camera_pose(Head(camera_mm=(3, 2, 1), depression_deg=20.0, heading_deg=50.0))
    both = pose.apply(inner.apply(points))
    np.testing.assert_allclose((pose @ inner).apply(points), both, atol=1e-9)


def test_the_board_lies_in_the_sheet() -> None:
    scene = load_scene(PAPER / "board.toml")
    head = head_pose(scene.tank.head, 0.0)
    points = np.array([[0.0, 0, 0], [450, 0, -450]])
    np.testing.assert_allclose(head.invert(target_pose(scene).apply(points)), points, atol=1e-9)
