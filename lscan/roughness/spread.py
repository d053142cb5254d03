"""How much the ripples of a train differ from one another in wavelength and in heading."""

from dataclasses import dataclass

import numpy as np

from lscan.records import Floats
from lscan.roughness.patch import Patch, wavenumbers
from lscan.roughness.ripples import RippleTrain
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

    The second moments of the tapered periodogram about the peak's own middle, less a power law
    beneath it, less those of the train's wave over the same cells, by which the patch resolves.
    Spreads above about 0.2 or 15 degrees are understated: the peak is then wider than the ellipse.

    Parameters
    ----------
    patch : Patch, of at least some four wavelengths
    train : RippleTrain, found on it
    """
    y, x = np.nonzero(patch.seen)
    phase = (np.column_stack([y, x]) * patch.cell_cm) @ train.wavenumber_per_cm
    wave = np.zeros_like(patch.z_cm)
    wave[patch.seen] = np.cos(phase)
    measured = _variances(detrended(patch), train.wavenumber_per_cm, patch.cell_cm)
    single = _variances(wave, train.wavenumber_per_cm, patch.cell_cm)
    along, across = np.sqrt(np.maximum(measured - single, 0.0))
    return RippleSpread(float(along), float(np.degrees(across)))


def _variances(z_cm: Floats, peak_per_cm: Floats, cell_cm: float) -> Floats:
    """(2,) of a peak along its heading and across it, in its wavenumber's square."""
    taper = np.outer(*(np.hanning(count + 2)[1:-1] for count in z_cm.shape))
    shape = (PADDING * z_cm.shape[0], PADDING * z_cm.shape[1])
    power = np.abs(np.fft.fft2(z_cm * taper, shape)) ** 2
    y, x = wavenumbers(shape, cell_cm)
    size = float(np.linalg.norm(peak_per_cm))
    to_y, to_x = peak_per_cm / size
    along = (y * to_y + x * to_x) / size - 1
    across = (x * to_y - y * to_x) / size
    far = (along / ALONG) ** 2 + (across / ACROSS) ** 2
    inside, rim = far <= 1, (far > 1) & (far <= AROUND**2)
    law = np.hypot(1 + along, across, where=far <= AROUND**2, out=np.ones(shape)) ** -STEEP
    # The median of an exponential distribution is ln 2 of its mean.
    beneath = float(np.median(power[rim] / law[rim])) / np.log(2)
    weight = (power - beneath * law)[inside]
    total = max(float(weight.sum()), np.finfo(float).tiny)
    found = []
    for places in (along[inside], across[inside]):
        middle = float((weight * places).sum()) / total
        found.append(float((weight * (places - middle) ** 2).sum()) / total)
    return np.array(found)
