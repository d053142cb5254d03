"""Sediments as sound in water meets them: a fluid half space, by name or by grain size."""

from dataclasses import dataclass
from math import log, pi

from lscan.errors import InputError

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
