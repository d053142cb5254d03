"""How far a disc's centre, as seen, lies from the image of the disc's centre.

Perspective and distortion do not keep middles: the near half of a tilted disc covers more of
the picture than the far half.  The centre of a mark is found as the maximum of the smoothed
picture (centre.py), so the same is done here with the disc as the local map draws it: its
first and second derivatives, J and Q, place the disc's points at J x + Q(x, x) / 2 with the
area det(J + Q x).  To leading order the shift grows as Q times the square of the radius
(Heikkilä, IEEE Trans. PAMI 22, 10, 2000, gives that of the ellipse's centre under perspective).
"""

import numpy as np

from lscan.board.lattice import Expansion
from lscan.board.picture import BLUR_PX
from lscan.records import Floats

RINGS, SPOKES = 3, 8  # quadrature over the disc: exact to the fifth order in its points
STEPS = 2  # Newton's; the shift is small beside the window, so the first is good to a percent


def shift_of_discs(map_there: Expansion, radius_mm: float, sigma_px: Floats) -> Floats:
    """(N, 2) px from the image of each disc's centre to the maximum of its smoothed image.

    Parameters
    ----------
    map_there : Expansion, px and mm, the local map about the N centres
    radius_mm : float, mm, of the discs
    sigma_px : (N,) array, px, of the smoothing (``window_sigma``); the picture's own blur of 0.7 px
        adds to it
    """
    jacobian, bend = map_there.jacobian, map_there.bend
    spots, weight = _quadrature(radius_mm)
    derivative = jacobian[:, None] + np.einsum("ncij,qj->nqci", bend, spots)
    halfway = jacobian[:, None] + np.einsum("ncij,qj->nqci", bend, spots) / 2
    image = np.einsum("nqci,qi->nqc", halfway, spots)
    mass = weight * np.abs(np.linalg.det(derivative))
    return _maximum(image, mass, sigma_px**2 + BLUR_PX**2)


def _quadrature(radius: float) -> tuple[Floats, Floats]:
    """Points (Q, 2) and weights (Q,) of a Gauss rule over a disc: Legendre in the area."""
    node, share = np.polynomial.legendre.leggauss(RINGS)
    reach = radius * np.sqrt((node + 1) / 2)
    angle = 2 * np.pi * np.arange(SPOKES) / SPOKES
    spokes = np.column_stack([np.cos(angle), np.sin(angle)])
    return (reach[:, None, None] * spokes).reshape(-1, 2), np.repeat(share, SPOKES)


def _maximum(image: Floats, mass: Floats, variance: Floats) -> Floats:
    """(N, 2) maxima, by Newton's steps from 0, of masses (N, Q) at (N, Q, 2) smoothed."""
    top = np.zeros((len(image), 2))
    for _ in range(STEPS):
        away = image - top[:, None]
        weight = mass * np.exp(-(away**2).sum(axis=2) / (2 * variance[:, None]))
        gradient = np.einsum("nq,nqc->nc", weight, away)
        spread = np.einsum("nq,nqc,nqd->ncd", weight, away, away) / variance[:, None, None]
        hessian = spread - weight.sum(axis=1)[:, None, None] * np.eye(2)
        top = top - np.linalg.solve(hessian, gradient[..., None])[..., 0]
    return top
