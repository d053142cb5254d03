"""How much the ripples of a train differ from one another in wavelength and in heading."""

from dataclasses import dataclass, replace

import numpy as np

from lscan.records import Floats
from lscan.roughness.patch import Patch, wavenumbers
from lscan.roughness.ripples import RippleTrain, without_ripples
from lscan.roughness.spectra import detrended

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
    peak = _Peak.of(train, whole.shape, patch.cell_cm)
    spread = peak.variances(whole - peak.beneath(other)) - peak.variances(single)
    along, across = np.sqrt(np.maximum(spread, 0.0))
    return RippleSpread(float(along), float(np.degrees(across)))


def _periodogram(patch: Patch) -> Floats:
    z_cm = detrended(patch)
    taper = np.outer(*(np.hanning(count + 2)[1:-1] for count in z_cm.shape))
    shape = [PADDING * count for count in z_cm.shape]
    power: Floats = np.abs(np.fft.fft2(z_cm * taper, shape)) ** 2
    return power


@dataclass(frozen=True)
class _Peak:
    """Wavenumbers (R, C) from that of a train, along its heading and across it, in its own.

    far: 1 at the rim of the ellipse that counts as the peak.
    """

    along: Floats
    across: Floats
    far: Floats

    @staticmethod
    def of(train: RippleTrain, shape: tuple[int, ...], cell_cm: float) -> "_Peak":
        y, x = wavenumbers((shape[0], shape[1]), cell_cm)
        to_y, to_x = train.wavenumber_per_cm / np.sum(train.wavenumber_per_cm**2)
        along, across = y * to_y + x * to_x - 1, x * to_y - y * to_x
        return _Peak(along, across, (along / ALONG) ** 2 + (across / ACROSS) ** 2)

    def beneath(self, power: Floats) -> Floats:
        """(R, C) the power law, within the ellipse and its rim, that ``power`` has at the rim."""
        known, rim = self.far <= AROUND**2, (self.far > 1) & (self.far <= AROUND**2)
        law = np.hypot(1 + self.along, self.across, where=known, out=np.ones(known.shape)) ** -STEEP
        # The median of an exponential distribution is ln 2 of its mean.
        level: Floats = law * (np.median(power[rim] / law[rim]) / np.log(2))
        return level

    def variances(self, power: Floats) -> Floats:
        """(2,) along the heading and across it, about the middle of ``power`` in the ellipse."""
        inside = self.far <= 1
        weight = power[inside] / max(float(power[inside].sum()), np.finfo(float).tiny)
        places = np.stack([self.along[inside], self.across[inside]])
        middle = (places @ weight)[:, None]
        found: Floats = (places - middle) ** 2 @ weight
        return found
