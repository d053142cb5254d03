"""Spectra of a patch and of its profiles, the laws that model them, and moments.

These show; what is fitted is the periodogram itself (whittle.py).  Where there are holes a taper
is laid over what was measured, so that none invents power, but it leaks more.
"""

from dataclasses import dataclass
from math import atan2, exp, gamma, hypot, pi, sqrt

import numpy as np
from scipy.signal import correlate
from scipy.special import chdtri

from lscan.errors import InputError, MeasurementError
from lscan.records import Floats, Ints, Mask
from lscan.roughness.patch import FEWEST, Patch, wavenumbers

# Spectra to look at: by multitaper of a patch and of its profiles, by Capon of short stretches.

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
    low_cm4, high_cm4 : (K,) array, cm^4, of its 95 % interval; NaN where none can be stated
    seabed_cm4 : (K,) array or None, cm^4, less the noise, over what the instrument passes; NaN
        where that is not known.  None where it was not asked for
    """

    wavenumber_per_cm: Floats
    density_cm4: Floats
    low_cm4: Floats
    high_cm4: Floats
    seabed_cm4: Floats | None = None


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


def detrend(patch: Patch) -> Floats:
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
    z, shape = detrend(patch), patch.z_cm.shape
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
    which there are as many in a ring as its area holds of the tapers' own.  It holds scatter alone:
    what leaks and folds into a ring only a law can say, as that of ``PowerLawFit.rings`` does.

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


# Models of a roughness spectrum: a power law, the same in all directions or stretched.
#
# A spectrum W2(K) is the density of mean square height over the plane of the wavenumber vector K,
# rad/cm: its integral over all of the plane is the mean square height.  It is in cm^4.


REFERENCE_CM = 1.0
"""Length h0 that makes K dimensionless in a power law (APL-UW TR 9407, sec. IV)."""


@dataclass(frozen=True)
class PowerLaw:
    """W2(K) = w2 / (h0 k)^gamma2, where k² = K' M K and M stretches the plane without its area.

    M is the exponential of [[a, b], [b, -a]]: for a = b = 0 the law is the same in all directions.

    Attributes
    ----------
    gamma2 : float, spectral exponent
    w2_cm4 : float, cm^4, spectral strength: W2 at k = 1 rad/cm
    stretch : (float, float), a and b

    References
    ----------
    Applied Physics Laboratory, APL-UW TR 9407 (1994), sec. IV; Jackson & Richardson, High-Frequency
    Seafloor Acoustics (Springer 2007), ch. 6.

    Examples
    --------
    >>> float(PowerLaw(3.0, 0.004).density(0.0, 2.0))
    0.0005
    """

    gamma2: float
    w2_cm4: float
    stretch: tuple[float, float] = (0.0, 0.0)

    def density(self, along_y: Floats | float, along_x: Floats | float) -> Floats:
        """W2 in cm^4 at wavenumbers; 0 at K = 0, where a power law has none.

        Parameters
        ----------
        along_y, along_x : array or float, rad/cm, components of K
        """
        a, b = self.stretch
        size = hypot(a, b)
        steep = np.sinh(size) / size if size else 1.0
        square = np.cosh(size) * (np.square(along_x) + np.square(along_y))
        square = square + steep * (
            a * (np.square(along_x) - np.square(along_y)) + 2 * b * np.multiply(along_x, along_y)
        )
        with np.errstate(divide="ignore"):
            found = self.w2_cm4 * (REFERENCE_CM**2 * square) ** (-self.gamma2 / 2)
        return np.where(square > 0, found, 0.0)[()]

    @property
    def ratio(self) -> float:
        """How many times longer features are across the heading than along it."""
        return exp(hypot(*self.stretch))

    @property
    def heading_deg(self) -> float:
        """From x towards y, degrees of 0 to 180: the direction in which the surface is roughest."""
        a, b = self.stretch
        return float(np.degrees(atan2(-b, -a) / 2) % 180)

    @property
    def one_dimensional(self) -> tuple[float, float]:
        """gamma1 and w1 in cm³ of profiles: W1(k) = w1 / (h0 k)^gamma1, -inf < k < inf.

        Of the law that is the same in all directions: the integral of W2 over the other component.

        References
        ----------
        Jackson & Richardson (2007), ch. 6: W1 and W2 of an isotropic surface.
        """
        share = sqrt(pi) * gamma((self.gamma2 - 1) / 2) / gamma(self.gamma2 / 2)
        return self.gamma2 - 1, self.w2_cm4 * share / REFERENCE_CM


def from_profiles(gamma1: float, w1_cm3: float) -> PowerLaw:
    """The law, the same in all directions, whose profiles have a spectrum w1 / (h0 k)^gamma1.

    Parameters
    ----------
    gamma1 : float, above 0
    w1_cm3 : float, cm³, of the two-sided spectrum of a profile

    Examples
    --------
    >>> law = from_profiles(*PowerLaw(3.2, 0.01).one_dimensional)
    >>> round(law.gamma2, 12), round(law.w2_cm4, 12)
    (3.2, 0.01)
    """
    _, unit = PowerLaw(gamma1 + 1, 1.0).one_dimensional
    return PowerLaw(gamma1 + 1, w1_cm3 / unit)


# Moments of a patch: rms height and slope, skewness, structure function, correlation length.


@dataclass(frozen=True)
class RoughnessMoments:
    """Moments of a patch less its plane; what its noise adds to a mean square is taken off.

    Attributes
    ----------
    rms_height_cm : float, cm
    rms_slope_y, rms_slope_x : float, of differences of neighbouring cells
    skewness : float, of the heights; that of their noise is none
    correlation_length_cm : float, cm, at which the autocovariance has fallen to 1/e of the mean
        square; NaN where it does not within half of the patch
    """

    rms_height_cm: float
    rms_slope_y: float
    rms_slope_x: float
    skewness: float
    correlation_length_cm: float


@dataclass(frozen=True)
class StructureFunction:
    """Mean squared difference of heights against their distance along an axis.

    Attributes
    ----------
    distance_cm : (L,) array, cm
    difference_cm2 : (L,) array, cm²; what the points' noise adds is taken off
    pairs : (L,) array, of measured cells that far apart
    """

    distance_cm: Floats
    difference_cm2: Floats
    pairs: Ints


def moments(patch: Patch) -> RoughnessMoments:
    """The moments of a patch.

    Parameters
    ----------
    patch : Patch

    Raises
    ------
    MeasurementError
        The noise is as large as the roughness.
    """
    z = detrend(patch)
    heights = z[patch.seen]
    square = float((heights**2).mean()) - patch.points_noise_cm2
    if square <= 0:
        raise MeasurementError(
            f"roughness: the heights' rms of {np.sqrt((heights**2).mean()):.3g} cm is no more than "
            f"their noise, {np.sqrt(patch.points_noise_cm2):.3g} cm"
        )
    structures = [structure_function(patch, axis) for axis in (0, 1)]
    slopes = [np.sqrt(max(one.difference_cm2[0], 0.0)) / patch.cell_cm for one in structures]
    return RoughnessMoments(
        rms_height_cm=float(np.sqrt(square)),
        rms_slope_y=float(slopes[0]),
        rms_slope_x=float(slopes[1]),
        skewness=float((heights**3).mean() / square**1.5),
        correlation_length_cm=_correlation_length(structures, square),
    )


def structure_function(patch: Patch, axis: int) -> StructureFunction:
    """Of a patch less its plane, up to half of its length; pairs with a hole do not count.

    Parameters
    ----------
    patch : Patch
    axis : int, 0: along y, 1: along x
    """
    z, seen = detrend(patch), patch.seen.astype(float)
    if axis == 0:
        z, seen = z.T, seen.T
    count = z.shape[1]
    reach = slice(count, count + count // 2)  # lags from 1
    total, pairs = np.zeros(count // 2), np.zeros(count // 2)
    for heights, mask in zip(z, seen, strict=True):
        squares = correlate(heights**2, mask) + correlate(mask, heights**2)
        total += (squares - 2 * correlate(heights, heights))[reach]
        pairs += np.rint(correlate(mask, mask))[reach]
    known = pairs > 0
    distance = patch.cell_cm * np.arange(1, count // 2 + 1)
    # Cells between the same two points have part of their noise in common.
    apart = np.arange(1, count // 2 + 1) / (patch.points_cells if axis == 1 else 1.0)
    noise = 2 * patch.points_noise_cm2 * np.minimum(apart, 1.0)
    mean = np.maximum(total[known], 0.0) / pairs[known] - noise[known]
    return StructureFunction(distance[known], mean, pairs[known].astype(np.int64))


def _correlation_length(structures: list[StructureFunction], square_cm2: float) -> float:
    """cm, the mean over both axes of where the structure function reaches 2 (1 - 1/e) squares."""
    found = []
    for one in structures:
        beyond = np.flatnonzero(one.difference_cm2 >= 2 * (1 - np.exp(-1)) * square_cm2)
        if not len(beyond):
            return float("nan")
        k = int(beyond[0])
        steps = np.r_[0.0, one.difference_cm2[: k + 1]][-2:]
        places = np.r_[0.0, one.distance_cm[: k + 1]][-2:]
        found.append(np.interp(2 * (1 - np.exp(-1)) * square_cm2, steps, places))
    return float(np.mean(found))
