"""A camera's noise and gain from its own pictures: the photon transfer of EMVA 1288.

Photons come at random, so the variance of a pixel grows in proportion to its light:
``variance = read² + gain · (mean - dark)``, all in digital numbers (DN); the slope is DN per
electron and what is left in the dark is the reading noise (EMVA Standard 1288, "Linear camera
model").  Here, as there, the variance is taken from differences of two pictures of the same
still scene, in which everything that stands still drops out.

The standard wants an evenly lit sensor.  Any still scene serves: its pixels are sorted into
levels of grey by their neighbours in one half of the pictures and measured in the other half.
Sorted by their own grey values, pixels of high offset or noise would count as bright, and so
flatten the slope; diagonal neighbours share neither row nor column, which have offsets too.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.optimize import minimize_scalar

from lscan.errors import InputError, MeasurementError
from lscan.files.pictures import step_of
from lscan.records import Floats, GreyValues, Ints, Mask

BRIGHTEST_DN = 255
ROUNDING_DN = 12**-0.5
"""Standard deviation of rounding to whole digital numbers."""

LEVEL_DN = 4.0
"""Width of a level of grey."""

LEAST_ALIKE = 0.05  # of a level's pixels, that are themselves as grey as it

DIAGONALS = np.array([[0.25, 0.0, 0.25], [0.0, 0.0, 0.0], [0.25, 0.0, 0.25]])

FEWEST_DIFFERENCES = 100
"""A level with fewer of them is passed over: its variance is known to worse than 14 %."""

MOST_CLIPPED = 1e-3
"""Share of clipped values above which a level is passed over.  Of Gaussian noise, that is a
level 3 standard deviations from the limit, and it takes less than 1 % off the variance."""

LINEAR_DN = (0.05 * BRIGHTEST_DN, 0.95 * BRIGHTEST_DN)
"""Grey values between which a camera is judged for linearity (EMVA 1288, "Linearity")."""


LEAST_CURVE = 0.05
"""Gamma above 1 that counts as a curve: a lamp that warms by 10 % over the series feigns less."""

GAMMA_STEP = 0.02  # of second differences

LEAST_FLICKER = 0.05
"""Part of a pixel's noise variance that a change of the light must reach to be taken out of it."""


@dataclass(frozen=True)
class Flicker:
    """A periodic change of the light, as of a lamp on the mains.

    share: standard deviation of the mean grey value of a row from picture to picture, relative.
    period_rows: of the bands that a rolling shutter makes of it; None where all rows change alike.
    """

    share: float
    period_rows: float | None


@dataclass(frozen=True)
class Levels:
    """Levels of grey and how pixels of each scatter in time.

    mean_dn, variance: (N,) mean in DN, temporal variance in DN².
    differences: (N,) independent differences of two values that the variance comes from; its
    relative standard uncertainty is ``sqrt(2 / differences)`` for Gaussian noise.
    clipped: (N,) share of values at either end of the range.
    step_dn: (N,) steps in which the values come, 1 DN of a camera of 8 bits.
    """

    mean_dn: Floats
    variance: Floats
    differences: Floats
    clipped: Floats
    step_dn: Floats

    def __add__(self, other: "Levels") -> "Levels":
        """The levels of both, one after the other."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Levels(*(np.concatenate(pair) for pair in pairs))

    def __getitem__(self, which: Mask) -> "Levels":
        """Some of the levels."""
        return Levels(*(array[which] for array in vars(self).values()))


@dataclass(frozen=True)
class PhotonTransfer:
    """Noise and gain of a camera, each with its standard uncertainty.

    Attributes
    ----------
    dark_dn : float, DN, grey value without light; 0 where no dark pictures were taken
    read_dn : float, DN, standard deviation of a dark pixel, rounding included; never below that of
        rounding, and where it comes out there, ``read_at_most_dn`` is what is known
    read_sigma_dn : float, DN, standard uncertainty of read_dn
    dn_per_electron : float, the gain; in doubt it may come out below 0
    gain_sigma : float, standard uncertainty of the gain
    chi2 : float, the levels' squared distance from the straight line in units of their own
        uncertainty, per degree of freedom: 1 for a linear camera, far more for one with a gamma
        curve or with noise reduction
    levels : Levels, the grey levels it was measured from
    """

    dark_dn: float
    read_dn: float
    read_sigma_dn: float
    dn_per_electron: float
    gain_sigma: float
    chi2: float
    levels: Levels

    @property
    def read_is_rounding(self) -> bool:
        """Whether no noise beyond that of rounding was found in the dark."""
        return self.read_dn <= ROUNDING_DN * self.levels.step_dn.max()

    @property
    def read_at_most_dn(self) -> float:
        """The reading noise in DN two standard uncertainties of its variance above ``read_dn``."""
        return float(np.sqrt(self.read_dn**2 + 2 * 2 * self.read_dn * self.read_sigma_dn))


@dataclass(frozen=True)
class Linearity:
    """How straight the grey value goes with the exposure time.

    error_percent: mean of |grey value - line| / line, in per cent, between 5 % and 95 % of the
    range.  dn_per_ms, offset_dn: the line.  gamma, gamma_sigma: of the tone curve that fits better,
    and its standard uncertainty; None where there are fewer than four exposures.
    """

    error_percent: float
    dn_per_ms: float
    offset_dn: float
    gamma: float | None = None
    gamma_sigma: float | None = None

    @property
    def is_curved(self) -> bool:
        """Whether a tone curve shows: by more than chance, and more than a lamp may drift."""
        if self.gamma is None or self.gamma_sigma is None:
            return False
        return self.gamma - 1 > max(3 * self.gamma_sigma, LEAST_CURVE)


def flicker(pictures: GreyValues) -> Flicker | None:
    """The flicker of the light that pictures of a still scene show; None where it is no matter.

    Of a row the light changes by a share, so its grey values change together; noise of the rows
    themselves does so too, but has no period.

    Parameters
    ----------
    pictures : (N, H, W) DN, one channel, N at least 2
    """
    _require(pictures, 2)
    mean_dn = pictures.mean(axis=0)
    differences = [first - second for first, second in _pairs(pictures)]
    noise = np.mean([_without_flicker(each, mean_dn).var() for each in differences])
    changes = np.array([each.mean(axis=1) for each in differences])
    height, width = mean_dn.shape
    variance = float(np.mean(changes**2) - noise / width)
    if variance <= noise * max(LEAST_FLICKER, 5 / width):
        return None
    power = (np.abs(np.fft.rfft(changes, axis=1)) ** 2).sum(axis=0)
    power[1:] *= 2  # of the negative frequencies too
    peak = int(np.argmax(power))
    if power[max(peak - 1, 0) : peak + 2].sum() < power.sum() / 2:
        return None
    share = float(np.sqrt(variance / 2) / mean_dn.mean())
    return Flicker(share, height / peak if peak else None)


def grey_levels(pictures: GreyValues) -> Levels:
    """Levels of grey of a still scene, and how its pixels scatter.

    pictures: (N, H, W) DN, one channel, N at least 4; of an odd number the last is unused,
    and so are two where N is not a multiple of 4.  A change of the light between two pictures
    of a pair is taken out where it is the same everywhere in a level; a flicker, of each row.
    Levels that are clipped or rare are passed over; none may be left.
    """
    _require(pictures, 4)
    half = len(pictures) // 4 * 2
    # Sorted into as many levels as the scene has: by means of one half, in steps of LEVEL_DN.
    mean_dn = pictures[:half].mean(axis=0)
    sorting = ndimage.correlate(mean_dn, DIAGONALS, mode="mirror")
    level, flickers = np.floor(sorting / LEVEL_DN).astype(np.int64), flicker(pictures) is not None
    levels = _levels(pictures[half : 2 * half], level.ravel(), flickers)
    # Of two greys with an edge between them a level of both is on the line whatever the line is.
    alike = ndimage.mean(np.abs(mean_dn - sorting) <= LEVEL_DN, level, np.unique(level))
    kept = (levels.differences >= FEWEST_DIFFERENCES) & (levels.clipped <= MOST_CLIPPED)
    return levels[kept & (np.asarray(alike) >= LEAST_ALIKE)]


def dark_level(pictures: GreyValues) -> Levels:
    """The one level of pictures taken in the dark, clipped or not.

    pictures: (N, H, W) DN, one channel, N at least 2.
    """
    _require(pictures, 2)
    paired = pictures[: len(pictures) // 2 * 2]
    return _levels(paired, np.zeros(paired[0].size, dtype=np.int64))


def photon_transfer(levels: Levels, dark: Levels | None = None) -> PhotonTransfer:
    """Reading noise and gain: the straight line of variance over mean, by weighted least squares.

    Parameters
    ----------
    levels : Levels
        Of grey, DN and DN², as ``grey_levels`` finds them.
    dark : Levels, optional
        The level of pictures taken in the dark.  Without it, and where the camera clips its
        noise in the dark, grey value 0 counts as dark and the line is drawn on to it.

    Returns
    -------
    PhotonTransfer
        Noise in DN, gain in DN per electron.

    Raises
    ------
    MeasurementError
        Where there are no two levels of grey at least 1 DN apart.

    References
    ----------
    EMVA Standard 1288, "Linear camera model".
    """
    dark_is_seen = dark is not None and float(dark.clipped[0]) <= MOST_CLIPPED
    every = dark + levels if dark is not None and dark_is_seen else levels
    dark_dn = float(every.mean_dn[0]) if dark_is_seen else 0.0
    light = every.mean_dn - dark_dn
    if len(light) < 2 or np.ptp(light) < 1.0:
        raise MeasurementError(
            f"photon transfer: {len(light)} unclipped levels of grey, {np.round(light, 2).tolist()}"
            " DN; needed: two at least 1 DN apart; show the camera a still scene with bright and "
            "dark parts, neither black nor white"
        )
    (gain, dark_variance), covariance, chi2 = _weighted_line(light, every)
    read_dn = float(np.sqrt(max(dark_variance, (ROUNDING_DN * every.step_dn.max()) ** 2)))
    return PhotonTransfer(
        dark_dn=dark_dn,
        read_dn=read_dn,
        read_sigma_dn=float(np.sqrt(covariance[1, 1])) / (2 * read_dn),
        dn_per_electron=float(gain),
        gain_sigma=float(np.sqrt(covariance[0, 0])),
        chi2=chi2,
        levels=levels,
    )


def _weighted_line(light: Floats, levels: Levels) -> tuple[Floats, Floats, float]:
    """(slope, offset) of variance over light, their covariance, and chi² per degree of freedom.

    The weights come from the line itself, found in a few rounds: weights from the measured
    variances would favour those that came out small by chance.
    """
    share = np.sqrt(2 / levels.differences)
    model = levels.variance
    for _ in range(5):
        # No variance is smaller than that of rounding, so no level gets an endless weight.
        sigma = share * np.maximum(model, (ROUNDING_DN * levels.step_dn) ** 2)
        line, covariance = np.polyfit(light, levels.variance, 1, w=1 / sigma, cov="unscaled")
        model = np.asarray(np.polyval(line, light), dtype=float)
    chi2 = float((((levels.variance - model) / sigma) ** 2).sum() / max(len(light) - 2, 1))
    return line, covariance, chi2


def linearity(exposure_ms: Floats, mean_dn: Floats) -> Linearity:
    """How straight mean grey values go with exposure times.

    The line is the one whose relative distances are least in squares; so is the tone curve, the
    grey value over 255 being a straight line's value over 255 to the power 1 / gamma.

    Parameters
    ----------
    exposure_ms, mean_dn : array
        (N,) exposure time in ms and mean grey value in DN of one scene.

    Raises
    ------
    MeasurementError
        With fewer than three different exposures in the range judged.

    References
    ----------
    EMVA Standard 1288, "Linearity".
    """
    low, high = LINEAR_DN
    inside = (mean_dn >= low) & (mean_dn <= high)
    if len(np.unique(exposure_ms[inside])) < 3:
        raise MeasurementError(
            f"linearity: needs three exposures with mean grey values from {low:.0f} to "
            f"{high:.0f} DN; found: {np.round(mean_dn, 1).tolist()}"
        )
    time_ms, grey = exposure_ms[inside], mean_dn[inside]
    slope, offset = np.polyfit(time_ms, grey, 1, w=1 / grey)
    line = offset + slope * time_ms
    error = float(np.mean(np.abs(grey - line) / np.abs(line)))
    straight = Linearity(100 * error, float(slope), float(offset))
    if len(np.unique(time_ms)) < 4:
        return straight

    def left(gamma: float) -> float:
        """What a line leaves of the undone curve, as relative errors of grey values, squared."""
        light = (grey / BRIGHTEST_DN) ** gamma
        fitted = np.polyval(np.polyfit(time_ms, light, 1, w=1 / light), time_ms)
        return float((((light - fitted) / (gamma * light)) ** 2).sum())

    gamma = float(minimize_scalar(left, bounds=(0.3, 4.0), method="bounded").x)
    bend = (left(gamma + GAMMA_STEP) - 2 * left(gamma) + left(gamma - GAMMA_STEP)) / GAMMA_STEP**2
    variance = 2 * left(gamma) / max(len(grey) - 3, 1) / max(bend, np.finfo(float).tiny)
    return replace(straight, gamma=gamma, gamma_sigma=float(np.sqrt(variance)))


def _levels(pictures: GreyValues, level: Ints, flickers: bool = False) -> Levels:
    """Mean and variance of the pixels of each level that has any.  level: (H · W,) which one."""
    flat, mean_dn = pictures.reshape(len(pictures), -1), pictures.mean(axis=0)
    _, level, pixels = np.unique(level, return_inverse=True, return_counts=True)
    held = np.arange(len(pixels))
    # The drift of the light spends one degree of freedom of each pair, a flicker two of each row.
    free = 1 - 2 / pictures.shape[2] if flickers else 1.0
    differences = (len(flat) // 2 * (pixels - 1)) * free
    clipped = (flat == 0) | (flat >= BRIGHTEST_DN)
    squares = np.zeros(len(held))
    for first, second in _pairs(pictures):
        difference = first - second
        if flickers:
            difference = _without_flicker(difference, mean_dn)
        squares += pixels * ndimage.variance(difference.ravel(), level, held)
    return Levels(
        mean_dn=np.asarray(ndimage.mean(mean_dn.ravel(), level, held)),
        # Half the variance of a difference is that of a value.
        variance=squares / np.maximum(2 * differences, 1),
        differences=differences,
        clipped=np.asarray(ndimage.mean(clipped.mean(axis=0), level, held)),
        step_dn=np.full(len(held), step_of(pictures)),
    )


def _pairs(pictures: GreyValues) -> Iterator[tuple[Floats, Floats]]:
    return zip(pictures[::2].astype(float), pictures[1::2].astype(float), strict=False)


def _without_flicker(difference: Floats, mean_dn: Floats) -> Floats:
    """The difference of two pictures less, in each row, the straight line in the grey value.

    The light of a row changes by a share: in proportion to the grey value above the dark one.
    """
    grey = mean_dn - mean_dn.mean(axis=1, keepdims=True)
    change = difference - difference.mean(axis=1, keepdims=True)
    squares = (grey**2).sum(axis=1, keepdims=True)
    slope = (grey * change).sum(axis=1, keepdims=True) / np.maximum(squares, 1.0)
    return np.asarray(change - slope * grey)


def _require(pictures: GreyValues, fewest: int) -> None:
    known = pictures.dtype in (np.uint8, np.float32)
    if pictures.ndim != 3 or not known or len(pictures) < fewest:
        what = "cannot measure noise in these pictures"
        allowed = f"uint8 or float32 of shape (N, H, W), N at least {fewest}"
        raise InputError(what, value=f"{pictures.dtype} of shape {pictures.shape}", allowed=allowed)
