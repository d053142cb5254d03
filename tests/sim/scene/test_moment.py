"""Numbers that change from picture to picture, and errors of the track: draws, poses, pictures."""

from dataclasses import replace
from math import exp, pi, radians, sin, sqrt

import numpy as np
import pytest
from hypothesis import given, strategies as st
from places import SCENES

from lscan.config.rig import load_rig, parse_rig
from lscan.errors import InputError
from sim.devices import SimCamera, SimTrack, TrackOptions
from sim.render.tank import Tank
from sim.scene import Scene, at_moment, head_pose, load_scene, scene_of, track_pose
from sim.scene.errors import TrackErrors
from sim.scene.varying import Change
from sim.truth import sheet_of, stripe_truth

DRAWS = 2000
SIGMAS = 5.0  # of a statistic's own standard deviation: by chance beyond once in two million


def changing(*changes: dict, document: dict | None = None, **errors: float) -> Scene:
    """The paper's groove at 160 by 120 px, with changes and errors of the track."""
    whole = dict(load_rig(SCENES / "paper" / "groove.toml").document)
    whole["lens"] = {**whole["lens"], "focal_px": 212.5, "centre_px": [79.5, 59.5]}
    whole["camera"] = {**whole["camera"], "width_px": 160, "height_px": 120}
    whole["render"] = {"scatter_samples": 0}
    whole |= {"change": list(changes), "track_errors": errors, **(document or {})}
    return scene_of(parse_rig(whole, source="small"))


def offsets(**keys: object) -> np.ndarray:
    """(DRAWS,) offsets of the pictures of a change of the sheet's tilt."""
    change = Change(key="laser.tilt_deg", **keys)
    return np.array([change.offset(frame, 0.0) for frame in range(DRAWS)])


def picture(scene: Scene, frame: int, position_mm: float = 20.0, dark: bool = False) -> bytes:
    track = SimTrack(TrackOptions())
    track.move_to(position_mm)
    return SimCamera(scene, track).grab(frame, dark).image.tobytes()


@pytest.mark.parametrize(
    ("kind", "sd", "kurtosis"),
    [({"normal": 0.2}, 0.2, 3.0), ({"uniform": 0.3}, 0.3 / sqrt(3), 1.8)],
)
def test_mean_and_spread_of_white_draws(kind: dict, sd: float, kurtosis: float) -> None:
    """Mean within sd/sqrt(N), variance within sd2 sqrt((kurtosis - 1)/N), times SIGMAS."""
    drawn = offsets(**kind)
    assert abs(drawn.mean()) < SIGMAS * sd / sqrt(DRAWS)
    assert abs(drawn.var() / sd**2 - 1) < SIGMAS * sqrt((kurtosis - 1) / DRAWS)


def test_correlated_draws_are_autoregressive() -> None:
    """Lag-1 residuals are white with variance 1 - r2, so r is known to sqrt((1 - r2)/N)."""
    drawn, kept = offsets(normal=1.0, correlation=4.0), exp(-1 / 4)
    found = (drawn[1:] @ drawn[:-1]) / (drawn @ drawn)
    assert abs(found - kept) < SIGMAS * sqrt((1 - kept**2) / DRAWS)
    rest = drawn[1:] - kept * drawn[:-1]
    assert abs(rest.var() / (1 - kept**2) - 1) < SIGMAS * sqrt(2 / DRAWS)
    assert abs(rest[1:] @ rest[:-1] / (rest @ rest)) < SIGMAS / sqrt(DRAWS)


def test_values_come_by_their_odds() -> None:
    """A binomial count, within SIGMAS of its standard deviation."""
    drawn = offsets(values=[-0.3, 0.0, 0.3], weights=[1, 2, 1])
    for value, share in ((-0.3, 0.25), (0.0, 0.5), (0.3, 0.25)):
        spread = sqrt(share * (1 - share) / DRAWS)
        assert abs(np.mean(drawn == value) - share) < SIGMAS * spread


def test_a_sine_is_one_of_pictures_or_of_travel() -> None:
    by_picture = Change(key="sensor.gain", sine=0.1, period=8.0, phase_deg=30.0)
    by_travel = Change(key="sensor.gain", sine=0.1, period_mm=8.0)
    assert by_picture.offset(3, 99.0) == pytest.approx(0.1 * sin(2 * pi * 3 / 8 + pi / 6))
    assert by_travel.offset(99, 3.0) == pytest.approx(0.1 * sin(2 * pi * 3 / 8))


def test_numbers_are_added_or_multiplied() -> None:
    scene = changing(
        {"key": "laser.power_mw", "sine": 0.1, "period": 4.0, "relative": True},
        {"key": "head.camera_mm.2", "sine": 0.5, "period": 4.0},
        {"key": "camera.exposure_ms", "sine": 2.0, "period": 4.0},
    )
    at = at_moment(scene, 1, 0.0).scene
    assert at.tank.laser.power_mw == pytest.approx(1.1 * scene.tank.laser.power_mw)
    moved = np.subtract(at.tank.head.camera_mm, scene.tank.head.camera_mm)
    assert moved == pytest.approx([0, 0, 0.5])
    assert at.rig.camera.exposure_ms == pytest.approx(scene.rig.camera.exposure_ms + 2)
    assert at_moment(at, 7, 3.0) == type(at_moment(at, 7, 3.0))(at, 3.0), "nothing is left to do"


def test_the_head_goes_where_the_track_errs() -> None:
    """Scale, screw, backlash by direction, a lost step; angles and bow are 0 at position 0."""
    plan = changing().rig.plan
    forwards, back = (plan.model_copy(update={"step_mm": step}) for step in (0.5, -0.5))
    errors = TrackErrors(scale_ppm=100.0, periodic_mm=0.05, phase_deg=90.0)
    assert errors.true_mm(forwards, 1, 200.0) == pytest.approx(200.02 + 0.05)
    assert errors.true_mm(forwards, 1, 204.0) == pytest.approx(204.0204 - 0.05)
    loose = TrackErrors(backlash_mm=0.1)
    found = [loose.true_mm(forwards, frame, -10.0) for frame in (0, 1)]
    assert found == pytest.approx([-9.9, -10.0]), "reached backwards from 0, then forwards"
    assert loose.true_mm(back, 0, 10.0) == 10.0
    assert loose.true_mm(back, 1, 9.5) == pytest.approx(9.6)
    lost = TrackErrors(lost_step_mm=0.02, lost_at_mm=5.0)
    assert [lost.true_mm(forwards, 1, s) - s for s in (4.0, 6.0)] == pytest.approx([0, -0.02])
    assert [lost.true_mm(back, 1, s) - s for s in (6.0, 4.0)] == pytest.approx([0, 0.02])
    bowed = TrackErrors(bow_z_mm=0.3, bow_length_mm=600.0, pitch_deg_per_m=2.0)
    assert bowed.shift_mm(300.0) == pytest.approx([0, 0, 0.3])
    assert bowed.turn_deg(500.0) == pytest.approx([1, 0, 0])


def test_noise_of_the_position() -> None:
    """Bounds as for white draws."""
    errors, plan = TrackErrors(noise_mm=0.02), changing().rig.plan
    drawn = np.array([errors.true_mm(plan, frame, 5.0) - 5.0 for frame in range(DRAWS)])
    assert abs(drawn.mean()) < SIGMAS * 0.02 / sqrt(DRAWS)
    assert abs(drawn.var() / 0.02**2 - 1) < SIGMAS * sqrt(2 / DRAWS)


@given(s=st.floats(-200, 200), yaw=st.floats(-2, 2), bow=st.floats(-1, 1))
def test_the_pivot_stays_on_the_way(s: float, yaw: float, bow: float) -> None:
    """Whatever angles there are, the point turned about is off by scale and bow alone: rounding."""
    scene = changing(document={}, yaw_deg_per_m=yaw, roll_deg_per_m=yaw, bow_x_mm=bow)
    scene = scene.with_tank(head={"pivot_mm": (10.0, -40.0, 600.0)})
    at, pivot = at_moment(scene, 0, s), np.array([10.0, -40.0, 600.0])
    there = head_pose(at.scene.tank.head, at.position_mm).apply(pivot)
    nominal = head_pose(scene.tank.head, s).apply(pivot)
    assert there - nominal == pytest.approx([bow * (2 * s / 1000) ** 2, 0, 0], abs=1e-9)


def test_the_truth_of_a_flat_floor_moves_as_geometry_says() -> None:
    """A head that pitches by a about O meets a level floor, h below, in its sheet at y = 0.

    Off the pivot the sheet's foot moves by h tan a along the track; the distance down the sheet
    grows by 1/cos a.  Exact, so rounding alone.
    """
    floor = {"target": {"shape": "none"}, "floor": {"z_mm": -30.0}}
    scene = changing(document=floor, pitch_deg_per_m=5.0, scale_ppm=1000.0)
    at = at_moment(scene, 1, 100.0)
    truth = stripe_truth(at.scene, at.position_mm)
    points = np.column_stack([truth.xz_mm[:, 0], truth.y_mm, truth.xz_mm[:, 1]])[truth.lit]
    assert len(points)
    assert sheet_of(at.scene).pose.rotation[:, 1] == pytest.approx([0, 1, 0])
    angle, height = radians(0.5), 30.0
    assert points[:, 2] == pytest.approx(-height / np.cos(angle), abs=1e-9)
    head = at.scene.tank.head
    assert at.position_mm == pytest.approx(100.1)
    held = track_pose(head, 100.1).invert(head_pose(head, 100.1).apply(points))
    assert held[:, 1] == pytest.approx(height * np.tan(angle), abs=1e-9)


def test_zero_changes_are_the_same_bytes() -> None:
    still = changing(
        {"key": "laser.tilt_deg", "normal": 0.0},
        {"key": "head.turn_deg.0", "uniform": 0.0, "correlation": 5.0},
        {"key": "laser.power_mw", "values": [0.0], "relative": True},
        {"key": "head.camera_mm.1", "sine": 0.0, "period": 3.0},
    )
    assert picture(still, 3) == picture(changing(), 3)


def test_a_picture_alone_is_that_of_a_scan() -> None:
    """Changes of every kind of cost; gathered light; backgrounds have their frame's numbers."""
    scene = changing(
        {"key": "laser.tilt_deg", "normal": 0.05, "correlation": 2.0},
        {"key": "head.depression_deg", "normal": 0.02},
        {"key": "laser.wavelength_nm", "values": [-0.3, 0.3]},
        {"key": "sensor.gain", "uniform": 0.1, "relative": True},
        noise_mm=0.05,
        document={"render": {"samples": 1}},
    )
    track = SimTrack(TrackOptions())
    camera = SimCamera(scene, track)
    for frame in range(2):
        track.move_to(20.0 + frame)
        scanned = camera.grab(frame).image.tobytes()
        camera.grab(frame, dark=True)
    assert scanned == picture(scene, 1, 21.0)
    assert scanned != picture(replace(scene, tank=changing().tank), 1, 21.0)


def test_gathered_light_is_nearly_that_of_a_tank_made_anew() -> None:
    """The first order is exact, all else within a tenth of a grey value of a line at 255 DN."""
    scene = changing(
        {"key": "head.depression_deg", "normal": 0.02}, document={"render": {"samples": 1}}
    )
    at = at_moment(scene, 1, 20.0)
    tank, anew = Tank(scene), Tank(at.scene)
    tank.take(at.scene)
    found, expected = (here.render(at.position_mm) for here in (tank, anew))
    peak = expected.direct.max()
    assert expected.scattered.any()
    assert np.abs(found.direct - expected.direct).max() < 1e-6 * peak  # float32
    assert np.abs(found.scattered - expected.scattered).max() < 0.1 / 255 * peak


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"key": "water.salinity_psu", "normal": 1.0}, r"change\.0\.key.*head\.turn_deg\.0"),
        ({"key": "laser.tilt_deg", "sine": 1.0}, "sine goes with one of period and period_mm"),
        ({"key": "laser.power_mw", "normal": 0.2, "relative": True}, r"laser\.power_mw"),
        ({"key": "light.ambient_w_m2_sr", "normal": 0.0}, "no light is there to change"),
    ],
)
def test_wrong_changes_are_refused(change: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        changing(change)


def test_two_draws_from_one_seed_are_refused() -> None:
    change = {"key": "laser.tilt_deg", "normal": 0.1}
    with pytest.raises(InputError, match="drawn twice from one seed"):
        changing(change, change)


def test_scenes_without_changes_come_back_as_they_are() -> None:
    scene = load_scene("paper/groove")
    assert at_moment(scene, 5, 3.0).scene is scene
