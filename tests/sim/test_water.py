"""The water against published tables, against an independent index, and by quadrature."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lscan.errors import InputError
from sim.scene import Water
from sim.water import (
    PARTICLE_G,
    PARTICLE_WEIGHTS,
    absolute_index,
    absorption_per_m,
    air_index,
    henyey_greenstein,
    molecular_phase,
    molecular_scattering_per_m,
    refractive_index,
    water_optics,
)

# physics.md section 1, 650 nm: T, Quan & Fry at S 0, the same times air, and both at S 35.
QUAN_FRY = [
    (0, 1.332262, 1.332630, 1.339110, 1.339480),
    (10, 1.331995, 1.332363, 1.338532, 1.338902),
    (20, 1.331324, 1.331692, 1.337661, 1.338031),
    (30, 1.330249, 1.330616, 1.336499, 1.336868),
]
LAST_DIGIT = 0.51e-6  # those values have six decimals

# Petzold's average particle, degrees and 1/sr (physics.md section 3).
PETZOLD = np.fromstring(
    """
    0.1 1.7826e3  0.1259 1.3074e3  0.1585 9.5877e2  0.1995 7.0541e2  0.2512 5.1833e2
    0.3162 3.7978e2
    0.3981 2.7882e2  0.5012 2.0302e2  0.6310 1.4567e2  0.7944 1.0317e2  1 7.2256e1  1.259 5.0029e1
    1.585 3.4258e1  1.995 2.3019e1  2.512 1.5299e1  3.162 1.0106e1  3.981 6.6391  5.012 4.3341
    6.310 2.8323  7.943 1.8357  10 1.1630  15 4.9377e-1  20 2.4663e-1  25 1.4848e-1
    30 8.6863e-2  35 5.9844e-2  40 4.2479e-2  45 3.0950e-2  50 2.2959e-2  55 1.7144e-2
    60 1.3244e-2  65 1.0557e-2  70 8.5650e-3  75 7.0391e-3  80 5.8952e-3  85 4.9979e-3
    90 4.3311e-3  95 3.8158e-3  100 3.4348e-3  105 3.1441e-3  110 2.9386e-3  115 2.8223e-3
    120 2.7100e-3  125 2.5947e-3  130 2.4984e-3  135 2.3982e-3  140 2.3500e-3  145 2.3340e-3
    150 2.3861e-3  155 2.5285e-3  160 2.6859e-3  165 2.8604e-3  170 3.0579e-3  175 3.1200e-3
    180 3.1822e-3
    """,
    sep=" ",
).reshape(-1, 2)


def iapws_index(density_kg_m3: float, temperature_k: float, wavelength_um: float) -> float:
    """Absolute index of pure water: IAPWS R9-97 (Schiebener, Harvey)."""
    rho, t, lam = density_kg_m3 / 1000, temperature_k / 273.15, wavelength_um / 0.589
    lorentz = rho * (
        0.244257733
        + 0.974634476e-2 * rho
        - 0.373234996e-2 * t
        + 0.268678472e-3 * lam**2 * t
        + 0.158920570e-2 / lam**2
        + 0.245934259e-2 / (lam**2 - 0.229202**2)
        + 0.900704920 / (lam**2 - 5.432937**2)
        - 0.166626219e-1 * rho**2
    )
    return float(np.sqrt((1 + 2 * lorentz) / (1 - lorentz)))


def on_sphere(phase: np.ndarray, cosine: np.ndarray) -> float:
    """Integral over the sphere of a function given on a dense grid of the cosine."""
    return float(2 * np.pi * np.trapezoid(phase, cosine))


@pytest.fixture(scope="module")
def cosine() -> np.ndarray:
    """Cosines, denser towards forward: the sharpest lobe is 0.16 degrees wide."""
    angle = np.concatenate([[0], np.geomspace(1e-5, np.pi, 200_000)])
    return np.cos(angle[::-1])


@pytest.mark.parametrize(("t", "fresh", "fresh_abs", "sea", "sea_abs"), QUAN_FRY)
def test_index_is_that_of_the_table(t, fresh, fresh_abs, sea, sea_abs):
    assert refractive_index(t, 0, 650) == pytest.approx(fresh, abs=LAST_DIGIT)
    assert refractive_index(t, 35, 650) == pytest.approx(sea, abs=LAST_DIGIT)
    assert absolute_index(t, 0, 650) == pytest.approx(fresh_abs, abs=LAST_DIGIT)
    assert absolute_index(t, 35, 650) == pytest.approx(sea_abs, abs=LAST_DIGIT)


def test_index_at_660_nm_and_of_air():
    assert refractive_index(20, 0, 660) == pytest.approx(1.331081, abs=LAST_DIGIT)
    assert refractive_index(20, 35, 660) == pytest.approx(1.337409, abs=LAST_DIGIT)
    assert air_index(650) == pytest.approx(1.00027632, abs=0.51e-8)


def test_iapws_has_its_official_check_value():
    assert iapws_index(997.047435, 298.15, 0.2265) == pytest.approx(1.39277824, abs=0.51e-8)


@pytest.mark.parametrize(
    ("t", "density"), [(0.01, 999.793), (10, 999.702), (20, 998.207), (30, 995.649)]
)
def test_index_agrees_with_iapws(t, density):
    # 3e-5: the two formulas' stated accuracies, 1.5e-5 each.  Without the factor of air the
    # difference would be 3.7e-4.
    assert absolute_index(t, 0, 650) == pytest.approx(
        iapws_index(density, t + 273.15, 0.650), abs=3e-5
    )


def test_absorption_at_650_nm_with_its_slopes():
    assert absorption_per_m(22, 0, 650) == pytest.approx(0.340, abs=1e-12)
    assert absorption_per_m(12, 0, 650) == pytest.approx(0.340 + 3.62e-3, abs=1e-12)
    assert absorption_per_m(22, 35, 650) == pytest.approx(0.340 + 35 * 2.15e-5, abs=1e-12)
    assert absorption_per_m(5, 30, 532) == absorption_per_m(22, 0, 532)
    assert absorption_per_m(22, 0, 525) == pytest.approx((0.0204 + 0.0565) / 2, abs=1e-12)


@pytest.mark.parametrize(
    ("nm", "beta90", "b", "psu"),
    [
        (532, 9.19e-5, 1.511e-3, 0),
        (650, 4.003e-5, 6.582e-4, 0),
        (660, 3.759e-5, 6.180e-4, 0),
        (532, 1.194e-4, 1.963e-3, 35),
        (650, 5.174e-5, 8.506e-4, 35),
        (660, 4.856e-5, 7.984e-4, 35),
    ],
)
def test_molecular_scattering_is_that_of_zhang(nm, beta90, b, psu):
    # 1e-3: four digits (4e-4), and the power law's departure from three points (3e-4).
    assert molecular_scattering_per_m(psu, nm) == pytest.approx(b, rel=1e-3)
    beside = molecular_scattering_per_m(psu, nm) * molecular_phase(np.array(0.0))
    assert beside == pytest.approx(beta90, rel=1e-3)


def test_molecular_scattering_is_linear_in_salinity():
    ends = molecular_scattering_per_m(0, 600) + molecular_scattering_per_m(35, 600)
    assert molecular_scattering_per_m(17.5, 600) == pytest.approx(ends / 2, rel=1e-12)


def test_particle_phase_follows_petzold():
    cosine = np.cos(np.radians(PETZOLD[:, 0]))
    lobes = henyey_greenstein(cosine[:, None], PARTICLE_G)
    ratio = np.sum(PARTICLE_WEIGHTS * lobes, axis=1) / PETZOLD[:, 1]
    assert 0.905 < ratio.min() < 0.915  # .91 and 1.13 of the fit, to the digits printed
    assert 1.125 < ratio.max() < 1.135


def test_particle_phase_has_the_mean_cosine_and_backscatter_of_the_fit(cosine):
    phase = np.sum(PARTICLE_WEIGHTS * henyey_greenstein(cosine[:, None], PARTICLE_G), axis=1)
    assert on_sphere(phase, cosine) == pytest.approx(1, abs=2e-5)  # weights: five decimals
    assert on_sphere(phase * cosine, cosine) == pytest.approx(0.9237, abs=0.6e-4)
    behind = cosine <= 0
    assert on_sphere(phase[behind], cosine[behind]) == pytest.approx(0.01884, abs=0.6e-5)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(
    nm=st.floats(450, 700),
    t=st.floats(0, 30),
    psu=st.floats(0, 35),
    a=st.floats(0, 2),
    b=st.floats(0, 5),
)
def test_optics_are_whole(nm, t, psu, a, b):
    optics = water_optics(
        Water(
            temperature_c=t,
            salinity_psu=psu,
            particle_absorption_per_m=a,
            particle_scattering_per_m=b,
        ),
        nm,
    )
    angle = np.concatenate([[0], np.geomspace(1e-5, np.pi, 20_000)])
    cosine = np.cos(angle[::-1])
    assert on_sphere(optics.phase(cosine), cosine) == pytest.approx(1, abs=1e-4)
    assert 0 < optics.molecular_weight <= 1
    assert optics.hg_weights.sum() == pytest.approx(1, abs=1e-15)
    per_m = 1000 * optics.scattering_per_mm
    assert per_m == pytest.approx(b + molecular_scattering_per_m(psu, nm), rel=1e-12)
    assert 1000 * (optics.extinction_per_mm - optics.scattering_per_mm) == pytest.approx(
        a + absorption_per_m(t, psu, nm), rel=1e-9
    )
    assert optics.index == refractive_index(t, psu, nm)


@pytest.mark.parametrize(
    ("t", "psu", "nm", "named"),
    [
        (-1, 0, 650, "temperature_c"),
        (31, 0, 650, "temperature_c"),
        (float("nan"), 0, 650, "temperature_c"),
        (20, -0.1, 650, "salinity_psu"),
        (20, 36, 650, "salinity_psu"),
        (20, 0, 399, "wavelength_nm"),
        (20, 0, 701, "wavelength_nm"),
    ],
)
def test_out_of_range_is_refused(t, psu, nm, named):
    with pytest.raises(InputError, match=f"water: {named}.*allowed"):
        refractive_index(t, psu, nm)
    with pytest.raises(InputError, match=f"water: {named}.*allowed"):
        absorption_per_m(t, psu, nm)


def test_violet_is_refused_for_want_of_absorption():
    with pytest.raises(InputError, match=r"wavelength_nm.*got 420.*allowed: 450 to 700"):
        water_optics(Water(), 420.0)
