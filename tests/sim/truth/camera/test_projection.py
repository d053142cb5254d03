"""The truth's projection: published values, OpenCV, an independent trace through the port."""

import cv2
import numpy as np
import pytest
from camera_strategies import FLAT_PORT, LENS
from drawn_examples import examples
from hypothesis import given, strategies as st
from truth_scenes import tank

from lscan.errors import InputError
from sim.scene import Lens, PlanePort, Pose, Scene, camera_pose, rotation
from sim.truth import project
from sim.truth.camera import (
    TrueCamera,
    camera_of,
    crossed_at,
    entry_points,
    flat_normal,
    fold_radius,
    image,
    rays_to,
)
from sim.water import refractive_index

MANY = examples(60)
LENSES, PORTS = st.builds(Lens, **LENS), st.builds(PlanePort, **FLAT_PORT)
ANGLE = st.floats(-180, 180)


@st.composite
def poses(draw: st.DrawFn) -> Pose:
    turned = rotation("ZXY", [draw(ANGLE), draw(ANGLE), draw(ANGLE)])
    return Pose(turned, np.array([draw(st.floats(-500, 500)) for _ in range(3)]))


CAMERAS = st.builds(
    TrueCamera, pose=poses(), lens=LENSES, port=PORTS, water_index=st.floats(1.33, 1.345)
)


def points_before(camera: TrueCamera, seed: int, count: int = 40) -> np.ndarray:
    """(N, 3) points in the water within some 30 degrees of the axis, head frame."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(250, 3000, count)
    tangents = rng.uniform(-0.4, 0.4, (2, count))
    return camera.pose.apply(np.column_stack([*(tangents * z), z]))


def refract(direction: np.ndarray, normal: np.ndarray, ratio: float) -> np.ndarray:
    """Unit rays behind a face: Snell's law in vectors; ratio = index before / index after."""
    cosine = direction @ normal
    after = np.sqrt(1 - ratio**2 * (1 - cosine**2))
    return ratio * direction + np.outer(after - ratio * cosine, normal)


def trace(camera: TrueCamera, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays of a direction in air (camera frame) enter the water, and their direction."""
    port, normal = camera.port, flat_normal(camera.port)
    air = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    glass = refract(air, normal, 1 / port.glass_index)
    water = refract(glass, normal, port.glass_index / camera.water_index)
    entry = air * (port.gap_mm / (air @ normal))[:, None]
    entry = entry + glass * (port.thickness_mm / (glass @ normal))[:, None]
    return entry, water


@pytest.mark.parametrize(
    ("r_mm", "z_mm", "tangent"),
    [
        (300.0, 1000.0, 0.412659913867),
        (50.0, 1000.0, 0.066450567346),
        (400.0, 500.0, 1.454784819992),
        (800.0, 1000.0, 1.475503390053),
    ],
)
def test_the_check_values_of_the_port(r_mm, z_mm, tangent):
    # docs/explanation/physics.md, section 6: 10 mm of air, 6 mm of glass, n = 1 / 1.49 / 1.3313.
    port = PlanePort(gap_mm=10.0, thickness_mm=6.0, glass_index=1.49)
    inner, _ = crossed_at(port, 1.3313, np.array([r_mm]), np.array([z_mm - 16.0]))
    assert inner[0] / port.gap_mm == pytest.approx(tangent, abs=1e-10)


@MANY
@given(lens=LENSES, pose=poses(), seed=st.integers(0, 2**31))
def test_without_refraction_it_is_opencv(lens, pose, seed):
    camera = TrueCamera(pose, lens, PlanePort(glass_index=1.0, tilt_x_deg=5.0), water_index=1.0)
    points = points_before(camera, seed)
    local = pose.invert(points)
    found = image(camera, rays_to(camera, points).direction)
    matrix = np.array(
        [[lens.focal_px, 0, lens.centre_px[0]], [0, lens.focal_px, lens.centre_px[1]], [0, 0, 1]]
    )
    expected, _ = cv2.projectPoints(
        local,
        np.zeros(3),
        np.zeros(3),
        matrix,
        np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3]),
    )
    folded = np.isnan(found[:, 0])
    radius = np.linalg.norm(local[:, :2] / local[:, 2:], axis=1)
    assert np.array_equal(folded, radius >= fold_radius(lens))
    assert np.abs(found - expected[:, 0])[~folded].max(initial=0) < 1e-9


@MANY
@given(camera=CAMERAS, seed=st.integers(0, 2**31))
def test_the_ray_found_passes_through_the_point(camera, seed):
    points = points_before(camera, seed)
    rays = rays_to(camera, points)
    entry, water = trace(camera, rays.direction)
    local = camera.pose.invert(points)
    miss = np.linalg.norm(np.cross(local - entry, water), axis=1)
    assert miss.max() < 1e-9
    # 1e-10: twelve digits of an entry some 100 mm away.
    assert np.abs(entry - rays.entry_mm).max() < 1e-10


def test_the_axis_meets_the_principal_point():
    scene = tank()
    pose = camera_pose(scene.tank.head)
    pixel = project(scene, pose.apply(np.array([[0, 0, 700.0]])))
    assert pixel[0] == pytest.approx(scene.tank.lens.centre_px, abs=1e-10)


def test_the_water_is_that_of_the_scene():
    scene = tank(water={"temperature_c": 5.0, "salinity_psu": 30.0})
    assert camera_of(scene).water_index == refractive_index(5.0, 30.0, 650.0)


def test_the_camera_moves_with_its_points():
    near, far = tank(), tank(head={"camera_mm": [30.0, -750.0, 380.0]})
    points = np.array([[0.0, 0, 0], [150.0, 0, -200.0], [-80.0, 20.0, 60.0]])
    by = np.array([30.0, 50.0, -20.0])
    moved = points + by
    assert np.allclose(project(near, points), project(far, moved), rtol=0, atol=1e-9)
    assert np.allclose(entry_points(near, points) + by, entry_points(far, moved), atol=1e-9)


def test_what_cannot_be_imaged_has_no_pixel():
    scene = tank(port={"gap_mm": 10.0, "thickness_mm": 6.0})
    pose = camera_pose(scene.tank.head)
    local = np.array([[0, 0, 15.999], [0, 0, 16.001], [0, 0, -500.0], [5.0, 0, 0]])
    shown = np.isfinite(project(scene, pose.apply(local)))
    assert shown.tolist() == [[False, False], [True, True], [False, False], [False, False]]
    assert np.isfinite(entry_points(scene, pose.apply(local))).all(axis=1).tolist() == [
        False,
        True,
        False,
        False,
    ]


@pytest.mark.parametrize("k1", [-1e-300, -2.2e-313, 1e-313])
def test_a_distortion_next_to_none_is_none(k1):
    """The fold's radius is then so large that its square is no number any more."""
    lens = Lens(focal_px=100.0, centre_px=(0.0, 0.0), k1=k1)
    camera = TrueCamera(Pose(np.eye(3), np.zeros(3)), lens, PlanePort(), 1.33)
    assert image(camera, np.array([[0.5, -0.25, 1.0]])).tolist() == [[50.0, -25.0]]


def test_no_pixel_beyond_the_fold_of_the_distortion():
    # r (1 - r2/12) turns at 1 = 3 r2/12: r = 2.
    lens = Lens(focal_px=100.0, centre_px=(0.0, 0.0), k1=-1 / 12)
    camera = TrueCamera(Pose(np.eye(3), np.zeros(3)), lens, PlanePort(), 1.33)
    assert fold_radius(lens) == pytest.approx(2.0, abs=1e-12)
    pixels = image(camera, np.array([[1.999, 0, 1.0], [2.001, 0, 1.0]]))
    assert np.isfinite(pixels[:, 0]).tolist() == [True, False]


def test_a_lens_that_folds_beyond_all_numbers_does_not_fold() -> None:
    lens = Lens(focal_px=300.0, centre_px=(200.0, 150.0), k2=0.06, k3=-2e-313)
    assert fold_radius(lens) == np.inf


@pytest.mark.parametrize(
    "points", [np.zeros((3, 2)), np.zeros(3), np.array([[0, np.nan, 0.0]]), np.full((1, 3), np.inf)]
)
def test_bad_points_are_refused(points):
    scene: Scene = tank()
    with pytest.raises(InputError, match=r"points to project.*finite"):
        project(scene, points)
