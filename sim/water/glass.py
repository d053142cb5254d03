"""The refractive index of the materials ports are made of, relative to air."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

from lscan.errors import InputError
from lscan.files.disk import packaged_table
from lscan.water.index import Limits, require

INDEX = (1.0, 2.5)  # what a scene file may name as a number


@dataclass(frozen=True)
class Sellmeier:
    """n2 = 1 + sum of strength w2 / (w2 - pole), w the wavelength in um, pole in um2; at 20 C.

    terms: strength and pole of each.
    """

    terms: Sequence[tuple[float, float]]
    range_nm: Limits


_TABLE = packaged_table("sim.water", "tables.toml")["glass"]
GLASSES = {name: Sellmeier(**formula) for name, formula in _TABLE.items()}


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
    return sqrt(1 + sum(strength * w2 / (w2 - pole) for strength, pole in formula.terms))
