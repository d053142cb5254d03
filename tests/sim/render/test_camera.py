"""The camera plugin: against the truth, which shares no formula with it; blur; motion."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from places import SCENES

from lscan.config.rig import LensKind
from lscan.errors import InputError
from lscan.records import Floats
from sim.render.firstorder import Defocus
from sim.render.plugins.arrays import floats
from sim.render.plugins.camera import RefractiveCamera
from sim.scene import Head, Lens, PlanePort, Port, Pose, Scene, camera_pose, load_scene
from sim.scene.instrument import DomePort, is_folded
from sim.truth import project
from sim.water import water_optics

SCENE = load_scene(SCENES / "paper" / "groove.toml")
WIDTH, HEIGHT = SCENE.rig.camera.width_px, SCENE.rig.camera.height_px
PORT = PlanePort(gap_mm=10.0, thickness_mm=6.0, glass_index=1.488)
AT_ORIGIN = Pose(np.eye(3), np.zeros(3))  # the world is the camera frame


def make_camera(width: int = WIDTH, height: int = HEIGHT) -> RefractiveCamera:
    camera = mi.load_dict(
        {
            "type": "refractive_camera",
            "film": {
                "type": "hdrfilm", "width": width, "height": height,
                "pixel_format": "luminance", "rfilter": {"type": "box"},
            },
            "sampler": {"type": "stratified", "jitter": False},
        }
    )  # fmt: skip
    assert isinstance(camera, RefractiveCamera)
    return camera


def scene_camera(scene: Scene) -> RefractiveCamera:
    """The scene's camera with the head at the origin, its port's glass given by number."""
    camera = make_camera()
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


def random_rig(seed: int, dome: bool, model: LensKind = "brown") -> Scene:
    """Any lens that does not fold, behind a port up to 8 degrees askew, or behind a dome up to 0.87
    of its radius off the pinhole."""
    generator = np.random.default_rng([seed, dome])
    between, pair = generator.uniform, lambda low, high: tuple(generator.uniform(low, high, 2))
    while True:
        lens = Lens(
            focal_px=between(500, 1200), centre_px=(between(280, 360), between(200, 280)),
            k1=between(-0.3, 0.2), k2=between(-0.05, 0.1), p1=between(-2e-3, 2e-3),
            p2=between(-2e-3, 2e-3),
        )  # fmt: skip
        if model != "brown":
            lens = wide_lens(model, generator)
        tilt, glass, radius = pair(-8, 8), between(1.4, 1.7), between(20, 100)
        port: Port = PlanePort(
            gap_mm=between(1, 60), thickness_mm=between(1, 25), glass_index=glass,
            tilt_x_deg=tilt[0], tilt_y_deg=tilt[1],
        )  # fmt: skip
        if dome:
            off = tuple(radius * between(-0.5, 0.5, 3))
            port = DomePort(
                kind="dome", radius_mm=radius, thickness_mm=between(1, 15), glass_index=glass,
                centre_mm=off,
            )  # fmt: skip
        head = Head(
            camera_mm=(225.0, -866.0, 300.0), depression_deg=between(-20, 60),
            heading_deg=between(-30, 30), roll_deg=between(-20, 20),
        )  # fmt: skip
        tank = SCENE.tank.model_copy(update={"lens": lens, "port": port, "head": head})
        scene = replace(SCENE, tank=tank)
        if not is_folded(lens, WIDTH, HEIGHT):
            return scene


def wide_lens(model: LensKind, generator: np.random.Generator) -> Lens:
    """A fisheye, or a rational lens, of up to 150 degrees from corner to corner."""
    u, v, *k = generator.uniform(-1, 1, 6)
    centre = (320 + 5 * u, 240 + 5 * v)
    if model == "fisheye":
        return Lens(
            model=model, focal_px=generator.uniform(300, 700), centre_px=centre,
            k1=0.05 * k[0], k2=0.01 * k[1], k3=0.003 * k[2], k4=0.0005 * k[3],
        )  # fmt: skip
    # About the arctangent's: the angle off the axis over its tangent.
    return Lens(
        model=model, focal_px=generator.uniform(300, 700), centre_px=centre, p1=1e-4 * k[3],
        k1=0.78 + 0.02 * k[0], k2=0.068, k4=1.11 + 0.02 * k[1], k5=0.238, k6=0.001 * k[2],
    )  # fmt: skip


@pytest.mark.parametrize(
    ("dome", "model"),
    [(dome, "brown") for dome in (False, True)]
    + [(True, "rational"), (False, "fisheye"), (True, "fisheye")],
)
def test_a_ray_passes_through_what_its_pixel_sees(dome: bool, model: LensKind) -> None:
    """Points on the plugin's rays, 0.2 to 2.5 m away, are imaged on their pixels within 0.005 px.

    The plugin works in single precision: a coordinate of 1000 mm is good to 6e-5 mm, a ray
    of a metre to some 1e-4 mm, which is 1e-4 px here.
    """
    pixels = grid()
    for seed in range(10):
        scene = random_rig(seed, dome, model)
        origin, direction, _ = rays(scene, pixels)
        back = project(scene, origin + np.geomspace(200, 2500, 10)[seed] * direction)
        np.testing.assert_allclose(back, pixels, atol=0.005)


def test_rays_leave_from_the_glass_and_are_unit() -> None:
    """In the camera frame they start on the port's outer face, gap + thickness along it."""
    scene = replace(SCENE, tank=SCENE.tank.model_copy(update={"port": PORT}))
    origin, direction, _ = rays(scene, grid())
    pose, port = camera_pose(scene.tank.head), PORT
    depth = pose.invert(origin)[:, 2]
    np.testing.assert_allclose(depth, port.gap_mm + port.thickness_mm, atol=2e-4)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1, atol=1e-6)


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


@pytest.mark.parametrize(
    ("aperture", "focus", "distance", "pixel"),
    [
        (8.0, 300.0, 2500.0, (12, 460)),
        (3.0, 900.0, 950.0, (320, 240)),
        (0.5, 2000.0, 250.0, (639, 0)),
    ],
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


@pytest.mark.parametrize(
    ("aperture", "focus", "distances"),
    [(8.0, 300.0, (200.0, 2500.0)), (3.0, 900.0, (950.0,)), (24.0, 1000.0, (400.0, 990.0))],
)
def test_defocus_is_known_from_the_rays(
    aperture: float, focus: float, distances: tuple[float, ...]
) -> None:
    """The thin lens's circle, as above, at the corner's depth or on the axis, behind the port."""
    camera = lens_in_air(aperture, focus)
    found = Defocus.of(camera, (WIDTH, HEIGHT)).radius_px(np.array(distances))
    corner = np.hypot(WIDTH, HEIGHT) / 2 / 850
    port = PlanePort(gap_mm=40.0)
    behind = np.outer(distances, [1, 1 / np.hypot(1, corner)])
    depths = port.gap_mm + port.thickness_mm + behind
    circles = aperture * 850 * np.abs(1 / focus - 1 / depths) / 2
    assert circles.max(axis=0).min() - 1e-3 <= found
    assert found <= circles.max() * np.hypot(1, corner) + 1e-3  # seen aslant, it is taken as larger


def test_light_is_blurred_over_a_disc() -> None:
    """Of radius r, and of variance r² / 4 along either axis; an eighth of a pixel is seen of it."""
    defocus = Defocus.of(lens_in_air(24.0, 1000.0), (WIDTH, HEIGHT))
    radius = defocus.radius_px(np.array([600.0]))
    light = np.zeros((61, 61), np.float32)
    light[30, 30] = 1.0
    blurred = defocus.blurred(light, 600.0)
    v, u = np.indices(light.shape) - 30
    assert radius > 3 and blurred.sum() == pytest.approx(1, rel=1e-5)
    for axis in (u, v):
        assert (blurred * axis**2).sum() == pytest.approx(
            radius**2 / 4 + 1 / 12, rel=1 / 8 / radius
        )


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
