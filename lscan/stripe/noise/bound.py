"""The Cramér-Rao bound: no unbiased extractor scatters less than this."""

import numpy as np

from lscan.records import Floats
from lscan.stripe.crosssection import CENTRE, TILT, lines, parameters_of
from lscan.stripe.noise.model import Noise


def centre_bound_px(
    width_px: Floats | float,
    height_dn: Floats | float,
    noise: Noise,
    phase_px: Floats | float = 0.0,
    reach_px: int | None = None,
) -> Floats:
    """Least standard deviation (K,) in px of an unbiased estimate of a line's centre.

    Centre, width, height and an even ground are unknown; the noise is known, independent from
    pixel to pixel and normal: reading, shot and speckle.  For additive noise and a line much wider
    than a pixel the bound is (sigma_n / A) sqrt(2 w / sqrt(pi)).

    Parameters
    ----------
    width_px : (K,) array or float, px, standard deviation of the Gaussian
    height_dn : (K,) array or float, DN, its height
    noise : Noise, of the pixels
    phase_px : (K,) array or float, px, place of the centre in the middle pixel
    reach_px : int, optional, px, pixels seen to either side; 8 widths by default

    References
    ----------
    The inverse of Fisher's information J^T V^-1 J: Kay, Fundamentals of Statistical Signal
    Processing I, sec. 3.9, without the little that the variance itself says of the line;
    docs/explanation/physics.md, section 4.
    """
    width, height, phase = np.broadcast_arrays(
        *(np.atleast_1d(np.asarray(value, float)) for value in (width_px, height_dn, phase_px))
    )
    reach = int(np.ceil(8 * width.max())) + 1 if reach_px is None else reach_px
    steps = np.arange(-reach, reach + 1, dtype=float)
    level = np.zeros(len(width))
    seen = lines(parameters_of(phase, width, height, level, level), steps)
    jacobian = np.delete(seen.jacobian, TILT, axis=1)
    weight = 1 / noise.variance(seen.light)
    information = (jacobian * weight[:, None]) @ jacobian.transpose(0, 2, 1)
    return np.sqrt(np.linalg.inv(information)[:, CENTRE, CENTRE])
