"""Roughness of a slice: rms height, structure function, power spectrum and its power law.

The paper's motive: the roughness of the seabed is a key parameter of high-frequency acoustic
scattering, which models take as a power spectrum, commonly a power law (D. R. Jackson and
M. D. Richardson, High-Frequency Seafloor Acoustics, Springer 2007, ch. 6).
"""

from dataclasses import dataclass

import numpy as np
from scipy import signal

from lscan.errors import InputError, MeasurementError
from lscan.records import Floats, Ints, Mask, has_value
from lscan.surface import Slice

MIN_POINTS = 16


@dataclass(frozen=True)
class Spectrum:
    """One-sided power spectral density of height.

    Attributes
    ----------
    wavenumber_per_mm : (K,) array, cycles per mm, 0 excluded
    density_mm3 : (K,) array, mm² per (cycle / mm); its integral over wavenumber is the variance
    points : int, slice points it came from, the longest stretch without a hole
    left_out : int, number of the slice's other points
    """

    wavenumber_per_mm: Floats
    density_mm3: Floats
    points: int
    left_out: int


@dataclass(frozen=True)
class PowerLaw:
    """density = strength * wavenumber ** -exponent, strength at 1 cycle / mm.

    Attributes
    ----------
    strength : float, mm³, density at 1 cycle / mm
    exponent : float
    exponent_sigma : float, standard uncertainty of the exponent from the scatter about the line
    """

    strength: float
    exponent: float
    exponent_sigma: float


def rms_height(measured: Slice) -> float:
    """Root-mean-square height in mm about the straight line that fits the slice best.

    Parameters
    ----------
    measured : Slice, mm; points without data are left out

    Raises
    ------
    MeasurementError
        For fewer than MIN_POINTS points with data.
    """
    seen = _seen(measured)
    _require(int(seen.sum()))
    along, z = measured.along_mm[seen], measured.z_mm[seen]
    residual = z - np.polynomial.Polynomial.fit(along, z, 1)(along)
    return float(np.sqrt(np.mean(residual**2)))


def structure_function(measured: Slice) -> tuple[Floats, Floats, Ints]:
    """Mean squared height difference against distance.

    Parameters
    ----------
    measured : Slice, mm.  Holes are no obstacle: only pairs with data at both ends count, and a
        distance without a pair is not in the answer.

    Returns
    -------
    distance : (L,) array, mm, of one step up to half the slice
    difference : (L,) array, mm², mean of (z(r + distance) - z(r))²
    pairs : (L,) array, their number

    Raises
    ------
    MeasurementError
        For fewer than MIN_POINTS points with data.
    """
    seen = _seen(measured)
    _require(int(seen.sum()))
    z = np.where(seen, measured.z_mm, 0.0)
    # Sums over pairs by correlation: of z², of z z', and of the pairs themselves.
    mask = seen.astype(float)
    pairs = np.rint(signal.correlate(mask, mask))
    squares = signal.correlate(z**2, mask) + signal.correlate(mask, z**2)
    middle = len(z) - 1
    reach = slice(middle + 1, middle + 1 + len(z) // 2)
    total: Floats = (squares - 2 * signal.correlate(z, z))[reach]
    count = pairs[reach].astype(np.int64)
    known = count > 0
    distance = _step(measured) * np.arange(1, len(count) + 1, dtype=float)
    mean = np.maximum(total[known], 0.0) / count[known]
    return distance[known], mean, count[known]


def power_spectrum(measured: Slice, window: str = "hann") -> Spectrum:
    """The power spectrum of the slice's longest stretch without a hole, its trend removed.

    A periodogram, scaled so that its integral is the variance: exactly so under "boxcar"
    (Parseval's theorem).  The slice itself is smoothed over its radius, so wavelengths below about
    twice that are damped.

    Parameters
    ----------
    measured : Slice, mm, of an even step
    window : str, a name known to scipy.signal.get_window

    Raises
    ------
    InputError
        For an unknown window.
    MeasurementError
        For a stretch of fewer than MIN_POINTS points.
    """
    stretch = _longest_stretch(_seen(measured))
    z = measured.z_mm[stretch]
    _require(len(z))
    try:
        wavenumber, density = signal.periodogram(
            signal.detrend(z), fs=1 / _step(measured), window=window, detrend=False
        )
    except ValueError as error:
        raise InputError("unknown window", where="spectrum", value=window) from error
    left_out = len(measured.status) - len(z)
    return Spectrum(wavenumber[1:], density[1:], len(z), left_out)


def fit_power_law(spectrum: Spectrum, band_per_mm: tuple[float, float]) -> PowerLaw:
    """The power law through the spectrum of a slice.

    A straight line through log density against log wavenumber.

    Parameters
    ----------
    spectrum : Spectrum, of heights
    band_per_mm : tuple of float, least and greatest wavenumber, cycles / mm

    Raises
    ------
    MeasurementError
        Where fewer than four values lie in the band.

    References
    ----------
    D. R. Jackson and M. D. Richardson, High-Frequency Seafloor Acoustics, Springer 2007, ch. 6.
    """
    low, high = band_per_mm
    wavenumber, density = spectrum.wavenumber_per_mm, spectrum.density_mm3
    inside = (wavenumber >= low) & (wavenumber <= high) & (density > 0)
    if inside.sum() < 4:
        raise MeasurementError(
            f"power law: {int(inside.sum())} values between {low:g} and {high:g} cycles/mm, "
            "4 are needed"
        )
    x, y = np.log(wavenumber[inside]), np.log(density[inside])
    design = np.column_stack([np.ones_like(x), -x])
    (constant, exponent), *_ = np.linalg.lstsq(design, y, rcond=None)
    residual = y - design @ np.array([constant, exponent])
    variance = float(residual @ residual) / (len(x) - 2) * np.linalg.inv(design.T @ design)[1, 1]
    return PowerLaw(float(np.exp(constant)), float(exponent), float(np.sqrt(variance)))


def _seen(measured: Slice) -> Mask:
    return has_value(measured.status) & np.isfinite(measured.z_mm)


def _step(measured: Slice) -> float:
    """Distance between neighbouring points of the slice, mm."""
    return float(measured.along_mm[1] - measured.along_mm[0])


def _require(points: int) -> None:
    if points < MIN_POINTS:
        raise MeasurementError(
            f"roughness: {points} slice points with data, {MIN_POINTS} are needed"
        )


def _longest_stretch(seen: Mask) -> slice:
    """The longest run of points with data."""
    change = np.flatnonzero(np.diff(np.concatenate([[0], seen.astype(int), [0]])))
    starts, stops = change[::2], change[1::2]
    if not len(starts):
        return slice(0, 0)
    longest = int(np.argmax(stops - starts))
    return slice(int(starts[longest]), int(stops[longest]))
