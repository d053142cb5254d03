"""Tables of a scene's water: kept by all that they depend on, and the same in kernels."""

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from ship_spreads import shipped_waters
from shown_work import ShownWork

from lscan.errors import InputError
from lscan.files.cache import long_work_shown
from sim.render import spreads, spreads as photons
from sim.render.plugins.arrays import floats
from sim.render.plugins.water import SpreadLookup
from sim.render.spreads import (
    MOST_PHOTONS,
    SEED,
    make_spread,
    photons_asked_for,
    shipped_file,
    spread_of,
)
from sim.scene.matter import Water
from sim.water import Optics, water_optics
from sim.water.spread import ANGLE_AXIS, Spread, between_nodes

PHOTONS = 2**14
WATER = water_optics(Water(kind="harbor"), 640.0)  # of no scene: no tables of it are shipped
WATER_OF_SCENES = water_optics(Water(kind="tank", turbidity_ntu=5.0), 650.0)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "lscan"


def made(water: Optics = WATER, seed: int = 1) -> Spread:
    return spread_of(water, PHOTONS, seed)


@pytest.fixture(scope="module")
def spread(tmp_path_factory: pytest.TempPathFactory) -> Spread:
    """The tables of WATER, for tests that only read them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("tables")))
        return made()


def test_a_kernel_reads_the_tables_as_numpy_does(spread: Spread) -> None:
    """To 3e-5: single precision of exponents up to 30, and of a place among 512 nodes, 5e-5 of a
    cell, between whose ends values differ by a tenth.  Where the beam ends far in front of the
    point, what is left is the difference of two large numbers: of those."""
    c = WATER.extinction_per_mm
    random = np.random.default_rng(3)
    theta = np.append(np.exp(random.uniform(np.log(1e-5), np.log(3.1), 4000)), [0.0, 3.1])
    distance = random.uniform(80.0, 3500.0, theta.size)
    cosine, chi = random.uniform(0, 1, theta.size), random.uniform(0, np.pi, theta.size)
    aside = np.sqrt(1 - cosine**2) * np.cos(chi)
    lookup, large = SpreadLookup(spread, c), np.zeros(theta.size)
    for end in (distance, distance * random.uniform(0.6, 1.5, theta.size)):
        kernel = [floats(values) for values in (theta, distance, end, cosine, aside)]
        found = np.array(lookup.vector_irradiance(*kernel[:3]))
        expected = c**2 * np.array(spread.vector_irradiance(theta, c * distance, c * end))
        large = np.maximum(large, np.hypot(*expected))
        assert np.all(np.abs(found - expected) < 3e-5 * large)
        received = np.array(lookup.irradiance(*kernel[:2], *kernel[3:], kernel[2]))
        on_plane = c**2 * spread.irradiance(theta, c * distance, cosine, aside, c * end)
        assert np.all(np.abs(received - on_plane) < 3e-5 * large)


def test_a_surface_in_space_receives_what_its_angles_say(spread: Spread) -> None:
    """A beam along an oblique direction, points beside it and surfaces that face its origin."""
    c = WATER.extinction_per_mm
    random = np.random.default_rng(4)
    beam, across, third = np.linalg.qr(random.normal(size=(3, 3)))[0]
    theta = np.exp(random.uniform(np.log(1e-4), np.log(2.0), 500))
    up = np.outer(np.cos(theta), beam) + np.outer(np.sin(theta), across)
    away = np.outer(np.cos(theta), across) - np.outer(np.sin(theta), beam)
    cosine, chi = random.uniform(0.05, 1, 500), random.uniform(0, np.pi, 500)
    aside, beside = (np.sqrt(1 - cosine**2) * part for part in (np.cos(chi), np.sin(chi)))
    normal = -cosine[:, None] * up + aside[:, None] * away + np.outer(beside, third)
    distance, origin = random.uniform(200, 2000, 500), np.array([30.0, -20.0, 10.0])
    point = (origin + distance[:, None] * up).T
    found = SpreadLookup(spread, c).received(
        mi.Point3f(*map(float, origin)),
        mi.Vector3f(*map(float, beam)),
        mi.Point3f(*map(floats, point)),
        mi.Vector3f(*map(floats, normal.T)),
        floats(1.1 * distance),
    )
    expected = c**2 * spread.irradiance(theta, c * distance, cosine, aside, 1.1 * c * distance)
    # Single precision of places, 1e-4 mm of 2000, is 6e-8 rad: of 1e-4 rad, 6e-4.
    unhidden = c**2 * np.hypot(*spread.vector_irradiance(theta, c * distance, c * distance))
    assert np.all(np.abs(np.array(found) - expected) < (1e-7 / theta * 4 + 5e-5) * unhidden)


def test_twice_the_attenuation_over_half_the_length_gives_four_times_the_light(
    spread: Spread,
) -> None:
    theta = floats(np.geomspace(1e-4, 3.0, 50))
    one, twice = (
        np.array(SpreadLookup(spread, c).irradiance(theta, length, 0.8, 0.1, length))
        for c, length in ((1e-3, mi.Float(1000.0)), (2e-3, mi.Float(500.0)))
    )
    assert twice == pytest.approx(4 * one, rel=1e-4)


def test_a_water_is_made_once(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = made()
    monkeypatch.setattr(spreads, "first_crossings", None)  # would raise if called
    again = made()
    assert np.array_equal(first.multiple, again.multiple)
    assert np.array_equal(first.once.table, again.once.table)
    assert np.array_equal(first.horizon, again.horizon)
    assert (again.nearest, again.farthest) == (first.nearest, first.farthest)


def test_while_a_table_is_made_it_is_shown_how_far(monkeypatch: pytest.MonkeyPatch) -> None:
    """And nothing is shown where it is there already."""
    monkeypatch.setattr(photons, "BATCH", PHOTONS // 2)  # to spheres, and one to planes
    shown = ShownWork()
    with long_work_shown(shown):
        made()
        made()
    assert shown.titles == ["tables of this water's scattered light"]
    assert shown.steps == [(1, 3), (2, 3), (3, 3)]


def test_what_a_table_depends_on_names_its_file(
    cache: Path, spread: Spread, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spreads, "make_spread", lambda *_: spread)
    waters = [
        WATER,
        replace(WATER, absorption_per_mm=1.01 * WATER.absorption_per_mm),
        replace(WATER, molecular_weight=WATER.molecular_weight + 0.01),
        water_optics(Water(kind="harbor", phase="henyey-greenstein", asymmetry=0.92), 640.0),
        water_optics(Water(kind="harbor", phase="henyey-greenstein", asymmetry=0.90), 640.0),
    ]
    for water in waters:
        made(water)
    made(seed=2)
    spread_of(WATER, 2 * PHOTONS)
    assert len(list(cache.glob("spread-*[0-9a-f]"))) == len(waters) + 2


def test_every_scene_finds_its_tables_shipped(monkeypatch: pytest.MonkeyPatch) -> None:
    """And nothing else is shipped; where more photons or others are asked for, none serve."""
    waters = {shipped_file(water): water for water in shipped_waters()}
    folder = Path(str(next(iter(waters)))).parent
    assert {Path(str(file)) for file in waters} == set(folder.iterdir())
    monkeypatch.setattr(spreads, "make_spread", lambda *_: pytest.fail("makes a table"))
    for water in waters.values():
        assert np.all(spread_of(water, PHOTONS).error > 0)
    for sent, seed in ((MOST_PHOTONS + 1, SEED), (PHOTONS, SEED + 1)):
        with pytest.raises(pytest.fail.Exception, match="makes a table"):
            spread_of(water, sent, seed)


def test_a_shipped_table_is_what_is_made() -> None:
    _assert_same_light(spread_of(WATER_OF_SCENES), WATER_OF_SCENES, 2**16)


@pytest.mark.slow
def test_every_shipped_table_is_what_is_made() -> None:
    for water in {shipped_file(water): water for water in shipped_waters()}.values():
        _assert_same_light(spread_of(water), water, 2**20)


def test_a_table_that_is_five_percent_off_is_noticed() -> None:
    spread = spread_of(WATER_OF_SCENES)
    spread = replace(spread, multiple=spread.multiple + np.array([0.05, 0.0]))
    with pytest.raises(AssertionError):
        _assert_same_light(spread, WATER_OF_SCENES, 2**18)


def _assert_same_light(shipped: Spread, water: Optics, photons: int) -> None:
    """Shipped tables and others of another seed differ as their standard errors say.

    Errors of neighbouring angles hang together: of the 40 angles and 4 distances at which they are
    compared some twenty are independent, whose rms is at most 1 + 3 / sqrt(2 * 20).
    """
    one, other = shipped, make_spread(water, photons, SEED + 1)
    theta, row = ANGLE_AXIS.nodes()[100:420:8], np.array([[20], [50], [80], [110]])
    depth = one.depth_axis.nodes()[row]
    light, again = (s.vector_irradiance(theta, depth, depth)[0] for s in (one, other))
    error = np.hypot(one.error, other.error)[row, np.arange(100, 420, 8)]
    z = (again - light) / light / error
    assert np.sqrt(np.mean(z**2)) < 1.5
    assert np.all(np.abs(z) < 5)


def test_errors_fall_with_the_number_of_photons() -> None:
    """As its square root; within 20 %, for the weights of the curves vary with the counts."""
    column = ANGLE_AXIS.place(np.array([0.1, 0.4]))
    few, many = (
        between_nodes(found.error, found.depth_axis.place(1000 * WATER.extinction_per_mm), column)
        for found in (spread_of(WATER, n) for n in (2**15, 2**17))
    )
    assert few / many == pytest.approx([2, 2], rel=0.2)


def test_between_nodes_the_tables_are_linear() -> None:
    """An eighth of the second difference is what linear interpolation misses: 1e-3 at most, at
    12 scatterings on 3 m too.  Nearer to the axis few photons fall, and most light is that of
    the quadrature; beyond 2 rad light is behind the source."""
    thick = replace(WATER, scattering_per_mm=12 / 3000)
    for water in (WATER, thick):
        table = spread_of(water, 2**18).multiple
        first, last = np.searchsorted(ANGLE_AXIS.nodes(), [0.02, 2.0])
        for axis in (0, 1):
            assert np.abs(np.diff(table[:, first:last], 2, axis=axis)).max() / 8 < 1e-3


@pytest.mark.parametrize(
    "water",
    [
        Water(kind="pure"),
        Water(absorption_per_m=0.0, scattering_per_m=2.0),
        Water(kind="tank", turbidity_ntu=100),
        Water(particle_scattering_per_m=1.0, phase="henyey-greenstein", asymmetry=-0.9),
    ],
    ids=["pure", "no absorption", "thick", "backwards"],
)
def test_every_water_has_tables(water: Water) -> None:
    """Finite everywhere, within the tables and beyond them, and light in every direction."""
    optics = water_optics(water, 650.0)
    spread = spread_of(optics, 2**12)
    theta, cosine = np.geomspace(1e-7, np.pi, 100), np.linspace(0, 1, 5).reshape(-1, 1)
    for distance in (50.0, 500.0, 4000.0):
        depth = distance * optics.extinction_per_mm
        assert np.all(spread.vector_irradiance(theta, depth, depth)[0] > 0)
        aside = 0.5 * np.sqrt(1 - cosine**2)
        received = spread.irradiance(theta, depth, cosine, aside, 0.9 * depth)
        assert np.all(np.isfinite(received))


def test_clear_air_has_no_table() -> None:
    with pytest.raises(InputError, match="scatters no light"):
        spread_of(replace(WATER, scattering_per_mm=0.0))


@pytest.mark.parametrize("said", ["lots", "-1", "16383", "1e6", ""])
def test_no_number_of_photons_is_refused(monkeypatch: pytest.MonkeyPatch, said: str) -> None:
    monkeypatch.setenv("LSCAN_PHOTONS", said)
    with pytest.raises(InputError, match=rf"LSCAN_PHOTONS.*{said}.*16384"):
        photons_asked_for()
