"""The pieces of a stripe: stretches of neighbouring columns between gaps and jumps."""

import numpy as np

from lscan.records import Ints, Mask, Stripe, has_value

JUMP_PX = 3.0
"""A line that moves further than this from one column to the next has jumped: another surface
begins there.  It is the slope (72 degrees) above which a line is rather one of the rows."""


def pieces(stripe: Stripe) -> Ints:
    """(N,) number of the piece each column belongs to, from 0; -1 where there is no value.

    A piece ends where a column has no value and where the centre moves by more than JUMP_PX.

    Parameters
    ----------
    stripe : Stripe, px, of N entries
    """
    valued = has_value(stripe.status)
    step = np.abs(np.diff(np.where(valued, stripe.centre_px, 0.0)))
    goes_on = valued[1:] & valued[:-1] & (step <= JUMP_PX)
    begins = valued.copy()
    begins[1:] &= ~goes_on
    return np.where(valued, np.cumsum(begins) - 1, -1)


def neighbours(piece: Ints, steps: Ints) -> tuple[Ints, Mask]:
    """(N, n) entries some steps from each, and the mask of those of the same piece.

    Beyond the ends it is the entry at the end, which is not in the mask.

    Parameters
    ----------
    piece : (N,) array, as :func:`pieces` numbers them
    steps : (n,) array, entries
    """
    at = np.arange(len(piece))[:, None] + steps
    inside = np.clip(at, 0, len(piece) - 1)
    return inside, (at == inside) & (piece[inside] == piece[:, None]) & (piece[:, None] >= 0)
