"""The table of the light that the water scatters of a sheet, against sums over many beams."""

from collections.abc import Callable
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from gathered_cases import WATER, spread
from integrator_cases import make_sheet

from lscan.records import Floats
from sim.render.gathered import line as glows
from sim.render.gathered.line import Glow, thin_sheet
from sim.render.plugins.sheet import LaserSheet
from sim.render.plugins.water import SpreadLookup
from sim.scene import Laser, Pose
from sim.scene.poses import rotation

LASER = Laser(power_mw=10.0, apex_mm=[0.0, 0.0, 500.0], fan_half_angle_deg=35.0, waist_mm=0.5)
ELSEWHERE = Pose(rotation("ZYX", [30.0, -50.0, 110.0]), np.array([20.0, -300.0, 80.0]))
MANY = 128  # beams
# Parts back to the apex, along the fan and out of the sheet.
NORMALS = {
    "facing": (1.0, 0.0, 0.0),
    "along": (0.9, 0.436, 0.0),
    "out": (0.9, 0.0, 0.436),
    "in": (0.9, 0.0, -0.436),
    "oblique": (0.7, 0.5, -0.51),
}


@cache
def table(power_mw: float = 10.0) -> tuple[LaserSheet, SpreadLookup, Glow]:
    sheet = make_sheet(LASER.model_copy(update={"power_mw": power_mw}))
    lookup = SpreadLookup(spread(), WATER.extinction_per_mm)
    return sheet, lookup, Glow(sheet, spread(), WATER.extinction_per_mm)


def irradiance(
    glow: Glow, sheet: LaserSheet, place: tuple[Floats, Floats, Floats], parts: tuple[float, ...]
) -> Floats:
    """At (phi, rho, s) of a sheet, wherever it is placed, by a normal's parts."""
    phi, rho, aside = place
    vectors = (sheet.axis, sheet.across, sheet.normal, sheet.apex(mi.Float(0)))
    axis, across, out, apex = (np.array(v, dtype=float).ravel() for v in vectors)
    ahead = np.outer(np.sin(phi), across) + np.outer(np.cos(phi), axis)
    along = np.outer(np.cos(phi), across) - np.outer(np.sin(phi), axis)
    point = apex + ahead * rho[:, np.newaxis] + np.outer(aside, out)
    normal = along * parts[1] - ahead * parts[0] + out * parts[2]
    columns = (np.ascontiguousarray(v.T, dtype=np.float32) for v in (point, normal))
    return np.array(
        glow.irradiance(
            *(kind(v) for kind, v in zip((mi.Point3f, mi.Normal3f), columns, strict=True))
        ),
        dtype=float,
    )


def places(nearest_mm: float = 3.0, count: int = 400) -> tuple[Floats, Floats, Floats]:
    """phi within the fan, rho and s; from 6 standard deviations of the sheet on it is thin."""
    between = np.random.default_rng(3).uniform
    phi = between(-0.55, 0.55, count)
    rho, aside = (
        np.exp(between(np.log(low), np.log(high), count))
        for low, high in ((250, 1500), (nearest_mm, 100))
    )
    return phi, rho, aside


@pytest.mark.parametrize("name", list(NORMALS))
def test_the_table_is_the_sum_over_many_beams(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Linear between 12, 28 and 21 nodes of curves that bend, and of the second degree in the
    normal: 4 % rms, 2 % in the mean within 100 mm of the sheet."""
    sheet, lookup, glow = table()
    monkeypatch.setattr(glows, "BEAMS", MANY)
    expected = thin_sheet(sheet, lookup, *places(), np.array([NORMALS[name]]))[:, 0]
    off = irradiance(glow, sheet, places(), NORMALS[name]) / expected - 1
    assert np.sqrt(np.mean(off**2)) < 0.04
    assert abs(off.mean()) < 0.02


def test_the_table_of_one_sheet_is_summed_up_once(monkeypatch: pytest.MonkeyPatch) -> None:
    _, _, first = table()
    monkeypatch.setattr(glows, "thin_sheet", None)  # would raise if called
    again = Glow(make_sheet(LASER.model_copy()), spread(), WATER.extinction_per_mm)
    np.testing.assert_array_equal(np.array(again._table.tensor()), np.array(first._table.tensor()))


def test_glow_is_the_sheets_power() -> None:
    (sheet, _, once), (strong, _, twice) = table(), table(20.0)
    one, two = (
        irradiance(glow, at, places(0.05), NORMALS["oblique"])
        for glow, at in ((once, sheet), (twice, strong))
    )
    np.testing.assert_allclose(two, 2 * one, rtol=1e-4)


def test_glow_falls_off_with_the_distance_from_the_sheet() -> None:
    sheet, _, glow = table()
    aside = np.geomspace(0.05, 1000, 200)
    for phi, rho in ((0.0, 400.0), (0.4, 900.0)):
        place = (np.full_like(aside, phi), np.full_like(aside, rho), aside)
        light = irradiance(glow, sheet, place, NORMALS["facing"])
        assert np.all(np.diff(light) < 0)
        # A surface is lit alike on either side of the sheet.
        mirrored = irradiance(glow, sheet, (place[0], place[1], -aside), NORMALS["facing"])
        np.testing.assert_allclose(mirrored, light, rtol=1e-3)


@pytest.mark.parametrize("name", list(NORMALS))
def test_strip_and_rest_are_all_that_falls_on_a_plane(name: str) -> None:
    """What counts as of the line is a sum over 16 places across it; here over 800 across and 80
    along it, of a fan that is 40 mm wide there.  What a tilt along the fan shifts over one of its
    ends, 10 mm at most of the 80, it shifts back over the other but for how the light varies
    between the ends, a tenth: 1 %; the nodes across lie a third of a decade apart: 1 %."""
    sheet, _, glow = table()
    axis, across, out, apex = (
        np.array(v, dtype=float).ravel()
        for v in (sheet.axis, sheet.across, sheet.normal, sheet.apex(mi.Float(0)))
    )
    back, along, outward = NORMALS[name]
    normal = across * along - axis * back + out * outward
    phi, aside = np.meshgrid(
        np.linspace(-0.1, 0.1, 81), 0.1 * np.sinh(np.linspace(-6.5, 6.5, 801)), indexing="ij"
    )
    ahead = np.sin(phi)[..., np.newaxis] * across + np.cos(phi)[..., np.newaxis] * axis
    start = apex + aside[..., np.newaxis] * out
    rho = ((apex + 400.0 * axis - start) @ normal) / (ahead @ normal)
    point = start + rho[..., np.newaxis] * ahead
    turned, moved = (np.gradient(point, axis=k) for k in (0, 1))
    area = np.linalg.norm(np.cross(turned, moved), axis=-1).ravel()

    def light(of: Callable[..., mi.Float], at: Floats) -> Floats:
        place = mi.Point3f(np.ascontiguousarray(at.reshape(-1, 3).T, dtype=np.float32))
        plane = mi.Vector3f(*normal.tolist()) + dr.zeros(mi.Float, at.size // 3)
        return np.array(of(place, plane), dtype=float)

    strip = light(glow.of_strip, point[:, 400]).sum() * 0.2 / 80
    rest = (light(glow.off_strip, point) * area).sum()
    assert strip + rest == pytest.approx((light(glow.irradiance, point) * area).sum(), rel=0.02)
    assert 0.05 < rest / strip < 1


def test_glow_moves_with_the_head() -> None:
    """One table serves wherever the sheet is placed; places to single precision, 1e-4 mm of the
    0.5 mm at least from the sheet."""
    sheet = make_sheet(LASER)
    glow = Glow(sheet, spread(), WATER.extinction_per_mm)
    here = irradiance(glow, sheet, places(0.5), NORMALS["oblique"])
    sheet.place(ELSEWHERE)
    there = irradiance(glow, sheet, places(0.5), NORMALS["oblique"])
    np.testing.assert_allclose(there, here, rtol=1e-3)


def test_light_that_misses_many_surfaces_is_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of few photons none may fall on a facing surface: 11 of 31 are dark here.

    (n . v)^2, v square to the way back, is a polynomial of the second degree: the fit is exact, to
    rounding times the design's condition, 1e-16 * 1e6^2.
    """
    azimuth = np.pi / glows.AZIMUTHS
    across = np.array([0.0, -np.sin(azimuth), np.cos(azimuth)])
    received = np.maximum(1e-9 * (glows._normals() @ across) ** 2, 0.0)
    received[received < 1e-24] = 0.0
    assert received[0] == 0 and (received == 0).sum() == 11
    monkeypatch.setattr(glows, "thin_sheet", lambda *_: received)
    nought = np.zeros(())
    terms = glows._fit_coefficients(None, None, nought, nought, nought)  # type: ignore[arg-type]
    basis = np.stack(glows._basis(*glows._normals().T), axis=-1)
    np.testing.assert_allclose(basis @ terms, received, atol=1e-3 * received.max())
