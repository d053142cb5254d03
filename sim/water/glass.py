"""The refractive index of the materials ports are made of, relative to air."""

from dataclasses import dataclass
from math import sqrt

from lscan.errors import InputError
from sim.water.limits import Limits, require

INDEX = (1.0, 2.5)  # what a scene file may name as a number


@dataclass(frozen=True)
class Sellmeier:
    """n2 = 1 + sum of strength w2 / (w2 - pole_um2), w the wavelength in um, 20 C."""

    strength: tuple[float, ...]
    pole_um2: tuple[float, ...]
    range_nm: Limits


GLASSES = {
    # Schott's data sheet N-BK7 517642.251.
    "N-BK7": Sellmeier(
        (1.03961212, 0.231792344, 1.01046945),
        (0.00600069867, 0.0200179144, 103.560653),
        (300.0, 2500.0),
    ),
    # Malitson 1965, J. Opt. Soc. Am. 55, 1205.
    "fused silica": Sellmeier(
        (0.6961663, 0.4079426, 0.8974794),
        (0.0684043**2, 0.1162414**2, 9.896161**2),
        (210.0, 3710.0),
    ),
    # Polyanskiy's fit to Sultanova, Kasarova & Nikolov 2009.  Acrylics differ: +-0.002.
    "PMMA": Sellmeier((1.1819,), (0.011313,), (436.8, 1052.0)),
}


def glass_index(glass: float | str, wavelength_nm: float) -> float:
    """Index, relative to air, of a port's material.

    Parameters
    ----------
    glass : float or str, name of a material in GLASSES, or an index from 1 to 2.5, which passes
        through
    wavelength_nm : float, nm

    Raises
    ------
    InputError
        The name is unknown, the number is not an index, or the wavelength lies outside the range of
        the material's formula.

    References
    ----------
    Schott, data sheet N-BK7 517642.251; Malitson 1965 (fused silica); Sultanova, Kasarova & Nikolov
    2009 (PMMA).

    Examples
    --------
    >>> round(glass_index("PMMA", 650.0), 4)
    1.4881
    """
    if not isinstance(glass, str):
        require("glass_index", glass, INDEX, where="port")
        return float(glass)
    if glass not in GLASSES:
        allowed = f"a number or one of {', '.join(GLASSES)}"
        raise InputError("glass_index", where="port", value=glass, allowed=allowed)
    formula = GLASSES[glass]
    require("wavelength_nm", wavelength_nm, formula.range_nm, where=glass)
    w2 = (wavelength_nm / 1000) ** 2
    terms = zip(formula.strength, formula.pole_um2, strict=True)
    return sqrt(1 + sum(strength * w2 / (w2 - pole) for strength, pole in terms))
