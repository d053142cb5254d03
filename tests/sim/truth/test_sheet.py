"""The truth of misaligned, bowed and several sheets: vectors, symmetries, limits."""

from typing import Any

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from truth_scenes import BOARD, block_mesh, tank

from lscan.config.documents import merge
from lscan.config.targets import GroovedBlock
from lscan.errors import InputError
from lscan.records import Status
from sim.scene import Laser, Pose, Scene, head_pose, rotation, sheet_pose, target_pose
from sim.truth import StripeTruth, project, sheet_of, stripe_truth
from sim.truth.sheet import bow_of, sheet_plane
from sim.truth.surfaces import clip
from sim.truth.visibility import fan_angle, passing_mm
from sim.water import refractive_index

FEW = examples(6)
FEWER = examples(3)
SMALL = st.floats(-8, 8)
ASKEW = st.fixed_dictionaries(
    {
        "apex_mm": st.tuples(st.floats(-60, 60), st.floats(-20, 20), st.floats(400, 600)).map(list),
        "aim_deg": st.floats(-10, 10),
        "tilt_deg": SMALL,
        "skew_deg": SMALL,
        "port_tilt_deg": st.just(0.0) | st.floats(-12, 12),
        "fan_half_angle_deg": st.just(35.0),
    }
)
INDEX = refractive_index(20.0, 0.0, 650.0)


def screen(laser: dict[str, Any], **target: Any) -> Scene:
    """A board leaning back in the sheet's way, nothing else."""
    stand = {"position_mm": [-75.0, 0.0, 0.0], "tilt_x_deg": -40.0}
    board = merge(BOARD, {"plate": {"margin_mm": 150.0}})
    return tank(board=board, target={"shape": "board", **stand, **target}, laser=laser)


def sandwave(laser: dict[str, Any], **sections: Any) -> Scene:
    """The sandwave on a floor."""
    return tank(
        workpiece={"kind": "sandwave"},
        target={"shape": "workpiece", "position_mm": [-75.0, -75.0, -100.0]},
        floor={"z_mm": -140.0},
        laser=laser,
        **sections,
    )


def over(scene: Scene, y: float) -> float:
    """Track position at which the sheet meets the sandwave's level at (0, y) of the world."""
    return float(passing_mm(scene.tank.head, np.array([[0, y, -100.0]]), sheet_of(scene))[0])


def block(laser: dict[str, Any]) -> Scene:
    """The grooved block on a floor."""
    return tank(
        workpiece={"kind": "grooved-block"},
        target={"shape": "workpiece", "position_mm": [-100.0, 0.0, -100.0]},
        floor={"z_mm": -100.0},
        laser=laser,
    )


def points(truth: StripeTruth, chosen: np.ndarray) -> np.ndarray:
    """(N, 3) of the head frame."""
    return np.column_stack([truth.xz_mm[chosen, 0], truth.y_mm[chosen], truth.xz_mm[chosen, 1]])


def fan_rays(laser: Laser, angle: np.ndarray, line: int = 0) -> np.ndarray:
    """(N, 3) unit rays in the water, head frame, of fan angles in the air: Snell in vectors."""
    tilt = np.radians(laser.port_tilt_deg)
    across, normal, ahead = np.eye(3)
    window = np.cos(tilt) * ahead + np.sin(tilt) * normal

    def behind(ray: np.ndarray) -> np.ndarray:
        cosine = ray @ window
        after = np.sqrt(1 - (1 - cosine**2) / INDEX**2)
        return ray / INDEX + np.outer(after - cosine / INDEX, window)

    rays = behind(np.outer(np.sin(angle), across) + np.outer(np.cos(angle), ahead))
    middle = behind(ahead[None])[0]
    side = normal - (normal @ middle) * middle
    own = np.column_stack([rays @ across, rays @ side / np.linalg.norm(side), -rays @ middle])
    return own @ sheet_pose(laser, laser.sheets[line]).rotation.T


@FEW
@given(laser=ASKEW)
def test_the_plane_of_the_sheet_is_the_scene_s(laser):
    laser = tank(laser=laser).tank.laser
    plane, pose = sheet_plane(laser, laser.sheets[0]), sheet_pose(laser, laser.sheets[0])
    assert np.abs(plane.rotation @ rotation("Y", -laser.aim_deg) - pose.rotation).max() < 1e-14
    apex = plane.apply(np.array([laser.apex_mm[0], 0.0, laser.apex_mm[2]]))
    assert apex == pytest.approx(np.array(laser.apex_mm), abs=1e-12)
    ahead = pose.apply(np.array([[0, 0, -100.0], [50.0, 0, -100.0]]))
    angle = fan_angle(laser, plane.invert(ahead)[:, [0, 2]])
    assert angle == pytest.approx([0.0, np.arctan(0.5)], abs=1e-12)


@examples(40)
@given(laser=ASKEW, tilt=st.floats(0.5, 30) | st.floats(-30, -0.5), seed=st.integers(0, 2**31))
def test_the_bow_is_that_of_the_rays(laser, tilt, seed):
    scene = tank(laser={**laser, "port_tilt_deg": tilt})
    angle = np.random.default_rng(seed).uniform(-1.2, 1.2, 200)  # in the air
    distance = np.random.default_rng(seed).uniform(10, 1500, (200, 1))
    head = np.array(laser["apex_mm"]) + distance * fan_rays(scene.tank.laser, angle)
    sheet = sheet_of(scene)
    # 1e-9: a length of 1.5 m, and the square root's loss of digits near the limiting angle.
    assert np.abs(sheet.clearance_mm(head)).max() < 1e-9
    assert np.abs(sheet.in_head(sheet.flatten(head)) - head).max() < 1e-9


@FEW
@given(laser=ASKEW, s=st.floats(-10, 10), turn=st.floats(-10, 10))
def test_a_plane_shows_the_fan_s_rays(laser, s, turn):
    scene = screen(laser, turn_deg=turn)
    truth = stripe_truth(scene, s)
    on = (truth.face == 0) & truth.lit
    assert on.sum() > 100
    pose = target_pose(scene)
    front = head_pose(scene.tank.head, s)
    normal = front.rotation.T @ pose.rotation[:, 1]
    place = front.invert(pose.origin_mm)
    apex = np.array(laser["apex_mm"])
    angle = np.linspace(-0.9, 0.9, 20001)  # in the air: 35 degrees in the water are 0.87
    rays = fan_rays(scene.tank.laser, angle)
    hits = apex + ((place - apex) @ normal / (rays @ normal))[:, None] * rays
    u, v = project(scene, hits).T
    columns = np.flatnonzero(on)
    # Rays 0.05 mm apart, so straight between them to 1e-6 px; the aim is 1e-4 px.
    assert np.abs(np.interp(columns, u, v) - truth.centre_px[on]).max() < 1e-4
    assert np.abs((points(truth, on) - place) @ normal).max() < 1e-4
    assert np.abs(sheet_of(scene).clearance_mm(points(truth, on))).max() < 1e-9


@FEWER
@given(laser=ASKEW, y=st.floats(-60, 60), yaw=st.floats(-3, 3))
def test_the_wave_is_met_on_wave_and_sheet(laser, y, yaw):
    scene = sandwave(laser, head={"yaw_deg": yaw})
    s = over(scene, y)
    truth = stripe_truth(scene, s)
    on = truth.face == 0
    assert on.sum() > 100
    here = points(truth, on)
    pixels = project(scene, here)
    # Pieces of 0.05 mm taken as straight in the picture: 1e-6 px (test_truth_stripe).
    assert np.abs(pixels[:, 0] - np.flatnonzero(on)).max() < 2e-6
    assert np.abs(pixels[:, 1] - truth.centre_px[on]).max() < 2e-6
    x, y, z = target_pose(scene).invert(head_pose(scene.tank.head, s).apply(here)).T
    # The sag of a chord, 0.05 mm squared / 8 times 0.6 /mm, twice for the tilts.
    assert np.abs(z - scene.rig.workpiece.height_mm(x, y)).max() < 2 * 0.05**2 / 8 * 0.6
    assert np.abs(sheet_of(scene).clearance_mm(here)).max() < 1e-9


@FEW
@given(d=st.floats(-30, 30), s=st.floats(-40, 40))
def test_a_laser_set_back_is_a_camera_set_forward(d, s):
    apex = {"apex_mm": [0.0, d, 500.0]}
    here = stripe_truth(sandwave(apex), s)
    camera = {"camera_mm": [0.0, -800.0 - d, 400.0]}
    there = stripe_truth(sandwave({"apex_mm": [0.0, 0.0, 500.0]}, head=camera), s + d)
    # The same light in the same water, only the head frame's origin is elsewhere; where
    # shadows end a column may fall on either side.
    same = here.status == there.status
    assert np.count_nonzero(~same) <= 1
    good = same & (here.status == Status.OK)
    assert np.abs(here.centre_px - there.centre_px)[good].max() < 1e-6
    assert np.abs(here.xz_mm - there.xz_mm)[good].max() < 1e-6
    assert here.y_mm[good] == pytest.approx(d, abs=1e-9)


def test_a_slight_bow_is_next_to_none():
    straight = block({"tilt_deg": 2.0})
    bent = block({"tilt_deg": 2.0, "port_tilt_deg": 1e-7})
    # The bow is 1e-9 of the distance: 1e-6 mm.  Columns at corners and shadows' edges may
    # go either way: a dozen corners.
    a, b = stripe_truth(straight, -20.0), stripe_truth(bent, -20.0)
    same = (a.status == b.status) & (a.face == b.face)
    assert np.count_nonzero(~same) <= 3
    shown = same & (a.status != Status.NO_PEAK)
    assert np.abs(a.centre_px - b.centre_px)[shown].max() < 1e-4


@pytest.mark.slow
def test_a_bowed_sheet_cuts_a_mesh_as_it_cuts_the_shape(tmp_path):
    laser = {"tilt_deg": 3.0, "port_tilt_deg": 8.0}
    path = tmp_path / "block.obj"
    block_mesh(GroovedBlock(), Pose(np.eye(3), np.zeros(3))).export(path)  # eight decimals
    target = {"shape": "mesh", "file": str(path), "position_mm": [-100.0, 0.0, -100.0]}
    a = stripe_truth(block(laser), 0.7)
    b = stripe_truth(tank(target=target, floor={"z_mm": -100.0}, laser=laser), 0.7)
    inner = (a.edge_px >= 1) | (a.status != Status.OK)
    assert np.count_nonzero(a.status[inner] != b.status[inner]) <= 1
    good = inner & (a.status == Status.OK) & (b.status == Status.OK)
    assert good.sum() > 300
    assert np.abs(a.centre_px - b.centre_px)[good].max() < 1e-4


def test_lines_lean_by_their_tilts():
    tilts = [-10.0, 0.0, 10.0]
    lines = [{"tilt_deg": tilt, "share": 0.3} for tilt in tilts]
    scene = tank(laser={"lines": lines}, floor={"z_mm": -100.0})
    for line, tilt in enumerate(tilts):
        truth = stripe_truth(scene, 0.0, line)
        good = truth.status == Status.OK
        assert truth.line == line
        # The floor lies 600 mm beneath the apex.
        assert truth.y_mm[good] == pytest.approx(600 * np.tan(np.radians(tilt)), abs=1e-9)
    with pytest.raises(InputError, match=r"line of the laser.*3.*0 to 2"):
        stripe_truth(scene, 0.0, 3)


def test_a_fan_wider_than_the_window_lets_out_is_refused():
    # sin(48.7 deg) = 1/n: no ray leaves water's side of a window at more, about.
    laser = tank(laser={"fan_half_angle_deg": 50.0, "port_tilt_deg": 3.0}).tank.laser
    with pytest.raises(InputError, match=r"fan_half_angle_deg.*50.*up to 48\.\d degrees"):
        bow_of(laser, INDEX)


def test_pieces_are_clipped_at_every_edge():
    comb = np.array([[0, 0], [5, 0], [5, 2], [4, 2], [4, 1], [1, 1], [1, 2], [0, 2.0]])
    pieces = np.array([[[-1, 1.5], [6, 1.5]], [[2, 0.5], [3, 0.5]], [[2, 3], [3, 3.0]]])
    found = clip(pieces, comb)
    assert found.shape == (3, 2, 2)
    assert found[:2, :, 0] == pytest.approx(np.array([[0, 1], [4, 5]]), abs=1e-12)
    assert np.array_equal(found[2], pieces[1])
