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
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from scipy.fft import fft, irfft2, next_fast_len, rfft2
from scipy.special import chdtri, stdtrit

from lscan.errors import MeasurementError
from lscan.records import Floats, Mask, Progress
from lscan.roughness.instrument import LAW_ENDS_SIGMA, FoldedPower, noise_density
from lscan.roughness.patch import Patch, wavenumbers
from lscan.roughness.spectra import RINGS, PowerLaw, RingSpectrum

# Differences of a patch's cells: their periodogram, and what it is expected to be.
#
# The covariance of differences is the differences of the cells' own covariance, at every lag: one
# sum over wavenumbers serves all differences of a patch.


Known = Callable[[Floats, Floats], Mask]

PADDING = 4  # sides of the grid that a covariance is summed on, in those of the patch


@dataclass(frozen=True)
class Band:
    """Wavenumbers that a fit uses, rad/cm."""

    low_per_cm: float
    high_per_cm: float


@dataclass(frozen=True)
class CovarianceSum:
    """The sum over wavenumbers that gives the covariance of a patch's cells.

    Attributes
    ----------
    shape : (R, C), of the patch
    cell_cm : float, cm
    """

    shape: tuple[int, int]
    cell_cm: float

    @cached_property
    def plane(self) -> tuple[Floats, Floats]:
        """(P, 1) and (1, Q) rad/cm along y and x, x not negative: a real field's other half."""
        rows, columns = self._padded_shape
        y, _ = wavenumbers((rows, 1), self.cell_cm)
        x = 2 * np.pi * np.fft.rfftfreq(columns, self.cell_cm)
        return y, np.asarray(x, dtype=float)[np.newaxis, :]

    def of(self, density_cm4: Floats) -> Floats:
        """(2 R - 1, 2 C - 1) cm², covariances of a spectrum, at lags from 1 - R and 1 - C on.

        Parameters
        ----------
        density_cm4 : (P, Q) array, cm^4, on ``plane``
        """
        summed = irfft2(density_cm4, self._padded_shape) * (2 * np.pi / self.cell_cm) ** 2
        return np.asarray(summed[np.ix_(*(np.arange(1 - count, count) for count in self.shape))])

    def of_noise(self, variance_cm2: float) -> Floats:
        """The same of white noise.

        Parameters
        ----------
        variance_cm2 : float, cm², of a cell
        """
        rows, columns = self.shape
        found = np.zeros((2 * rows - 1, 2 * columns - 1))
        found[rows - 1, columns - 1] = variance_cm2
        return found

    @property
    def _padded_shape(self) -> tuple[int, int]:
        rows, columns = (next_fast_len(PADDING * count, real=True) for count in self.shape)
        return rows, columns


@dataclass(frozen=True)
class Differences:
    """One way to take differences: of which cells, and which values of its periodogram count.

    Attributes
    ----------
    take : callable, the differences of (..., R, C) values
    sign : int, of them taken twice, as a covariance of theirs
    taper : (R', C') array, 0 where a difference has a hole in it
    chosen : (R' // 2 + 1, C') array, of its periodogram's values, those along y from 0 on
    cell_cm : float, cm
    """

    take: Callable[[Floats], Floats]
    sign: int
    taper: Floats
    chosen: Mask
    cell_cm: float

    def periodogram(self, z_cm: Floats) -> Floats:
        """(..., V) cm^4, values of the periodogram.

        Parameters
        ----------
        z_cm : (..., R, C) array, cm
        """
        steps = self.take(z_cm)
        # First differences of a slope are an offset, which leaks from a taper with holes.
        offset = (self.taper * steps).sum((-2, -1), keepdims=True) / self.taper.sum()
        tapered = rfft2(self.taper * (steps - offset), axes=(-1, -2))
        return np.asarray(np.abs(tapered[..., self.chosen]) ** 2 * self._scale)

    def expected(self, covariance_cm2: Floats) -> Floats:
        """(V,) cm^4, the periodogram's expectation.

        Parameters
        ----------
        covariance_cm2 : (2 R - 1, 2 C - 1) array, cm², of the cells, as of ``CovarianceSum``
        """
        rows, columns = self.taper.shape
        differences = self.sign * self.take(self.take(covariance_cm2))
        # A periodogram has the cells' own period: lags that are one apart count as the same.
        folded = np.pad(differences * self._overlap, ((1, 0), (1, 0)))
        folded = folded.reshape(2, rows, 2, columns).sum((0, 2))
        return np.asarray(rfft2(folded, axes=(-1, -2)).real[self.chosen] * self._scale)

    @cached_property
    def _overlap(self) -> Floats:
        """(2 R' - 1, 2 C' - 1) sums of products of the taper with itself, shifted by each lag."""
        size = tuple(2 * count for count in self.taper.shape)
        return np.fft.fftshift(irfft2(np.abs(rfft2(self.taper, size)) ** 2, size))[1:, 1:]

    @property
    def places(self) -> tuple[Floats, Floats]:
        """(V,) rad/cm along y and x, of the values that count."""
        y, x = np.broadcast_arrays(*_half_wavenumbers(self.taper.shape, self.cell_cm))
        return y[self.chosen], x[self.chosen]

    @cached_property
    def gain(self) -> Floats:
        """(V,) share of the power at its wavenumbers that differences keep."""
        cell = np.zeros(np.add(self.taper.shape, 2))
        cell[2, 2] = 1.0
        waves = rfft2(self.take(cell), self.taper.shape[::-1], axes=(-1, -2))
        return np.asarray(np.abs(waves[self.chosen]) ** 2)

    @property
    def _scale(self) -> float:
        """Makes a periodogram of it: the one that white noise has the spectrum of."""
        return self.cell_cm**2 / float((self.taper**2).sum()) / (2 * np.pi) ** 2


def differences_of(
    patch: Patch, band: Band, second: bool, known: Known | None = None
) -> Iterator[Differences]:
    """The differences of a patch: its Laplacian, or those along x and along y.

    First differences along either axis lose what runs along the other; each counts for the
    wavenumbers that it shows better.

    Parameters
    ----------
    patch : Patch
    band : Band, rad/cm, of the periodogram's values that count
    second : bool, whether the Laplacian is taken
    known : callable, optional, of rad/cm along y and x: where values count
    """
    seen, cell = patch.seen, patch.cell_cm
    if second:
        there = _whole(seen)
        chosen = _chosen(there.shape, band, cell, known)
        yield Differences(_laplacian, 1, _taper(there), chosen, cell)
        return
    for axis in (0, 1):
        both = np.diff(seen.astype(int), axis=axis) == 0
        there = both & np.take(seen, range(seen.shape[axis] - 1), axis=axis)
        y, x = _half_wavenumbers(there.shape, cell)
        chosen = _chosen(there.shape, band, cell, known)
        chosen &= np.abs(y) > np.abs(x) if axis == 0 else np.abs(x) >= np.abs(y)
        yield Differences(partial(np.diff, axis=axis - 2), -1, _taper(there), chosen, cell)


def _half_wavenumbers(shape: tuple[int, ...], cell_cm: float) -> tuple[Floats, Floats]:
    """Wavenumbers of a periodogram, of a real field's each once: those along y from 0 on."""
    rows, columns = shape
    y, x = wavenumbers((rows, columns), cell_cm)
    return np.abs(y[: rows // 2 + 1]), x


def _chosen(shape: tuple[int, ...], band: Band, cell_cm: float, known: Known | None) -> Mask:
    y, x = _half_wavenumbers(shape, cell_cm)
    size, end = np.hypot(y, x), np.pi / cell_cm * (1 - 1e-9)
    # Rounding, which is another in other units, does not choose among those on the band's ends.
    chosen = (size >= band.low_per_cm * (1 - 1e-9)) & (size <= band.high_per_cm * (1 + 1e-9))
    chosen &= (y > 0) | (x > 0)
    chosen &= (np.abs(x) < end) & (y < end)
    return chosen if known is None else chosen & known(y, x)


def _taper(there: Mask) -> Floats:
    """The first sine taper (Riedel & Sidorenko, IEEE Trans. Signal Processing 43, 188, 1995)."""
    sines = (np.sin(np.pi * (np.arange(n) + 1) / (n + 1)) for n in there.shape)
    return np.asarray(np.outer(*sines) * there)


def _laplacian(z: Floats) -> Floats:
    inner = z[..., 1:-1, 1:-1]
    beside = z[..., :-2, 1:-1] + z[..., 2:, 1:-1] + z[..., 1:-1, :-2] + z[..., 1:-1, 2:]
    return np.asarray(beside - 4 * inner)


def _whole(seen: Mask) -> Mask:
    """Inner cells that are seen with all four beside them."""
    return seen[1:-1, 1:-1] & seen[:-2, 1:-1] & seen[2:, 1:-1] & seen[1:-1, :-2] & seen[1:-1, 2:]


# The power law of a patch by Whittle's likelihood, its intervals, and what makes them hold.


LEAST_WAVES = 2.5
"""Of the longest wavelength used, in the shorter side: of longer ones the taper's main lobe, and
the slope that differences take away, leave nothing to tell."""
SHARE_OF_NYQUIST = 0.8
"""Of the shortest: beyond, what lies above Nyquist's wavenumber folds in."""
TURNING = 3.3
"""Exponent from which on the Laplacian leaves less steepness than first differences do."""
TOO_STEEP = 5.0  # for first differences, which leak, and whose covariances then cancel to noise
BEGIN = 3.0  # spectral exponent where the search begins: the middle of what is found on seabeds
SIMULATED_PADDING = 2
SIMULATED = 400  # patches: J's variances are then known to 7 %
STEPS, CLOSE = 400, 1e-8  # scoring nears a flat maximum by a tenth a step
WHOLE_STEPS = 20  # by then it goes to and fro across a sharp one, or slowly: halves end both
DIFFERENCE = 1e-4  # of a parameter, for derivatives of the spectrum
FEWEST_VALUES = 30
PARAMETERS = ("ln_w2", "gamma2", "a", "b")  # a and b where the law may be stretched
DB_PER_LN = 10 / np.log(10)
LEAST_RING = 1.5  # waves in the shorter side
LEAST_KNOWN = 0.5  # of a ring, for what is passed of it
PARTS = 8  # of the band, of as many values each
LACKING = 0.04  # of fields that follow the law: so many are said not to
MOST_LIFTED = 2.0
"""Expectation over the spectrum itself, beyond which a ring has no limits: more than half of it is
then leakage and folding, which the law says alone, not the patch."""
TAILS = 0.025, 0.975  # of chi squared, that a 95 % interval leaves

NO_RINGS = RingSpectrum(*np.zeros((5, 0)))

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
    rings : RingSpectrum, W2 as the instrument shows it, noise included, without what leaks and
        folds in: the law times how far the patch is off its expectation.  Limits hold the scatter,
        and what the law is not known of leakage and folding; they are NaN where these two are
        expected to be more than all else in the ring
    lack : float, what the law's lack of fit has widened the uncertainties by: by Birge's ratio
        where the patch is less like the law than 96 % of simulated patches; otherwise 1

    References
    ----------
    Birge, Phys. Rev. 40, 207 (1932): uncertainties of what fits worse than its own says.
    """

    law: PowerLaw
    names: tuple[str, ...]
    covariance: Floats
    freedom: int
    band: Band
    values: int
    misfit: float
    rings: RingSpectrum = NO_RINGS
    lack: float = 1.0

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
    rings = _Rings(patch, likelihood, response, known, theta)
    patches = likelihood.simulated_patches(law_of(theta), seed, simulated)
    (score, by_end), scores, ratios = likelihood.scores(theta), [], []
    ends = np.random.default_rng([seed, 18]).standard_normal(simulated)
    for number, z in enumerate(patches, start=1):
        scores.append(score(z) + ends[number - 1] * by_end)
        ratios.append(rings.ratios(z))
        if progress is not None:
            progress(number, simulated)
    count, every = len(theta), np.array(scores)
    lack = _lack_of_fit(score(patch.z_cm)[count:], every[:, count:])
    covariance = likelihood.covariance(theta, every[:, :count]) * lack**2
    return PowerLawFit(
        law_of(theta),
        PARAMETERS[: len(theta)],
        covariance,
        2 * (simulated // 2) - 1,
        band,
        len(likelihood.values),
        float(np.mean(likelihood.values / likelihood.expected(theta)) - 1),
        rings.spectrum(np.array(ratios), covariance),
        lack,
    )


def _lack_of_fit(own: Floats, simulated: Floats) -> float:
    """Birge's ratio of (F,) sums against (N, F) of simulated patches, 1 where it is one of theirs.

    The largest of four: of the parts of the band, of a bend, of an end, and of the directions.
    """
    sums = np.vstack([own, simulated]) / simulated.std(axis=0)
    sums[:, PARTS] = np.minimum(
        sums[:, PARTS], 0.0
    )  # to the flat: long waves are lower, not higher
    sums = sums**2
    kinds = np.split(sums, [PARTS, PARTS + 1, PARTS + 2], axis=1)
    squares = np.stack([kind.mean(axis=1) for kind in kinds])
    beyond = squares[:, 0] > np.quantile(squares[:, 1:], 1 - LACKING / len(kinds), axis=1)
    return float(np.sqrt(squares[beyond, 0].max(initial=1.0)))


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


def flat_periodogram(
    patch: Patch, band: Band, response: Density | None = None, known: Known | None = None
) -> tuple[Floats, Floats, Callable[[Floats], Floats]]:
    """(V,) rad/cm along y and x, and the periodogram of heights there over what a law lets expect.

    The law is the patch's own; the heights, cm, may be the patch's or others on its cells.  Of
    heights that follow one each value is about exponentially distributed, with the mean 1,
    whatever is missing: what holes make of the law is in the expectation.

    Parameters
    ----------
    patch : Patch
    band : Band, rad/cm, of the values
    response, known : as of ``fit_power_law``
    """
    theta, second = np.array([0.0, BEGIN]), False
    with suppress(MeasurementError):  # of what follows no law
        likelihood, theta = _most_likely(patch, usable_band(patch), False, response, known)
        second = likelihood.second
    parts = list(differences_of(patch, band, second, known))
    whole = _Likelihood(patch, parts, response, second)
    expected = whole.expected(theta)
    return *whole.places, lambda z_cm: whole.periodogram(z_cm) / expected


def _most_likely(
    patch: Patch, band: Band, stretched: bool, response: Density | None, known: Known | None
) -> tuple["_Likelihood", Floats]:
    """The likelihood of the differences that suit the exponent, and where it is largest."""
    theta = np.zeros(4 if stretched else 2)
    theta[1] = BEGIN
    for second in (False, True):
        parts = list(differences_of(patch, band, second, known))
        likelihood = _Likelihood(patch, parts, response, second)
        theta = likelihood.maximum(theta)
        if theta[1] < TURNING:
            break
    if second and theta[1] < TURNING - 0.3:  # turned by chance: what was found first is better
        parts = list(differences_of(patch, band, False, known))
        likelihood = _Likelihood(patch, parts, response, False)
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

    def __init__(
        self, patch: Patch, parts: list[Differences], response: Density | None, second: bool
    ) -> None:
        self._patch, self._parts, self._response, self.second = patch, parts, response, second
        self.values = self.periodogram(patch.z_cm)
        if len(self.values) < FEWEST_VALUES:
            raise MeasurementError(
                f"roughness: the band holds {len(self.values)} values of the periodogram, "
                f"{FEWEST_VALUES} are needed"
            )
        self._sum = CovarianceSum(patch.z_cm.shape, patch.cell_cm)
        self._passed = np.asarray(1.0 if response is None else response(*self._sum.plane))
        self._folded = FoldedPower(patch.cell_cm, response)
        self._white = self._expectation(self._sum.of_noise((2 * np.pi / patch.cell_cm) ** 2))
        self._noise = noise_density(patch) * self._white

    def periodogram(self, z_cm: Floats) -> Floats:
        """(V,) cm^4."""
        return np.concatenate([part.periodogram(z_cm) for part in self._parts])

    @property
    def places(self) -> tuple[Floats, Floats]:
        """(V,) rad/cm along y and x."""
        y, x = zip(*(part.places for part in self._parts), strict=True)
        return np.concatenate(y), np.concatenate(x)

    def _expectation(self, covariance_cm2: Floats) -> Floats:
        return np.concatenate([part.expected(covariance_cm2) for part in self._parts])

    def _density(self, theta: Floats) -> Floats:
        """cm^4 on the plane of the sum: the law's, as passed by the instrument, and folded in."""
        law = law_of(theta)
        own = law.density(*self._sum.plane) * self._passed
        return np.asarray(own + self._folded.of(law, *self._sum.plane))

    def expected(self, theta: Floats) -> Floats:
        """(V,) expectation of the periodogram."""
        return self._expectation(self._sum.of(self._density(theta))) + self._noise

    def derivatives(self, theta: Floats, expected: Floats) -> Floats:
        """(V, P) of the logarithm of the expectation."""
        columns = [expected - self._noise]  # by ln w2
        for way in DIFFERENCE * np.eye(len(theta))[1:]:
            steps = self._density(theta + way) - self._density(theta - way)
            columns.append(self._expectation(self._sum.of(steps / (2 * DIFFERENCE))))
        return np.stack(columns, axis=1) / expected[:, np.newaxis]

    @np.errstate(over="ignore", invalid="ignore", divide="ignore")  # a step may lead anywhere
    def maximum(self, theta: Floats) -> Floats:
        """(P,) parameters of the largest likelihood, by Fisher's scoring."""
        theta = theta.copy()
        theta[0] += np.log(np.mean(self.values / self.expected(theta)))
        size, expected = self._cost(theta)
        for number in range(STEPS):
            slopes = self.derivatives(theta, expected)
            normal = slopes.T @ slopes
            if not np.isfinite(normal).all() or np.linalg.matrix_rank(normal) < len(theta):
                break  # as where all is noise
            step = np.linalg.solve(normal, slopes.T @ (self.values / expected - 1))
            step = step if number < WHOLE_STEPS else step / 2
            for _ in range(STEPS):
                found, there = self._cost(theta + step)
                if found <= size + 1e-9 * abs(size):
                    break
                step = step / 2
            theta, size, expected = theta + step, found, there
            if np.abs(step).max() < CLOSE or (theta[1] > TOO_STEEP and not self.second):
                return theta
            if theta[1] < 0:
                break  # a spectrum that does not fall is noise, of which no law is likelier
        raise MeasurementError("roughness: no power law makes the patch most likely")

    def _cost(self, theta: Floats) -> tuple[float, Floats]:
        expected = self.expected(theta)
        if not (expected > 0).all():
            return np.inf, expected
        return float(np.sum(np.log(expected) + self.values / expected)), expected

    def by_end(self, theta: Floats, expected: Floats) -> Floats:
        """(V,) what a sigma of the law's end changes the logarithm of the expectation by."""
        return LAW_ENDS_SIGMA * self._folded.by_end(law_of(theta)) * self._white / expected

    def scores(self, theta: Floats) -> tuple[Callable[[Floats], Floats], Floats]:
        """(P + F,) of a patch's heights: the score, and by how much it is unlike any such law.

        These are sums of periodogram over expectation, less 1, of parts of the band, and weighted
        with K^-2, K^2 and the direction; less what the law's parameters would follow.  Also what a
        sigma of the law's end adds to all of these.

        K^-2 is the score of a bend to the flat, (k0² + K²)^(-gamma2 / 2) at k0 = 0, and K^2 that of
        an end, exp(-K² l²) at l = 0: of small ones nothing tells more (C. R. Rao, Proc. Cambridge
        Philos. Soc. 44 (1948) 50).
        """
        expected, (y, x) = self.expected(theta), self.places
        slopes = self.derivatives(theta, expected)
        size, way = np.log(np.hypot(y, x)), 2 * np.arctan2(y, x)
        part = np.digitize(size, np.quantile(size, np.arange(1, PARTS) / PARTS))
        unlike = np.column_stack([
            part[:, np.newaxis] == np.arange(PARTS), np.exp(-2 * size), np.exp(2 * size),
            np.cos(way), np.sin(way),
        ])  # fmt: skip
        unlike = unlike - slopes @ np.linalg.lstsq(slopes, unlike, rcond=None)[0]
        columns = np.column_stack([slopes, unlike])
        by_end = columns.T @ self.by_end(theta, expected)
        return lambda z_cm: columns.T @ (self.periodogram(z_cm) / expected - 1), by_end

    def covariance(self, theta: Floats, scores: Floats) -> Floats:
        """(P, P) of the parameters, by (N, P) scores of simulated patches."""
        slopes = self.derivatives(theta, self.expected(theta))
        inverse = np.linalg.inv(slopes.T @ slopes)
        return np.asarray(inverse @ np.cov(scores.T) @ inverse)

    def simulated_patches(self, law: PowerLaw, seed: int, simulated: int) -> Iterator[Floats]:
        """(R, C) cm, patches of a law as the instrument shows it."""
        patch, generator = self._patch, np.random.default_rng([seed, 17])
        rows, columns = patch.z_cm.shape
        shape = SIMULATED_PADDING * rows, SIMULATED_PADDING * columns
        y, x = wavenumbers(shape, patch.cell_cm)
        area = (2 * np.pi) ** 2 / (shape[0] * shape[1] * patch.cell_cm**2)
        passed = 1.0 if self._response is None else self._response(y, x)
        density = law.density(y, x) * passed + self._folded.of(law, y, x) + noise_density(patch)
        size = np.sqrt(density * area)
        for _ in range(simulated // 2):
            drawn = generator.standard_normal((2, *shape))
            # Rows beyond the patch are not transformed along x.
            along_y = fft(size * (drawn[0] + 1j * drawn[1]), axis=0)[:rows]
            both = fft(along_y, axis=1)[:, :columns]
            yield both.real
            yield both.imag


class _Rings:
    """Means over rings of a patch's periodogram over its expectation, and what they say of W2."""

    def __init__(
        self,
        patch: Patch,
        fitted: _Likelihood,
        response: Density | None,
        known: Known | None,
        theta: Floats,
    ) -> None:
        low, high = 2 * np.pi * LEAST_RING / min(patch.size_cm), patch.nyquist_per_cm
        edges = np.geomspace(low, high, RINGS + 1)
        parts = list(differences_of(patch, Band(low, high), fitted.second))
        self._likelihood = _Likelihood(patch, parts, response, fitted.second)
        self._y, self._x = self._likelihood.places
        held, self._ring = np.unique(
            np.digitize(np.hypot(self._y, self._x), edges[1:-1]), return_inverse=True
        )
        self._middle = np.sqrt(edges[held] * edges[held + 1])
        self._gain = np.concatenate([part.gain for part in parts])
        self._passed = np.ones(()) if response is None else response(self._y, self._x)
        told = np.ones(self._y.shape)
        if known is not None:
            told = np.asarray(known(self._y, self._x), dtype=float)
        self._known, self._noise = self._mean(told) >= LEAST_KNOWN, noise_density(patch)
        self._theta, self._expected = theta, self._likelihood.expected(theta)
        self._ratios = self.ratios(patch.z_cm)

    def _mean(self, values: Floats) -> Floats:
        """(K,) means over the rings."""
        return np.bincount(self._ring, values) / np.bincount(self._ring)

    def ratios(self, z_cm: Floats) -> Floats:
        """(K,) of a patch's heights."""
        return self._mean(self._likelihood.periodogram(z_cm) / self._expected)

    def spectrum(self, simulated: Floats, covariance: Floats) -> RingSpectrum:
        """W2 with limits, by (N, K) ratios of simulated patches and the law's covariance."""
        shown = self._shown(self._theta)
        usual = simulated.mean(axis=0)
        found = self._mean(shown) * self._ratios / usual
        slopes = self._likelihood.derivatives(self._theta, self._expected)
        by_law = -np.stack([self._mean(one) for one in slopes.T])
        for one, way in zip(by_law, DIFFERENCE * np.eye(len(self._theta)), strict=True):
            more, less = (self._mean(self._shown(self._theta + k * way)) for k in (1, -1))
            one += np.log(more / less) / (2 * DIFFERENCE)
        by_end = self._mean(self._likelihood.by_end(self._theta, self._expected))
        of_law = np.einsum("pk,pq,qk->k", by_law, covariance, by_law) + by_end**2
        # That many degrees of freedom has a value of chi squared that scatters as much.
        freedom = 2 / (simulated.var(axis=0, ddof=1) / usual**2 + of_law)
        here = law_of(self._theta).density(self._y, self._x) * self._passed + self._noise
        lifted = self._mean(self._expected / (self._gain * here))
        held = np.abs(np.log(lifted)) <= np.log(MOST_LIFTED)
        low, high = (np.where(held, found * freedom / chdtri(freedom, q), np.nan) for q in TAILS)
        law = law_of(self._theta).density(0.0, self._middle)
        passed = np.where(self._known, self._mean(shown) - self._noise, np.nan)
        seabed = law * (found - self._noise) / passed
        return RingSpectrum(self._middle, found, low, high, seabed)

    def _shown(self, theta: Floats) -> Floats:
        """(V,) cm^4, of a law at the middle of the ring: as passed, and the noise."""
        to_middle = self._middle[self._ring] / np.hypot(self._y, self._x)
        law = law_of(theta).density(self._y * to_middle, self._x * to_middle)
        return np.asarray(law * self._passed + self._noise)
