"""Index of water, air and glass, and density, against published values."""

from typing import Any

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.camera.optics import FORMULA_SIGMA, stated_water
from lscan.config.documents import check
from lscan.config.rig import OpticsSection
from lscan.errors import InputError
from lscan.water import air_index, fresh_water_density, iapws_index, refractive_index

# docs/explanation/physics.md, section 1, 650 nm: T, Quan & Fry at S 0, the same times air, and both
# at S 35.
QUAN_FRY = [
    (0, 1.332262, 1.332630, 1.339110, 1.339480),
    (10, 1.331995, 1.332363, 1.338532, 1.338902),
    (20, 1.331324, 1.331692, 1.337661, 1.338031),
    (30, 1.330249, 1.330616, 1.336499, 1.336868),
]
LAST_DIGIT = 0.51e-6  # those values have six decimals
PRESSURES = [(0.101325, 1.3316675), (1.0, 1.3318006), (10.0, 1.3331194)]  # at 20 C, 650 nm


def absolute_index(t: float, salinity: float, nm: float, *mpa: float) -> float:
    return refractive_index(t, salinity, nm, *mpa) * air_index(nm)


# ---- Quan & Fry, air ---------------------------------------------------------------------


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


# ---- IAPWS, pressure ---------------------------------------------------------------------


def test_iapws_has_its_official_check_value():
    assert iapws_index(997.047435, 25.0, 226.5) == pytest.approx(1.39277824, abs=0.51e-8)


@pytest.mark.parametrize(
    ("t", "density", "index"),
    [
        (0.01, 999.793, 1.332643),
        (10, 999.702, 1.332374),
        (20, 998.207, 1.331668),
        (30, 995.649, 1.330619),
    ],
)
def test_index_agrees_with_iapws(t, density, index):
    assert iapws_index(fresh_water_density(t), t, 650) == pytest.approx(index, abs=LAST_DIGIT)
    # 3e-5: the two formulas' stated accuracies, 1.5e-5 each.  Without the factor of air the
    # difference would be 3.7e-4.
    assert absolute_index(t, 0, 650) == pytest.approx(iapws_index(density, t, 650), abs=3e-5)


def test_the_formula_s_uncertainty_is_what_it_differs_by_from_iapws():
    """Fresh water of 0 to 30 C, 400 to 700 nm: rms, and 95 % within its interval."""
    off = np.array([
        absolute_index(t, 0, nm) - iapws_index(fresh_water_density(t), t, nm)
        for t in np.linspace(0, 30, 31) for nm in np.linspace(400, 700, 13)
    ])  # fmt: skip
    assert np.sqrt(np.mean(off**2)) == pytest.approx(FORMULA_SIGMA, rel=0.05)
    assert np.mean(np.abs(off) < 1.96 * FORMULA_SIGMA) > 0.95


@pytest.mark.parametrize(
    ("kelvin", "mpa", "litres"), [(300.0, 3.0, 0.100215168e-2), (300.0, 80.0, 0.971180894e-3)]
)
def test_density_has_the_check_values_of_its_release(kelvin, mpa, litres):
    # IAPWS R7-97, table 5: specific volume in m3/kg, nine digits.
    volume = 1 / fresh_water_density(kelvin - 273.15, mpa)
    assert volume == pytest.approx(litres, rel=0.51e-8)


@pytest.mark.parametrize(
    ("t", "bar", "density"),
    [(5, 0, 999.96675), (5, 1000, 1044.12802), (25, 0, 997.04796), (25, 1000, 1037.90204)],
)
def test_density_agrees_with_the_equation_of_state_of_the_sea(t, bar, density):
    # UNESCO 44 (Fofonoff & Millard 1983), check values at salinity 0; bar above atmosphere and
    # C of IPTS-68.  0.045 kg/m3 is 1.5e-5 of the index, the accuracy Quan & Fry state.
    mpa = min(0.101325 + bar / 10, 100.0)
    expected = density + (mpa - 0.101325 - bar / 10) * 0.38  # d rho / dp at 1000 bar
    assert fresh_water_density(t / 1.00024, mpa) == pytest.approx(expected, abs=0.045)


@pytest.mark.parametrize(("mpa", "index"), PRESSURES)
def test_index_under_pressure_is_that_of_iapws(mpa, index):
    digit = 0.51e-7  # the values have seven decimals
    assert iapws_index(fresh_water_density(20, mpa), 20, 650) == pytest.approx(index, abs=digit)
    rise = absolute_index(20, 0, 650, mpa) - absolute_index(20, 0, 650)
    assert rise == pytest.approx(index - PRESSURES[0][1], abs=2 * digit)


@examples(40)
@given(
    t=st.floats(0, 30),
    psu=st.floats(0, 35),
    nm=st.floats(400, 700),
    mpa=st.floats(0.1, 99),
    more=st.floats(0.01, 1),
)
def test_index_rises_with_pressure_whatever_the_water(t, psu, nm, mpa, more):
    assert refractive_index(t, psu, nm, 0.101325) == refractive_index(t, psu, nm)
    rise = refractive_index(t, psu, nm, mpa + more) - refractive_index(t, psu, nm, mpa)
    # Compressibility 3.4 to 5.1e-10 1/Pa, and rho dn/drho 0.32 to 0.36: 1.1 to 1.9e-4 a MPa.
    assert 1.1e-4 < rise / more < 1.9e-4


# ---- refusals ----------------------------------------------------------------------------


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


@pytest.mark.parametrize("mpa", [0.0, 0.099, 100.1, np.nan])
def test_pressure_out_of_range_is_refused(mpa):
    with pytest.raises(InputError, match=r"pressure_mpa.*allowed: 0\.1 to 100"):
        refractive_index(20, 0, 650, mpa)
    with pytest.raises(InputError, match="pressure_mpa"):
        fresh_water_density(20, mpa)


@pytest.mark.parametrize(
    ("density", "t", "nm", "named"),
    [
        (1061, 20, 650, "density_kg_m3"),
        (998, -13, 650, "temperature_c"),
        (998, 501, 650, "temperature_c"),
        (998, 20, 199, "wavelength_nm"),
        (998, 20, 1101, "wavelength_nm"),
    ],
)
def test_iapws_out_of_range_is_refused(density, t, nm, named):
    with pytest.raises(InputError, match=f"{named}.*allowed"):
        iapws_index(density, t, nm)


@pytest.mark.parametrize("state", [{"temperature_c": (31.0, 0.1)}, {"salinity_psu": (35.165, 0.1)}])
def test_water_beyond_the_formula_is_referred_to_its_index(state: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"where the index has a formula.* water_index = \["):
        check(OpticsSection, {"temperature_c": (20.0, 0.1)} | state, where="rig.toml")


@pytest.mark.parametrize(("salinity_psu", "less"), [(0.0, 0.03), (35.0, 0.05)])
def test_the_index_at_depth_is_as_uncertain_as_its_rise(salinity_psu: float, less: float) -> None:
    """The rise is 3 % too large in fresh water, whose pressure is less, and 4 to 6 % in the sea."""

    def stated(depth_m: float) -> tuple[float, float]:
        known = {"salinity_psu": (salinity_psu, 0.0), "depth_m": (depth_m, 0.0)}
        found = stated_water(OpticsSection(temperature_c=(4.0, 0.0), **known))
        assert found is not None
        return found

    (deep, sigma), (surface, _) = stated(4000.0), stated(0.0)
    assert less * (deep - surface) < 1.96 * sigma < 0.13 * (deep - surface)
