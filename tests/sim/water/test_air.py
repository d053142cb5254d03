"""Water of the kind "air": nothing refracts, absorbs or scatters."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from places import SCENES
from truth_scenes import tank

from lscan.config.documents import check
from lscan.errors import InputError
from sim.render.tank import Tank
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


FINENESS = 2


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


@pytest.mark.slow
def test_a_render_in_air_shows_what_a_pinhole_sees() -> None:
    """Centroids of the dots' light within 0.005 px rms of the truth's, which is a pinhole's.

    1024 samples a pixel lie 1/32 px apart on a grid, so that the share of a pixel on a dot's rim
    errs by 1/32 / sqrt(12) px.  A dot 5.9 px wide has some 20 of them and 27 px of area: its
    centroid errs by 2.95 sqrt(20) / 111 / 27 = 0.0044 px rms at most, and their mean, over 35
    dots, by a sixth of that.  Whole pixels would alias a dot of radius r by up to
    2 J1(2 pi r) / (2 pi r) / pi, here 0.005 px, whatever the samples; halves of them by a
    fifth of that (the envelope falls as r to the power -1.5, and parts are half as large).
    """
    scene = around_the_dots(load_scene(METRIC / "air.toml"))
    finer = scene.tank.render.model_copy(update={"fineness": FINENESS})
    scene = replace(scene, tank=scene.tank.model_copy(update={"render": finer}))
    image = Tank(scene).render(0.0, 1024, scatter_samples=0).ambient
    expected = board_truth(scene).centroids.grid.image_px
    miss = np.array([centroid(image, place) - place for place in expected])
    assert np.sqrt((miss**2).mean(axis=0)).max() <= 0.005
    assert np.abs(miss.mean(axis=0)).max() <= 0.002


def around_the_dots(scene: Scene) -> Scene:
    """The scene without the laser, and with only the pixels that show the dots and 15 px more."""
    dots = board_truth(scene).centroids.grid.image_px
    low = np.floor(dots.min(axis=0)).astype(int) - 15
    width, height = (np.ceil(dots.max(axis=0)).astype(int) + 16 - low).tolist()
    camera = scene.rig.camera.model_copy(update={"width_px": width, "height_px": height})
    centre = tuple((np.array(scene.tank.lens.centre_px) - low).tolist())
    lens = scene.tank.lens.model_copy(update={"centre_px": centre})
    laser = scene.tank.laser.model_copy(update={"on": False})
    return replace(
        scene,
        rig=scene.rig.model_copy(update={"camera": camera}),
        tank=scene.tank.model_copy(update={"lens": lens, "laser": laser}),
    )


def centroid(image: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(2,) px of what is darker than the plate within 5 px of a place (2,) px.

    image: of the light in each part of a pixel, FINENESS parts a side.
    """
    v, u = (np.indices(image.shape) + 0.5) / FINENESS - 0.5
    distance = np.hypot(u - place[0], v - place[1])
    near = distance <= 5
    plate = image[(distance > 5) & (distance < 9)].astype(float).mean()
    dark = plate - image[near].astype(float)
    return np.array([(dark * u[near]).sum(), (dark * v[near]).sum()]) / dark.sum()
