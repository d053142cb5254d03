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

import numpy as np
from scipy.fft import fft
from scipy.special import stdtrit

from lscan.errors import MeasurementError
from lscan.records import Floats, Progress
from lscan.roughness.differences import Band, CovarianceSum, Differences, Known, differences_of
from lscan.roughness.instrument import noise_density
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
SIMULATED_PADDING = 2
SIMULATED = 400  # patches: J's variances are then known to 7 %
STEPS, CLOSE = 50, 1e-8
DIFFERENCE = 1e-4  # of a parameter, for derivatives of the spectrum
FEWEST_VALUES = 30
PARAMETERS = ("ln_w2", "gamma2", "a", "b")  # a and b where the law may be stretched
DB_PER_LN = 10 / np.log(10)

Density = Callable[[Floats, Floats], Floats]


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
        return float(stdtrit(self.freedom, 0.975))


def fit_power_law(
    patch: Patch,
    *,
    stretched: bool = False,
    band: Band | None = None,
    response: Density | None = None,
    known: Known | None = None,
    seed: int = 1,
    simulated: int = SIMULATED,
    progress: Progress | None = None,
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
    progress : Progress or None, called with (done, all) after each of them

    Raises
    ------
    MeasurementError
        The band holds fewer than 30 values; the likelihood has no maximum.
    """
    band = band or usable_band(patch)
    likelihood, theta = _most_likely(patch, band, stretched, response, known)
    covariance = likelihood.covariance(theta, seed, simulated, progress)
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
    known: Known | None = None,
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
    known: Known | None,
) -> tuple["_Likelihood", Floats]:
    """The likelihood of the differences that suit the exponent, and where it is largest."""
    theta = np.zeros(4 if stretched else 2)
    theta[1] = BEGIN
    for second in (False, True):
        parts = list(differences_of(patch, band, second, known))
        likelihood = _Likelihood(patch, parts, response)
        theta = likelihood.maximum(theta)
        if theta[1] < TURNING:
            break
    if second and theta[1] < TURNING - 0.3:  # turned by chance: what was found first is better
        likelihood = _Likelihood(patch, list(differences_of(patch, band, False, known)), response)
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

    def __init__(self, patch: Patch, parts: list[Differences], response: Density | None) -> None:
        self._patch, self._parts, self._response = patch, parts, response
        self.values = np.concatenate([part.periodogram(patch.z_cm) for part in parts])
        if len(self.values) < FEWEST_VALUES:
            raise MeasurementError(
                f"roughness: the band holds {len(self.values)} values of the periodogram, "
                f"{FEWEST_VALUES} are needed"
            )
        self._sum = CovarianceSum(patch.z_cm.shape, patch.cell_cm)
        self._passed = np.asarray(1.0 if response is None else response(*self._sum.plane))
        self._noise = self._expected(self._sum.of_noise(patch.noise_cm2))

    def _expected(self, covariance_cm2: Floats) -> Floats:
        return np.concatenate([part.expected(covariance_cm2) for part in self._parts])

    def _density(self, theta: Floats) -> Floats:
        """cm^4 on the plane of the sum: the law's, as far as the instrument passes it."""
        return np.asarray(law_of(theta).density(*self._sum.plane) * self._passed)

    def expected(self, theta: Floats) -> Floats:
        """(V,) expectation of the periodogram."""
        return self._expected(self._sum.of(self._density(theta))) + self._noise

    def _derivatives(self, theta: Floats, expected: Floats) -> Floats:
        """(V, P) of the logarithm of the expectation."""
        columns = [expected - self._noise]  # by ln w2
        for way in DIFFERENCE * np.eye(len(theta))[1:]:
            steps = self._density(theta + way) - self._density(theta - way)
            columns.append(self._expected(self._sum.of(steps / (2 * DIFFERENCE))))
        return np.stack(columns, axis=1) / expected[:, np.newaxis]

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # a step may lead anywhere
    def maximum(self, theta: Floats) -> Floats:
        """(P,) parameters of the largest likelihood, by Fisher's scoring."""
        theta = theta.copy()
        theta[0] += np.log(np.mean(self.values / self.expected(theta)))
        size, expected = self._cost(theta)
        for _ in range(STEPS):
            slopes = self._derivatives(theta, expected)
            normal = slopes.T @ slopes
            if not np.isfinite(normal).all() or np.linalg.matrix_rank(normal) < len(theta):
                break  # as where all is noise
            step = np.linalg.solve(normal, slopes.T @ (self.values / expected - 1))
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

    def covariance(
        self, theta: Floats, seed: int, simulated: int, progress: Progress | None
    ) -> Floats:
        """(P, P) of the parameters."""
        expected = self.expected(theta)
        slopes = self._derivatives(theta, expected)
        scores = []
        for number, z in enumerate(self._simulated(law_of(theta), seed, simulated), start=1):
            values = np.concatenate([part.periodogram(z) for part in self._parts])
            scores.append(slopes.T @ (values / expected - 1))
            if progress is not None:
                progress(number, simulated)
        inverse = np.linalg.inv(slopes.T @ slopes)
        return np.asarray(inverse @ np.cov(np.array(scores).T) @ inverse)

    def _simulated(self, law: PowerLaw, seed: int, simulated: int) -> Iterator[Floats]:
        """(R, C) cm, patches of a law as the instrument shows it."""
        patch, generator = self._patch, np.random.default_rng([seed, 17])
        rows, columns = patch.z_cm.shape
        shape = SIMULATED_PADDING * rows, SIMULATED_PADDING * columns
        y, x = wavenumbers(shape, patch.cell_cm)
        area = (2 * np.pi) ** 2 / (shape[0] * shape[1] * patch.cell_cm**2)
        passed = 1.0 if self._response is None else self._response(y, x)
        size = np.sqrt((law.density(y, x) * passed + noise_density(patch)) * area)
        for _ in range(simulated // 2):
            drawn = generator.standard_normal((2, *shape))
            # Rows beyond the patch are not transformed along x.
            along_y = fft(size * (drawn[0] + 1j * drawn[1]), axis=0)[:rows]
            both = fft(along_y, axis=1)[:, :columns]
            yield both.real
            yield both.imag
