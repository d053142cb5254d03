"""Light of the second and all higher orders: densities, stock Mitsuba, and conserved power."""

from dataclasses import replace
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import example, given, strategies as st
from integrator_cases import (
    DRY,
    RUNS,
    differ,
    floor_scene,
    groove_scene,
    make_sheet,
    one_lobe,
    parts,
    render,
)
from scipy.special import ndtr

from lscan.records import Floats
from sim.render.plugins.arrays import floats, opaque, opaque_vector
from sim.render.sampled.beams import BeamDensity, beam_density, falloff, line_density
from sim.render.sampled.integrator import SheetIntegrator
from sim.render.sampled.multiple import MultipleIntegrator
from sim.render.tank import Tank
from sim.scene import Laser, Pose
from sim.scene.matter import AmbientLight, Penumbra
from sim.water import Optics
from tests.validation.light.scattering import stock_medium

FEW = examples(15)
LASER = Laser(
    power_mw=3, apex_mm=(0, 0, 0), fan_half_angle_deg=35, waist_mm=2, waist_distance_mm=400,
    port_tilt_deg=8,
)  # fmt: skip
# Points beside the line, in it, and outside the fan.
POINTS = st.tuples(st.floats(-400, 400), st.floats(-0.5, 2.0), st.floats(60, 700)).map(
    lambda p: (p[0], (-1) ** int(p[2]) * 10 ** p[1], -p[2])
)
AT_REST = Pose(np.eye(3), np.zeros(3))
STOCK_SEEDS = range(100, 100 + RUNS)


def doubles(values: mi.Float) -> Floats:
    return np.array(values, dtype=float)


def beam_about(point: tuple[float, float, float]) -> BeamDensity:
    """How rays of the sheet are drawn for light that goes to a point.

    Its numbers are opaque: the kernels of the first point serve all others.
    """
    beam = beam_density(make_sheet(LASER), mi.Point3f(opaque_vector(np.array(point))), opaque(0.0))
    dr.eval(beam)
    return beam


def drawn(beam: BeamDensity, count: int, seed: int) -> tuple[Floats, Floats, Floats]:
    """(count,) phi, lateral and their density, of as many samples."""
    numbers = np.random.default_rng(seed).random((4, count))
    choice, x, y, second = (floats(row) for row in numbers)
    phi, lateral = beam.sample(choice, mi.Point2f(x, y), second)
    return doubles(phi), doubles(lateral), doubles(beam.density(phi, lateral))


def sinh_spaced(low: float, high: float, centre: float, scale: float, count: int) -> Floats:
    """Places between two ends, as dense as 1 / sqrt(scale2 + (x - centre)2)."""
    first, last = (float(np.arcsinh((end - centre) / scale)) for end in (low, high))
    return centre + scale * np.sinh(np.linspace(first, last, count))


def assert_mean(values: Floats, expected: float) -> None:
    """The mean is as expected within 4.5 standard errors: missed once in 150,000 tests."""
    error = values.std() / np.sqrt(len(values))
    assert abs(values.mean() - expected) < 4.5 * error + 1e-5 * abs(expected)


@FEW
@given(
    centre=st.floats(-0.6, 0.6), scale=st.floats(-4, 0).map(lambda p: 10**p), end=st.floats(1, 1e4)
)
def test_falloffs_are_densities_of_their_samples(centre: float, scale: float, end: float) -> None:
    """Even numbers give even shares of the density's integral, which is 1."""
    numbers = (np.arange(1000) + 0.5) / 1000
    for low, high, density in (
        (-0.6, 0.6, falloff(*(opaque(v) for v in (centre, scale, -0.6, 0.6)))),
        (0.0, end, line_density(*(opaque(v) for v in (centre * end, 100 * scale, end)))),
    ):
        middle, spread = float(density.centre[0]), float(density.scale[0])
        place = sinh_spaced(low, high, middle, spread, 20001)
        value = doubles(density.density(floats(place)))
        share = np.concatenate([[0], np.cumsum(0.5 * (value[1:] + value[:-1]) * np.diff(place))])
        # Single precision of sinh and asinh; trapezoids even in asinh are exact to 1e-7.
        assert share[-1] == pytest.approx(1, abs=1e-4)
        sample = doubles(density.sample(floats(numbers)))
        # A place is rounded to 6e-8 of the centre, over the scale on which shares change.
        rounding = 1e-4 + 2**-23 * abs(middle) / spread
        assert np.abs(np.interp(sample, place, share) - numbers).max() < rounding
        first, last = doubles(density.sample(floats(np.array([0, 1 - 2**-24]))))
        assert np.float32(low) <= first < last <= np.float32(high), "rounding puts none outside"


@FEW
@given(point=POINTS, seed=st.integers(0, 2**31))
@example(point=(0.0, 1.0, -60.0), seed=17305722)  # one rounded to outside the fan
def test_beams_are_drawn_with_their_density(point: tuple[float, float, float], seed: int) -> None:
    """Functions over their density have the mean that is the functions' integral.

    The sheet's own power, and over the disc about the point a cone, whose integral is
    pi reach2 / 3.
    """
    beam, sheet = beam_about(point), make_sheet(LASER)
    phi, lateral, density = drawn(beam, 100_000, seed)
    power = doubles(sheet.power_density(floats(phi)))
    power *= np.exp(-0.5 * lateral**2) / np.sqrt(2 * np.pi)
    assert np.all(density > 0)
    assert_mean(power / density, LASER.power_mw)

    near = replace(beam, about=opaque(1.0))
    phi, lateral, density = drawn(near, 100_000, seed)
    rho, unit, reach = (float(v[0]) for v in (beam.rho, beam.unit, beam.reach))
    along = rho * (phi - float(beam.phi[0]))
    radius = np.hypot(along, unit * lateral - float(beam.offset[0]))
    cone = np.maximum(1 - radius / reach, 0) * (rho * unit)
    held = density > 0  # single precision puts a few samples just outside the disc
    assert held.mean() > 0.999
    assert_mean(cone[held] / density[held], np.pi * reach**2 / 3)


@pytest.mark.slow
def test_interreflection_equals_stock_path() -> None:
    """In clear water light of two and more orders is all that grooves reflect to and fro.

    Of stock ``path`` it is the picture of all orders less that of the first; with the same
    seed both draw the same points of the line, whose noise cancels.
    """
    tank = Tank(groove_scene())
    tank.higher.configure(DRY, tank.sheets, 0.0)
    camera = tank.make_camera(jitter=True)
    # So many samples that the 5 % below are beyond twice the bound.
    ours = parts(render(tank, camera, tank.higher, 64, range(RUNS)), 4)
    everything = {"type": "path", "max_depth": -1, "rr_depth": 50}
    first = {"type": "path", "max_depth": 2}
    theirs = render(tank, camera, everything, 128, STOCK_SEEDS)
    theirs -= render(tank, camera, first, 128, STOCK_SEEDS)
    theirs = parts(theirs, 4)
    assert not differ(ours, theirs)
    assert differ(0 * ours, theirs), "that there is any is seen"
    # Light of two orders goes as the albedo squared, of more with higher powers.
    assert differ(0.95**2 * ours, theirs), "an albedo 5 % less is seen"


def test_a_closed_white_box_shows_no_ambient_light() -> None:
    """Light from outside cannot enter, however often the walls reflect it."""
    scene = mi.load_dict({"type": "scene", "box": box(1.0)})
    for integrator in both(DRY, [], ambient=1.0):
        assert np.all(radiance(scene, integrator, *wall_rays(20_000, seed=3)) == 0)


def test_ambient_light_in_a_groove_equals_stock_path() -> None:
    """A V of albedo 0.8 under a uniform sky: both integrators' sum is stock ``path``'s."""
    bright = 2.0
    walls = {f"wall-{k}": groove_wall(side) for k, side in enumerate((-1, 1))}
    ours_scene = mi.load_dict({"type": "scene", **walls})
    # A dome of light, because the stock ``constant`` shines through walls: sampled as a light
    # it is 8 % brighter here than when met by chance, which the closed form confirms.
    glow = {"type": "area", "radiance": {"type": "spectrum", "value": bright}}
    sky = {"type": "sphere", "radius": 2000.0, "flip_normals": True, "emitter": glow}
    stock_scene = mi.load_dict({"type": "scene", **walls, "sky": sky})
    stock = mi.load_dict({"type": "path", "max_depth": -1, "rr_depth": 50})

    generator = np.random.default_rng(8)
    count = 40_000
    # Straight down into the V, all across it and well within its length.
    starts = np.column_stack(
        [
            generator.uniform(-80, 80, count),
            generator.uniform(-100, 100, count),
            np.full(count, 300),
        ]
    )
    down = np.tile([0.0, 0.0, -1.0], (count, 1))
    first, higher = (
        radiance(ours_scene, one, starts, down) for one in both(DRY, [], ambient=bright)
    )
    theirs = radiance(stock_scene, stock, starts, down)
    runs = (RUNS, 1, -1)
    ours, theirs = (v.reshape(runs).mean(axis=2) for v in (first + higher, theirs))
    assert not differ(ours, theirs)
    assert differ(first.reshape(runs).mean(axis=2), theirs), "the first order alone is not enough"
    assert differ(1.02 * ours, theirs), "2 % more light is seen"


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_penumbra_dims_a_surface_as_a_gaussians_integral(side: Literal["left", "right"]) -> None:
    """A white floor under a uniform sky of radiance L shows L, times the share that is left."""
    shade = Penumbra(x_mm=20.0, width_mm=30.0, left=0.1, side=side)
    size = mi.ScalarTransform4f().scale([1000, 1000, 1])
    floor = {"type": "rectangle", "to_world": size, "bsdf": matt(1.0)}
    x_mm = np.linspace(-100.0, 140.0, 49)
    starts = np.column_stack([x_mm, 0 * x_mm, 0 * x_mm + 300])
    first = SheetIntegrator(mi.Properties())
    first.configure(DRY, [], 2.0, AmbientLight(penumbra=shade))
    scene = mi.load_dict({"type": "scene", "floor": floor})
    seen = radiance(scene, first, starts, np.tile([0.0, 0.0, -1.0], (len(x_mm), 1)))
    lit = ndtr((x_mm - 20) / 30 * (1 if side == "left" else -1))
    # Single precision, and the error function's approximation in it.
    np.testing.assert_allclose(seen, 2.0 * (0.1 + 0.9 * lit), rtol=1e-5)


def both(
    water: Optics, sheets: list[Any], ambient: float
) -> tuple[SheetIntegrator, MultipleIntegrator]:
    """The two integrators, of the first and of all higher orders."""
    integrators = SheetIntegrator(mi.Properties()), MultipleIntegrator(mi.Properties())
    for integrator in integrators:
        integrator.configure(water, sheets, ambient)
    return integrators


def radiance(scene: mi.Scene, integrator: Any, starts: Floats, along: Floats) -> Floats:
    """(N,) one sample of the radiance along each of (N, 3) rays."""
    count = len(starts)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(21, count)
    o, d = ([floats(column) for column in vectors.T] for vectors in (starts, along))
    rays = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(*o), mi.Vector3f(*d)))
    value, _, _ = integrator.sample(scene, sampler, rays, None, dr.full(mi.Bool, True, count))
    return doubles(value[0])


HALF_BOX = 200.0  # mm
BOXED = Laser(
    power_mw=5, apex_mm=(30, -20, 60), fan_half_angle_deg=40, waist_mm=12, waist_distance_mm=200
)


def matt(albedo: float) -> dict[str, Any]:
    """A two-sided Lambertian surface."""
    reflectance = {"type": "spectrum", "value": albedo}
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}


def box(albedo: float) -> dict[str, Any]:
    """A closed cube about the origin."""
    to_world = mi.ScalarTransform4f().scale(HALF_BOX)
    return {"type": "cube", "to_world": to_world, "bsdf": matt(albedo)}


def groove_wall(side: int) -> dict[str, Any]:
    """One side of a V at right angles, along y, its edge in the origin's line."""
    to_world = mi.ScalarTransform4f().rotate([0, 1, 0], -45 * side).translate([100 * side, 0, 0])
    to_world = to_world.scale([100, 150, 1])
    return {"type": "rectangle", "to_world": to_world, "bsdf": matt(0.8)}


def wall_rays(count: int, seed: int) -> tuple[Floats, Floats]:
    """(N, 3) places even over the box's walls, and directions inwards, drawn by their cosine.

    So the mean radiance along them times pi is what arrives per mm2 of the walls.
    """
    generator = np.random.default_rng(seed)
    side = generator.integers(0, 6, count)
    a, b = generator.uniform(-HALF_BOX, HALF_BOX, (2, count))
    azimuth, squared = generator.uniform(0, 2 * np.pi, count), generator.random(count)
    inward = np.where(side % 2, 1.0, -1.0)
    flat = np.sqrt(squared) * np.array([np.cos(azimuth), np.sin(azimuth)])
    start = np.column_stack([a, b, -(HALF_BOX - 1e-2) * inward])
    along = np.column_stack([*flat, inward * np.sqrt(1 - squared)])
    # The components are listed from the wall's own tangents on, in cyclic order.
    order = np.argsort((side[:, np.newaxis] // 2 + np.arange(1, 4)) % 3, axis=1)
    return np.take_along_axis(start, order, axis=1), np.take_along_axis(along, order, axis=1)


def arriving(albedo: float, water: Optics) -> tuple[Floats, Floats]:
    """(runs,) mW that arrive on the box's walls by way of walls and water: of the first order
    and of all higher ones, the apex standing inside."""
    sheet = make_sheet(BOXED)
    scene = mi.load_dict({"type": "scene", "box": box(albedo), "sheet": sheet})
    area = 6 * (2 * HALF_BOX) ** 2
    # Of the first order there is little but the line, which a ray seldom meets by chance.
    first, higher = (
        np.pi * area * radiance(scene, one, *rays).reshape(RUNS, -1).mean(axis=1)
        for one, rays in zip(
            both(water, [sheet], 0.0),
            (wall_rays(RUNS * 2**15, seed=17), wall_rays(RUNS * 2**12, seed=18)),
            strict=True,
        )
    )
    return first, higher


def test_water_that_only_scatters_loses_no_light() -> None:
    """All light ends in the walls: what arrives there times (1 - albedo) is the laser's power.

    It arrives straight, which the loss along the fan's rays gives in closed form, or by way of
    walls and water: every family of two vertices and all walks take part.
    """
    albedo, water = 0.4, one_lobe(0.0, 4e-3, 0.6)
    first, higher = arriving(albedo, water)
    half = np.radians(BOXED.fan_half_angle_deg)
    phi = (np.arange(4000) + 0.5) * half / 2000 - half
    depth = HALF_BOX + BOXED.apex_mm[2]
    side = HALF_BOX - np.sign(phi) * BOXED.apex_mm[0]
    path = np.minimum(depth / np.cos(phi), side / np.abs(np.sin(phi)))
    straight = BOXED.power_mw * np.exp(-water.extinction_per_mm * path).mean()
    whole = straight + first + higher
    error = whole.std(ddof=1) / np.sqrt(RUNS)
    expected = BOXED.power_mw / (1 - albedo)
    assert error < 2e-2 * expected
    assert abs(whole.mean() - expected) < 4.1 * error + 1e-3 * expected
    assert higher.mean() > 0.3 * expected, "the higher orders carry much of it"


@pytest.mark.slow
def test_all_orders_in_turbid_water_equal_stock_volpath() -> None:
    """A thick sheet over a floor, in water that scatters evenly: two thirds of the light has
    met more than one place.  In four strips, from the veil down to the floor."""
    tank = Tank(floor_scene())
    water = one_lobe(4e-4, 2.6e-3, 0.0)
    stock = {"type": "volpath", "max_depth": -1, "rr_depth": 8}

    def ours(other: Optics) -> Floats:
        for integrator in (tank.integrator, tank.higher):
            integrator.configure(other, tank.sheets, 0.0)
        camera = tank.make_camera(jitter=True)
        first = render(tank, camera, tank.integrator, 64, range(RUNS))
        whole = first + render(tank, camera, tank.higher, 64, range(RUNS))
        return parts(whole.swapaxes(1, 2), 4)

    camera = tank.make_camera(medium=stock_medium(water), jitter=True)
    theirs = parts(render(tank, camera, stock, 512, STOCK_SEEDS).swapaxes(1, 2), 4)
    assert not differ(ours(water), theirs)
    assert differ(ours(one_lobe(4e-4, 2.6e-3, 0.1)), theirs), "an asymmetry of 0.1 is seen"


@pytest.mark.slow
def test_several_lines_add_up() -> None:
    """The picture of two lines is the sum of two pictures, each of one of them."""
    lines = [{"tilt_deg": -16, "share": 0.4}, {"tilt_deg": 8, "share": 0.6}]
    tank = Tank(floor_scene(laser={"lines": lines, "waist_mm": 3.0}))
    water = one_lobe(4e-4, 1e-3, 0.7)
    camera = tank.make_camera(jitter=True)

    def picture(sheets: list[Any], seeds: range) -> Floats:
        tank.higher.configure(water, sheets, 0.0)
        return render(tank, camera, tank.higher, 8, seeds)

    together = picture(tank.sheets, range(8))
    singles = [picture([one], range(50 * k, 50 * k + 8)) for k, one in enumerate(tank.sheets, 1)]
    assert not differ(parts(together, 2), parts(np.sum(singles, axis=0), 2))
    assert differ(parts(together, 2), parts(np.sum(singles[1:], axis=0), 2)), "a line less is seen"


def moving_picture(speed: float, is_followed: bool = True) -> Floats:
    """(runs, 16) rows of all orders over a floor, with a head that moves 20 mm meanwhile.

    is_followed: whether the sheet moves with the camera.
    """
    scene = floor_scene(
        laser={"waist_mm": 3.0}, lens={"focal_px": 140.0}, head={"depression_deg": 45.0}
    )
    tank = Tank(scene)
    water = one_lobe(4e-4, 1e-3, 0.7)
    velocity = np.array([0.0, speed, 0.0])
    camera = tank.make_camera(jitter=True)
    camera.move(velocity, 40.0, 0.0)
    for sheet in tank.sheets:
        sheet.place(AT_REST, velocity if is_followed else None)
    for integrator in (tank.integrator, tank.higher):
        integrator.configure(water, tank.sheets, 0.0)
    pictures = render(tank, camera, tank.integrator, 256, range(8))
    pictures += render(tank, camera, tank.higher, 32, range(8))
    return pictures.sum(axis=2)


@pytest.mark.slow
def test_a_moving_head_sees_its_sheet_stand_still() -> None:
    """Over a level floor nothing changes while camera and laser move together, whatever the
    speed; at none, the picture is the same to the last bit."""
    still = moving_picture(0.0)
    assert np.array_equal(still, moving_picture(0.0, is_followed=False))
    assert not differ(moving_picture(500.0), still)
    assert differ(moving_picture(500.0, is_followed=False), still), "a smeared line is seen"
