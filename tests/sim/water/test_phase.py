"""Phase functions against published values, exact arithmetic, and by quadrature."""

from decimal import Decimal, localcontext

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from water_sphere import integral

from lscan.errors import InputError
from sim.water import FournierForand, HenyeyGreensteinMixture, PetzoldTable
from sim.water.optics import (
    TABLE_PER_SR,
    TABLE_RAD,
    henyey_greenstein,
    molecular_phase,
    table_density,
    table_integral,
)

ANGLES = np.concatenate([[0.0], np.geomspace(1e-5, np.pi, 2000)])
QUADRATURE = 1e-6  # of the panels, where a function has corners

# Petzold's average particle, degrees and 1/sr: every fifth row of docs/explanation/physics.md,
# section 3.
PETZOLD = [
    (0.1, 1.7826e3), (0.3162, 3.7978e2), (1, 7.2256e1), (3.162, 1.0106e1), (10, 1.1630),
    (35, 5.9844e-2), (60, 1.3244e-2), (85, 4.9979e-3), (110, 2.9386e-3), (135, 2.3982e-3),
    (160, 2.6859e-3), (180, 3.1822e-3),
]  # fmt: skip
# Index and Junge slope, backscattered share, and half of its last digit.
FOURNIER_SHARES = [
    (1.021, 3.0742, 1e-4, 5e-6),
    (1.040, 3.2010, 1e-3, 5e-6),
    (1.08, 3.483, 1e-2, 5e-5),
    (1.175, 4.065, 0.1, 5e-4),
    (1.10, 3.5835, 0.01831, 5e-6),
]
FOURNIER = [(1, 7.27838e1), (10, 1.09624), (30, 7.30563e-2), (90, 4.19332e-3), (180, 2.85777e-3)]
SPHERES = st.builds(FournierForand, st.floats(1.01, 1.5), st.floats(3.05, 4.95))


def mean_cosine(density) -> float:
    return integral(lambda angle: density(angle) * np.cos(angle))


def backscattered(density) -> float:
    return integral(density, np.pi / 2)


# ---- Henyey & Greenstein, molecules ------------------------------------------------------


@examples(30)
@given(g=st.floats(-0.9, 0.999))  # the rule of integral() is coarse at a backward peak
def test_a_lobe_has_its_mean_cosine(g):
    def lobe(angle):
        return henyey_greenstein(angle, g)

    assert integral(lobe) == pytest.approx(1, abs=QUADRATURE)
    assert mean_cosine(lobe) == pytest.approx(g, abs=QUADRATURE)
    assert henyey_greenstein(0.0, g) == pytest.approx(
        (1 + g) / (4 * np.pi * (1 - g) ** 2), rel=1e-12
    )


@pytest.mark.parametrize("angle", ["1e-5", "1e-3"])
@pytest.mark.parametrize("g", ["0.5", "0.99723", "0.99999"])
def test_a_lobe_is_exact_near_forward(angle, g):
    with localcontext() as context:
        context.prec = 40
        a, lean = Decimal(angle), Decimal(g)
        turned = a**2 / 2 - a**4 / 24 + a**6 / 720 - a**8 / 40320  # 1 - cos
        distance2 = (1 - lean) ** 2 + 2 * lean * turned
        expected = (1 - lean**2) / (4 * Decimal(np.pi) * distance2 ** Decimal("1.5"))
    # 1e-10: 1 - g keeps eleven digits where g is 0.99999.
    assert henyey_greenstein(float(angle), float(g)) == pytest.approx(float(expected), rel=1e-10)


def test_molecules_scatter_as_much_forward_as_backward():
    assert integral(molecular_phase) == pytest.approx(1, abs=1e-9)
    assert backscattered(molecular_phase) == pytest.approx(0.5, abs=1e-9)
    # Across, (1 + cos2 (1 - d)/(1 + d)) is 1 / (1 + (1 - d)/(1 + d)) of forward.
    ratio = molecular_phase(np.array(0.0)) / molecular_phase(np.array(np.pi / 2))
    assert ratio == pytest.approx(1 + 0.961 / 1.039, rel=1e-12)


# ---- mixtures ----------------------------------------------------------------------------


def test_the_four_lobes_follow_petzold():
    ratio = HenyeyGreensteinMixture().density(TABLE_RAD) / TABLE_PER_SR
    assert 0.905 < ratio.min() < 0.915  # .91 and 1.13 of the fit, to the digits printed
    assert 1.125 < ratio.max() < 1.135


def test_the_four_lobes_have_the_mean_cosine_and_backscatter_of_the_fit():
    density = HenyeyGreensteinMixture().density
    assert integral(density) == pytest.approx(1, abs=QUADRATURE)
    assert mean_cosine(density) == pytest.approx(0.9237, abs=0.51e-4)
    assert backscattered(density) == pytest.approx(0.01884, abs=0.51e-5)


def test_a_mixture_keeps_the_shape_of_its_argument():
    mixture = HenyeyGreensteinMixture((0.25, 0.75), (0.9, -0.3))
    angle = np.linspace(0, np.pi, 12).reshape(3, 4)
    lobes = 0.25 * henyey_greenstein(angle, 0.9) + 0.75 * henyey_greenstein(angle, -0.3)
    assert mixture.density(angle) == pytest.approx(lobes, rel=1e-14)
    assert mixture.density(np.array(0.3)).shape == ()


@pytest.mark.parametrize(
    ("weights", "g", "says"),
    [
        ((0.5, 0.4), (0.9, 0.1), "lobes: weights.*together 1"),
        ((1.0,), (1.0,), "lobes: g.*between -1 and 1"),
        ((1.0,), (0.9, 0.1), "one weight and one g"),
    ],
)
def test_lobes_that_are_no_density_are_refused(weights, g, says):
    with pytest.raises(InputError, match=says):
        HenyeyGreensteinMixture(weights, g)


# ---- Petzold's table ---------------------------------------------------------------------


@pytest.mark.parametrize(("degrees", "published"), PETZOLD)
def test_the_table_is_petzolds(degrees, published):
    assert table_density(np.radians(degrees)) == pytest.approx(published, rel=1e-12)


def test_the_table_has_the_published_integral_mean_cosine_and_backscatter():
    # 1e-5: one unit of the integral's last digit; the table's own digits leave 5e-6 and more.
    assert table_integral() == pytest.approx(0.99994, abs=1e-5)
    assert integral(table_density) == pytest.approx(table_integral(), abs=QUADRATURE)
    density = PetzoldTable().density
    assert integral(density) == pytest.approx(1, abs=QUADRATURE)
    assert mean_cosine(density) == pytest.approx(0.92397, abs=0.51e-5)
    assert backscattered(density) == pytest.approx(0.018295, abs=0.51e-6)


def test_below_a_tenth_of_a_degree_the_table_is_a_power_law():
    density = PetzoldTable().density
    angle = np.radians([0.1, 0.01, 0.001])
    assert density(angle[1:]) / density(angle[:-1]) == pytest.approx(10**1.346, rel=1e-12)


def test_the_table_is_straight_between_its_rows_in_the_logarithms():
    middle = np.sqrt(TABLE_RAD[:-1] * TABLE_RAD[1:])
    expected = np.sqrt(TABLE_PER_SR[:-1] * TABLE_PER_SR[1:])
    assert table_density(middle) == pytest.approx(expected, rel=1e-12)


# ---- Fournier & Forand -------------------------------------------------------------------


@pytest.mark.parametrize(("degrees", "published"), FOURNIER)
def test_spheres_scatter_as_published(degrees, published):
    found = FournierForand(1.10, 3.5835).density(np.radians(degrees))
    assert found == pytest.approx(published, rel=0.51e-5 / 1.09624)  # six digits


@pytest.mark.parametrize(("index", "slope", "share", "digit"), FOURNIER_SHARES)
def test_spheres_scatter_back_as_published(index, slope, share, digit):
    assert backscattered(FournierForand(index, slope).density) == pytest.approx(share, abs=digit)


def test_the_equivalent_of_petzolds_particle():
    spheres = FournierForand(1.10, 3.5835)
    assert mean_cosine(spheres.density) == pytest.approx(0.930, abs=0.51e-3)


def literal(spheres: FournierForand, angle: float) -> float:
    """The published formula as it stands, in 60 digits."""
    with localcontext() as context:
        context.prec = 60
        sin2 = Decimal(float(np.sin(angle / 2) ** 2))
        nu = (3 - Decimal(spheres.junge_slope)) / 2
        scale = 3 * (Decimal(spheres.index) - 1) ** 2
        d, d180 = 4 * sin2 / scale, 4 / scale
        first = nu * (1 - d) - (1 - d**nu) + (d * (1 - d**nu) - nu * (1 - d)) / sin2
        second = (1 - d180**nu) * (3 * (1 - 2 * sin2) ** 2 - 1) / ((d180 - 1) * d180**nu)
        pi = Decimal(np.pi)
        return float(first / (4 * pi * (1 - d) ** 2 * d**nu) + second / (16 * pi))


@examples(60)
@given(spheres=SPHERES, side=st.sampled_from([-1, 1]), decades=st.floats(0.7, 14.5))
def test_spheres_are_exact_near_delta_1(spheres, side, decades):
    """Where the literal formula in double precision loses all its digits.

    From the least distance on, 3e-15, the reference cannot divide 0 by 0: square roots, arcsine,
    sine and square leave no more than 14 roundings of 1.1e-16 between delta and the reference's.
    """
    delta = 1 + side * 10**-decades
    angle = 2 * np.arcsin(np.sqrt(0.75 * delta) * (spheres.index - 1))
    expected = literal(spheres, angle)
    # 2.3e-13 is what docs/explanation/physics.md, section 3 gives the series.
    assert spheres.density(angle) == pytest.approx(expected, rel=2.3e-13)


def test_at_delta_1_spheres_scatter_as_beside_it():
    """There the literal formula divides 0 by 0."""
    spheres = FournierForand(1.5, 3.5835)  # whose delta of 1 is that of a double
    step = 1e-6
    sin2 = 0.75 * 0.5**2 * np.array([1 - step, 1, 1 + step])
    below, there, above = spheres.density(2 * np.arcsin(np.sqrt(sin2)))
    # p falls as about delta^-1.2 here, which bends by 1.3 step^2.
    assert there == pytest.approx((below + above) / 2, rel=3 * step**2)


@examples(60)
@given(spheres=SPHERES)
def test_spheres_scatter_all_and_nowhere_less_than_nothing(spheres):
    low = 1e-40
    # The published cumulative function tends to delta^-nu forwards.
    beyond = (low**2 / (3 * (spheres.index - 1) ** 2)) ** -spheres.nu
    assert integral(spheres.density, low) + beyond == pytest.approx(1, abs=QUADRATURE)
    assert np.all(spheres.density(ANGLES) > 0)


@pytest.mark.parametrize(
    ("index", "slope", "named"), [(1.51, 3.5, "particle_index"), (1.1, 5.0, "junge_slope")]
)
def test_spheres_out_of_range_are_refused(index, slope, named):
    with pytest.raises(InputError, match=f"water: {named}: must be a number"):
        FournierForand(index, slope)


# ---- all of them -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "phase",
    [HenyeyGreensteinMixture(), PetzoldTable(), FournierForand(1.10, 3.5835)],
    ids=lambda phase: type(phase).__name__,
)
def test_every_density_is_finite_and_smooth_from_forward_to_backward(phase):
    density = phase.density(ANGLES)
    assert np.all(np.isfinite(density)) and np.all(density > 0)
    # A lobe's tail falls as angle^-3, the table's steepest cell (50 to 55 degrees) as ^-3.06.
    step = np.log(ANGLES[2] / ANGLES[1])
    assert np.abs(np.diff(np.log(density[1:]))).max() < 3.1 * step
    assert density[0] >= density[1]
