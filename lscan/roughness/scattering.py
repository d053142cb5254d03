"""How strongly a rough seabed throws sound back, and how well that is known from its spectrum.

Three models of the backscattering cross section of a rough fluid half space, with the same
spectrum W2 in them.  The one of small roughness holds where heights are small beside the
wavelength, Kirchhoff's near vertical incidence, and that of small slopes, which has both as its
limits, at all angles.

References
----------
Jackson & Richardson, High-Frequency Seafloor Acoustics (Springer 2007), ch. 13; APL-UW TR 9407
(1994), sec. IV.
"""

from dataclasses import dataclass
from math import gamma, log, pi
from typing import Literal, get_args

import numpy as np
from scipy.special import hankel1

from lscan.errors import InputError
from lscan.records import Floats
from lscan.roughness.spectra import PowerLaw
from lscan.roughness.whittle import PowerLawFit, law_of

# Sediments as sound in water meets them: a fluid half space, by name or by grain size.


_WATER_M_PER_MS = 1.528  # speed of sound that Hamilton's attenuations are turned into losses with


@dataclass(frozen=True)
class Sediment:
    """A fluid of its density, speed of sound and loss, each by those of the water above.

    Attributes
    ----------
    name : str
    density_ratio : float, of the sediment to the water
    speed_ratio : float, of the speeds of sound
    loss : float, imaginary part of the wavenumber in it over the real one
    """

    name: str
    density_ratio: float
    speed_ratio: float
    loss: float


GRAIN_SIZE = {
    "sandy gravel": -1.0,
    "very coarse sand": 0.0,
    "coarse sand": 0.5,
    "gravelly muddy sand": 1.0,
    "medium sand": 1.5,
    "muddy gravel": 2.0,
    "fine sand": 2.5,
    "muddy sand": 3.0,
    "very fine sand": 3.5,
    "clayey sand": 4.0,
    "coarse silt": 4.5,
    "sandy silt": 5.0,
    "medium silt": 5.5,
    "sandy mud": 6.0,
    "fine silt": 6.5,
    "sandy clay": 7.0,
    "very fine silt": 7.5,
    "silty clay": 8.0,
    "clay": 9.0,
}
"""Mean grain size in phi by name (APL-UW TR 9407, sec. IV, table 2)."""

HARD = {
    "rough rock": Sediment("rough rock", 2.5, 2.5, 0.01374),
    "rock": Sediment("rock", 2.5, 2.5, 0.01374),
    "cobble": Sediment("cobble", 2.5, 1.8, 0.01374),
}
"""What has no grain size (the same table)."""

SEDIMENTS = (*HARD, *GRAIN_SIZE)
"""Names that ``sediment`` knows."""


def sediment(name: str) -> Sediment:
    """The sediment of a name.

    Parameters
    ----------
    name : str, one of SEDIMENTS

    Raises
    ------
    InputError
        There is none of that name.

    Examples
    --------
    >>> sediment("medium sand").speed_ratio
    1.1782
    """
    if name in HARD:
        return HARD[name]
    if name not in GRAIN_SIZE:
        raise InputError("sediment", value=name, allowed=", ".join(SEDIMENTS))
    found = of_grain_size(GRAIN_SIZE[name])
    return Sediment(
        name, round(found.density_ratio, 3), round(found.speed_ratio, 4), round(found.loss, 5)
    )


def of_grain_size(phi: float) -> Sediment:
    """The sediment of a mean grain size, by the regressions that the named ones come from.

    Parameters
    ----------
    phi : float, -1 to 9: minus the binary logarithm of the diameter in mm

    Raises
    ------
    InputError
        The size is not in that range.

    References
    ----------
    APL-UW TR 9407 (1994), sec. IV: density and speed; its losses are Hamilton's attenuations,
    Geophysics 37, 620 (1972), in dB/m/kHz.
    """
    if not -1 <= phi <= 9:
        raise InputError("grain size", value=phi, allowed="-1 to 9 phi")
    if phi < 1:
        density = 2.3139 - 0.17057 * phi + 0.007797 * phi**2
        speed = 1.2778 - 0.056452 * phi + 0.002709 * phi**2
    elif phi < 5.3:
        density = 3.0455 - 1.1069031 * phi + 0.2290201 * phi**2 - 0.0165406 * phi**3
        speed = 1.3425 - 0.1382798 * phi + 0.0213937 * phi**2 - 0.0014881 * phi**3
    else:
        density = 1.1565 - 0.0012973 * phi
        speed = 1.0019 - 0.0024324 * phi
    loss = _attenuation(phi) * speed * _WATER_M_PER_MS * log(10) / (40 * pi)
    return Sediment(f"{phi:g} phi", density, speed, loss)


def _attenuation(phi: float) -> float:
    """dB/m/kHz in a sediment of a grain size."""
    if phi < 0:
        return 0.4556
    if phi < 2.6:
        return 0.4556 + 0.0245 * phi
    if phi < 4.5:
        return 0.1978 + 0.1245 * phi
    if phi < 6:
        return 8.0399 - 2.5228 * phi + 0.20098 * phi**2
    return 0.9431 - 0.2041 * phi + 0.0117 * phi**2


# How strongly a rough seabed throws sound back, and how well that is known from its spectrum.


CM_PER_M = 100.0
WATER_M_PER_S = 1500.0
ScatteringModel = Literal["small roughness", "small slope", "kirchhoff"]
EXPONENTS = 2.0, 4.0
"""Of a surface whose structure function is a power law: between them the models have an integral
that exists."""
LEAST_COSINE = 5e-4
"""At vertical incidence the limit exists, but has no such form; as in Jackson's TM 2-00."""
_STEP = 1e-4  # of a parameter, for the uncertainty
_LOGS = np.linspace(-40.0, 6.0, 1201)
"""Logarithms of the variable of the integral: below the first it adds less than e^-80, beyond the
last Hankel's function has fallen below e^-150; steps of .04 are exact to 1e-12."""


@dataclass(frozen=True)
class Backscatter:
    """Backscattering strength by grazing angle.

    Attributes
    ----------
    grazing_deg : (N,) array, degrees
    strength_db : (N,) array, dB re 1 (of the cross section per area and solid angle)
    sigma_db : (N,) array, dB, standard uncertainty that comes from the spectrum's
    """

    grazing_deg: Floats
    strength_db: Floats
    sigma_db: Floats


def bragg_per_cm(
    frequency_khz: float, grazing_deg: Floats | float, speed_m_per_s: float = WATER_M_PER_S
) -> Floats:
    """rad/cm, the wavenumber of the seabed that throws sound back: 2 k cos(grazing angle).

    Parameters
    ----------
    frequency_khz : float, kHz
    grazing_deg : array or float, degrees
    speed_m_per_s : float, m/s, speed of sound in the water

    Raises
    ------
    InputError
        A frequency, angle or speed is not allowed.

    Examples
    --------
    >>> round(float(bragg_per_cm(100.0, 0.0)), 3)
    8.378
    """
    cosine, _ = _cosine_and_sine(grazing_deg)
    return np.asarray(2 * _wavenumber(frequency_khz, speed_m_per_s) * cosine)


def backscattering_strength(
    law: PowerLaw,
    bottom: Sediment,
    frequency_khz: float,
    grazing_deg: Floats | float,
    *,
    model: ScatteringModel = "small slope",
    speed_m_per_s: float = WATER_M_PER_S,
) -> Floats:
    """dB re 1, the backscattering strength of a seabed's roughness, as ``grazing_deg``'s shape.

    Parameters
    ----------
    law : PowerLaw, the same in all directions, its exponent between 2 and 4
    bottom : Sediment
    frequency_khz : float, kHz
    grazing_deg : array or float, degrees, above 0 up to 90
    model : {"small slope", "small roughness", "kirchhoff"}
    speed_m_per_s : float, m/s, speed of sound in the water

    Raises
    ------
    InputError
        A value is not allowed, or the law differs between directions.

    References
    ----------
    Small roughness: Kuo, J. Acoust. Soc. Am. 36, 2135 (1964), as TR 9407 writes it.  Small slope:
    Voronovich, Sov. Phys. JETP 62, 65 (1985), at its lowest order, as Jackson, APL-UW TM 2-00
    (2000), applies it to the seabed.
    """
    if model not in get_args(ScatteringModel):
        raise InputError("model", value=model, allowed=", ".join(get_args(ScatteringModel)))
    if law.stretch != (0.0, 0.0):
        raise InputError("stretch", value=law.stretch, allowed="0, 0: the models are isotropic")
    if not EXPONENTS[0] < law.gamma2 < EXPONENTS[1]:
        raise InputError("gamma2", value=law.gamma2, allowed="above 2 and below 4")
    k = _wavenumber(frequency_khz, speed_m_per_s)
    cosine, sine = _cosine_and_sine(grazing_deg)
    if model == "small roughness":
        density = law.density(0.0, 2 * k * np.maximum(cosine, 1e-9))
        shape = sine**4 * _perturbation_factor(bottom, cosine, sine)
    else:
        density = _density_of_slopes(law, k, cosine, sine)
        shape = (
            sine**4 * _perturbation_factor(bottom, cosine, sine)
            if model == "small slope"
            else np.full_like(sine, abs(reflection(bottom, 90.0)) ** 2)
        )
    return np.asarray(10 * np.log10(4 * k**4 * shape * density))


def predicted_backscatter(
    fit: PowerLawFit,
    bottom: Sediment,
    frequency_khz: float,
    grazing_deg: Floats,
    *,
    model: ScatteringModel = "small slope",
    speed_m_per_s: float = WATER_M_PER_S,
) -> Backscatter:
    """Backscattering strength of a fitted law, with the uncertainty of its parameters.

    Parameters
    ----------
    fit : PowerLawFit, of a law that is the same in all directions
    bottom : Sediment
    frequency_khz : float, kHz
    grazing_deg : (N,) array, degrees
    model : as of ``backscattering_strength``
    speed_m_per_s : float, m/s

    Raises
    ------
    InputError
        As ``backscattering_strength``.
    """
    grazing_deg = np.atleast_1d(np.asarray(grazing_deg, dtype=float))

    def strength(theta: Floats) -> Floats:
        return backscattering_strength(
            law_of(theta), bottom, frequency_khz, grazing_deg,
            model=model, speed_m_per_s=speed_m_per_s,
        )  # fmt: skip

    theta = np.array([np.log(fit.law.w2_cm4), fit.law.gamma2])
    middle = backscattering_strength(
        fit.law, bottom, frequency_khz, grazing_deg, model=model, speed_m_per_s=speed_m_per_s
    )
    ways = _STEP * np.eye(2)
    slopes = np.stack([(strength(theta + w) - strength(theta - w)) / (2 * _STEP) for w in ways])
    variance = np.einsum("pn,pq,qn->n", slopes, fit.covariance, slopes)
    return Backscatter(grazing_deg, middle, np.sqrt(variance))


def reflection(bottom: Sediment, grazing_deg: Floats | float) -> Floats:
    """Complex coefficient of reflection of a flat seabed, of the pressure.

    Parameters
    ----------
    bottom : Sediment
    grazing_deg : array or float, degrees
    """
    cosine, sine = _cosine_and_sine(grazing_deg)
    below = np.sqrt(_index(bottom) ** 2 - cosine**2)
    heavy = bottom.density_ratio * sine
    return np.asarray((heavy - below) / (heavy + below))


def structure_constant(law: PowerLaw) -> float:
    """C² in cm^(4 - gamma2): the structure function is C² R^(gamma2 - 2) at distances R in cm.

    Parameters
    ----------
    law : PowerLaw, the same in all directions, its exponent between 2 and 4

    References
    ----------
    Jackson & Richardson (2007), ch. 6; TR 9407, sec. IV.
    """
    a = law.gamma2 / 2 - 1
    return (
        2 * pi * law.w2_cm4 * gamma(2 - a) * 2 ** (-2 * a) / (a * (1 - a) * gamma(1 + a))
    )  # h0 = 1 cm


def kirchhoff_integral(q: Floats, exponent: float) -> Floats:
    """The integral of u J0(u) exp(-q u^exponent) over u from 0 to infinity.

    Along a ray of the complex plane on which both J0, as the real part of Hankel's function, and
    the exponential fall: nothing oscillates.  1 is taken off the exponential, the integral of which
    is 0, so that small q lose no digits.

    Parameters
    ----------
    q : array, above 0
    exponent : float, above 0 and below 2
    """
    angle = min(pi / (4 * exponent), pi / 4)
    u = np.exp(_LOGS + 1j * angle)
    weight = u**2 * hankel1(0, u) * (_LOGS[1] - _LOGS[0])
    powers = np.exp(exponent * (_LOGS + 1j * angle))
    return np.asarray((np.expm1(-np.multiply.outer(q, powers)) @ weight).real)


def _density_of_slopes(law: PowerLaw, k: float, cosine: Floats, sine: Floats) -> Floats:
    """cm^4, what stands for W2 where slopes, not heights, are small."""
    along = 2 * k * np.hypot(cosine, LEAST_COSINE)
    down = 2 * k * sine
    a = law.gamma2 / 2 - 1
    q = structure_constant(law) * down**2 / 2 * along ** (-2 * a)
    return kirchhoff_integral(q, 2 * a) / (2 * pi * down**2 * along**2)


def _perturbation_factor(bottom: Sediment, cosine: Floats, sine: Floats) -> Floats:
    """|Y|² of TR 9407: how well a small height scatters."""
    heavy, index = bottom.density_ratio, _index(bottom)
    below = np.sqrt(index**2 - cosine**2)
    found = ((heavy - 1) ** 2 * cosine**2 + heavy**2 - index**2) / (heavy * sine + below) ** 2
    return np.asarray(np.abs(found) ** 2)


def _index(bottom: Sediment) -> complex:
    """Wavenumber in the sediment over that in the water."""
    return (1 + 1j * bottom.loss) / bottom.speed_ratio


def _wavenumber(frequency_khz: float, speed_m_per_s: float) -> float:
    """rad/cm, of sound in the water."""
    for name, value, unit in (("frequency", frequency_khz, "kHz"), ("speed", speed_m_per_s, "m/s")):
        if not 0 < value < np.inf:
            raise InputError(name, value=value, allowed=f"above 0 {unit}")
    return 2 * pi * frequency_khz * 1e3 / (speed_m_per_s * CM_PER_M)


def _cosine_and_sine(grazing_deg: Floats | float) -> tuple[Floats, Floats]:
    angle = np.asarray(grazing_deg, dtype=float)
    if not np.all((angle >= 0) & (angle <= 90)):
        raise InputError("grazing angle", value=grazing_deg, allowed="0 to 90 degrees")
    return np.cos(np.radians(angle)), np.sin(np.radians(angle))
