"""Ripples and waves of one wavelength: their place in the plane of wavenumbers, and their height.

A regular train of ripples is a line of the spectrum, with harmonics where its crests are sharp.  It
is found as the highest peak of the periodogram above the power law, and then fitted to the heights
themselves, harmonics included, by least squares: holes do no harm.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from lscan.errors import MeasurementError
from lscan.records import Floats, Ints
from lscan.roughness.instrument import ScannerResponse
from lscan.roughness.patch import Patch, wavenumbers
from lscan.roughness.spectra import detrend
from lscan.roughness.whittle import Band, flat_periodogram

HARMONICS = 12
"""With the wave itself: of a crest as sharp as that of 1 - |sin| 2.5 % of the height is beyond."""
OF_WAVENUMBER = 4
"""Harmonics that the wavenumber is found by, where the grid shows them: of more the cells could be
fitted with another wave as well."""
ABOVE = 20.0
"""A peak's height over the median of its surroundings that chance does not reach: of 1e5 values of
an exponential distribution the largest is 17 medians with 50 %, 20 with 10 %."""
BEYOND_NYQUIST = 2.0  # that harmonics may lie, in Nyquist's wavenumber
SURROUNDINGS = 4  # rings: of fewer values than some 20 a median would chance to be low
LEAST_HEIGHT = 2.0  # of a train, in its standard uncertainty
LEAST_OWN = 0.25
"""Of the columns of a fit, what no others explain: less more than doubles an uncertainty."""
LEAST_WAVES = 2.0
FLAT = 3  # coefficients of a plane


@dataclass(frozen=True)
class RippleTrain:
    """A train of waves.

    Attributes
    ----------
    wavelength_cm : float, cm
    heading_deg : float, degrees of 0 to 180, from x towards y: across the crests
    height_cm : float, cm, from trough to crest, of the places that were measured
    amplitudes_cm : (H,) array, cm, of the wave and its harmonics
    wavenumber_per_cm : (2,) array, rad/cm along y and x, of the wave
    sigma_wavelength_cm, sigma_heading_deg : float, standard uncertainties, by the power of what is
        left around the wave
    sigma_height_cm : float, the same where what is left is white
    """

    wavelength_cm: float
    heading_deg: float
    height_cm: float
    amplitudes_cm: Floats
    wavenumber_per_cm: Floats
    sigma_wavelength_cm: float
    sigma_heading_deg: float
    sigma_height_cm: float


def find_ripples(
    patch: Patch, harmonics: int = HARMONICS, response: ScannerResponse | None = None
) -> RippleTrain | None:
    """The train of ripples that stands out of a patch; None where none does.

    Parameters
    ----------
    patch : Patch
    harmonics : int, with the wave itself; those beyond twice Nyquist's wavenumber are left out:
        many crests fall on many places of the cells, and tell more than one would
    response : ScannerResponse, optional; directions in which less is passed do not make waves of
        others stand out, and none is looked for where the response is not known

    Raises
    ------
    MeasurementError
        The wave that stands out cannot be fitted.
    """
    start = _peak(patch, response or ScannerResponse())
    train = None if start is None else fit_waves(patch, start, harmonics)
    return train if train and train.height_cm >= LEAST_HEIGHT * train.sigma_height_cm else None


def fit_waves(patch: Patch, start_per_cm: Floats, harmonics: int = HARMONICS) -> RippleTrain:
    """The train of waves near a wavenumber, by least squares of the heights.

    Parameters
    ----------
    patch : Patch
    start_per_cm : (2,) array, rad/cm along y and x, within half a wave of the patch of the truth
    harmonics : int, with the wave itself

    Raises
    ------
    MeasurementError
        The fit does not end.
    """
    z = patch.z_cm[patch.seen]
    top = patch.nyquist_per_cm / float(np.linalg.norm(start_per_cm))
    few = max(min(harmonics, OF_WAVENUMBER, int(top)), 1)
    orders = max(min(harmonics, int(BEYOND_NYQUIST * top)), few)

    def residual(k: Floats) -> Floats:
        design = _waves(patch, k, few)
        return np.asarray(z - design @ np.linalg.lstsq(design, z, rcond=None)[0])

    scale = 2 * np.pi / max(patch.size_cm) * np.ones(2)
    found = least_squares(residual, start_per_cm, x_scale=scale, xtol=1e-12, ftol=1e-12)
    if not found.success:
        raise MeasurementError(f"ripples: {found.message}")
    # Of waves that come to whole cells, harmonics beyond Nyquist's wavenumber look like others.
    design = _waves(patch, found.x, orders)
    while orders > 1 and _least_own(design) < LEAST_OWN:
        orders -= 1
        design = _waves(patch, found.x, orders)
    coefficients = np.linalg.lstsq(design, z, rcond=None)[0]
    cosines, sines = np.split(coefficients[FLAT:], 2)
    variance = float((found.fun**2).mean()) * len(z) / (len(z) - len(coefficients) - 2)
    slopes, left = np.asarray(found.jac), np.zeros_like(patch.z_cm)
    left[patch.seen] = z - design @ coefficients
    power = _periodogram(replace(patch, z_cm=left))
    peak = _Peak.of(found.x, power.shape, patch.cell_cm)
    # Derivatives by the wavenumber are waves as long: of the rest, what is as long counts.
    of_k = np.linalg.inv(slopes.T @ slopes) * peak.beneath(power).flat[peak.far.argmin()]
    size = float(np.linalg.norm(found.x))
    along = found.x / size
    across = np.array([-along[1], along[0]])
    height = float(np.ptp(design[:, FLAT:] @ coefficients[FLAT:]))
    return RippleTrain(
        wavelength_cm=2 * np.pi / size,
        heading_deg=float(np.degrees(np.arctan2(*found.x)) % 180),
        height_cm=height,
        amplitudes_cm=np.hypot(cosines, sines),
        wavenumber_per_cm=found.x,
        sigma_wavelength_cm=float(2 * np.pi / size**2 * np.sqrt(along @ of_k @ along)),
        sigma_heading_deg=float(np.degrees(np.sqrt(across @ of_k @ across) / size)),
        sigma_height_cm=float(2 * np.sqrt(2 * orders * variance / len(z))),
    )


def without_ripples(patch: Patch, train: RippleTrain) -> Patch:
    """The patch less a train of waves and its harmonics.

    Parameters
    ----------
    patch : Patch
    train : RippleTrain, found on it
    """
    design = _waves(patch, train.wavenumber_per_cm, len(train.amplitudes_cm))
    coefficients = np.linalg.lstsq(design, patch.z_cm[patch.seen], rcond=None)[0]
    z = patch.z_cm.copy()
    z[patch.seen] -= design[:, FLAT:] @ coefficients[FLAT:]
    return replace(patch, z_cm=z)


def _waves(patch: Patch, wavenumber_per_cm: Floats, orders: int) -> Floats:
    """(S, 3 + 2 H) a plane, cosines and sines of a wave and its harmonics at the cells seen."""
    y, x = np.nonzero(patch.seen)
    y, x = (y - y.mean()) * patch.cell_cm, (x - x.mean()) * patch.cell_cm
    phase = np.outer(np.column_stack([y, x]) @ wavenumber_per_cm, np.arange(1, orders + 1))
    return np.column_stack([np.ones_like(x), y, x, np.cos(phase), np.sin(phase)])


def _least_own(design: Floats) -> float:
    """The least share of a unit combination of a design's columns that no others explain."""
    unit = design / np.linalg.norm(design, axis=0)
    return float(np.linalg.eigvalsh(unit.T @ unit)[0])


def _peak(patch: Patch, response: ScannerResponse) -> Floats | None:
    """(2,) rad/cm along y and x of the highest value over its surroundings; None where none is."""
    least = 2 * np.pi * LEAST_WAVES / min(patch.size_cm)
    band = Band(least, 0.9 * patch.nyquist_per_cm)
    try:
        y, x, over_law = flat_periodogram(patch, band, response, response.known)
    except MeasurementError:  # the response is known of too few waves
        return None
    edges = np.geomspace(least, band.high_per_cm, SURROUNDINGS + 1)[1:-1]
    ratio = _over_surroundings(over_law(patch.z_cm), ring := np.digitize(np.hypot(y, x), edges))
    if ratio.max() < ABOVE:
        return None
    peak = np.array([y[ratio.argmax()], x[ratio.argmax()]])
    # Over a law that falls steeply a harmonic may stand out more than the wave that it is of; what
    # leaks from it into longer waves is no wave.
    rest = without_ripples(patch, fit_waves(patch, peak, 1))
    ratio = _over_surroundings(over_law(rest.z_cm), ring)
    within = np.pi / min(patch.size_cm)
    for order in range(HARMONICS, 1, -1):
        off = np.hypot(y - peak[0] / order, x - peak[1] / order)
        if (found := np.where(off <= within, ratio, 0.0)).max() >= ABOVE:
            return np.array([y[found.argmax()], x[found.argmax()]])
    return peak


def _over_surroundings(ratio: Floats, ring: Ints) -> Floats:
    """(V,) ratios over what is usual in their rings: ripples lift the law."""
    held, ring = np.unique(ring, return_inverse=True)
    usual = [float(np.median(ratio[ring == number])) for number in range(len(held))]
    return np.asarray(ratio / np.maximum(usual, 1e-300)[ring])


# How much the ripples of a train differ from one another in wavelength and in heading.


ALONG, ACROSS = 0.5, 0.7
"""Semi-axes of the ellipse that a peak is looked for in, in the wavenumber: it ends before the
patch's own plane on one side and the first harmonic on the other."""
AROUND = 1.25  # the ellipse, larger so, whose rim says what there is beneath the peak
PADDING = 2
STEEP = 3.0  # spectral exponent of what is beneath: of it the middle counts, not the slope


@dataclass(frozen=True)
class RippleSpread:
    """Standard deviations of the wavenumbers of a train's peak; 0 where a wave's would be as wide.

    Attributes
    ----------
    relative : float, along the heading, in the wavenumber itself
    heading_deg : float, degrees, of their headings
    """

    relative: float
    heading_deg: float


def ripple_spread(patch: Patch, train: RippleTrain) -> RippleSpread:
    """The spread of a train of ripples: the width of its peak beyond that of a single wave.

    The second moments of the tapered periodogram about the peak's own middle, less the power law
    beneath it that the heights without the train have, less those of the train alone over the same
    cells: by it the patch resolves, and what holes scatter of a wave is in both.
    Spreads above about 0.2 or 15 degrees are understated: the peak is then wider than the ellipse.

    Parameters
    ----------
    patch : Patch, of at least some four wavelengths
    train : RippleTrain, found on it
    """
    rest = without_ripples(patch, train)
    waves = replace(patch, z_cm=patch.z_cm - rest.z_cm)
    whole, single, other = (_periodogram(each) for each in (patch, waves, rest))
    peak = _Peak.of(train.wavenumber_per_cm, whole.shape, patch.cell_cm)
    spread = peak.variances(whole - peak.beneath(other)) - peak.variances(single)
    along, across = np.sqrt(np.maximum(spread, 0.0))
    return RippleSpread(float(along), float(np.degrees(across)))


def _periodogram(patch: Patch) -> Floats:
    """(R', C') cm², of white noise its variance."""
    z_cm = detrend(patch)
    taper = np.outer(*(np.hanning(count + 2)[1:-1] for count in z_cm.shape))
    shape = [PADDING * count for count in z_cm.shape]
    return np.abs(np.fft.fft2(z_cm * taper, shape)) ** 2 / float((taper[patch.seen] ** 2).sum())


@dataclass(frozen=True)
class _Peak:
    """Wavenumbers (R, C) from that of a train, along its heading and across it, in its own.

    far: 1 at the rim of the ellipse that counts as the peak.
    """

    along: Floats
    across: Floats
    far: Floats

    @staticmethod
    def of(wavenumber_per_cm: Floats, shape: tuple[int, ...], cell_cm: float) -> "_Peak":
        y, x = wavenumbers((shape[0], shape[1]), cell_cm)
        to_y, to_x = wavenumber_per_cm / np.sum(wavenumber_per_cm**2)
        along, across = y * to_y + x * to_x - 1, x * to_y - y * to_x
        return _Peak(along, across, (along / ALONG) ** 2 + (across / ACROSS) ** 2)

    def beneath(self, power: Floats) -> Floats:
        """(R, C) the power law, within the ellipse and its rim, that ``power`` has at the rim."""
        known, rim = self.far <= AROUND**2, (self.far > 1) & (self.far <= AROUND**2)
        law = np.hypot(1 + self.along, self.across, where=known, out=np.ones(known.shape)) ** -STEEP
        # The median of an exponential distribution is ln 2 of its mean.
        return law * (np.median(power[rim] / law[rim]) / np.log(2))

    def variances(self, power: Floats) -> Floats:
        """(2,) along the heading and across it, about the middle of ``power`` in the ellipse."""
        inside = self.far <= 1
        weight = power[inside] / max(float(power[inside].sum()), np.finfo(float).tiny)
        places = np.stack([self.along[inside], self.across[inside]])
        middle = (places @ weight)[:, None]
        return (places - middle) ** 2 @ weight
