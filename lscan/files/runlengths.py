"""Masks as run lengths, as the data set COCO has them.

References
----------
Lin et al., Microsoft COCO: Common Objects in Context, ECCV 2014; its uncompressed run lengths.
"""

from typing import Any

import numpy as np

from lscan.records import Mask


def run_lengths(mask: Mask) -> dict[str, Any]:
    """The mask as COCO's uncompressed run lengths, of JSON types.

    Parameters
    ----------
    mask : (H, W) array of bool

    Returns
    -------
    mapping
        "size", [H, W]; "counts", pixels column by column: how many are outside, how many of the
        next inside, and so on; the first is 0 where the mask begins inside.

    Examples
    --------
    >>> run_lengths(np.array([[False, True], [True, True]]))
    {'size': [2, 2], 'counts': [1, 3]}
    """
    flat = np.asarray(mask, dtype=bool).ravel(order="F")
    turns = np.flatnonzero(np.diff(flat)) + 1
    begin = [0, 0] if flat[:1].any() else [0]
    counts = np.diff(np.concatenate([begin, turns, [flat.size]]).astype(int))
    return {"size": list(mask.shape), "counts": counts.tolist()}
