"""Backscattering strength against limits in closed form and against Jackson's own program."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.errors import InputError
from lscan.roughness import (
    SEDIMENTS,
    Band,
    PowerLaw,
    PowerLawFit,
    Sediment,
    backscattering_strength,
    bragg_per_cm,
    of_grain_size,
    predicted_backscatter,
    reflection,
    sediment,
    structure_constant,
)
from lscan.roughness.scattering import kirchhoff_integral
from tests.validation.roughness.sound import PUBLISHED, PublishedStrength

LAW = PowerLaw(3.25, 0.004446)
SAND = sediment("medium sand")

# TR 9407, table 2: density ratio, speed ratio, loss, to the digits printed there.
TABLE = {
    "sandy gravel": (2.492, 1.3370, 0.01705),
    "coarse sand": (2.231, 1.2503, 0.01638),
    "medium sand": (1.845, 1.1782, 0.01624),
    "fine sand": (1.451, 1.1073, 0.01602),
    "very fine sand": (1.268, 1.0568, 0.01875),
    "coarse silt": (1.195, 1.0179, 0.02158),
    "sandy silt": (1.169, 0.9999, 0.01261),
    "sandy mud": (1.149, 0.9873, 0.00386),
    "silty clay": (1.146, 0.9824, 0.00163),
    "clay": (1.145, 0.9800, 0.00148),
}


@pytest.mark.parametrize(("name", "printed"), TABLE.items(), ids=TABLE)
def test_named_sediments_are_those_of_the_table(
    name: str, printed: tuple[float, float, float]
) -> None:
    found = sediment(name)
    assert (found.density_ratio, found.speed_ratio, found.loss) == printed


def test_every_name_has_a_sediment_and_no_other_has() -> None:
    assert {sediment(name).name for name in SEDIMENTS} == set(SEDIMENTS)
    with pytest.raises(InputError, match=r"sediment.*sandd.*medium sand"):
        sediment("sandd")
    with pytest.raises(InputError, match="-1 to 9"):
        of_grain_size(float("nan"))


@pytest.mark.parametrize(
    "value", PUBLISHED, ids=lambda v: f"{v.bottom.name}-{v.frequency_khz}-{v.grazing_deg}"
)
def test_small_slopes_as_jackson_s_program_has_them(value: PublishedStrength) -> None:
    """To 0.002 dB; the loss of reflection too, which in his has a little shear (ratio .002)."""
    law = PowerLaw(3.25, value.w2_cm4)
    found = backscattering_strength(law, value.bottom, value.frequency_khz, value.grazing_deg)
    assert float(found) == pytest.approx(value.strength_db, abs=0.002)
    reflected = abs(complex(reflection(value.bottom, value.grazing_deg)))
    assert -20 * np.log10(reflected) == pytest.approx(value.loss_db, abs=0.002)


@given(q=st.floats(1e-9, 1e3))
def test_the_integral_has_its_closed_forms(q: float) -> None:
    """For exponents 1 and, where it is not too small for a double, 2."""
    one = np.array([q])
    assert kirchhoff_integral(one, 1.0)[0] == pytest.approx(q / (1 + q * q) ** 1.5, rel=1e-9)
    if q > 0.05:
        expected = np.exp(-1 / (4 * q)) / (2 * q)
        assert kirchhoff_integral(one, 1.9999)[0] == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("density", [1e-8, 1e8])
def test_soft_and_hard_ground_in_closed_form(density: float) -> None:
    """4 k^4 sin^4 W2 of a free surface, 4 k^4 (1 + cos²)² W2 of a rigid one: Brekhovskikh &
    Lysanov, Fundamentals of Ocean Acoustics, ch. 9."""
    angles = np.array([10.0, 40.0, 80.0])
    k = 2 * np.pi * 100e3 / 150000
    c, s = np.cos(np.radians(angles)), np.sin(np.radians(angles))
    shape = s**4 if density < 1 else (1 + c**2) ** 2
    expected = 10 * np.log10(4 * k**4 * shape * LAW.density(0.0, 2 * k * c))
    bottom = Sediment("extreme", density, 1.1, 0.01)
    found = backscattering_strength(LAW, bottom, 100, angles, model="small roughness")
    np.testing.assert_allclose(found, expected, atol=1e-5)


@examples(30)
@given(
    gamma2=st.floats(2.1, 3.9), khz=st.floats(5, 500), phi=st.floats(-1, 9), angle=st.floats(2, 88)
)
def test_small_slopes_join_small_roughness_and_kirchhoff(
    gamma2: float, khz: float, phi: float, angle: float
) -> None:
    """As heights vanish the models of small slope and small roughness are one; at vertical
    incidence the one of small slope is Kirchhoff's; sound that reaches no critical angle does."""
    bottom = of_grain_size(phi)
    flat = PowerLaw(gamma2, 1e-14)
    small, slope = (
        backscattering_strength(flat, bottom, khz, angle, model=model)
        for model in ("small roughness", "small slope")
    )
    assert float(small) == pytest.approx(float(slope), abs=0.01)
    law = PowerLaw(gamma2, 0.004)
    slope, kirchhoff = (
        backscattering_strength(law, bottom, khz, 90.0, model=model)
        for model in ("small slope", "kirchhoff")
    )
    assert float(slope) == pytest.approx(float(kirchhoff), abs=1e-3)


@examples(20)
@given(gamma2=st.floats(2.2, 3.8))
def test_the_structure_function_is_the_integral_of_the_spectrum(gamma2: float) -> None:
    """2 int W2 (1 - cos(K R)) over the plane: 4 pi int W2(K) (1 - J0(K)) K dK at R = 1 cm.

    Below K = 1e-4 the integrand is K^(3 - gamma2) / 4, beyond 300 the mean of 1 - J0 is 1 to less
    than 1e-3; both are in closed form."""
    from scipy.special import j0

    low, high = 1e-4, 300.0
    k = np.geomspace(low, high, 400_001)
    values = k ** (1 - gamma2) * (1 - j0(k)) * k
    inner = np.sum((values[1:] + values[:-1]) / 2 * np.diff(np.log(k)))
    outer = low ** (4 - gamma2) / (4 * (4 - gamma2)) + high ** (2 - gamma2) / (gamma2 - 2)
    found = 4 * np.pi * (inner + outer)
    assert structure_constant(PowerLaw(gamma2, 1.0)) == pytest.approx(found, rel=2e-3)


def test_bragg_s_wavenumber_is_twice_the_sound_s_along_the_bottom() -> None:
    assert float(bragg_per_cm(30.0, 60.0, 1500.0)) == pytest.approx(2 * np.pi / 5.0)
    with pytest.raises(InputError, match="grazing angle"):
        bragg_per_cm(30.0, 91.0)
    with pytest.raises(InputError, match="frequency"):
        bragg_per_cm(-1.0, 45.0)


def test_the_uncertainty_is_that_of_drawn_parameters() -> None:
    """Against the scatter of 1,000 draws: their standard deviation is known to 2.2 %, tested to 4
    of that; the strength is nearly linear in ln w2 and gamma2 over so little."""
    covariance = np.array([[0.02, 0.002], [0.002, 0.001]]) / 4
    fit = PowerLawFit(LAW, ("ln_w2", "gamma2"), covariance, 399, Band(1, 20), 500, 0.0)
    angles = np.array([15.0, 30.0, 70.0])
    told = predicted_backscatter(fit, SAND, 120.0, angles)
    draws = np.random.default_rng(3).multivariate_normal(
        [np.log(LAW.w2_cm4), LAW.gamma2], covariance, 1000
    )
    strengths = [
        backscattering_strength(PowerLaw(g, float(np.exp(w))), SAND, 120.0, angles)
        for w, g in draws
    ]
    np.testing.assert_allclose(told.sigma_db, np.std(strengths, axis=0), rtol=0.09)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"model": "bragg"}, "small roughness"),
        ({"law": PowerLaw(4.2, 0.01)}, "gamma2"),
        ({"law": PowerLaw(3.0, 0.01, (0.2, 0.0))}, "stretch"),
    ],
    ids=["model", "steep", "stretched"],
)
def test_what_has_no_strength_is_refused(change: dict[str, object], match: str) -> None:
    asked = {"law": LAW, "bottom": SAND, "frequency_khz": 100.0, "grazing_deg": 30.0} | change
    with pytest.raises(InputError, match=match):
        backscattering_strength(**asked)  # type: ignore[arg-type]
