"""All that the tank asks of its water at one wavelength, in one record."""

from dataclasses import dataclass

from lscan.records import Floats
from lscan.water.index import refractive_index, require
from sim.scene.matter import Water
from sim.water.fournier import FournierForand
from sim.water.inherent import WATER_NM, coefficients
from sim.water.petzold import PetzoldTable
from sim.water.phase import HenyeyGreensteinMixture, PhaseFunction, molecular_phase

MM_PER_M = 1000.0


@dataclass(frozen=True)
class Optics:
    """The water at one wavelength.

    Attributes
    ----------
    index : float, refractive index relative to air
    absorption_per_mm, scattering_per_mm : float, 1/mm, of water and particles together
    particles : PhaseFunction, the phase function of the particles
    molecular_weight : float, the molecules' share of scattering_per_mm, 0 to 1
    """

    index: float
    absorption_per_mm: float
    scattering_per_mm: float
    particles: PhaseFunction
    molecular_weight: float

    @property
    def extinction_per_mm(self) -> float:
        """Beam attenuation, 1/mm: absorption and scattering."""
        return self.absorption_per_mm + self.scattering_per_mm

    def phase(self, angle: Floats) -> Floats:
        """Phase function, 1/sr; same shape as ``angle``.  Its integral over the sphere is 1.

        Parameters
        ----------
        angle : array, scattering angle in rad; 0 is forward
        """
        share = self.molecular_weight
        return (1 - share) * self.particles.density(angle) + share * molecular_phase(angle)


def water_optics(water: Water, wavelength_nm: float) -> Optics:
    """The optics of a scene's water at one wavelength.

    Parameters
    ----------
    water : Water, the scene's
    wavelength_nm : float, nm, 450 to 700

    Raises
    ------
    InputError
        The wavelength lies outside the range.

    References
    ----------
    docs/explanation/physics.md, sections 1 to 3.
    """
    found = coefficients(water, wavelength_nm)
    scattering = found.scattering_per_m
    return Optics(
        index=water_index(water, wavelength_nm),
        absorption_per_mm=found.absorption_per_m / MM_PER_M,
        scattering_per_mm=scattering / MM_PER_M,
        particles=particle_phase(water),
        # Where nothing scatters, the molecules' share is as good as any.
        molecular_weight=found.molecular_per_m / scattering if scattering > 0 else 1.0,
    )


def water_index(water: Water, wavelength_nm: float) -> float:
    """The index of a scene's water, relative to air: that of ``water_optics`` in less time.

    Parameters
    ----------
    water : Water, the scene's
    wavelength_nm : float, nm, 450 to 700

    Raises
    ------
    InputError
        The wavelength lies outside the range.
    """
    require("wavelength_nm", wavelength_nm, WATER_NM)
    if water.kind == "air":
        return 1.0
    return refractive_index(
        water.temperature_c, water.salinity_psu, wavelength_nm, water.pressure_mpa
    )


def particle_phase(water: Water) -> PhaseFunction:
    """The phase function that a scene names for its particles."""
    match water.phase:
        case "petzold-mixture":
            return HenyeyGreensteinMixture()
        case "petzold":
            return PetzoldTable()
        case "fournier-forand":
            return FournierForand(water.particle_index, water.junge_slope)
        case "henyey-greenstein":
            return HenyeyGreensteinMixture((1.0,), (water.asymmetry,))
