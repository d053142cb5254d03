"""The camera plugin: against the truth, which shares no formula with it; blur; motion."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import assume, given, strategies as st
from places import SCENES

from lscan.errors import InputError
from lscan.records import Floats
from sim.render.plugins.arrays import floats
from sim.render.plugins.camera import RefractiveCamera
from sim.scene import Head, Lens, PlanePort, Port, Pose, Scene, camera_pose, load_scene
from sim.scene.file import check_lens
from sim.scene.instrument import DomePort
from sim.truth import project
from sim.water import water_optics
from tests.validation.light.rigs import TracedCamera

SCENE = load_scene(SCENES / "paper" / "groove.toml")
WIDTH, HEIGHT = SCENE.rig.camera.width_px, SCENE.rig.camera.height_px
PORT = PlanePort(gap_mm=10.0, thickness_mm=6.0, glass_index=1.488)
AT_ORIGIN = Pose(np.eye(3), np.zeros(3))  # the world is the camera frame


def scene_with(lens: Lens, port: Port, head: Head) -> Scene:
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


def make_camera(
    kind: str = "refractive_camera", width: int = WIDTH, height: int = HEIGHT
) -> RefractiveCamera:
    camera = mi.load_dict(
        {
            "type": kind,
            "film": {
                "type": "hdrfilm", "width": width, "height": height,
                "pixel_format": "luminance", "rfilter": {"type": "box"},
            },
            "sampler": {"type": "stratified", "jitter": False},
        }
    )  # fmt: skip
    assert isinstance(camera, RefractiveCamera)
    return camera


def scene_camera(scene: Scene, kind: str = "refractive_camera") -> RefractiveCamera:
    """The scene's camera with the head at the origin, its port's glass given by number."""
    camera = make_camera(kind)
    index = water_optics(scene.tank.water, scene.tank.laser.wavelength_nm).index
    port = scene.tank.port
    camera.configure(scene.tank.lens, port, float(port.glass_index), index)
    camera.place(camera_pose(scene.tank.head))
    return camera


def sample(
    camera: RefractiveCamera,
    pixels: Floats,
    time: Floats | float = 0.0,
    pupil: Floats | None = None,
) -> tuple[mi.Ray3f, mi.Spectrum]:
    """The rays through (N, 2) pixels, with (N,) shutter and (N, 2) pupil samples."""
    place = (pixels + 0.5) / camera.film().size()
    pupil = np.zeros((len(pixels), 2)) if pupil is None else pupil
    shutter = floats(np.broadcast_to(time, len(pixels)))
    return camera.sample_ray(shutter, 0.0, points(place), points(pupil))


def points(values: Floats) -> mi.Point2f:
    return mi.Point2f(*map(floats, values.T))


def vectors(values: mi.Vector3f) -> Floats:
    """(N, 3) in double precision."""
    return np.array(values, dtype=float).T


def rays(scene: Scene, pixels: Floats) -> tuple[Floats, Floats, Floats]:
    """Origins and directions in the head frame, and weights, of the rays through pixels."""
    ray, weight = sample(scene_camera(scene), pixels)
    return vectors(ray.o), vectors(ray.d), np.array(weight).ravel()


def grid(count: int = 9) -> Floats:
    u, v = np.meshgrid(np.linspace(0, WIDTH - 1, count), np.linspace(0, HEIGHT - 1, count))
    return np.column_stack([u.ravel(), v.ravel()])


@examples(40)
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
    port = PlanePort(
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
    back = project(scene, origin + reach * direction)
    assert np.isfinite(back).all()
    np.testing.assert_allclose(back, pixels, atol=0.005)


@examples(40)
@given(
    radius=st.floats(20, 100),
    thickness=st.floats(1, 15),
    glass=st.floats(1.4, 1.8),
    off=st.tuples(*3 * [st.floats(-0.5, 0.5)]),
    focal=st.floats(500, 1200),
    k1=st.floats(-0.2, 0.2),
    reach=st.floats(200, 2500),
)
def test_a_ray_through_a_dome_passes_through_what_its_pixel_sees(
    radius: float, thickness: float, glass: float, off: tuple, focal: float, k1: float, reach: float
) -> None:
    """As for the flat port; the dome is up to 0.87 of its radius off the pinhole."""
    dome = DomePort(
        kind="dome", radius_mm=radius, thickness_mm=thickness, glass_index=glass,
        centre_mm=tuple(radius * part for part in off),
    )  # fmt: skip
    lens = Lens(focal_px=focal, centre_px=(319.5, 239.5), k1=k1)
    scene = scene_with(lens, dome, SCENE.tank.head)
    assume(not folds(scene))
    pixels = grid()
    origin, direction, _ = rays(scene, pixels)
    back = project(scene, origin + reach * direction)
    np.testing.assert_allclose(back, pixels, atol=0.005)


def test_rays_leave_from_the_glass_and_are_unit() -> None:
    """In the camera frame they start on the port's outer face, gap + thickness along it."""
    scene = scene_with(SCENE.tank.lens, PORT, SCENE.tank.head)
    origin, direction, _ = rays(scene, grid())
    pose, port = camera_pose(scene.tank.head), PORT
    depth = pose.invert(origin)[:, 2]
    np.testing.assert_allclose(depth, port.gap_mm + port.thickness_mm, atol=2e-4)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1, atol=1e-6)


def test_the_field_of_view_shrinks_by_the_index() -> None:
    """The ratio of sines is exactly n: 30 degrees in air is 22.06 in water
    (docs/explanation/physics.md, section 6)."""
    lens = Lens(focal_px=300.0, centre_px=(319.5, 239.5))
    scene = scene_with(lens, PlanePort(), SCENE.tank.head)
    index = water_optics(scene.tank.water, 650.0).index
    pixels = np.array([[319.5 + 300 * np.tan(np.radians(30)), 239.5]])
    _, direction, _ = rays(scene, pixels)
    axis = camera_pose(scene.tank.head).rotation[:, 2]
    sine = np.sqrt(1 - float(direction[0] @ axis) ** 2)
    assert 0.5 / sine == pytest.approx(index, rel=1e-6)
    assert np.degrees(np.arcsin(0.5 / 1.3313)) == pytest.approx(22.06, abs=0.01)


@pytest.mark.parametrize("aperture_mm", [0.0, 3.0])
def test_a_traced_port_can_stand_in_for_the_closed_form(aperture_mm: float) -> None:
    """The same rays in the world, 1 m away to 1e-3 mm (0.001 px), from either camera.

    Coordinates of some 1000 mm are good to 6e-5 mm in single precision, a direction to 1e-7.
    """
    lens = SCENE.tank.lens.model_copy(update={"focus_mm": 900.0})
    pupil = np.random.default_rng(1).random((81, 2))
    found = []
    for kind in ("refractive_camera", "traced_camera"):
        camera = make_camera(kind)
        assert isinstance(camera, TracedCamera) == (kind == "traced_camera")
        camera.configure(lens, PORT, 1.488, 1.3313, aperture_mm=aperture_mm)
        camera.place(camera_pose(SCENE.tank.head))
        ray, weight = sample(camera, grid(), pupil=pupil)
        away = 1000 - np.linalg.norm(vectors(ray.o) - SCENE.tank.head.camera_mm, axis=1)
        found.append((vectors(ray.o) + away[:, None] * vectors(ray.d), np.array(weight).ravel()))
    np.testing.assert_allclose(found[0][0], found[1][0], atol=1e-3)
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=1e-5)


@pytest.mark.parametrize("dome", [False, True])
def test_numbers_change_without_a_kernel_being_compiled(dome: bool) -> None:
    """Cameras of other numbers run the same kernel on the same samples."""
    camera = make_camera()
    place, pupil = (points(np.random.default_rng(k).random((81, 2))) for k in (1, 2))
    shutter = mi.Float(0.3)

    def kernels(scale: float) -> set[str]:
        port = (
            DomePort(kind="dome", radius_mm=50 * scale, thickness_mm=4 * scale)
            if dome
            else PlanePort(gap_mm=20 * scale, thickness_mm=6 * scale, tilt_x_deg=3 * scale)
        )
        lens = Lens(focal_px=850 * scale, centre_px=(319.5 * scale, 239.5), focus_mm=900 * scale)
        camera.configure(lens, port, 1.5 * scale, 1.3 * scale, aperture_mm=2 * scale)
        camera.place(Pose(np.eye(3), np.full(3, 100 * scale)))
        camera.move(np.array([0.0, 50 * scale, 0.0]), 10 * scale, 20 * scale)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            ray, weight = camera.sample_ray(shutter, 0.0, place, pupil)
            dr.eval(ray.o, ray.d, ray.time, weight)
            return {entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])}

    used = [kernels(scale) for scale in np.linspace(0.9, 1.0, 12)]
    assert len(used[0]) == 1
    assert used == used[:1] * 12


def lens_in_air(aperture_mm: float, focus_mm: float, **size: int) -> RefractiveCamera:
    """A lens with nothing before it: every index is 1."""
    camera = make_camera(**size)
    width, height = camera.film().size()
    lens = Lens(focal_px=850.0, centre_px=((width - 1) / 2, (height - 1) / 2), focus_mm=focus_mm)
    port = PlanePort(gap_mm=40.0, glass_index=1.0)
    camera.configure(lens, port, 1.0, 1.0, aperture_mm=aperture_mm)
    camera.place(AT_ORIGIN)
    return camera


@examples(15)
@given(
    aperture=st.floats(0.5, 10),
    focus=st.floats(200, 3000),
    distance=st.floats(200, 3000),
    pixel=st.tuples(st.integers(0, WIDTH - 1), st.integers(0, HEIGHT - 1)),
)
def test_the_circle_of_confusion_is_the_thin_lenss(
    aperture: float, focus: float, distance: float, pixel: tuple[int, int]
) -> None:
    """A pixel's rays meet the plane at d in a uniform disc, aperture f |1/focus - 1/d| px wide.

    Similar triangles behind pupil and focus; as many px blur the picture of a point there.
    The squared radius of n points of a uniform unit disc is uniform in [0, 1]: its mean is
    1/2 within 5 / sqrt(12 n), its largest above 1 - 12/n but for exp(-12).  A metre in single
    precision is good to 1e-3 px.
    """
    count = 20_000
    camera = lens_in_air(aperture, focus)
    pupil = np.random.default_rng(3).random((count, 2))
    ray, weight = sample(camera, np.full((count, 2), pixel), pupil=pupil)
    np.testing.assert_allclose(np.array(weight), 1, rtol=1e-6)

    origin, direction = vectors(ray.o), vectors(ray.d)
    met = origin + direction * ((distance - origin[:, 2]) / direction[:, 2])[:, None]
    spot = 850 / distance * met[:, :2] - (np.array(pixel) - [(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    radius = np.linalg.norm(spot, axis=1)
    expected = aperture * 850 * abs(1 / focus - 1 / distance) / 2
    assert radius.max() <= expected + 2e-3
    assert radius.max() >= expected * np.sqrt(1 - 12 / count) - 2e-3
    if expected > 1:
        relative = (radius / expected) ** 2
        assert relative.mean() == pytest.approx(0.5, abs=5 / np.sqrt(12 * count) + 4e-3 / expected)


def edge_spread(camera: RefractiveCamera, distance_mm: float, samples: int) -> Floats:
    """(W,) mean over the rows of a picture of a luminous half plane x > 0 at a distance."""
    half_plane = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f()
        .translate([1000, 0, distance_mm])
        .rotate([0, 1, 0], 180)
        .scale(1000),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
    }
    scene = mi.load_dict({"type": "scene", "light": half_plane})
    integrator = mi.load_dict({"type": "path", "max_depth": 1})
    image = mi.render(scene, sensor=camera, integrator=integrator, spp=samples, seed=1)
    return np.array(image)[..., 0].mean(axis=0)


# Of 0 or 1, n values have a mean with a standard deviation of at most 1/2 / sqrt(n);
# stratified samples scatter less.  Without jitter the values of a pixel are 16, the same
# everywhere: only what the camera does to them makes a blurred edge a ramp.
EDGE = {"width": 64, "height": 256}
EDGE_SAMPLES = 16
EDGE_BOUND = 5 * 0.5 / np.sqrt(EDGE["height"] * EDGE_SAMPLES)


def test_a_defocused_edge_is_a_discs_share_of_a_half_plane() -> None:
    """A disc of radius r, cut s beside its centre: 1/2 + (t sqrt(1-t^2) + asin t) / pi, t = s/r."""
    aperture, focus, distance = 24.0, 1000.0, 500.0
    camera = lens_in_air(aperture, focus, **EDGE)
    seen = edge_spread(camera, distance, EDGE_SAMPLES)
    beside = np.arange(EDGE["width"]) - (EDGE["width"] - 1) / 2
    t = np.clip(beside / (aperture * 850 * (1 / distance - 1 / focus) / 2), -1, 1)
    expected = 0.5 + (t * np.sqrt(1 - t**2) + np.arcsin(t)) / np.pi
    np.testing.assert_allclose(seen, expected, atol=EDGE_BOUND)


def test_a_picture_through_a_traced_port_is_the_closed_forms() -> None:
    """An edge behind a dome, the port's scene and the picture's own traced in one go.

    Off the edge every pixel is 0 or Fresnel's weight.  At it, rays 0.002 px apart (single
    precision, twice) see different sides where a sample is as near to the edge; samples lie
    0.25 px apart, so in fewer than one row in a hundred.
    """
    dome = DomePort(kind="dome", radius_mm=50.0, centre_mm=(3.0, -2.0, 5.0))
    lens = Lens(focal_px=850.0, centre_px=(31.5, 127.5))
    pictures = []
    for kind in ("refractive_camera", "traced_camera"):
        camera = make_camera(kind, **EDGE)
        camera.configure(lens, dome, 1.488, 1.3313)
        camera.place(AT_ORIGIN)
        pictures.append(edge_spread(camera, 500.0, EDGE_SAMPLES))
    assert np.ptp(pictures[0]) > 0.5
    np.testing.assert_allclose(pictures[1], pictures[0], atol=0.01 * pictures[0].max())


def test_an_edge_seen_from_a_moving_camera_is_a_ramp() -> None:
    """As wide as the way in the exposure, f v T / d px: the shutter is open all the time."""
    camera = lens_in_air(0.0, 500.0, **EDGE)
    camera.move(np.array([1200.0, 0.0, 0.0]), exposure_ms=10.0, readout_ms=0.0)
    seen = edge_spread(camera, 500.0, EDGE_SAMPLES)
    beside = np.arange(EDGE["width"]) - (EDGE["width"] - 1) / 2
    expected = np.clip(0.5 + beside / (850 * 12.0 / 500.0), 0, 1)
    np.testing.assert_allclose(seen, expected, atol=EDGE_BOUND)


def test_a_camera_that_stands_has_no_times_and_asks_for_no_shutter_sample() -> None:
    camera = scene_camera(SCENE)
    still, _ = sample(camera, grid(), time=0.7)
    camera.move(np.array([0.0, 80.0, 0.0]), 10.0, 0.0)
    assert camera.shutter_open_time() == 1.0
    camera.move(np.zeros(3), exposure_ms=10.0, readout_ms=0.0)
    assert camera.shutter_open_time() == 0.0
    again, _ = sample(camera, grid(), time=0.7)
    assert not np.array(again.time).any()
    np.testing.assert_array_equal(vectors(again.o), vectors(still.o))


def test_rays_start_where_the_camera_is_at_their_time() -> None:
    """Displaced by velocity times time, directions kept; 1e-4 mm is single precision at 1 m."""
    camera = scene_camera(SCENE)
    pixels = np.random.default_rng(4).uniform(0, 479, (500, 2))
    shutter = np.random.default_rng(5).random(500)
    still, _ = sample(camera, pixels)
    velocity = np.array([20.0, 150.0, -5.0])
    camera.move(velocity, exposure_ms=20.0, readout_ms=30.0)
    moving, _ = sample(camera, pixels, time=shutter)
    time = np.array(moving.time, dtype=float)
    assert np.ptp(time) > 0.03
    shift = vectors(moving.o) - vectors(still.o)
    np.testing.assert_allclose(shift, time[:, None] * velocity, atol=2e-4)
    np.testing.assert_array_equal(vectors(moving.d), vectors(still.d))


def test_a_rolling_shutter_reads_rows_at_even_intervals() -> None:
    """Row v of H at (v/H - 1/2) readout, the same all along it; no exposure, no spread."""
    camera = make_camera()
    camera.configure(SCENE.tank.lens, PORT, 1.488, 1.3313)
    camera.place(AT_ORIGIN)
    camera.move(np.zeros(3), exposure_ms=0.0, readout_ms=30.0)
    pixels = np.column_stack([np.arange(HEIGHT), np.arange(HEIGHT)])
    ray, _ = sample(camera, pixels, time=0.2)
    expected = 0.03 * (np.arange(HEIGHT) / HEIGHT - 0.5)
    np.testing.assert_allclose(np.array(ray.time), expected, atol=1e-8)


def test_a_row_is_exposed_evenly_about_its_time() -> None:
    """Times are uniform over the exposure: mean and largest of n as for the disc."""
    count, exposure_s = 20_000, 0.012
    camera = scene_camera(SCENE)
    camera.move(np.array([0.0, 100.0, 0.0]), exposure_ms=12.0, readout_ms=30.0)
    shutter = np.random.default_rng(6).random(count)
    ray, _ = sample(camera, np.full((count, 2), [100, 60]), time=shutter)
    share = (np.array(ray.time, dtype=float) - 0.03 * (60 / HEIGHT - 0.5)) / exposure_s
    assert np.abs(share).max() <= 0.5 + 1e-5
    assert share.max() > 0.5 - 12 / count
    assert share.mean() == pytest.approx(0.0, abs=5 / np.sqrt(12 * count))


def test_an_open_lens_without_focus_is_refused() -> None:
    camera = make_camera()
    with pytest.raises(InputError, match="focus_mm"):
        camera.configure(Lens(focal_px=850, centre_px=(0, 0)), PORT, 1.5, 1.33, aperture_mm=2.0)
