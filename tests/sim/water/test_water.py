"""The water's absorption and scattering against published tables, and every way to name it."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from water_sphere import integral

from lscan.errors import InputError
from sim.scene.matter import Water
from sim.water import (
    FournierForand,
    HenyeyGreensteinMixture,
    PetzoldTable,
    refractive_index,
    water_optics,
)
from sim.water.optics import absorption_per_m, molecular_phase, molecular_scattering_per_m

# docs/explanation/physics.md, section 2: printed absorption and scattering, 1/m.
PETZOLD_532 = [("clear", 0.069, 0.080), ("coastal", 0.088, 0.216), ("harbor", 0.295, 1.875)]
JERLOV_650 = [
    ("I", 0.309, 0.001), ("IB", 0.309, 0.045), ("II", 0.310, 0.270), ("III", 0.310, 0.737),
    ("1C", 0.316, 0.274), ("7C", 0.351, 1.772), ("9C", 0.398, 2.347),
]  # fmt: skip
SEA = {"temperature_c": 22.0, "salinity_psu": 35.0}
NAMED = ["pure", "clear", "coastal", "harbor", *(f"jerlov-{name}" for name, _, _ in JERLOV_650)]


def per_m(optics) -> tuple[float, float]:
    """Absorption and scattering in 1/m."""
    return 1000 * optics.absorption_per_mm, 1000 * optics.scattering_per_mm


# ---- pure water --------------------------------------------------------------------------


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
    beside = molecular_scattering_per_m(psu, nm) * molecular_phase(np.array(np.pi / 2))
    assert beside == pytest.approx(beta90, rel=1e-3)


def test_molecular_scattering_is_linear_in_salinity():
    ends = molecular_scattering_per_m(0, 600) + molecular_scattering_per_m(35, 600)
    assert molecular_scattering_per_m(17.5, 600) == pytest.approx(ends / 2, rel=1e-12)


# ---- waters with a name ------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "a", "b"), PETZOLD_532)
def test_petzolds_waters_are_as_printed_at_532_nm(kind, a, b):
    assert per_m(water_optics(Water(kind=kind, **SEA), 532)) == pytest.approx((a, b), abs=1e-12)


@pytest.mark.parametrize(("name", "a", "b"), JERLOV_650)
def test_jerlovs_types_are_as_printed_at_650_nm(name, a, b):
    # The printed absorption with the 0.031 that it leaves out; salt adds 35 x 2.15e-5.
    found = per_m(water_optics(Water(kind=f"jerlov-{name}", **SEA), 650))
    assert found == pytest.approx((a + 0.031 + 35 * 2.15e-5, b), abs=1e-12)


@pytest.mark.parametrize(("kind", "a", "b"), PETZOLD_532)
@pytest.mark.parametrize("nm", [450, 650])
def test_at_other_wavelengths_the_particles_stay_and_the_water_changes(kind, a, b, nm):
    found = per_m(water_optics(Water(kind=kind, **SEA), nm))
    added_a = a - absorption_per_m(22, 0, 532)
    added_b = b - molecular_scattering_per_m(35, 532)
    assert found[0] == pytest.approx(added_a + absorption_per_m(22, 35, nm), rel=1e-12)
    assert found[1] == pytest.approx(added_b + molecular_scattering_per_m(35, nm), rel=1e-12)


@pytest.mark.parametrize("kind", NAMED)
@pytest.mark.parametrize("nm", [450.0, 650.0])
def test_no_water_is_clearer_than_pure(kind, nm):
    found = per_m(water_optics(Water(kind=kind), nm))
    assert found[0] >= absorption_per_m(20, 0, nm) * (1 - 1e-12)
    assert found[1] >= molecular_scattering_per_m(0, nm) * (1 - 1e-12)


def test_pure_water_is_molecules_alone():
    optics = water_optics(Water(kind="pure"), 650)
    assert optics == water_optics(Water(), 650)
    assert optics.molecular_weight == 1
    angle = np.linspace(0, np.pi, 50)
    assert optics.phase(angle) == pytest.approx(molecular_phase(angle), rel=1e-14)


@pytest.mark.parametrize("ntu", [0.0, 0.3, 5.0, 100.0])
def test_a_tank_scatters_by_its_turbidity(ntu):
    pure = per_m(water_optics(Water(kind="pure"), 650))
    found = per_m(water_optics(Water(kind="tank", turbidity_ntu=ntu), 650))
    assert found == pytest.approx((pure[0], pure[1] + ntu), rel=1e-12)


def test_molecules_count_in_clear_water():
    """docs/explanation/physics.md, section 2: at 650 nm and 170 degrees they compare with clear
    water's particles.

    In Petzold's clear water b is 0.078 1/m of particles that scatter 3.06e-3 1/sr there, and
    8.5e-4 1/m of molecules that scatter 0.120 1/sr: 2.4e-4 and 1.0e-4 1/(m sr).
    """
    optics = water_optics(Water(kind="clear", phase="petzold", **SEA), 650)
    angle = np.radians(170.0)
    particles = (1 - optics.molecular_weight) * optics.particles.density(angle)
    molecules = optics.molecular_weight * molecular_phase(angle)
    assert 1000 * optics.scattering_per_mm * particles == pytest.approx(2.4e-4, rel=0.03)
    assert 1000 * optics.scattering_per_mm * molecules == pytest.approx(1.0e-4, rel=0.03)


# ---- waters by number --------------------------------------------------------------------


@examples(20)
@given(
    nm=st.floats(450, 700),
    t=st.floats(0, 30),
    psu=st.floats(0, 35),
    mpa=st.floats(0.1, 100),
    a=st.none() | st.floats(0, 2),
    b=st.none() | st.floats(0, 5),
    phase=st.sampled_from(["petzold-mixture", "petzold", "fournier-forand", "henyey-greenstein"]),
)
def test_optics_are_whole(nm, t, psu, mpa, a, b, phase):
    water = Water(
        temperature_c=t,
        salinity_psu=psu,
        pressure_mpa=mpa,
        particle_absorption_per_m=a,
        particle_scattering_per_m=b,
        phase=phase,
    )
    optics = water_optics(water, nm)
    assert integral(optics.phase) == pytest.approx(1, abs=1e-6)
    assert 0 < optics.molecular_weight <= 1
    molecular = molecular_scattering_per_m(psu, nm)
    assert 1000 * optics.scattering_per_mm == pytest.approx((b or 0) + molecular, rel=1e-12)
    absorbed = 1000 * (optics.extinction_per_mm - optics.scattering_per_mm)
    assert absorbed == pytest.approx((a or 0) + absorption_per_m(t, psu, nm), rel=1e-9)
    assert optics.index == refractive_index(t, psu, nm, mpa)


@examples(40)
@given(a=st.floats(0, 2), b=st.floats(0, 5), nm=st.floats(450, 700))
def test_totals_are_taken_as_they_are(a, b, nm):
    optics = water_optics(Water(absorption_per_m=a, scattering_per_m=b), nm)
    assert per_m(optics) == pytest.approx((a, b), rel=1e-12)
    molecular = molecular_scattering_per_m(0, nm)
    assert optics.molecular_weight * b == pytest.approx(min(molecular, b), rel=1e-12)
    assert 0 <= optics.molecular_weight <= 1


def test_totals_of_nothing_are_empty_space():
    optics = water_optics(Water(absorption_per_m=0.0, scattering_per_m=0.0), 650)
    assert optics.extinction_per_mm == 0
    assert integral(optics.phase) == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize(
    ("settings", "particles"),
    [
        ({}, HenyeyGreensteinMixture()),
        ({"phase": "petzold"}, PetzoldTable()),
        ({"phase": "fournier-forand"}, FournierForand(1.10, 3.5835)),
        (
            {"phase": "fournier-forand", "particle_index": 1.05, "junge_slope": 4.0},
            FournierForand(1.05, 4.0),
        ),
        ({"phase": "henyey-greenstein", "asymmetry": 0.8}, HenyeyGreensteinMixture((1.0,), (0.8,))),
    ],
)
def test_the_particles_scatter_as_the_scene_names(settings, particles):
    assert water_optics(Water(**settings), 650).particles == particles


@pytest.mark.parametrize("nm", [420.0, 701.0])
def test_light_out_of_range_is_refused_for_want_of_absorption(nm):
    for water in (Water(), Water(kind="harbor"), Water(absorption_per_m=1, scattering_per_m=1)):
        with pytest.raises(InputError, match=r"wavelength_nm.*got.*allowed: 450 to 700"):
            water_optics(water, nm)


@examples(30)
@given(
    step=st.floats(1e-3, 0.2), psu=st.floats(0, 35), t=st.floats(10, 30), particles=st.floats(0, 5)
)
def test_a_rounded_water_is_half_a_step_off_at_most(step, psu, t, particles):
    water = Water(temperature_c=t, salinity_psu=psu, particle_scattering_per_m=particles)
    whole = water_optics(water, 650.0)
    near = whole.rounded(step)
    for name in ("absorption_per_mm", "scattering_per_mm", "molecular_weight"):
        ratio = getattr(near, name) / getattr(whole, name)
        assert (1 + step) ** -0.5 <= ratio * (1 + 1e-12) and ratio <= (1 + step) ** 0.5 + 1e-12
    assert near.index == whole.index and near.rounded(step) == near
    assert whole.rounded(0.0) == whole


def test_rounded_waters_of_a_study_are_few():
    kinds = (Water(salinity_psu=psu) for psu in np.linspace(0, 5, 200))
    waters = [water_optics(kind, 650.0).rounded(0.01) for kind in kinds]
    assert 1 < len({(w.extinction_per_mm, w.scattering_per_mm) for w in waters}) < 12
