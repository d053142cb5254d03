"""Whether a picture was compressed in blocks, as JPEG and MJPEG do, whatever file it comes in.

No noise of single pixels holds in such a picture.  Its dark parts have none, and beside a line the
coder leaves ripples, and colours of half the resolution, far above the noise of the flank's little
light: a fit that trusts the camera's noise, its speckle above all, follows them.
"""

import numpy as np

from lscan.records import Floats, GreyValues

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
