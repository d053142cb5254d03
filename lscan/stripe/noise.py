"""The noise of a picture: as the rig file states it, or estimated from that picture alone.

Three terms make up the variance of a pixel.  One is the same everywhere (reading noise,
rounding, the ground's own light), seen in the pixels away from the line.  Shot noise grows in
proportion to the light of the line; speckle, whose deviation (not variance) is proportional
to the light, with its square.  Those two are seen in how pixels scatter about a fitted line
(:func:`scatter_noise`), and distinguished by pixels of different light.

The paper's extractors fit no line.  For them one term stands for both, seen in how much the
line's brightness jumps from one column to the next (:func:`line_variance_per_dn`): photon
noise follows it exactly; speckle and the target's own texture are stated too large by it:
their weight is at the line's crest, where a pixel hardly moves the centroid.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from lscan.config.rig import NoiseSection
from lscan.records import Floats, GreyValues, Ints

ROUNDING_VARIANCE = 1 / 12
"""Variance of rounding to whole digital numbers, DN²: a uniform distribution one DN wide."""

_SECOND_DIFFERENCE_GAIN = 6.0
"""Variance of I[i-1] - 2 I[i] + I[i+1] over that of I, for independent pixels: 1 + 4 + 1."""

_COLUMNS_SAMPLED = 64
_FEWEST_TRIPLES = 16
_CUTS, _KEPT = 3, 0.97334  # of robust_variance, which says where they come from


@dataclass(frozen=True)
class Noise:
    """Variance of a pixel: ``constant + per_dn · (light + veil) + (speckle · light)²``.

    Attributes
    ----------
    constant : float, DN², at least that of rounding
    per_dn : float, DN² of variance for each DN of light above the background
    speckle : float, contrast of the laser's speckle in one pixel

    References
    ----------
    docs/explanation/physics.md, sections 4 (speckle) and 5 (noise, after EMVA 1288).
    """

    constant: float
    per_dn: float
    speckle: float = 0.0

    def variance(self, light: Floats, veil: Floats | float = 0.0) -> Floats:
        """Variance in DN², same shape as ``light``.

        Parameters
        ----------
        light : array, DN, the line's grey values above the ground
        veil : array or float, DN, by how much the ground under the line is brighter than the
            picture's: water's scattered light, which has shot noise but no speckle
        """
        variance: Floats = np.maximum(light + veil, 0.0)
        variance *= self.per_dn
        variance += self.constant
        variance += np.square(self.speckle * light)
        return variance


def stated_noise(section: NoiseSection, base: float) -> Noise:
    """The noise that the rig file states, for a picture of a known background.

    Parameters
    ----------
    section : NoiseSection, of the rig file
    base : float, DN, background of the picture
    """
    gain = section.dn_per_electron
    return Noise(section.read_dn**2 + gain * max(base, 0.0), gain, section.speckle)


def difference_noise(section: NoiseSection, dark_dn: float) -> NoiseSection:
    """The noise of a picture from which another was taken off.

    Reading noise comes in twice, and so does the shot noise of the light in both.

    Parameters
    ----------
    section : NoiseSection, of one picture
    dark_dn : float, DN, mean grey value of the picture taken off
    """
    variance = 2 * (section.read_dn**2 + section.dn_per_electron * max(dark_dn, 0.0))
    return section.model_copy(update={"read_dn": variance**0.5})


def constant_variance(columns: GreyValues) -> float:
    """Variance in DN² of the pixels away from the line.

    Second differences along the columns cancel the background and its slope; the line's own are
    outliers and are cut off.  Neighbouring pixels must have independent noise: a picture that was
    smoothed or strongly compressed states too little.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    """
    sample = columns[sampled(len(columns))]
    with np.errstate(invalid="ignore"):
        grey = sample.astype(np.int16)
    # Differences of bytes would overflow, those of single precision are rounded.
    values = grey if (grey == sample).all() else sample.astype(np.float64)
    differences = np.diff(values, n=2, axis=1)
    least = _SECOND_DIFFERENCE_GAIN * ROUNDING_VARIANCE
    return max(robust_variance(differences, least) / _SECOND_DIFFERENCE_GAIN, ROUNDING_VARIANCE)


def sampled(count: int) -> slice:
    """The columns that the noise is estimated from: 64 to 127 of them, evenly; all of fewer.

    Parameters
    ----------
    count : int, columns there are
    """
    return slice(None, None, max(1, count // _COLUMNS_SAMPLED))


def line_variance_per_dn(light: Floats, at: Ints, constant: float) -> float:
    """Variance per DN of light on the line, in DN, from the scatter between columns.

    0 where fewer than 16 triples of neighbouring columns have a line, or where half of the windows
    have no light.  Columns that are clipped scatter less than the light does.

    Parameters
    ----------
    light : (K, n) array, DN, above the background in the window of each column that has a line
    at : (K,) array, the columns' indices, rising
    constant : float, DN², as in :class:`Noise`
    """
    together = (at[2:] - at[:-2]) == 2
    if np.count_nonzero(together) < _FEWEST_TRIPLES:
        return 0.0
    sums = light.sum(axis=1)
    typical = float(np.median(sums))
    if typical <= 0:
        return 0.0
    least = _SECOND_DIFFERENCE_GAIN * ROUNDING_VARIANCE
    scatter = robust_variance(np.diff(sums, n=2)[together], least) / _SECOND_DIFFERENCE_GAIN
    return max(scatter - light.shape[1] * constant, 0.0) / typical


def line_noise(columns: GreyValues, light: Floats, at: Ints) -> Noise:
    """The noise of a picture in which no line is fitted.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    light, at : as :func:`line_variance_per_dn` takes them
    """
    constant = constant_variance(columns)
    return Noise(constant, line_variance_per_dn(light, at, constant))


def scatter_noise(square: Floats, light: Floats, constant: float) -> Noise:
    """The noise that makes pixels scatter so about a fitted line.

    Least squares of ``square - constant`` on light and light², neither term below 0,
    weighted by the inverse square of the variance: that of a normal residual's square is
    twice the variance squared.  Thrice, as the weights need the result; squares beyond 25
    times their expectation (5 sigma) are left out.

    Parameters
    ----------
    square : (N,) array, DN², on average the variance of the noise (noise/scatter.py)
    light : (N,) array, DN, the line's fitted grey values, 0 or more
    constant : float, DN², as in :class:`Noise`, known from elsewhere
    """
    noise = Noise(constant, 0.0)
    if len(light) == 0:
        return noise
    for turn in range(4):
        variance = noise.variance(light)
        # Nothing is known of the line's part yet at the first turn: all squares count.
        core = (square <= 25 * variance) if turn else np.ones(len(square), dtype=bool)
        root = core / np.maximum(variance, 1e-3 * light**2)
        terms = np.column_stack([light, light**2]) * root[:, None]
        (shot, speckled), _ = nnls(terms, (square - constant) * root)
        noise = Noise(constant, float(shot), min(float(speckled) ** 0.5, 1.0))
    return noise


def robust_variance(values: GreyValues, least: float = 0.0) -> float:
    """Variance about zero of the normal core of ``values``, what lies outside 3 sigma cut off.

    Starts from the median absolute deviation and cuts thrice; a normal distribution cut at
    3 sigma keeps 0.97334 of its variance (1 - 6 phi(3) / (2 Phi(3) - 1)).

    Parameters
    ----------
    values : array, of any shape and unit; integers are counted, not sorted
    least : float, a variance there is in any case, where the search starts if most values agree
    """
    if values.size == 0:
        return 0.0
    sizes = np.abs(values).ravel()
    if np.issubdtype(values.dtype, np.integer):
        count = np.bincount(sizes)
        sizes = np.arange(len(count))
        up_to, squares = count.cumsum(), (count * sizes**2).cumsum()
    else:
        sizes = np.sort(sizes)
        up_to, squares = np.arange(1, sizes.size + 1), np.square(sizes).cumsum()
    middle = up_to.searchsorted([(up_to[-1] - 1) // 2, up_to[-1] // 2], side="right")
    variance = max((1.4826 * float(sizes[middle].mean())) ** 2, least)
    for _ in range(_CUTS):
        last = int(sizes.searchsorted(3 * np.sqrt(variance), side="right")) - 1
        if last < 0 or up_to[last] == 0:
            break
        variance = float(squares[last] / up_to[last]) / _KEPT
    return variance


# Whether a picture was compressed in blocks, as JPEG and MJPEG do, whatever file it comes in.
#
# No noise of single pixels holds in such a picture.  Its dark parts have none, and beside a line
# the
# coder leaves ripples, and colours of half the resolution, far above the noise of the flank's
# little
# light: a fit that trusts the camera's noise, its speckle above all, follows them.


_BLOCK = 8  # px, of JPEG's transform
_FEWEST = 16  # blocks along the line
_MOST_DN = 8  # a greater step is one of the target's, or a hot pixel's
_BEYOND_CHANCE = 5.0  # standard deviations
_STANDS_OUT = 1.1  # times the next: a colour filter's steps are large at every second pixel


def is_coded(grey: GreyValues) -> bool:
    """Whether the steps from pixel to pixel are the greatest at the bounds of blocks of eight.

    At one of the eight places that a block's bound can have the step must be the greatest in more
    blocks than by chance, in which an eighth of them have it there; and its mean must stand out.

    Parameters
    ----------
    grey : (N, L) array, DN, the pixels across the line, entry by entry: along L it crosses the
        line, whose own steps are in every block alike

    References
    ----------
    The steps at the blocks' bounds tell them: Fan and de Queiroz, Identification of bitmap
    compression history: JPEG detection and quantizer estimation, IEEE Trans. Image Process. 12,
    230 (2003).

    Examples
    --------
    >>> import numpy as np
    >>> is_coded(np.random.default_rng(1).integers(0, 9, (640, 480)))
    False
    """
    steps = _steps(grey)
    blocks = len(steps) // _BLOCK
    if blocks < _FEWEST:
        return False
    steps = steps[: blocks * _BLOCK].reshape(blocks, _BLOCK)
    means = steps.mean(axis=0)
    others, bound = means.argsort()[-2:]
    greatest = np.count_nonzero(steps[:, [bound]] > np.delete(steps, bound, axis=1), axis=1)
    chance = 1 / _BLOCK
    doubt = np.sqrt(chance * (1 - chance) / blocks)
    share = np.mean(greatest == _BLOCK - 1)
    return bool(
        share > chance + _BEYOND_CHANCE * doubt and means[bound] > _STANDS_OUT * means[others]
    )


def _steps(grey: GreyValues) -> Floats:
    """(N - 1,) mean sizes of the steps to the next entry, in every second pixel of each."""
    seen = grey[:, ::2]
    seen = seen.astype(np.int16) if np.issubdtype(seen.dtype, np.integer) else seen
    mean: Floats = np.minimum(np.abs(np.diff(seen, axis=0)), _MOST_DN).mean(axis=1)
    return mean
