"""Water of the kind "air": nothing refracts, absorbs or scatters."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from places import SCENES
from truth_scenes import tank

from lscan.config.documents import check
from lscan.errors import InputError
from sim.scene import Scene, camera_pose, load_scene
from sim.scene.matter import Water
from sim.truth import board_truth, project
from sim.water import water_optics

METRIC = SCENES / "metric"


@examples(60)
@given(
    nm=st.floats(450, 700),
    temperature=st.floats(0, 30),
    salinity=st.floats(0, 35),
    pressure=st.floats(0.1, 100),
)
def test_whatever_its_state(
    nm: float, temperature: float, salinity: float, pressure: float
) -> None:
    water = Water(
        kind="air", temperature_c=temperature, salinity_psu=salinity, pressure_mpa=pressure
    )
    optics = water_optics(water, nm)
    assert (optics.index, optics.extinction_per_mm) == (1.0, 0.0)


@pytest.mark.parametrize(
    "also", [{"particle_scattering_per_m": 0.1}, {"absorption_per_m": 0.1}, {"turbidity_ntu": 1.0}]
)
def test_nothing_floats_in_it(also: dict[str, float]) -> None:
    with pytest.raises(InputError, match="water"):
        check(Water, {"kind": "air", **also}, where="scene", prefix="water")


@pytest.mark.parametrize("nm", [449.9, 700.1, float("nan")])
def test_wavelengths_the_tank_does_not_know(nm: float) -> None:
    with pytest.raises(InputError, match="wavelength_nm"):
        water_optics(Water(kind="air"), nm)


def pinhole(scene: Scene, points: np.ndarray) -> np.ndarray:
    """(N, 2) px by the textbook's pinhole with distortion (OpenCV's documentation)."""
    lens, camera = scene.tank.lens, camera_pose(scene.tank.head)
    local = (points - camera.origin_mm) @ camera.rotation
    x, y = (local[:, :2] / local[:, 2:]).T
    q = x * x + y * y
    radial = 1 + lens.k1 * q + lens.k2 * q**2 + lens.k3 * q**3
    u = x * radial + 2 * lens.p1 * x * y + lens.p2 * (q + 2 * x * x)
    v = y * radial + lens.p1 * (q + 2 * y * y) + 2 * lens.p2 * x * y
    return lens.focal_px * np.column_stack([u, v]) + np.array(lens.centre_px)


@examples(40)
@given(
    tilt=st.tuples(st.floats(-10, 10), st.floats(-10, 10)),
    gap=st.floats(1, 60),
    thickness=st.floats(1, 40),
    seed=st.integers(0, 2**16),
)
def test_behind_glass_of_index_1_the_camera_is_a_pinhole(
    tilt: tuple[float, float], gap: float, thickness: float, seed: int
) -> None:
    """Truth to 1e-6 px wherever the window that is none stands."""
    scene = tank(
        lens={"k1": -0.2, "k2": 0.05, "p1": 1e-3, "p2": -2e-3},
        water={"kind": "air"},
        port={
            "gap_mm": gap,
            "thickness_mm": thickness,
            "glass_index": 1.0,
            "tilt_x_deg": tilt[0],
            "tilt_y_deg": tilt[1],
        },
    )
    box = np.random.default_rng(seed).uniform(-1, 1, (40, 3)) * [250.0, 80.0, 180.0]
    np.testing.assert_allclose(project(scene, box), pinhole(scene, box), rtol=0, atol=1e-6)


def test_the_truth_of_the_board_in_air_is_the_pinholes() -> None:
    scene = load_scene(METRIC / "air.toml")
    marks = board_truth(scene).centres.grid
    target, board = scene.tank.target, marks.board_mm
    tilt = np.radians(target.tilt_x_deg)
    local = np.column_stack([board[:, 0], -np.sin(tilt) * board[:, 1], np.cos(tilt) * board[:, 1]])
    expected = pinhole(scene, local + np.array(target.position_mm))
    np.testing.assert_allclose(marks.image_px, expected, rtol=0, atol=1e-6)
