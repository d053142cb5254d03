"""Single scattering from the sheet against quadrature."""

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.integrate import quad

from lscan.records import Floats
from sim.render.tank import Tank
from sim.scene import Laser, Scene, sheet_pose
from sim.water import Optics, water_optics
from tests.validation.light.rigs import RANDOM, drawn, scene_with, topic
from tests.validation.rows import Topic, row

SEED = 71
SAMPLES = 200_000
# x of the direction (x, .05, 1), and the radiance for 1 W in 1/m2: the quadrature of
# docs/explanation/physics.md, section 7.
CHECK_VALUES = ((0.0, 5.942197074e-4), (0.1, 9.540560200e-4), (0.2, 1.300608409e-3))
PER_MM2_IN_PER_M2 = 1e6
REACH_SIGMAS = 10.0  # of the Gaussian along the ray: what lies beyond is below 1e-22
STEP_MM = 0.01  # of differences: their error is its square over the Rayleigh length's


@dataclass(frozen=True)
class LineOfSight:
    """A line of sight in a scene whose only content is water and one straight sheet.

    origin_mm, direction: (3,) in the world frame, the direction of unit length.
    """

    scene: Scene
    origin_mm: Floats
    direction: Floats


def single_scattering(sights: int) -> Topic:
    """The veil's radiance on the lines of the check values and on so many random lines of sight."""
    generator = np.random.default_rng(SEED)
    lines = [check_sight(x) for x, _ in CHECK_VALUES]
    lines += [random_sight(generator) for _ in range(sights)]
    checked = max(abs(check_by_quadrature(x) / value - 1) for x, value in CHECK_VALUES)
    veil = max(abs(rendered(line) / quadrature(line) - 1) for line in lines)
    rows = (
        row("veil-quadrature", checked),
        row("veil", veil, seed=SEED, sights=sights, samples=SAMPLES),
    )
    return topic("single-scattering", rows)


def check_by_quadrature(x: float) -> float:
    """Radiance for 1 W in 1/m2 on a check value's line of sight: particles only, no molecules."""
    sight = check_sight(x)
    optics = replace(optics_of(sight.scene), molecular_weight=0.0)
    return quadrature(sight, optics) * PER_MM2_IN_PER_M2


def optics_of(scene: Scene) -> Optics:
    """The scene's water at its laser's wavelength."""
    return water_optics(scene.tank.water, scene.tank.laser.wavelength_nm)


def check_sight(x: float) -> LineOfSight:
    """The geometry of the check values, turned so that its fan points down.

    There the apex is (.3, 0, 0) m, the fan's axis leans by 17 degrees from z and the sheet
    contains y; b = .5, a = .4 per m, Henyey-Greenstein .9, half angle 30 degrees, w = 2 mm.
    """
    lean = np.radians(17.0)
    down = np.array([-np.sin(lean), 0.0, np.cos(lean)])
    across = np.array([0.0, 1.0, 0.0])
    turn = np.array([across, np.cross(across, down), -down])  # rows: x, y, z of our world
    scene = scene_with("check-sheet")
    direction = turn @ np.array([x, 0.05, 1.0])
    return LineOfSight(
        scene, turn @ np.array([-300.0, 0.0, 0.0]), direction / np.linalg.norm(direction)
    )


def random_sight(generator: np.random.Generator) -> LineOfSight:
    """A line of sight through a random place of a random sheet, at least 10 degrees to it."""
    water, laser = (drawn(generator, part) for part in RANDOM["sheet"].values())
    water["asymmetry"] = generator.uniform(-0.3, 0.9)
    laser |= drawn(generator, {"waist_mm": (0.5, 3.0), "waist_distance_mm": (300, 700)})
    scene = scene_with("sheet", water=water, laser=laser)
    half = scene.tank.laser.fan_half_angle_deg
    pose = sheet_pose(scene.tank.laser, scene.tank.laser.sheets[0])
    rho, phi = generator.uniform(300, 900), np.radians(generator.uniform(-0.8, 0.8) * half)
    place = pose.apply(np.array([rho * np.sin(phi), 0.0, -rho * np.cos(phi)]))
    elevation, azimuth = np.radians(generator.uniform((10, 0), (80, 360)))
    flat = np.cos(elevation) * np.array([np.cos(azimuth), np.sin(azimuth)])
    direction = pose.rotation @ np.array([flat[0], np.sin(elevation), flat[1]])
    return LineOfSight(scene, place - generator.uniform(300, 1500) * direction, direction)


def rendered(sight: LineOfSight) -> float:
    """Radiance in mW/(mm2 sr) that the tank's integrator finds along the line of sight."""
    tank = Tank(sight.scene)
    tank.place(0.0)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(SEED, SAMPLES)
    ray = mi.Ray3f(mi.Point3f(sight.origin_mm.tolist()), mi.Vector3f(sight.direction.tolist()))
    rays = dr.gather(mi.RayDifferential3f, mi.RayDifferential3f(ray), dr.zeros(mi.UInt32, SAMPLES))
    _, _, values = tank.integrator.sample(tank.mitsuba_scene, sampler, rays)
    layers = dict(zip(tank.integrator.aov_names(), values, strict=True))
    return float(np.array(layers["scattered"], dtype=float).mean())


def quadrature(sight: LineOfSight, optics: Optics | None = None) -> float:
    """The same by adaptive quadrature along the ray, for a sheet of finite width.

    docs/explanation/physics.md, section 7, gives the limit of a thin sheet.

    optics: the water, the scene's own if None.
    """
    laser = sight.scene.tank.laser
    pose = sheet_pose(laser, laser.sheets[0])
    optics = optics or optics_of(sight.scene)
    origin, along = pose.invert(sight.origin_mm), sight.direction @ pose.rotation

    def source(t: float) -> float:
        point = origin + t * along
        way, distance = light_at(laser, point, optics.index)
        angle = np.arccos(np.clip(-(way @ along), -1, 1))  # it leaves along -along
        scattered = optics.scattering_per_mm * float(optics.phase(angle))
        loss = np.exp(-optics.extinction_per_mm * (distance + t))
        return float(scattered * irradiance(laser, point, optics.index) * loss)

    crossing = -origin[1] / along[1]
    reach = REACH_SIGMAS * 2.0 * laser.waist_mm / abs(along[1])
    low = max(crossing - reach, 0.0)
    value, _ = quad(
        source, low, crossing + reach, points=[crossing], epsabs=0, epsrel=1e-9, limit=400
    )
    return float(value)


def irradiance(laser: Laser, point: Floats, water_index: float) -> float:
    """mW/mm2 of a straight, uniform sheet at (3,) a point of its frame, mm.

    docs/explanation/physics.md, section 4.

    The laser's power, spread evenly over the fan's angle and as a Gaussian over s.
    """
    across, s, up = point
    rho = np.hypot(across, up)
    half = np.radians(laser.fan_half_angle_deg)
    if abs(np.arctan2(across, -up)) > half:
        return 0.0
    width = laser.half_thickness_mm(rho, water_index)
    density = np.sqrt(2 / np.pi) / width * np.exp(-2 * (s / width) ** 2)
    return float(laser.power_mw / (2 * half) / rho * density)


def light_at(laser: Laser, point: Floats, water_index: float) -> tuple[Floats, float]:
    """Which way light travels at (3,) a point of the sheet's frame, and mm from its source.

    Away from the apex within the sheet's plane; across it, as the sheet widens.
    """
    across, s, up = point
    rho = np.hypot(across, up)
    widths = laser.half_thickness_mm(np.array([0.0, rho]), water_index)
    way = np.array([across / rho, s * widening(laser, rho, water_index), up / rho])
    return way / np.linalg.norm(way), float(np.hypot(rho, s * (1 - widths[0] / widths[1])))


def widening(laser: Laser, rho: Floats, water_index: float) -> Floats:
    """Derivative of the logarithm of the sheet's half width, 1/mm, at distances from the apex."""
    ahead, behind = (
        laser.half_thickness_mm(rho + step, water_index) for step in (STEP_MM, -STEP_MM)
    )
    return np.asarray((ahead - behind) / (ahead + behind) / STEP_MM)
