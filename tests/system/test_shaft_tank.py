"""The tank's head on a shaft: poses, truth and renders against closed forms; a scan end to end."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from places import SCENES
from scipy.spatial.transform import Rotation
from truth_scenes import BOARD, in_head, tank

from lscan.acquisition.scan import scan
from lscan.cli.app import app
from lscan.cli.inputs import open_calibrated
from lscan.config.rig import load_rig, parse_rig
from lscan.errors import InputError
from lscan.pipeline import measure_sandwave
from lscan.records import Floats, Status
from sim.demo import stripe_errors
from sim.render.tank import Tank
from sim.scene import (
    Head,
    TrueShaft,
    head_pose,
    into_head,
    into_world,
    load_scene,
    scene_of,
    target_pose,
)
from sim.truth import board_truth, project, slice_visibility, stripe_truth
from sim.truth.visibility import passing_mm

FEW = examples(25)
LEVEL = {"point_mm": [0.0, 0.0, 500.0], "direction": [1.0, 0.0, 0.0]}

shafts = st.builds(
    lambda x, z, yaw, pitch, radius: TrueShaft(
        point_mm=(x, 10.0, z), direction=(1.0, yaw, pitch), arc_radius_mm=radius
    ),
    st.floats(-100, 100),
    st.floats(200, 600),
    st.floats(-0.3, 0.3),
    st.floats(-0.3, 0.3),
    st.floats(20, 500),
)


def head_on(shaft: TrueShaft, yaw_deg: float = 0.0) -> Head:
    return Head(camera_mm=(0.0, -800.0, 400.0), yaw_deg=yaw_deg, shaft=shaft)


@FEW
@given(shafts, st.floats(-5, 5), st.floats(-100, 100), st.integers(0, 99))
def test_the_head_turns_as_scipys_rotation_vectors_do(
    shaft: TrueShaft, yaw_deg: float, arc_mm: float, seed: int
) -> None:
    head, points = head_on(shaft, yaw_deg), np.random.default_rng(seed).uniform(-300, 300, (5, 3))
    assert shaft.arc_radius_mm is not None
    along = np.array(shaft.direction) / np.linalg.norm(shaft.direction)
    turn = Rotation.from_rotvec(arc_mm / shaft.arc_radius_mm * along)
    there = turn.apply(points - shaft.point_mm) + shaft.point_mm
    world = Rotation.from_euler("z", yaw_deg, degrees=True).apply(there)
    np.testing.assert_allclose(head_pose(head, arc_mm).apply(points), world, atol=1e-9)
    np.testing.assert_allclose(into_world(head, points, arc_mm), world, atol=1e-9)
    np.testing.assert_allclose(into_head(head, world, arc_mm), points, atol=1e-9)


def test_on_a_track_the_same_functions_shift() -> None:
    head = Head(camera_mm=(0.0, -800.0, 400.0), yaw_deg=2.0)
    points, position = np.random.default_rng(1).uniform(-300, 300, (3, 3)), np.array([0.0, 5, -7])
    world = into_world(head, points, position)
    for point, s, there in zip(points, position, world, strict=True):
        np.testing.assert_allclose(head_pose(head, s).apply(point), there, atol=1e-12)
    np.testing.assert_allclose(into_head(head, world, position), points, atol=1e-12)


@pytest.mark.parametrize("angle_deg", [-12.0, 0.0, 8.0])
def test_a_floor_under_a_level_shaft_lies_at_its_depth_over_the_cosine(angle_deg: float) -> None:
    """The laser's apex on the shaft: z = 500 - 700 / cos a in the sheet, one height across."""
    scene = tank(shaft=LEVEL, floor={"z_mm": -200.0})
    truth = stripe_truth(scene, angle_deg)
    seen = truth.status == Status.OK
    assert seen.sum() > 300
    depth = 700.0 / np.cos(np.radians(angle_deg))
    np.testing.assert_allclose(truth.xz_mm[seen, 1], 500.0 - depth, atol=1e-9)
    pixels = project(scene, in_head(truth.xz_mm[seen]))
    # As on a track: 0.05 mm pieces, straight to 1e-6 px.
    assert np.abs(pixels[:, 1] - truth.centre_px[seen]).max() < 2e-6


@FEW
@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-12, 12))
def test_the_floor_is_level_whatever_the_shaft(yaw: float, pitch: float, arc_mm: float) -> None:
    true = {"point_mm": [10.0, 5.0, 450.0], "direction": [1.0, yaw, pitch]}
    scene = tank(shaft=LEVEL, head={"shaft": true}, floor={"z_mm": -200.0})
    truth = stripe_truth(scene, arc_mm)
    seen = truth.status == Status.OK
    assert seen.sum() > 200
    world = head_pose(scene.tank.head, arc_mm).apply(in_head(truth.xz_mm[seen]))
    np.testing.assert_allclose(world[:, 2], -200.0, atol=1e-9)


@FEW
@given(shafts, st.integers(0, 99))
def test_the_sheet_passes_a_point_when_it_is_said_to(shaft: TrueShaft, seed: int) -> None:
    head = head_on(shaft, 1.0)
    points = np.random.default_rng(seed).uniform(-100, 100, (20, 3)) - [0, 0, 300]
    arc = passing_mm(head, points)
    assert np.isfinite(arc).all()
    np.testing.assert_allclose(into_head(head, points, arc)[:, 1], 0.0, atol=1e-9)
    assert shaft.arc_radius_mm is not None
    assert np.abs(arc / shaft.arc_radius_mm).max() < np.pi


def test_a_point_beyond_the_sheets_reach_is_never_passed() -> None:
    """The shaft 10 mm off the sheet: what is nearer to it than that is never met."""
    shaft = TrueShaft(point_mm=(0, 10.0, 0), direction=(1, 0, 0), arc_radius_mm=50.0)
    arc = passing_mm(head_on(shaft), np.array([[3.0, 10.0, -9.0], [3.0, 10.0, -11.0]]))
    assert np.isnan(arc[0])
    assert np.isfinite(arc[1])


def test_slices_are_seen_where_the_truth_of_a_picture_sees_them() -> None:
    """Points of the line's truth, asked for as points of a slice."""
    scene = load_scene(SCENES / "shaft" / "sandwave.toml")
    truth = stripe_truth(scene, -4.0)
    world = head_pose(scene.tank.head, -4.0).apply(in_head(truth.xz_mm[truth.status == Status.OK]))
    x, y, _ = target_pose(scene).invert(world).T
    inside = (x > 1) & (x < 149) & (y > 1) & (y < 149)
    assert inside.sum() > 100
    assert slice_visibility(scene, np.column_stack([x, y])[inside]).all()


def test_a_board_is_seen_from_where_the_head_has_turned() -> None:
    scene = tank(shaft=LEVEL, board=BOARD, target={"shape": "board", "position_mm": [-75, 0, 0]})
    still, turned = (board_truth(scene, arc).centres.grid for arc in (0.0, 2.0))
    both = still.found & turned.found
    assert both.sum() > 6
    world = np.column_stack(
        [still.board_mm[:, 0] - 75, 0 * still.board_mm[:, 0], still.board_mm[:, 1]]
    )
    axis = np.array([0, 0, 500])
    by_hand = Rotation.from_euler("x", -2.0, degrees=True).apply(world - axis) + axis
    np.testing.assert_allclose(turned.image_px[both], project(scene, by_hand[both]), atol=1e-9)


def test_without_its_own_the_head_turns_about_the_rigs_shaft() -> None:
    stated = {**LEVEL, "arc_radius_mm": 30.0}
    assert tank(shaft=stated).tank.head.shaft == TrueShaft(
        point_mm=(0, 0, 500), direction=(1, 0, 0), arc_radius_mm=30.0
    )
    true = tank(shaft=stated, head={"shaft": {"point_mm": [1, 0, 0], "direction": [1, 0, 1]}})
    assert true.tank.head.shaft == TrueShaft(
        point_mm=(1, 0, 0), direction=(1, 0, 1), arc_radius_mm=30.0
    )
    assert tank().tank.head.shaft is None


@pytest.mark.parametrize(
    ("sections", "named"),
    [
        ({"head": {"shaft": LEVEL}}, r"head.shaft: needs the section \[shaft\]"),
        ({"shaft": LEVEL, "head": {"speed_mm_s": 1.0}}, "head.speed_mm_s: .*stands still"),
        (
            {"shaft": LEVEL, "head": {"shaft": {**LEVEL, "direction": [0, 0, 0]}}},
            "head.shaft: direction must not be zero",
        ),
        ({"shaft": LEVEL, "head": {"shaft": {"point_mm": [0, 0, 0]}}}, "head.shaft.direction"),
    ],
)
def test_bad_scenes_are_refused(sections: dict[str, Any], named: str) -> None:
    with pytest.raises(InputError, match=named):
        tank(**sections)


def test_a_bowed_sheet_about_a_shaft_has_no_passing() -> None:
    scene = load_scene(SCENES / "shaft" / "sandwave.toml")
    document = {**scene.document, "laser": {**scene.document["laser"], "port_tilt_deg": 5.0}}
    bowed = scene_of(parse_rig(document, source="bowed"))
    with pytest.raises(InputError, match=r"laser.port_tilt_deg: .*bowed"):
        slice_visibility(bowed, np.array([[75.0, 75.0]]))


def test_the_rendered_line_lies_where_the_truth_says() -> None:
    """A noise-free picture of the block at -8 degrees, the head on a leaning shaft."""
    errors = stripe_errors(Tank(load_scene(SCENES / "shaft" / "sandwave.toml")), -8.0, 64, 0)
    assert len(errors) > 200
    # A turn wrong by 0.005 degrees moves the sheet by 0.05 mm at 580 mm, and the line by 0.85 px
    # a mm of that; what curvature, blur and the sheet's thickness displace is less.
    assert np.sqrt(np.mean(errors**2)) < 0.05 * 0.85


def small_scan(folder: Path, frames: int) -> Floats:
    """A run of the scene with fewer pictures, the board's picture, its calibration; and truth."""
    rig_file = load_rig(SCENES / "shaft" / "sandwave.toml")
    document = dict(rig_file.document)
    plan = document["plan"]
    step = plan["step_mm"] * plan["frames"] / frames
    document["plan"] = {**plan, "frames": frames, "step_mm": step}
    document["render"] = {**document.get("render", {}), "samples": 4, "scatter_samples": 0}
    scan(parse_rig(document, source="small"), folder / "run")
    board = load_rig(SCENES / "paper" / "board.toml").document
    board = {**board, "render": {"samples": 16, "scatter_samples": 0}}
    scan(parse_rig(board, source="board", trusted=True), folder / "board")
    shaft = document["head"]["shaft"]
    direction = np.array(shaft["direction"])
    return np.array([shaft["point_mm"], direction / np.linalg.norm(direction)])


@pytest.mark.slow
def test_a_misstated_shaft_is_found_in_the_tank(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """3 mm and 1 degree off, through pictures, commands and files, as a builder would do it."""
    point, direction = small_scan(tmp_path, frames=90)
    run, map_, found = (str(tmp_path / name) for name in ("run", "map.json", "shaft.toml"))

    def lscan(*arguments: str) -> Any:
        app(list(arguments), standalone_mode=False)
        printed = capsys.readouterr().out
        return json.loads(printed) if "--json" in arguments else printed

    lscan("calibrate", str(tmp_path / "board"), "-o", map_)
    fit = lscan("calibrate-shaft", run, "-c", map_, "-o", found, "--json")
    shaft = fit["shaft"]
    sigma_mm = np.array(shaft["offset_sigma_mm"])
    sigma_deg = np.array(shaft["tilt_sigma_deg"])
    # The shaft runs along x to within a degree: its axes are y and z to within that.
    beside = point + direction * (shaft["point_mm"][0] - point[0]) / direction[0]
    off_mm = (np.array(shaft["point_mm"]) - beside)[1:]
    off_deg = np.degrees(np.array(shaft["direction"]) - direction)[1:]
    assert (np.abs(off_mm) < 3 * sigma_mm).all()
    assert (np.abs(off_deg) < 3 * sigma_deg).all()
    assert sigma_mm[1] < 1.0
    assert sigma_deg[0] < 0.1
    assert fit["changes"]["scale"] == {"change": 0.0, "sigma": 0.0, "sigma_before": 0.0}

    stated = lscan("measure", run, "-c", map_, "--json")["sandwave"]
    assert stated["yaw_deg"]["estimated"] is None
    calibrated = measure_sandwave(*open_calibrated(Path(run), Path(map_), Path(found)))
    for name, cut in calibrated.slices.items():
        errors = calibrated.errors[name]
        assert errors.rmse_mm < stated["slices"][name]["rmse_mm"]
        compared = np.isfinite(errors.error_mm)
        within = np.abs(errors.error_mm)[compared] < 3 * cut.sigma_z_mm[compared]
        # 3 sigma hold 99.7 %; neighbours err together, so that one stretch of a wave's slope (a
        # quarter of its 37.6 mm in 150 mm) may lie outside at once.
        assert within.mean() > 1 - 0.25 * 37.6 / 150
    surface = lscan("reconstruct", run, "-c", map_, "-o", str(tmp_path / "s.nc"), "--json")
    assert surface["frame"] == "workpiece"
    assert surface["yaw_deg"] is None
