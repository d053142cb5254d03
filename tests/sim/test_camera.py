"""The camera plugin against the truth's projection, which shares no formula with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from lscan.errors import InputError
from lscan.records import Floats
from sim.plugins.camera import RefractiveCamera, fresnel_transmission
from sim.scene import FlatPort, Head, Lens, Scene, camera_pose, check_lens, load_scene
from sim.truth import project
from sim.water import water_optics

SCENE = load_scene(Path(__file__).resolve().parents[2] / "scenes" / "paper" / "groove.toml")
WIDTH, HEIGHT = SCENE.rig.camera.width_px, SCENE.rig.camera.height_px


def scene_with(lens: Lens, port: FlatPort, head: Head) -> Scene:
    """The grooved block's scene seen by another camera; folding lenses are refused."""
    tank = SCENE.tank.model_copy(update={"lens": lens, "port": port, "head": head})
    return replace(SCENE, tank=tank)


def folds(scene: Scene) -> bool:
    """Whether the scene file would be refused for its lens."""
    try:
        check_lens(scene)
    except InputError:
        return True
    return False


def rays(scene: Scene, pixels: Floats) -> tuple[Floats, Floats, Floats]:
    """Origins and directions in the head frame, and weights, of the rays through pixels."""
    camera = mi.load_dict(
        {
            "type": "refractive_camera",
            "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT},
        }
    )
    assert isinstance(camera, RefractiveCamera)
    index = water_optics(scene.tank.water, scene.tank.laser.wavelength_nm).index
    camera.configure(scene.tank.lens, scene.tank.port, index)
    camera.place(camera_pose(scene.tank.head))
    place = (pixels + 0.5) / [WIDTH, HEIGHT]
    sample = mi.Point2f(*(mi.Float(column.astype(np.float32)) for column in place.T))
    ray, weight = camera.sample_ray(0.0, 0.0, sample, mi.Point2f(0.0))
    return np.array(ray.o).T, np.array(ray.d).T, np.array(weight).ravel()


def grid(count: int = 9) -> Floats:
    u, v = np.meshgrid(np.linspace(0, WIDTH - 1, count), np.linspace(0, HEIGHT - 1, count))
    return np.column_stack([u.ravel(), v.ravel()])


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    focal=st.floats(500, 1200),
    k1=st.floats(-0.3, 0.2),
    k2=st.floats(-0.05, 0.1),
    p=st.tuples(st.floats(-2e-3, 2e-3), st.floats(-2e-3, 2e-3)),
    centre=st.tuples(st.floats(280, 360), st.floats(200, 280)),
    gap=st.floats(1, 60),
    thickness=st.floats(1, 25),
    glass=st.floats(1.4, 1.6),
    tilt=st.tuples(st.floats(-8, 8), st.floats(-8, 8)),
    depression=st.floats(-20, 60),
    heading=st.floats(-30, 30),
    roll=st.floats(-20, 20),
    reach=st.floats(200, 2500),
)
def test_a_ray_passes_through_what_its_pixel_sees(
    focal: float, k1: float, k2: float, p: tuple, centre: tuple, gap: float, thickness: float,
    glass: float, tilt: tuple, depression: float, heading: float, roll: float, reach: float,
) -> None:  # fmt: skip
    """Points on the plugin's rays are imaged on their pixels within 0.005 px.

    The plugin works in single precision: a coordinate of 1000 mm is good to 6e-5 mm, a ray
    of a metre to some 1e-4 mm, which is 1e-4 px here.
    """
    lens = Lens(focal_px=focal, centre_px=centre, k1=k1, k2=k2, p1=p[0], p2=p[1])
    port = FlatPort(
        gap_mm=gap, thickness_mm=thickness, glass_index=glass,
        tilt_x_deg=tilt[0], tilt_y_deg=tilt[1],
    )  # fmt: skip
    head = Head(
        camera_mm=(225.0, -866.0, 300.0), depression_deg=depression, heading_deg=heading,
        roll_deg=roll,
    )  # fmt: skip
    scene = scene_with(lens, port, head)
    assume(not folds(scene))
    pixels = grid()
    origin, direction, _ = rays(scene, pixels)
    back = project(scene, origin.astype(float) + reach * direction.astype(float))
    assert np.isfinite(back).all()
    np.testing.assert_allclose(back, pixels, atol=0.005)


def test_rays_leave_from_the_glass_and_are_unit() -> None:
    """In the camera frame they start on the port's outer face, gap + thickness along it."""
    origin, direction, _ = rays(SCENE, grid())
    pose = camera_pose(SCENE.tank.head)
    port = SCENE.tank.port
    depth = pose.invert(origin.astype(float))[:, 2]
    np.testing.assert_allclose(depth, port.gap_mm + port.thickness_mm, atol=2e-4)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1, atol=1e-6)


def test_the_field_of_view_shrinks_by_the_index() -> None:
    """The ratio of sines is exactly n: 30 degrees in air is 22.06 in water (physics.md, 6)."""
    lens = Lens(focal_px=300.0, centre_px=(319.5, 239.5))
    scene = scene_with(lens, FlatPort(), SCENE.tank.head)
    index = water_optics(scene.tank.water, 650.0).index
    pixels = np.array([[319.5 + 300 * np.tan(np.radians(30)), 239.5]])
    _, direction, _ = rays(scene, pixels)
    axis = camera_pose(scene.tank.head).rotation[:, 2]
    sine = np.sqrt(1 - float(direction[0].astype(float) @ axis) ** 2)
    assert 0.5 / sine == pytest.approx(index, rel=1e-6)
    assert np.degrees(np.arcsin(0.5 / 1.3313)) == pytest.approx(22.06, abs=0.01)


def test_the_weight_is_fresnels_loss_over_the_index_squared() -> None:
    """On the axis R = ((n1-n2)/(n1+n2))^2 at each face."""
    _, _, weight = rays(SCENE, np.array([[319.5, 239.5]]))
    index = water_optics(SCENE.tank.water, SCENE.tank.laser.wavelength_nm).index
    glass = SCENE.tank.port.glass_index
    outer = 1 - ((glass - 1) / (glass + 1)) ** 2
    inner = 1 - ((glass - index) / (glass + index)) ** 2
    assert weight[0] == pytest.approx(outer * inner / index**2, rel=1e-5)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(angle=st.floats(0, 80), index=st.floats(1.01, 1.7))
def test_fresnel_is_the_same_both_ways(angle: float, index: float) -> None:
    """Reciprocity: a face transmits the same share from either side along the same ray."""
    inside = np.arcsin(np.sin(np.radians(angle)) / index)
    cosines = np.cos(np.radians(angle)), np.cos(inside)
    forth = fresnel_transmission(mi.Float(cosines[0]), mi.Float(cosines[1]), mi.Float(index))
    back = fresnel_transmission(mi.Float(cosines[1]), mi.Float(cosines[0]), mi.Float(1 / index))
    assert float(forth[0]) == pytest.approx(float(back[0]), abs=1e-5)
    assert 0 <= float(forth[0]) <= 1


def test_brewsters_angle_loses_half_of_what_s_light_does() -> None:
    """At Brewster's angle p light passes whole, so the loss is half of R_s = cos^2(2 theta)."""
    index = 1.5
    angle = np.arctan(index)
    cosines = np.cos(angle), np.cos(np.arcsin(np.sin(angle) / index))
    passed = fresnel_transmission(mi.Float(cosines[0]), mi.Float(cosines[1]), mi.Float(index))
    assert 1 - float(passed[0]) == pytest.approx(0.5 * np.cos(2 * angle) ** 2, abs=1e-6)
