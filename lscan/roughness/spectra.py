"""Spectra to look at: by multitaper of a patch and of its profiles, by Capon of short stretches.

These show; what is fitted is the periodogram itself (whittle.py).  Where there are holes a taper
is laid over what was measured, so that none invents power, but it leaks more.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from lscan.errors import InputError, MeasurementError
from lscan.records import Floats, Mask
from lscan.roughness.patch import FEWEST, Patch, wavenumbers

TAPERS = 3
"""Along either side: nine in two dimensions, whose values scatter by a third."""
RINGS = 24


@dataclass(frozen=True)
class PatchSpectrum:
    """W2 of a patch over the plane of wavenumbers.

    Attributes
    ----------
    along_y_per_cm, along_x_per_cm : (R, 1) and (1, C) array, rad/cm, rising
    density_cm4 : (R, C) array, cm^4
    freedom : float, degrees of freedom of each value
    """

    along_y_per_cm: Floats
    along_x_per_cm: Floats
    density_cm4: Floats
    freedom: float


@dataclass(frozen=True)
class RingSpectrum:
    """W2 by the size of the wavenumber, means over rings.

    Attributes
    ----------
    wavenumber_per_cm : (K,) array, rad/cm, geometric mean of a ring's edges
    density_cm4 : (K,) array, cm^4
    low_cm4, high_cm4 : (K,) array, cm^4, of its 95 % interval
    """

    wavenumber_per_cm: Floats
    density_cm4: Floats
    low_cm4: Floats
    high_cm4: Floats


@dataclass(frozen=True)
class ProfileSpectrum:
    """Two-sided W1 of profiles, at positive wavenumbers.

    Attributes
    ----------
    wavenumber_per_cm : (K,) array, rad/cm
    density_cm3 : (K,) array, cm³; twice its integral is the mean square height
    profiles : int, that it is the mean of
    """

    wavenumber_per_cm: Floats
    density_cm3: Floats
    profiles: int


def detrended(patch: Patch) -> Floats:
    """(R, C) cm, heights less their best plane; 0 in holes.

    Parameters
    ----------
    patch : Patch
    """
    y, x = np.indices(patch.z_cm.shape) * patch.cell_cm
    design = np.column_stack([np.ones(int(patch.seen.sum())), y[patch.seen], x[patch.seen]])
    heights = patch.z_cm[patch.seen]
    plane, *_ = np.linalg.lstsq(design, heights, rcond=None)
    found = np.zeros_like(patch.z_cm)
    found[patch.seen] = heights - design @ plane
    return found


def sine_tapers(count: int, tapers: int = TAPERS) -> Floats:
    """(tapers, count) orthonormal sine tapers.

    Parameters
    ----------
    count : int, samples
    tapers : int

    References
    ----------
    Riedel & Sidorenko, IEEE Trans. Signal Processing 43, 188 (1995).
    """
    places = np.arange(1, count + 1)
    orders = np.arange(1, tapers + 1)[:, np.newaxis]
    return np.asarray(np.sqrt(2 / (count + 1)) * np.sin(np.pi * orders * places / (count + 1)))


def patch_spectrum(patch: Patch, tapers: int = TAPERS) -> PatchSpectrum:
    """W2 by multitaper, its plane removed, holes left out of every taper.

    Parameters
    ----------
    patch : Patch
    tapers : int, along either side
    """
    z, shape = detrended(patch), patch.z_cm.shape
    along_y, along_x = (sine_tapers(count, tapers) for count in shape)
    total = np.zeros(shape)
    for one in along_y:
        for other in along_x:
            taper = np.outer(one, other) * patch.seen
            total += np.abs(np.fft.fft2(taper * z)) ** 2 / float((taper**2).sum())
    density = total / tapers**2 * patch.cell_cm**2 / (2 * np.pi) ** 2
    y, x = wavenumbers(shape, patch.cell_cm)
    return PatchSpectrum(
        np.fft.fftshift(y, axes=0), np.fft.fftshift(x, axes=1), np.fft.fftshift(density),
        2.0 * tapers**2,
    )  # fmt: skip


def by_rings(spectrum: PatchSpectrum, rings: int = RINGS) -> RingSpectrum:
    """Means over rings of wavenumbers, evenly spaced in their logarithm, of values that are known.

    The interval is that of chi squared: values closer than the tapers tell apart count as one, of
    which there are as many in a ring as its area holds of the tapers' own.

    Parameters
    ----------
    spectrum : PatchSpectrum
    rings : int
    """
    y, x, density = spectrum.along_y_per_cm, spectrum.along_x_per_cm, spectrum.density_cm4
    size = np.hypot(y, x)
    least = max(float(np.min(np.diff(y.ravel()))), float(np.min(np.diff(x.ravel()))))
    edges = np.geomspace(1.5 * least, min(np.abs(y).max(), np.abs(x).max()), rings + 1)
    number = np.digitize(size, edges) - 1
    rows = []
    for ring in range(rings):
        inside = density[(number == ring) & np.isfinite(density)]
        if len(inside):
            # Half of the values are those of the other half; each is the mean of freedom / 2 more.
            freedom = max(len(inside) / 2 / (spectrum.freedom / 2), 1.0) * spectrum.freedom
            low, high = (freedom / float(chdtri(freedom, q)) for q in (0.025, 0.975))
            mean = inside.mean()
            rows.append((np.sqrt(edges[ring] * edges[ring + 1]), mean, low * mean, high * mean))
    return RingSpectrum(*np.array(rows).T)


def profile_spectrum(patch: Patch, axis: int, tapers: int = TAPERS) -> ProfileSpectrum:
    """W1 by multitaper, the mean over the patch's profiles without a hole, each less its slope.

    Parameters
    ----------
    patch : Patch
    axis : int, 0: profiles along y; 1: along x
    tapers : int

    Raises
    ------
    MeasurementError
        Every profile has a hole.
    """
    z, seen = (patch.z_cm, patch.seen) if axis == 1 else (patch.z_cm.T, patch.seen.T)
    whole = z[seen.all(axis=1)]
    if not len(whole):
        raise MeasurementError(f"roughness: no profile along {'yx'[axis]} is without a hole")
    count = whole.shape[1]
    whole = _without_slope(whole)
    found = np.fft.rfft(whole[:, np.newaxis] * sine_tapers(count, tapers), axis=2)
    density: Floats = (np.abs(found) ** 2).mean(axis=(0, 1)) * patch.cell_cm / (2 * np.pi)
    along = np.asarray(2 * np.pi * np.fft.rfftfreq(count, patch.cell_cm), dtype=float)
    return ProfileSpectrum(along[1:], density[1:], len(whole))


def capon_spectrum(
    profiles: Floats, seen: Mask, cell_cm: float, wavenumber_per_cm: Floats, order: int
) -> ProfileSpectrum:
    """W1 by Capon's minimum variance, for stretches too short for a periodogram.

    Parameters
    ----------
    profiles : (P, N) array, cm, 0 in holes
    seen : (P, N) array
    cell_cm : float, cm
    wavenumber_per_cm : (K,) array, rad/cm, where it is asked for
    order : int, samples of a window; windows with a hole are left out

    Raises
    ------
    InputError
        The order is not 2 to half of the samples.
    MeasurementError
        Fewer windows than the order are without a hole.

    References
    ----------
    Capon, Proc. IEEE 57, 1408 (1969); Stoica & Moses, Spectral Analysis of Signals (2005),
    sec. 5.4.
    """
    count = profiles.shape[1]
    if not 2 <= order <= count // 2:
        raise InputError("order", value=order, allowed=f"2 to {count // 2}")
    flat = _without_slope(profiles) if seen.all() else profiles
    windows = np.lib.stride_tricks.sliding_window_view(flat, order, axis=1).reshape(-1, order)
    held = np.lib.stride_tricks.sliding_window_view(seen, order, axis=1).reshape(-1, order)
    windows = windows[held.all(axis=1)]
    if len(windows) < max(order, FEWEST):
        raise MeasurementError(
            f"roughness: {len(windows)} windows of {order} samples are without a hole, "
            f"{max(order, FEWEST)} are needed"
        )
    both = np.concatenate([windows, windows[:, ::-1]])  # a profile read backwards is as likely
    inverse = np.linalg.pinv(both.T @ both / len(both), hermitian=True)
    waves = np.exp(1j * np.outer(wavenumber_per_cm * cell_cm, np.arange(order)))
    power = 1 / np.einsum("ki,ij,kj->k", waves.conj(), inverse, waves).real
    return ProfileSpectrum(wavenumber_per_cm, power * order * cell_cm / (2 * np.pi), len(profiles))


def _without_slope(profiles: Floats) -> Floats:
    """(P, N) profiles less the straight line that fits each best."""
    along = np.arange(profiles.shape[1]) - (profiles.shape[1] - 1) / 2
    slopes = profiles @ along / (along @ along)
    return np.asarray(profiles - profiles.mean(axis=1, keepdims=True) - np.outer(slopes, along))
