"""Waves of one length whose crests bend: in each profile a sine of its own height and phase."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from lscan.errors import MeasurementError
from lscan.records import Floats, Ints
from lscan.roughness import Patch

LEAST_PROFILE_WAVES = 1.5  # in a profile: fewer cannot be told from its slope
FINE_PROFILE = 4  # tried wavenumbers for each that a profile tells apart
FEWEST = 8  # cells of a profile that counts
SHARP = 1e-10  # relative tolerance of the wavenumber


@dataclass(frozen=True)
class ProfileWaves:
    """The line spectrum of profiles that share one wavelength.

    Attributes
    ----------
    wavelength_cm, sigma_wavelength_cm : float, cm, and its standard uncertainty where what is left
        of the profiles is white
    row : (P,) array, the patch's rows, or columns, that are its profiles
    amplitude_cm : (P,) array, cm, of each profile's sine
    sigma_amplitude_cm : (P,) array, cm
    phase_rad : (P,) array, rad, of sin(K s + phase), s from the patch's edge
    """

    wavelength_cm: float
    sigma_wavelength_cm: float
    row: Ints
    amplitude_cm: Floats
    sigma_amplitude_cm: Floats
    phase_rad: Floats


def profile_waves(patch: Patch, axis: int = 1) -> ProfileWaves:
    """The wavelength that a patch's profiles share, and the sine of each, by least squares.

    Each profile has a height and a slope of its own.  Holes are left out.

    Parameters
    ----------
    patch : Patch
    axis : int, 0: profiles along y; 1: along x

    Raises
    ------
    MeasurementError
        No profile has eight cells that were measured.
    """
    z, seen = (patch.z_cm, patch.seen) if axis == 1 else (patch.z_cm.T, patch.seen.T)
    rows = np.flatnonzero(seen.sum(axis=1) >= FEWEST)
    if len(rows) == 0:
        raise MeasurementError(f"roughness: no profile has {FEWEST} cells that were measured")
    z, weight = z[rows], seen[rows].astype(float)
    s = (np.arange(z.shape[1]) + 0.5) * patch.cell_cm
    length = z.shape[1] * patch.cell_cm

    def fitted(k: float) -> tuple[Floats, Floats, Floats]:
        """(P, 4) coefficients, (P, 4, 4) normal matrices, and (P,) squares that are left."""
        design = np.stack([np.ones_like(s), s - length / 2, np.cos(k * s), np.sin(k * s)])
        normal = np.einsum("as,ps,bs->pab", design, weight, design)
        right = np.einsum("as,ps->pa", design, weight * z)
        found = np.linalg.solve(normal, right[..., np.newaxis])[..., 0]
        left = ((weight * (z - found @ design)) ** 2).sum(axis=1)
        return found, normal, left

    def squares(k: float) -> float:
        return float(fitted(k)[2].sum())

    step = 2 * np.pi / length / FINE_PROFILE
    tried = np.arange(LEAST_PROFILE_WAVES * FINE_PROFILE * step, 0.9 * patch.nyquist_per_cm, step)
    best = tried[int(np.argmin([squares(k) for k in tried]))]
    k = float(
        minimize_scalar(squares, bounds=(best - step, best + step), method="bounded",
                        options={"xatol": SHARP * best}).x
    )  # fmt: skip
    found, normal, left = fitted(k)
    freedom = weight.sum() - found.size - 1
    variance = float(left.sum() / freedom)
    h = 1e-3 * step
    curvature = (squares(k + h) - 2 * squares(k) + squares(k - h)) / h**2 / 2
    cosine, sine = found[:, 2], found[:, 3]
    own = np.linalg.inv(normal)
    amplitude = np.hypot(cosine, sine)
    way = np.stack([cosine, sine], axis=1) / np.maximum(amplitude, 1e-300)[:, np.newaxis]
    spread = np.einsum("pa,pab,pb->p", way, own[:, 2:, 2:], way)
    return ProfileWaves(
        wavelength_cm=2 * np.pi / k,
        sigma_wavelength_cm=2 * np.pi / k**2 * float(np.sqrt(variance / max(curvature, 1e-300))),
        row=rows,
        amplitude_cm=amplitude,
        sigma_amplitude_cm=np.sqrt(variance * spread),
        phase_rad=np.arctan2(cosine, sine),
    )
