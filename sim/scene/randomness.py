"""Random numbers of a picture: functions of a seed, a name and the picture's number alone."""

from functools import lru_cache
from math import ceil, exp, log, sqrt
from zlib import crc32

import numpy as np

NEGLIGIBLE = 1e-12  # of a picture's number: what pictures before have on it, left out


def unit_normal(seed: int, name: str, frame: int, correlation: float = 0.0) -> float:
    """The value for a picture of a stationary normal process, of mean 0 and variance 1.

    Values of pictures j apart have the correlation exp(-j / correlation): an autoregressive
    process of the first order, written out as the sum of the white noise it is driven by, so
    that no picture needs the one before.

    Parameters
    ----------
    seed : int
    name : str, of what is drawn: each name has a sequence of its own
    frame : int, number of the picture
    correlation : float, pictures; 0: white

    References
    ----------
    Box and Jenkins, Time series analysis, chapter 3.
    """
    if correlation == 0:
        return _white(seed, crc32(name.encode()), frame)
    kept = exp(-1 / correlation)
    first = max(0, frame - ceil(-correlation * log(NEGLIGIBLE)))
    weights = sqrt(1 - kept**2) * kept ** np.arange(frame - first, -1, -1.0)
    weights[0] /= sqrt(1 - kept**2)  # what came before the first one, summed up
    return float(weights @ [_white(seed, crc32(name.encode()), k) for k in range(first, frame + 1)])


@lru_cache(maxsize=1 << 16)  # neighbouring pictures have nearly all of them in common
def _white(*stream: int) -> float:
    return float(np.random.Generator(np.random.SFC64(stream)).standard_normal())
