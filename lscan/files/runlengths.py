"""Masks as run lengths, as the data set COCO has them.

References
----------
Lin et al., Microsoft COCO: Common Objects in Context, ECCV 2014; its uncompressed run lengths.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from lscan.errors import InputError
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


def mask_of(lengths: Mapping[str, Any]) -> Mask:
    """The mask of COCO's uncompressed run lengths, (H, W).

    Parameters
    ----------
    lengths : mapping, as ``run_lengths`` gives it

    Raises
    ------
    InputError
        The runs do not fill the mask.
    """
    height, width = lengths["size"]
    counts = np.array(lengths["counts"], dtype=np.int64)
    if (counts < 0).any() or counts.sum() != height * width:
        raise InputError("run lengths", value=int(counts.sum()), allowed=f"{height * width} pixels")
    inside = np.arange(len(counts)) % 2 == 1
    return np.repeat(inside, counts).reshape((height, width), order="F")
