"""Differences of a patch's cells: their periodogram, and what it is expected to be.

The covariance of differences is the differences of the cells' own covariance, at every lag: one sum
over wavenumbers serves all differences of a patch.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2

from lscan.records import Floats, Mask
from lscan.roughness.patch import Patch, wavenumbers

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
        rows, columns = self._padded
        y, _ = wavenumbers((rows, 1), self.cell_cm)
        x = 2 * np.pi * np.fft.rfftfreq(columns, self.cell_cm)
        return y, np.asarray(x, dtype=float)[np.newaxis, :]

    def of(self, density_cm4: Floats) -> Floats:
        """(2 R - 1, 2 C - 1) cm², covariances of a spectrum, at lags from 1 - R and 1 - C on.

        Parameters
        ----------
        density_cm4 : (P, Q) array, cm^4, on ``plane``
        """
        summed = irfft2(density_cm4, self._padded) * (2 * np.pi / self.cell_cm) ** 2
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
    def _padded(self) -> tuple[int, int]:
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
        y, x = _shown(there.shape, cell)
        chosen = _chosen(there.shape, band, cell, known)
        chosen &= np.abs(y) > np.abs(x) if axis == 0 else np.abs(x) >= np.abs(y)
        yield Differences(_along(axis), -1, _taper(there), chosen, cell)


def _shown(shape: tuple[int, ...], cell_cm: float) -> tuple[Floats, Floats]:
    """Wavenumbers of a periodogram, of a real field's each once: those along y from 0 on."""
    rows, columns = shape
    y, x = wavenumbers((rows, columns), cell_cm)
    return np.abs(y[: rows // 2 + 1]), x


def _chosen(shape: tuple[int, ...], band: Band, cell_cm: float, known: Known | None) -> Mask:
    y, x = _shown(shape, cell_cm)
    size, end = np.hypot(y, x), np.pi / cell_cm * (1 - 1e-9)
    chosen = (size >= band.low_per_cm) & (size <= band.high_per_cm)
    chosen &= (y > 0) | (x > 0)
    chosen &= (np.abs(x) < end) & (y < end)
    return chosen if known is None else chosen & known(y, x)


def _taper(there: Mask) -> Floats:
    """The first sine taper (Riedel & Sidorenko, IEEE Trans. Signal Processing 43, 188, 1995)."""
    sines = (np.sin(np.pi * (np.arange(n) + 1) / (n + 1)) for n in there.shape)
    return np.asarray(np.outer(*sines) * there)


def _along(axis: int) -> Callable[[Floats], Floats]:
    return lambda z: np.diff(z, axis=axis - 2)


def _laplacian(z: Floats) -> Floats:
    inner = z[..., 1:-1, 1:-1]
    beside = z[..., :-2, 1:-1] + z[..., 2:, 1:-1] + z[..., 1:-1, :-2] + z[..., 1:-1, 2:]
    return np.asarray(beside - 4 * inner)


def _whole(seen: Mask) -> Mask:
    """Inner cells that are seen with all four beside them."""
    return seen[1:-1, 1:-1] & seen[:-2, 1:-1] & seen[2:, 1:-1] & seen[1:-1, :-2] & seen[1:-1, 2:]
