"""How a pencil beam spreads: power conserved on spheres, and what planes receive, by photons."""

from dataclasses import replace

import numpy as np

from lscan.records import Floats
from sim.render.spreads import make_spread, plane_crossings
from sim.scene.matter import Water
from sim.validation.physics.topics import topic
from sim.validation.rows import Row, Topic, row
from sim.water import Optics, planes, water_optics
from sim.water.spread import Spread, ring_edges, solid_angles

SEED, OTHER_SEED = 81, 82
TURBIDITIES_NTU = (1.0, 5.0)
SPHERES_MM = (200.0, 500.0, 1000.0, 2000.0)
TILTS_DEG, DISTANCES_MM = (0.0, 25.0, 48.0, 65.0), (500.0, 1000.0)
PARTS = 4  # places in a plane's cell, each way
STEEPEST = 0.2  # cosine of incidence, 78 degrees: beyond, light is dim and changes within a cell
WAVELENGTH_NM = 650.0


def beam_spread(photons: int) -> Topic:
    """The tables from so many photons, and others on planes."""
    rows = [found for ntu in TURBIDITIES_NTU for found in _of_water(ntu, photons)]
    return topic("spread", rows)


def _of_water(ntu: float, photons: int) -> tuple[Row, Row]:
    """The rows of one water."""
    optics = water_optics(Water(kind="tank", turbidity_ntu=ntu), WAVELENGTH_NM)
    clear = replace(optics, absorption_per_mm=0.0)
    lost = power_missed(make_spread(clear, photons, SEED), clear)
    missed, error = plane_missed(make_spread(optics, photons, SEED), optics, photons)
    return (
        row("spread-power", 100 * lost, seed=SEED, ntu=ntu, photons=photons),
        row("spread-planes", 100 * missed, seed=SEED, ntu=ntu, photons=photons, error=100 * error),
    )


def power_missed(spread: Spread, water: Optics) -> float:
    """Largest deviation of the scattered power through spheres from 1 - exp(-c r), of it.

    Parameters
    ----------
    spread, water : the tables and their water, which absorbs nothing
    """
    edges = ring_edges()
    theta = np.sqrt((edges[1:] ** 2 + edges[:-1] ** 2) / 2)
    depths = water.extinction_per_mm * np.array(SPHERES_MM)
    radial, _ = spread.vector_irradiance(theta, depths[:, np.newaxis], depths[:, np.newaxis])
    power = np.sum(radial * solid_angles(), axis=1) * depths**2
    return float(np.abs(power / -np.expm1(-depths) - 1).max())


def plane_missed(spread: Spread, water: Optics, photons: int) -> tuple[float, float]:
    """Mean deviation, by power, of what rings of planes receive of light scattered more than once.

    Against photons of another seed; and the deviation that their number alone would leave.

    Parameters
    ----------
    spread, water : the tables and their water
    photons : int, how many go to the planes
    """
    depths = water.extinction_per_mm * np.array(DISTANCES_MM)
    tilts = np.radians(TILTS_DEG)
    albedo = water.scattering_per_mm / water.extinction_per_mm
    counts = plane_crossings(water.phase, albedo, depths, tilts, photons, OTHER_SEED)
    expected = np.array([on_planes(spread, tilt, depths) for tilt in tilts])
    found = np.where(np.isnan(expected), 0, counts.weight / counts.photons)
    shape = len(tilts), len(depths), 3, planes.RINGS // 3, 2, planes.SECTORS // 2
    expected, found = (
        np.nan_to_num(power).reshape(shape).sum(axis=(3, 5)) for power in (expected, found)
    )
    deviation = np.sum(np.abs(expected - found)) / np.sum(found)
    # The mean size of a Gaussian's error is sqrt(2 / pi) of its standard deviation.
    error = np.sqrt(2 / np.pi) * np.sum(np.sqrt(found / counts.photons)) / np.sum(found)
    return float(deviation), float(error)


def on_planes(spread: Spread, tilt: float, distances: Floats) -> Floats:
    """(K, RINGS, SECTORS) power in cells of planes, as ``plane_crossings`` counts it.

    NaN where a cell is not seen as a whole, or from too near its plane, or lies too far away.

    Parameters
    ----------
    spread : Spread, of the water
    tilt : float, rad
    distances : (K,) where the planes cross the beam, optical depths
    """
    spread = replace(spread, once=replace(spread.once, table=0 * spread.once.table))
    rings, sectors = PARTS * planes.RINGS, PARTS * planes.SECTORS
    edges = np.geomspace(planes.RINGS_FROM, planes.RINGS_TO, rings + 1)
    theta = np.sqrt(edges[:-1] * edges[1:]).reshape(-1, 1)
    solid = 2 * np.pi / sectors * np.diff(-np.cos(edges)).reshape(-1, 1)
    azimuth = (np.arange(sectors) + 0.5) * np.pi / sectors
    cosine = np.cos(theta) * np.cos(tilt) - np.sin(theta) * np.cos(azimuth) * np.sin(tilt)
    aside = np.cos(theta) * np.cos(azimuth) * np.sin(tilt) + np.sin(theta) * np.cos(tilt)
    steep = np.maximum(cosine, STEEPEST)
    depth = distances.reshape(-1, 1, 1) * np.cos(tilt) / steep
    seen = (cosine > STEEPEST) & (depth < 0.7 * spread.farthest)
    received = spread.irradiance(theta, depth, steep, aside, depth) * depth**2 / steep * solid
    parts = np.where(seen, received, np.nan).reshape(
        len(distances), planes.RINGS, PARTS, planes.SECTORS, PARTS
    )
    return np.asarray(np.sum(parts, axis=(2, 4)))
