"""The spectrum of a relief as a thick sheet shows it, and what that tells of the relief.

A relief of the spectrum S, shown with the gain H (sheetresponse.py) and white noise of the
spectrum N, is measured with the spectrum H² S + N.  Where that clearly exceeds N it gives S; in
between, and beyond, S follows the power law of its neighbours, as natural beds do.  Then the
filter

    G = H S / ((H² + D²) S + N)

gives from what was measured the relief with the least mean square error (Wiener), D being the
standard uncertainty of H, from that of the sheet's thickness.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import jv

from lscan.records import Floats
from lscan.surface.concavity import REACH_IN_SIGMAS
from lscan.surface.sheetresponse import transfer

SEGMENT = 64  # rows of which a spectrum is taken
FEWEST = 12  # segments, of which the mean is known to a third
CLEAR = 1.5  # times the noise: what exceeds it by less may be chance
LEAST_GAIN = 0.15  # of H, beneath which its zero blurs with its neighbours
THICKNESS_DOUBT = 0.1
"""Relative standard uncertainty of the sheet's thickness, which is measured by ruler or by eye."""

STEEPNESS = (2.0, 6.0)
"""Power law of S: sand and rough beds have 2 to 4 (Jackson & Richardson 2007, ch. 6), smooth
surfaces more."""


@dataclass(frozen=True)
class ReliefSpectrum:
    """Spectra of a relief along d, one-sided wavenumbers, K of them.

    Attributes
    ----------
    wavenumber_per_mm : (K,) array, 1/mm, from 0 on
    relief : (K,) array, mm³, S, two-sided; infinite at 0, where nothing is held back
    noise : float, mm³, N
    gain, doubt : (K,) array, H and its standard uncertainty D
    sigma_mm : float, mm, standard deviation of the sheet's irradiance
    """

    wavenumber_per_mm: Floats
    relief: Floats
    noise: float
    gain: Floats
    doubt: Floats
    sigma_mm: float

    @property
    def filter(self) -> Floats:
        """(K,) Wiener's filter G, which gives the relief from what was measured."""
        found = np.ones_like(self.gain)
        gain, relief = self.gain[1:], self.relief[1:]
        power = (gain**2 + self.doubt[1:] ** 2) * relief + self.noise
        found[1:] = gain * relief / np.maximum(power, np.finfo(float).tiny)
        return found

    @property
    def correction_variance(self) -> float:
        """Variance in mm² by which a height that is corrected with G errs, less its own noise.

        A height h is measured as (H + D) h + n and corrected by (H - 1) G times that; it is left
        with ((H - 1) (1 - G H) + (1 + (1 - H) G) D) h and (1 + (1 - H) G) n.
        """
        gain, found = self.gain[1:], self.filter[1:]
        lost = ((1 - gain) * (1 - found * gain)) ** 2
        lost = self.relief[1:] * (lost + ((1 + (1 - gain) * found) * self.doubt[1:]) ** 2)
        noisy = self.noise * ((1 + (1 - gain) * found) ** 2 - 1)
        step = self.wavenumber_per_mm[1]
        return float(max(2 * step * (lost + noisy).sum(), 0.0))

    @property
    def series_variance(self) -> float:
        """Variance in mm² of what the series' first term (concavity.py) leaves of the relief.

        The second derivative of the quadratic that fits best within a circle of radius r shows a
        wave of x = 2 pi k r with the gain 48 J3(x) / x³, J3 being a Bessel function (derived here,
        from the Zernike polynomials of second order).
        """
        wavenumber, gain = self.wavenumber_per_mm[1:], self.gain[1:]
        q = (2 * np.pi * wavenumber * self.sigma_mm) ** 2
        x = 2 * np.pi * wavenumber * REACH_IN_SIGMAS * self.sigma_mm
        seen = gain * 48 * jv(3, x) / x**3
        left = (1 - gain - 1.5 * q * seen) ** 2 + self.doubt[1:] ** 2
        return float(2 * self.wavenumber_per_mm[1] * (self.relief[1:] * left).sum())

    @property
    def left_variance(self) -> float:
        """Variance in mm² of what was measured less what the filtered relief would show."""
        gain, relief = self.gain[1:], self.relief[1:]
        measured = gain**2 * relief + self.noise
        step = self.wavenumber_per_mm[1]
        return float(2 * step * (measured * (1 - gain * self.filter[1:]) ** 2).sum())

    @property
    def resolved_mm(self) -> float:
        """The shortest wave in mm of which, and of all longer ones, more than half is recovered."""
        held = np.flatnonzero(self.filter * self.gain < 0.5)
        last = held[0] - 1 if len(held) else len(self.gain) - 1
        return float(1 / self.wavenumber_per_mm[max(last, 1)])


def spectrum_of(
    segments: Floats, row_mm: float, sigma_mm: float, noise_mm: float
) -> ReliefSpectrum:
    """The spectra of a relief from M segments of what was measured.

    Parameters
    ----------
    segments : (SEGMENT, M) array, mm, heights along d, FEWEST or more
    row_mm : float, mm, from row to row
    sigma_mm : float, mm, standard deviation of the sheet's irradiance
    noise_mm : float, mm, standard deviation of each height's own noise

    References
    ----------
    P. D. Welch, IEEE Trans. Audio Electroacoust. 15 (1967) 70, for the spectrum; N. Wiener,
    Extrapolation, Interpolation and Smoothing of Stationary Time Series (1949), for the filter.
    """
    window = np.hanning(SEGMENT)[:, None]
    rows = np.arange(SEGMENT, dtype=float)
    level = np.vander(rows - rows.mean(), 2)
    rest = segments - level @ (np.linalg.pinv(level) @ segments)
    power = np.abs(np.fft.rfft(rest * window, axis=0)) ** 2 * row_mm / (window**2).sum()
    measured = power.mean(axis=1)
    wavenumber: Floats = np.fft.rfftfreq(SEGMENT, row_mm).astype(np.float64)
    gain, noise = transfer(wavenumber, sigma_mm), noise_mm**2 * row_mm
    clear = (wavenumber > 0) & (measured > CLEAR * noise) & (np.abs(gain) > LEAST_GAIN)
    relief = np.full_like(gain, np.inf)
    relief[clear] = (measured[clear] - noise) / gain[clear] ** 2
    relief[1:] = np.where(clear[1:], relief[1:], _power_law(wavenumber, relief, clear))
    per_percent = transfer(wavenumber, sigma_mm * 1.01) - gain
    doubt = np.abs(per_percent) * 100 * THICKNESS_DOUBT
    return ReliefSpectrum(wavenumber, relief, noise, gain, doubt, sigma_mm)


def _power_law(wavenumber: Floats, relief: Floats, clear: np.ndarray) -> Floats:
    """(K - 1,) the power law through the upper part of what is clear; 0 if nothing is."""
    known = np.flatnonzero(clear)
    if len(known) == 0:
        return np.zeros(len(wavenumber) - 1)
    upper = known[wavenumber[known] >= wavenumber[known[-1]] / 3]
    x, y = np.log(wavenumber[upper]), np.log(relief[upper])
    steepness = -np.polyfit(x, y, 1)[0] if len(upper) > 2 else STEEPNESS[1]
    steepness = float(np.clip(steepness, *STEEPNESS))
    level = np.mean(y + steepness * x)
    return np.asarray(np.exp(level) * wavenumber[1:] ** -steepness)
