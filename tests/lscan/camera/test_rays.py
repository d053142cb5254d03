"""Ray geometry: published and computed values, Snell's law, round trips, refusals."""

import cv2
import numpy as np
import pytest
from camera_strategies import FISHEYE, FLAT_PORT, LENS, RATIONAL
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.camera import CameraModel, PortModel, project, rays
from lscan.camera.optics import fold_radius
from lscan.errors import InputError
from lscan.records import Floats

MANY = examples(60)
PORTS = st.builds(PortModel, **FLAT_PORT, water_index=st.floats(1.0, 1.345))
CAMERAS = (
    st.builds(CameraModel, **LENS, port=st.none() | PORTS)
    | st.builds(CameraModel, **RATIONAL, port=st.none() | PORTS)
    | st.builds(CameraModel, **FISHEYE, fisheye=st.just(True), port=st.none() | PORTS)
)


def points_ahead(seed: int, count: int = 60) -> Floats:
    """(N, 3) points within some 22 degrees of the axis, beyond any of the ports."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(200.0, 3000.0, count)
    return np.column_stack([*(rng.uniform(-0.28, 0.28, (2, count)) * z), z])


@pytest.mark.parametrize(
    ("r", "z", "tangent"),
    [
        (0.3, 1.0, 0.412659913867),
        (0.05, 1.0, 0.066450567346),
        (0.4, 0.5, 1.454784819992),
        (0.8, 1.0, 1.475503390053),
    ],
)
def test_computed_values(r: float, z: float, tangent: float) -> None:
    """The 12 digits of docs/explanation/physics.md, section 6: 10 mm of air, 6 mm of glass."""
    camera = CameraModel(1.0, (0.0, 0.0), port=PortModel(10.0, 6.0, 1.49, 1.3313))
    for direction in ([1.0, 0.0], [0.6, -0.8]):
        point = np.array([[*(1000 * r * np.array(direction)), 1000 * z]])
        expected = tangent * np.array(direction)
        np.testing.assert_allclose(project(camera, point)[0], expected, rtol=0, atol=1e-12)


@MANY
@given(camera=CAMERAS, seed=st.integers(0, 1000), on=st.floats(1.0, 5000.0))
def test_round_trip(camera: CameraModel, seed: int, on: float) -> None:
    """A pixel's ray, followed any way into the water, is seen in that pixel: to 1e-9 px, the
    rounding of coordinates of 1e3 px and 1e3 mm with a few digits to spare."""
    pixels = project(camera, points_ahead(seed))
    imaged = np.isfinite(pixels).all(axis=1)
    # Close to the fold the inverse is ill-posed; k1 alone brings it to 2/3 in the picture.
    near_axis = np.linalg.norm((pixels - camera.centre_px) / camera.focal_px, axis=1)
    pixels = pixels[imaged & (near_axis < 0.6 * fold_radius(camera))]
    seen = rays(camera, pixels)
    valued = np.isfinite(seen.direction).all(axis=1)
    assert valued.all()
    again = project(camera, seen.origin_mm + on * seen.direction)
    np.testing.assert_allclose(again, pixels, rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(seen.direction, axis=1), 1.0, rtol=0, atol=1e-14)


@MANY
@given(camera=CAMERAS, seed=st.integers(0, 1000))
def test_rays_pass_through_the_points(camera: CameraModel, seed: int) -> None:
    """The distance of a point from its pixel's ray: 1e-12 of 3000 mm times what a wide port
    and a strong lens magnify it by."""
    points = points_ahead(seed)
    seen = rays(camera, project(camera, points))
    off = np.cross(points - seen.origin_mm, seen.direction)
    valued = np.isfinite(off).all(axis=1)
    assert np.linalg.norm(off[valued], axis=1).max(initial=0.0) < 1e-7


@MANY
@given(port=PORTS, seed=st.integers(0, 1000))
def test_snell_at_both_faces(port: PortModel, seed: int) -> None:
    """n sin(theta) is the same in air and water, the ray stays in the plane of incidence and
    leaves the glass where gap, glass and Snell's law put it."""
    camera = CameraModel(800.0, (320.0, 240.0), port=port)
    pixels = np.random.default_rng(seed).uniform(0, 1, (50, 2)) * [640, 480]
    air = np.column_stack([(pixels - [320, 240]) / 800, np.ones(50)])
    air /= np.linalg.norm(air, axis=1)[:, None]
    seen = rays(camera, pixels)
    sine_air = np.cross(air, port.normal)
    sine_water = np.cross(seen.direction, port.normal)
    np.testing.assert_allclose(sine_air, port.water_index * sine_water, rtol=0, atol=1e-13)
    height = seen.origin_mm @ port.normal
    np.testing.assert_allclose(height, port.gap_mm + port.thickness_mm, rtol=0, atol=1e-11)
    sine = np.linalg.norm(sine_air, axis=1)
    angle_air, angle_glass = np.arcsin(sine), np.arcsin(sine / port.glass_index)
    beside = port.gap_mm * np.tan(angle_air) + port.thickness_mm * np.tan(angle_glass)
    found = np.linalg.norm(np.cross(seen.origin_mm, port.normal), axis=1)
    np.testing.assert_allclose(found, beside, rtol=0, atol=1e-11)


@MANY
@given(camera=CAMERAS, seed=st.integers(0, 1000))
def test_in_air_it_is_opencv(camera: CameraModel, seed: int) -> None:
    """OpenCV's two projectPoints, the definition of the distortion's parameters."""
    air = CameraModel(**{**camera.__dict__, "port": None})
    points = points_ahead(seed)
    tangents = np.linalg.norm(points[:, :2] / points[:, 2:], axis=1)
    points = points[tangents < 0.99 * fold_radius(air)]
    u, v = air.centre_px
    matrix = np.array([[air.focal_px, 0, u], [0, air.focal_px, v], [0, 0, 1.0]])
    still = np.zeros(3)
    if air.fisheye:
        lens = np.array([air.k1, air.k2, air.k3, air.k4])
        expected, _ = cv2.fisheye.projectPoints(points[:, None], still, still, matrix, lens)
    else:
        lens = np.array([air.k1, air.k2, air.p1, air.p2, air.k3, air.k4, air.k5, air.k6])
        expected, _ = cv2.projectPoints(points, still, still, matrix, lens)
    np.testing.assert_allclose(project(air, points), expected.reshape(-1, 2), rtol=0, atol=1e-9)


def test_a_rational_lens_ends_at_its_pole() -> None:
    """r / (1 - q/4) grows without bound up to r = 2, r / (1 + q/9) turns at 3; both are the end."""
    assert fold_radius(CameraModel(1.0, (0.0, 0.0), k4=-0.25)) == pytest.approx(2.0, abs=1e-12)
    assert fold_radius(CameraModel(1.0, (0.0, 0.0), k4=1 / 9)) == pytest.approx(3.0, abs=1e-12)


def test_a_port_of_air_is_no_port() -> None:
    points = points_ahead(1)
    window = PortModel(10.0, 6.0, 1.0, 1.0, tilt_x_deg=5.0)
    with_port = project(CameraModel(800.0, (320.0, 240.0), k1=-0.1, port=window), points)
    without = project(CameraModel(800.0, (320.0, 240.0), k1=-0.1), points)
    np.testing.assert_allclose(with_port, without, rtol=0, atol=1e-9)


@pytest.mark.parametrize("k1", [-1e-300, -2.2e-313])
def test_a_distortion_next_to_none_is_none(k1: float) -> None:
    """The fold's radius is then so large that its square is no number any more."""
    bent, straight = CameraModel(100.0, (0.0, 0.0), k1=k1), CameraModel(100.0, (0.0, 0.0))
    points = points_ahead(1)
    pixels = project(straight, points)
    np.testing.assert_array_equal(project(bent, points), pixels)
    np.testing.assert_array_equal(rays(bent, pixels).direction, rays(straight, pixels).direction)


def test_no_image() -> None:
    """Inside the port, behind the pinhole, and where the lens folds back: NaN, and no more."""
    behind_port = CameraModel(800.0, (320.0, 240.0), port=PortModel(10.0, 6.0, 1.49, 1.33))
    in_air = CameraModel(800.0, (320.0, 240.0), k1=-0.3)
    points = np.array([[0.0, 0.0, 15.0], [0.0, 0.0, -5.0], [1.0, 2.0, 500.0], [np.nan, 0, 500]])
    lost = [True, True, False, True]
    np.testing.assert_array_equal(np.isnan(project(behind_port, points)).all(axis=1), lost)
    lost = [False, True, False, True]
    np.testing.assert_array_equal(np.isnan(project(in_air, points)).all(axis=1), lost)
    assert np.isnan(project(in_air, np.array([[1.2, 0.0, 1.0]]))).all()  # folds at 1.054
    # The lens reaches no farther than 1.054 (1 - 0.3 * 1.054^2) = 0.703 focal lengths.  Most of
    # the pixels farther out have a ray that it would take there from beyond its fold.
    reach = np.append(0.70, np.linspace(0.71, 3.0, 100))
    beyond = rays(in_air, np.column_stack([320 + 800 * reach, np.full(len(reach), 240.0)]))
    np.testing.assert_array_equal(np.isnan(beyond.direction).all(axis=1), reach > 0.703)


@pytest.mark.parametrize("shape", [(3,), (2, 4), (2, 1, 2)])
def test_bad_shapes(shape: tuple[int, ...]) -> None:
    camera = CameraModel(800.0, (320.0, 240.0))
    with pytest.raises(InputError, match="image_px: bad shape"):
        rays(camera, np.zeros(shape))
    with pytest.raises(InputError, match="points_mm: bad shape"):
        project(camera, np.zeros(shape))


def test_nothing_in_nothing_out() -> None:
    camera = CameraModel(800.0, (320.0, 240.0), port=PortModel(10.0, 6.0, 1.49, 1.33))
    assert project(camera, np.zeros((0, 3))).shape == (0, 2)
    assert rays(camera, np.zeros((0, 2))).direction.shape == (0, 3)
