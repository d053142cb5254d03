"""Derivatives of rays and projections, against differences of what they are derivatives of."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from camera_strategies import FISHEYE, FLAT_PORT, LENS, RATIONAL
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.camera import CameraModel, PortModel, rays
from lscan.camera.posedboards import (
    CAMERA,
    COUNT,
    LENS as OF_LENS,
    NEWER,
    OWN,
    POSE,
    PortKind,
    PosedBoards,
    bend_derivatives,
    image_derivatives,
    on_board_derivatives,
    ray_derivatives,
)
from lscan.records import Floats

PORT = {**FLAT_PORT, "water_index": st.floats(1.0, 1.345)}
NONE = dict.fromkeys(NEWER, 0.0)
CAMERAS = (
    st.fixed_dictionaries({**RATIONAL, **PORT, "k1": st.floats(-0.1, 0.1)})
    | st.fixed_dictionaries({**LENS, **PORT, "k1": st.floats(-0.1, 0.1)})
    | st.fixed_dictionaries({**FISHEYE, **PORT, "fisheye": st.just(1.0)})
).map(lambda values: {**NONE, "p1": 0.0, "p2": 0.0, **values})
BOARDS = 3

# Each moves the picture by some 1e-6 to 0.1 px, by the camera and by the pose.
CAMERA_STEPS = [0.05, 0.05, 0.05, 1e-4, 1e-4, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4, 1e-4]
CAMERA_STEPS += [1e-3]  # of whether it is a fisheye, which nothing changes with
CAMERA_STEPS += [0.01, 0.01, 1e-4, 1e-4, 1e-3, 1e-3]
STEPS = np.array([*CAMERA_STEPS, 1e-5, 1e-5, 1e-5, 0.01, 0.01, 1e-5])
# Pixels and mm of up to 1e3 round at 1e-13, and at ten times that after a search; what is left of
# differences of fourth order, and of second order by the turns inside, is 1e-7 of a derivative.
ROUNDING = 2e-12
WITHIN = 1e-6


def drawn(camera: dict[str, float], port: PortKind, seed: int) -> PosedBoards:
    """Boards some 300 to 900 mm away, turned by up to 35 degrees, seen in the picture's middle."""
    rng = np.random.default_rng(seed)
    u, v = camera.pop("centre_px")  # type: ignore[misc]
    values = {**camera, "centre_u_px": u, "centre_v_px": v}
    theta = [values[name] for name in CAMERA]
    for _ in range(BOARDS):
        seen = np.array([u, v]) + rng.uniform(-40, 40, 2)
        mm_per_px = rng.uniform(300, 900) / values["focal_px"]
        theta += [*rng.uniform(-0.35, 0.35, 3), *seen, mm_per_px]
    return PosedBoards(np.array(theta), rng.uniform(-20, 20, 2), port)


def differences(quantity: Callable[[PosedBoards], Floats], boards: PosedBoards) -> Floats:
    """(N, D, 20) derivatives by differences of fourth order, of the poses all at once."""
    columns = []
    for index, size in enumerate(STEPS):
        step = np.zeros_like(boards.theta)
        step[index if index < COUNT else slice(index, None, len(POSE))] = size
        far2, far1, near1, near2 = (
            quantity(replace(boards, theta=boards.theta + times * step)) for times in (2, 1, -1, -2)
        )
        columns.append((8 * (far1 - near1) - (far2 - near2)) / (12 * size))
    return np.stack(columns, axis=2)


def assert_alike(found: Floats, expected: Floats) -> None:
    """To WITHIN of the largest of each column, and to what rounding makes of a difference."""
    assert found.shape == expected.shape
    assert found.shape[2] == OWN
    assert np.isfinite(found).all()
    largest = np.abs(expected).max(axis=(0, 1))
    off = np.abs(found - expected).max(axis=(0, 1))
    assert (off <= WITHIN * largest + ROUNDING / STEPS).all()


@pytest.mark.parametrize("port", ["flat", pytest.param("none", marks=pytest.mark.slow)])
@examples(6)
@given(camera=CAMERAS, seed=st.integers(0, 1000))
def test_derivatives_agree_with_differences(
    port: PortKind, camera: dict[str, float], seed: int
) -> None:
    boards = drawn(dict(camera), port, seed)
    board_mm = np.random.default_rng(seed).uniform(-50, 50, (12, 2))
    board = np.repeat(np.arange(BOARDS), 4)
    found = image_derivatives(boards, board_mm, board)
    assert_alike(found, differences(lambda some: some.project(board_mm, board), boards))
    for number in range(BOARDS):
        image = boards.project(board_mm[board == number], number)

        def points(some: PosedBoards, image: Floats = image, number: int = number) -> Floats:
            return some.on_board(image, number)

        assert_alike(on_board_derivatives(boards, image, number), differences(points, boards))


def test_a_bent_board_is_seen_and_met_where_it_is() -> None:
    """By central differences; and a ray through a point's pixel meets the board there again."""
    theta = np.array([800.0, 320, 240, -0.1, *np.zeros(14), 0.4, -0.3, 0.1, 330, 230, 1])
    bend, step = np.array([2e-5, -1e-5, 3e-5]), 1e-7
    boards = PosedBoards(theta, np.array([5.0, -3.0]), "none", bend)
    places, board = np.array([[90.0, 40.0], [-70.0, 10.0], [5.0, -60.0]]), np.zeros(3, dtype=int)
    found = bend_derivatives(boards, places, board)
    for k, way in enumerate(step * np.eye(3)):
        after, before = (
            replace(boards, bend_per_mm=bend + side * way).project(places) for side in (1, -1)
        )
        np.testing.assert_allclose(found[:, :, k], (after - before) / (2 * step), rtol=1e-4)
    met = boards.on_board(boards.project(places))
    np.testing.assert_allclose(met, boards.in_camera(places), rtol=0, atol=1e-4)


def test_a_port_that_is_not_there_has_no_derivative() -> None:
    boards = PosedBoards(
        np.array([800.0, 320, 240, -0.1, *np.zeros(14), 0.1, 0.2, 0.1, 330, 230, 0.7]),
        np.zeros(2),
        "none",
    )
    found = image_derivatives(boards, np.array([[10.0, 20.0]]), np.array([0]))
    assert (found[:, :, len(OF_LENS) : COUNT] == 0).all()
    assert (found[:, :, : len(OF_LENS) - 1] != 0).any(axis=1).all()
    assert (found[:, :, CAMERA.index("fisheye")] == 0).all()


def test_where_there_is_no_image_there_is_no_derivative() -> None:
    """A board behind the camera."""
    pose = [0.1, 0.2, 0.1, 330.0, 230.0, -0.7]
    theta = np.array([800.0, 320, 240, -0.1, *np.zeros(8), 10, 6, 1.49, 1.33, 1, 1, *pose])
    boards = PosedBoards(theta, np.zeros(2))
    assert np.isnan(image_derivatives(boards, np.array([[10.0, 20.0]]), np.array([0]))).all()


@pytest.mark.parametrize(
    ("values", "pixel"),
    [({"water_index": 0.4}, (900.0, 240.0)), ({"tilt_y_deg": 45.0}, (-600.0, 240.0))],
)
def test_a_ray_that_there_is_not_has_no_derivative(
    values: dict[str, float], pixel: tuple[float, float]
) -> None:
    """An index below 1 reflects it all, which a search may try; or it misses the glass."""
    port = replace(PortModel(10.0, 6.0, 1.49, 1.33), **values)
    camera = CameraModel(800.0, (320.0, 240.0), port=port)
    image = np.array([pixel, (330.0, 250.0)])
    found = ray_derivatives(camera, image)
    assert np.isnan(rays(camera, image).direction).all(axis=1).tolist() == [True, False]
    assert np.isnan(found.direction[0]).any()
    assert np.isfinite(found.direction[1]).all()
    assert np.isfinite(found.origin_mm[1]).all()
