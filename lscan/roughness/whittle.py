"""The power law of a patch by Whittle's likelihood, its intervals, and what makes them hold.

A periodogram of a steep spectrum with holes is mostly leakage.  Two things mend it.  Differences of
neighbouring cells take the steepness away before anything leaks: first differences up to a spectral
exponent of about 3.3, the discrete Laplacian beyond; less their mean, they lose offset and slope.
What leaks still is in the likelihood: the periodogram is held against its own expectation, over
just the cells that were measured, not against the spectrum.  Nothing is filled in.

The parameters' covariance is H^-1 J H^-1: H from the expectation's derivatives, J the covariance of
the score over simulated patches of the fitted spectrum with the same holes, for neighbouring values
of such a periodogram are not independent.

References
----------
Guillaumin, Sykulski, Olhede & Simons, J. R. Stat. Soc. B 84, 1526 (2022): the debiased Whittle
likelihood of a random field on a grid with holes, and the covariance of its estimates.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.stats import t as student

from lscan.errors import MeasurementError
from lscan.records import Floats, Mask
from lscan.roughness.model import PowerLaw
from lscan.roughness.patch import Patch, wavenumbers

LEAST_WAVES = 2.5
"""Of the longest wavelength used, in the shorter side: of longer ones the taper's main lobe, and
the slope that differences take away, leave nothing to tell."""
SHARE_OF_NYQUIST = 0.8
"""Of the shortest: beyond, what lies above Nyquist's wavenumber folds in."""
TURNING = 3.3
"""Exponent from which on the Laplacian leaves less steepness than first differences do."""
BEGIN = 3.0  # spectral exponent where the search begins: the middle of what is found on seabeds
PADDING = 4  # sides of the grid that the expectation is summed on, in those of the patch
SIMULATED_PADDING = 2
SIMULATED = 400  # patches: J's variances are then known to 7 %
STEPS, CLOSE = 50, 1e-8
DIFFERENCE = 1e-4  # of a parameter, for derivatives of the spectrum
FEWEST_VALUES = 30
PARAMETERS = ("ln_w2", "gamma2", "a", "b")  # a and b where the law may be stretched
DB_PER_LN = 10 / np.log(10)

Density = Callable[[Floats, Floats], Floats]


@dataclass(frozen=True)
class Band:
    """Wavenumbers that a fit uses, rad/cm."""

    low_per_cm: float
    high_per_cm: float


@dataclass(frozen=True)
class PowerLawFit:
    """A power law with its uncertainty.

    Attributes
    ----------
    law : PowerLaw
    names : tuple of str, the parameters: ln_w2, gamma2, and a, b where it may be stretched
    covariance : (P, P) array, of these
    freedom : int, degrees of freedom that the covariance is known with
    band : Band, that was used
    values : int, of the periodogram in the band
    misfit : float, mean of periodogram over expectation, less 1: about 0 by construction
    """

    law: PowerLaw
    names: tuple[str, ...]
    covariance: Floats
    freedom: int
    band: Band
    values: int
    misfit: float

    @property
    def sigma_gamma2(self) -> float:
        """Standard uncertainty of the exponent."""
        return float(np.sqrt(self.covariance[1, 1]))

    @property
    def sigma_w2_db(self) -> float:
        """Standard uncertainty of 10 lg w2."""
        return float(DB_PER_LN * np.sqrt(self.covariance[0, 0]))

    @property
    def within(self) -> float:
        """Standard uncertainties that a 95 % interval reaches to either side."""
        return float(student.ppf(0.975, self.freedom))


@dataclass(frozen=True)
class _Differences:
    """One way to take differences: of which cells, and which values of its periodogram count.

    differences: of (..., R, C) heights.  transfer: their |D|² at wavenumbers.  taper: (R', C'), 0
    where a difference has a hole in it.  chosen: (R', C') of its periodogram's values.  cell_cm:
    side of a cell.
    """

    differences: Callable[[Floats], Floats]
    transfer: Density
    taper: Floats
    chosen: Mask
    cell_cm: float

    @cached_property
    def overlap(self) -> Floats:
        """(2 R', 2 C') sums of products of the taper with itself, shifted by each lag."""
        size = tuple(2 * count for count in self.taper.shape)
        return np.asarray(np.fft.ifft2(np.abs(np.fft.fft2(self.taper, size)) ** 2).real)

    def periodogram(self, z_cm: Floats) -> Floats:
        """(..., V) values of heights (..., R, C), cm^4."""
        steps = self.differences(z_cm)
        # First differences of a slope are an offset, which leaks from a taper with holes.
        offset = (self.taper * steps).sum((-2, -1), keepdims=True) / self.taper.sum()
        tapered = np.fft.fft2(self.taper * (steps - offset))
        return np.asarray(np.abs(tapered[..., self.chosen]) ** 2 * self._scale)

    def expected(self, spectrum: Density) -> Floats:
        """(V,) expectation of the periodogram, cm^4."""
        rows, columns = self.taper.shape
        y, x = wavenumbers((PADDING * rows, PADDING * columns), self.cell_cm)
        density = spectrum(y, x) * self.transfer(y, x)
        covariance = np.fft.ifft2(density).real * (2 * np.pi / self.cell_cm) ** 2
        lags_y = np.r_[0:rows, 0, -rows + 1 : 0]
        lags_x = np.r_[0:columns, 0, -columns + 1 : 0]
        product = covariance[np.ix_(lags_y, lags_x)] * self.overlap
        return np.asarray(np.fft.fft2(product).real[::2, ::2][self.chosen] * self._scale)

    @property
    def _scale(self) -> float:
        """Makes a periodogram of it: the one that white noise has the spectrum of."""
        return self.cell_cm**2 / float((self.taper**2).sum()) / (2 * np.pi) ** 2


def fit_power_law(
    patch: Patch,
    *,
    stretched: bool = False,
    band: Band | None = None,
    response: Density | None = None,
    known: Callable[[Floats, Floats], Mask] | None = None,
    seed: int = 1,
    simulated: int = SIMULATED,
) -> PowerLawFit:
    """The power law that makes a patch's periodogram most likely, with its uncertainty.

    Parameters
    ----------
    patch : Patch, cm; its noise counts as white and known
    stretched : bool, whether the law may differ between directions
    band : Band, optional, rad/cm; by default all that the patch can tell
    response : callable, optional, of rad/cm along y and x: share of the power at a wavenumber that
        the instrument passes
    known : callable, optional, of the same: where that share is known; elsewhere nothing is used
    seed : int, of the patches that are simulated
    simulated : int, of them, 3 or more; even

    Raises
    ------
    MeasurementError
        The band holds fewer than 30 values; the likelihood has no maximum.
    """
    band = band or usable_band(patch)
    likelihood, theta = _most_likely(patch, band, stretched, response, known)
    covariance = likelihood.covariance(theta, seed, simulated)
    return PowerLawFit(
        law_of(theta),
        PARAMETERS[: len(theta)],
        covariance,
        2 * (simulated // 2) - 1,
        band,
        len(likelihood.values),
        float(np.mean(likelihood.values / likelihood.expected(theta)) - 1),
    )


def most_likely_law(
    patch: Patch,
    *,
    stretched: bool = False,
    band: Band | None = None,
    response: Density | None = None,
    known: Callable[[Floats, Floats], Mask] | None = None,
) -> PowerLaw:
    """The law of ``fit_power_law`` without its uncertainty, which takes most of the time.

    Parameters
    ----------
    patch, stretched, band, response, known
        As of ``fit_power_law``.

    Raises
    ------
    MeasurementError
        As ``fit_power_law``.
    """
    band = band or usable_band(patch)
    return law_of(_most_likely(patch, band, stretched, response, known)[1])


def _most_likely(
    patch: Patch,
    band: Band,
    stretched: bool,
    response: Density | None,
    known: Callable[[Floats, Floats], Mask] | None,
) -> tuple["_Likelihood", Floats]:
    """The likelihood of the differences that suit the exponent, and where it is largest."""
    theta = np.zeros(4 if stretched else 2)
    theta[1] = BEGIN
    for second in (False, True):
        parts = list(_parts(patch, band, second, known))
        likelihood = _Likelihood(patch, parts, response)
        theta = likelihood.maximum(theta)
        if theta[1] < TURNING:
            break
    if second and theta[1] < TURNING - 0.3:  # turned by chance: what was found first is better
        likelihood = _Likelihood(patch, list(_parts(patch, band, False, known)), response)
        theta = likelihood.maximum(theta)
    return likelihood, theta


def usable_band(patch: Patch) -> Band:
    """From 2.5 wavelengths in the shorter side to 0.8 of Nyquist's wavenumber.

    Parameters
    ----------
    patch : Patch
    """
    low = 2 * np.pi * LEAST_WAVES / min(patch.size_cm)
    return Band(float(low), SHARE_OF_NYQUIST * patch.nyquist_per_cm)


def law_of(theta: Floats) -> PowerLaw:
    """The law of parameters ln w2, gamma2, and a and b.

    Parameters
    ----------
    theta : (2,) or (4,) array
    """
    a, b = theta[2:] if len(theta) > 2 else (0.0, 0.0)
    return PowerLaw(float(theta[1]), float(np.exp(theta[0])), (float(a), float(b)))


class _Likelihood:
    """Whittle's likelihood of a patch, of parameters of a power law."""

    def __init__(self, patch: Patch, parts: list[_Differences], response: Density | None) -> None:
        self._patch, self._parts, self._response = patch, parts, response
        self.values = np.concatenate([part.periodogram(patch.z_cm) for part in parts])
        if len(self.values) < FEWEST_VALUES:
            raise MeasurementError(
                f"roughness: the band holds {len(self.values)} values of the periodogram, "
                f"{FEWEST_VALUES} are needed"
            )
        self._noise = self._expected(lambda y, x: np.full(np.broadcast(y, x).shape, self._floor))

    @property
    def _floor(self) -> float:
        """cm^4, the spectrum of the cells' own noise."""
        return self._patch.noise_cm2 * self._patch.cell_cm**2 / (2 * np.pi) ** 2

    def _spectrum(self, law: PowerLaw) -> Density:
        response = self._response
        if response is None:
            return law.density
        return lambda y, x: law.density(y, x) * response(y, x)

    def _expected(self, spectrum: Density) -> Floats:
        return np.concatenate([part.expected(spectrum) for part in self._parts])

    def expected(self, theta: Floats) -> Floats:
        """(V,) expectation of the periodogram."""
        return self._expected(self._spectrum(law_of(theta))) + self._noise

    def _derivatives(self, theta: Floats, expected: Floats) -> Floats:
        """(V, P) of the logarithm of the expectation."""
        columns = [(expected - self._noise) / expected]  # by ln w2
        for way in DIFFERENCE * np.eye(len(theta))[1:]:
            high, low = self.expected(theta + way), self.expected(theta - way)
            columns.append((high - low) / (2 * DIFFERENCE * expected))
        return np.stack(columns, axis=1)

    def maximum(self, theta: Floats) -> Floats:
        """(P,) parameters of the largest likelihood, by Fisher's scoring."""
        theta = theta.copy()
        theta[0] += np.log(np.mean(self.values / self.expected(theta)))
        size, expected = self._cost(theta)
        for _ in range(STEPS):
            slopes = self._derivatives(theta, expected)
            score = slopes.T @ (self.values / expected - 1)
            step = np.linalg.solve(slopes.T @ slopes, score)
            for _ in range(STEPS):
                found, there = self._cost(theta + step)
                if found <= size + 1e-9 * abs(size):
                    break
                step = step / 2
            theta, size, expected = theta + step, found, there
            if np.abs(step).max() < CLOSE:
                return theta
        raise MeasurementError("roughness: no power law makes the patch most likely")

    def _cost(self, theta: Floats) -> tuple[float, Floats]:
        expected = self.expected(theta)
        if not (expected > 0).all():
            return np.inf, expected
        return float(np.sum(np.log(expected) + self.values / expected)), expected

    def covariance(self, theta: Floats, seed: int, simulated: int) -> Floats:
        """(P, P) of the parameters."""
        expected = self.expected(theta)
        slopes = self._derivatives(theta, expected)
        scores = []
        for z in self._simulated(law_of(theta), seed, simulated):
            values = np.concatenate([part.periodogram(z) for part in self._parts])
            scores.append(slopes.T @ (values / expected - 1))
        inverse = np.linalg.inv(slopes.T @ slopes)
        return np.asarray(inverse @ np.cov(np.array(scores).T) @ inverse)

    def _simulated(self, law: PowerLaw, seed: int, simulated: int) -> Iterator[Floats]:
        """(R, C) cm, patches of a law as the instrument shows it."""
        patch, generator = self._patch, np.random.default_rng([seed, 17])
        rows, columns = patch.z_cm.shape
        shape = SIMULATED_PADDING * rows, SIMULATED_PADDING * columns
        y, x = wavenumbers(shape, patch.cell_cm)
        area = (2 * np.pi) ** 2 / (shape[0] * shape[1] * patch.cell_cm**2)
        size = np.sqrt((self._spectrum(law)(y, x) + self._floor) * area)
        for _ in range(simulated // 2):
            drawn = generator.standard_normal((2, *shape))
            both = np.fft.fft2(size * (drawn[0] + 1j * drawn[1]))[:rows, :columns]
            yield both.real
            yield both.imag


def _parts(
    patch: Patch,
    band: Band,
    second: bool,
    known: Callable[[Floats, Floats], Mask] | None = None,
) -> Iterator[_Differences]:
    """The differences of a patch: its Laplacian, or those along x and along y.

    First differences along either axis lose what runs along the other; each counts for the
    wavenumbers that it shows better.
    """
    seen, cell = patch.seen, patch.cell_cm
    if second:
        yield _part(_laplacian, _of_laplacian(cell), _whole(seen), band, cell, None, known)
        return
    for axis in (0, 1):
        both = np.diff(seen.astype(int), axis=axis) == 0
        there = both & np.take(seen, range(seen.shape[axis] - 1), axis=axis)
        yield _part(_along(axis), _of_difference(cell, axis), there, band, cell, axis, known)


def _part(
    differences: Callable[[Floats], Floats],
    transfer: Density,
    there: Mask,
    band: Band,
    cell_cm: float,
    axis: int | None,
    known: Callable[[Floats, Floats], Mask] | None,
) -> _Differences:
    taper = np.outer(*(_sine(count) for count in there.shape)) * there
    y, x = wavenumbers(there.shape, cell_cm)
    size = np.hypot(y, x)
    chosen = (size >= band.low_per_cm) & (size <= band.high_per_cm)
    chosen &= (y > 0) | ((y == 0) & (x > 0))  # of a real field's, each once
    chosen &= (np.abs(x) < np.pi / cell_cm * (1 - 1e-9)) & (
        np.abs(y) < np.pi / cell_cm * (1 - 1e-9)
    )
    if known is not None:
        chosen &= known(y, x)
    if axis is not None:
        chosen &= np.abs(y) > np.abs(x) if axis == 0 else np.abs(x) >= np.abs(y)
    return _Differences(differences, transfer, taper, chosen, cell_cm)


def _sine(count: int) -> Floats:
    """The first sine taper (Riedel & Sidorenko, IEEE Trans. Signal Processing 43, 188, 1995)."""
    return np.sin(np.pi * (np.arange(count) + 1) / (count + 1))


def _along(axis: int) -> Callable[[Floats], Floats]:
    return lambda z: np.diff(z, axis=axis - 2)


def _of_difference(cell_cm: float, axis: int) -> Density:
    return lambda y, x: 4 * np.sin((y, x)[axis] * cell_cm / 2) ** 2 + 0 * (y + x)


def _laplacian(z: Floats) -> Floats:
    inner = z[..., 1:-1, 1:-1]
    beside = z[..., :-2, 1:-1] + z[..., 2:, 1:-1] + z[..., 1:-1, :-2] + z[..., 1:-1, 2:]
    return np.asarray(beside - 4 * inner)


def _of_laplacian(cell_cm: float) -> Density:
    return lambda y, x: (4 * np.sin(y * cell_cm / 2) ** 2 + 4 * np.sin(x * cell_cm / 2) ** 2) ** 2


def _whole(seen: Mask) -> Mask:
    """Inner cells that are seen with all four beside them."""
    return seen[1:-1, 1:-1] & seen[:-2, 1:-1] & seen[2:, 1:-1] & seen[1:-1, :-2] & seen[1:-1, 2:]
