"""Light scattered once on its way from the laser to the target, against quadrature."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats
from sim.render.plugins.arrays import floats
from sim.render.sampled.beams import drawn_beam
from sim.render.sampled.integrator import Leg
from sim.render.tank import Tank
from sim.scene import Laser, Scene
from sim.water import Optics, water_optics
from tests.validation.light.judge import JudgeEffort, landed_irradiance
from tests.validation.light.rigs import scene_with, topic
from tests.validation.light.single import widening
from tests.validation.rows import Topic, row

SEED = 53
SHEETS: Mapping[str, Mapping[str, float]] = MappingProxyType(
    {
        "parallel": {"waist_mm": 1.5, "waist_distance_mm": 600.0},
        "focused": {"waist_mm": 0.25, "waist_distance_mm": 650.0},
        "diverging": {"waist_mm": 0.25, "waist_distance_mm": 200.0},
    }
)
# Places on the floor: mm along the line, and half widths of the sheet beside it.
PLACES = ((0.0, 0.0), (0.0, 1.0), (0.0, 4.0), (150.0, -12.0))
ABOVE_MM = 10.0  # of the floor, where the rays to it start
# A strip of the floor about the line, mm along it and half widths across, that is judged in water
# so clear that light scattered twice is 6e-4 of it.
STRIP_MM, STRIP_WIDTHS, CLEAR_PER_MM, BATCHES = 300.0, 0.5, 1e-6, 8
TINY_MM = 1e-6  # of a range that is empty
REACH_WIDTHS = 3.0  # from the sheet's middle: 2e-8 of its light lies beyond
NODE, WEIGHT = (part / 2 for part in np.polynomial.legendre.leggauss(32))  # of a sum from 0 to 1
NODE = NODE + 0.5


@dataclass(frozen=True)
class LitFloor:
    """A level floor under an upright sheet, and what its light goes through.

    height_mm: the apex over the floor.
    """

    laser: Laser
    water: Optics
    height_mm: float

    def half_width(self, rho: Floats) -> Floats:
        """1/e2 half width of the sheet, mm, at distances from the apex."""
        return self.laser.half_thickness_mm(rho, self.water.index)


def laser_leg(samples: int) -> Topic:
    """The largest deviation at all places under each sheet, with so many samples a place."""
    rows = []
    for name in SHEETS:
        figure, error = deviation(name, samples)
        words: dict[str, Any] = {"name": name, "samples": samples, "error": error}
        rows.append(row("laser-leg", figure, seed=SEED, sigma=error, **words))
    figure, error = judged_deviation(samples // 2)
    words = {"error": error, "photons": BATCHES * (samples // 2)}
    rows.append(row("laser-leg-judge", figure, seed=SEED, sigma=error, **words))
    return topic("laser-leg", rows)


def deviation(name: str, samples: int) -> tuple[float, float]:
    """Largest relative deviation from quadrature over PLACES, and the largest standard error.

    name: of the sheet, among SHEETS.
    """
    scene = scene_with("laser-leg", laser=dict(SHEETS[name]))
    floor, tank = lit_floor(scene), Tank(scene)
    figures, errors = [], []
    for x_mm, widths in PLACES:
        beside_mm = widths * float(floor.half_width(np.hypot(x_mm, floor.height_mm)))
        mean, error = rendered(tank, x_mm, beside_mm, samples)
        expected = quadrature(floor, x_mm, beside_mm)
        figures.append(abs(mean / expected - 1))
        errors.append(error / expected)
    return max(figures), max(errors)


def judged_deviation(photons: int) -> tuple[float, float]:
    """Relative deviation of the judge's light on a strip about the line, and its standard error.

    photons: in each of BATCHES.
    """
    tank = Tank(scene_with("laser-leg", laser=dict(SHEETS["parallel"])))
    clear = replace(tank.water, scattering_per_mm=CLEAR_PER_MM)
    tank.higher.configure(clear, tank.sheets, 0.0)
    floor = replace(lit_floor(tank.scene), water=clear)
    widest = STRIP_WIDTHS * float(floor.half_width(np.array(floor.height_mm)))
    nodes, weights = np.polynomial.legendre.leggauss(8)
    half, weight = nodes[nodes > 0], weights[nodes > 0]
    expected: float = sum(
        a * b * quadrature(floor, x, s)
        for x, a in zip(STRIP_MM * half, weight, strict=True)
        for s, b in zip(widest * half, weight, strict=True)
    )
    found = [_on_strip(tank, photons, widest, SEED + k) for k in range(BATCHES)]
    error = float(np.std(found, ddof=1) / np.sqrt(BATCHES)) / expected
    return abs(float(np.mean(found)) / expected - 1), error


def _on_strip(tank: Tank, photons: int, widest: float, seed: int) -> float:
    """Mean of what so many photons bring to as many random places of the strip, mW/mm2."""
    floor, generator = tank.scene.tank.floor, np.random.default_rng(seed)
    assert floor is not None
    x, s = (floats(generator.uniform(-end, end, photons)) for end in (STRIP_MM, widest))
    start = mi.Point3f(x, s, floor.z_mm + ABOVE_MM)
    rays = mi.Ray3f(start, mi.Vector3f(0, 0, -1))
    return float(landed_irradiance(tank, rays, JudgeEffort(photons=photons), seed).mean())


def lit_floor(scene: Scene) -> LitFloor:
    """The scene's floor and sheet, which has to stand upright."""
    laser, floor = scene.tank.laser, scene.tank.floor
    assert floor is not None
    water = water_optics(scene.tank.water, laser.wavelength_nm)
    return LitFloor(laser, water, laser.apex_mm[2] - floor.z_mm)


def rendered(tank: Tank, x_mm: float, beside_mm: float, samples: int) -> tuple[float, float]:
    """Irradiance that the tank finds at a place of its floor, mW/mm2, and its standard error."""
    floor = tank.scene.tank.floor
    assert floor is not None
    tank.place(0.0)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(SEED, samples)
    start = mi.Point3f(x_mm, beside_mm, floor.z_mm + ABOVE_MM)
    down = mi.Ray3f(start, mi.Vector3f(0, 0, -1))
    ray = dr.gather(mi.Ray3f, down, dr.zeros(mi.UInt32, samples))
    si, higher, sheet = tank.mitsuba_scene.ray_intersect(ray), tank.higher, tank.sheets[0]
    leg = Leg(tank.mitsuba_scene, sampler, ray, si, mi.Bool(True))
    beam = drawn_beam(sheet, sampler, si.p, ray.time, leg.active)
    radiance = np.array(higher.surface_water(leg, sheet, beam), dtype=float)
    light = radiance * np.pi / floor.albedo * np.exp(tank.water.extinction_per_mm * ABOVE_MM)
    return float(light.mean()), float(light.std() / np.sqrt(samples))


def quadrature(floor: LitFloor, x_mm: float, beside_mm: float) -> float:
    """The same by Gauss and Legendre's rule, in mW/mm2.

    The sum goes over levels above the floor, and on each over places of the sheet: across it by
    cubes of the distance from the place whose light travels straight to the one in question, and
    along it by hyperbolic sines scaled by that distance.  So the phase function's peak, a power
    of the angle, leaves a smooth integrand.
    """
    near = 0.5 * float(floor.half_width(np.array(floor.height_mm)))
    last = np.arcsinh(floor.height_mm / near)
    levels = near * np.sinh(last * NODE)
    steps = last * WEIGHT * near * np.cosh(last * NODE)
    return float(steps @ _from_levels(floor, x_mm, beside_mm, levels))


def _from_levels(floor: LitFloor, x_mm: float, beside_mm: float, levels: Floats) -> Floats:
    """(N,) light from (N,) levels above the floor, mW/mm2 per mm of height."""
    rise = levels[:, None, None]
    phi, down = np.arctan2(x_mm, floor.height_mm), floor.height_mm - rise
    # Where light travels straight to the place, and how fast it turns away beside that.
    apart, rho = rise / np.cos(phi), down / np.cos(phi)
    turns = 1 / apart + widening(floor.laser, rho, floor.water.index)
    straight = beside_mm / (apart * turns)
    half = np.radians(floor.laser.fan_half_angle_deg)
    reach = REACH_WIDTHS * np.maximum(floor.half_width(down), floor.half_width(down / np.cos(half)))
    ratio = turns / (np.cos(phi) * (1 / apart + 1 / rho))
    middle, edge = down * np.tan(phi), down * np.tan(half)
    light = np.zeros(len(levels))
    for side in (-1.0, 1.0):
        first, last = (np.maximum(end - side * straight, 0.0) for end in (-reach, reach))
        gap = first + np.maximum(last - first, TINY_MM) * NODE[:, None] ** 3
        across = np.maximum(last - first, 0.0) * 3 * NODE[:, None] ** 2 * WEIGHT[:, None]
        low, high = (np.arcsinh((end - middle) / (gap * ratio)) for end in (-edge, edge))
        place = low + (high - low) * NODE
        along = (high - low) * WEIGHT * gap * ratio * np.cosh(place)
        x, s = middle + gap * ratio * np.sinh(place), straight + side * gap
        found = _scattered_at(floor, x, s, rise, (x_mm, beside_mm))
        light += (across * along * found).sum(axis=(1, 2))
    return light


def _scattered_at(
    floor: LitFloor, x: Floats, s: Floats, rise: Floats, place: tuple[float, float]
) -> Floats:
    """Irradiance at a place of the floor by what is scattered at x, s and height, per mm3."""
    laser, water = floor.laser, floor.water
    down = floor.height_mm - rise
    rho = np.hypot(x, down)
    way = _unit(x / rho, s * widening(laser, rho, water.index), -down / rho)
    offset = place[0] - x, place[1] - s, -rise
    apart = np.sqrt(sum(part**2 for part in offset))
    chord = np.sqrt(sum((a - b) ** 2 for a, b in zip(way, _unit(*offset), strict=True)))
    phase = water.phase(2 * np.arcsin(np.minimum(chord / 2, 1.0)))
    width = floor.half_width(rho)
    across = np.sqrt(2 / np.pi) / width * np.exp(-2 * (s / width) ** 2)
    power = laser.power_mw / (2 * np.radians(laser.fan_half_angle_deg)) / rho * across
    loss = np.exp(-water.extinction_per_mm * (rho + apart))
    return np.asarray(water.scattering_per_mm * phase * power * loss * rise / apart**3)


def _unit(*vector: Floats) -> tuple[Floats, ...]:
    """The parts of vectors, over their length."""
    length = np.sqrt(sum(part**2 for part in vector))
    return tuple(part / length for part in vector)
