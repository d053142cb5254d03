"""The water as a medium of Mitsuba's own, for its own integrators."""

from typing import Any

from lscan.errors import InputError
from sim.water import HenyeyGreensteinMixture, Optics


def stock_medium(water: Optics) -> dict[str, Any]:
    """The water as a stock homogeneous medium: nested blends of its lobes and Rayleigh's.

    Parameters
    ----------
    water : Optics, its particles' phase function is a mixture of Henyey-Greenstein lobes

    Returns
    -------
    The dictionary that ``mitsuba.load_dict`` takes; lengths in mm.

    Raises
    ------
    InputError
        The phase function is none of Mitsuba's own.
    """
    if not isinstance(water.particles, HenyeyGreensteinMixture):
        raise InputError(
            "no phase function of Mitsuba's own",
            where="water.phase",
            value=type(water.particles).__name__,
            allowed="henyey-greenstein or petzold-mixture",
        )
    phase: dict[str, Any] = {"type": "rayleigh"}
    share = water.molecular_weight
    for weight, g in zip(water.particles.weights, water.particles.g, strict=True):
        share += (1 - water.molecular_weight) * weight
        lobe = {"type": "hg", "g": float(g)}
        # blendphase = (1 - w) first + w second
        blend = float((1 - water.molecular_weight) * weight / share)
        phase = {"type": "blendphase", "weight": blend, "first": phase, "second": lobe}
    return {
        "type": "homogeneous",
        "sigma_t": water.extinction_per_mm,
        "albedo": water.scattering_per_mm / water.extinction_per_mm,
        "phase": phase,
        "has_spectral_extinction": False,
    }
