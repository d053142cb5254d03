"""Where a camera's range ends: at 255 DN, or at the plateau that a picture shows below it."""

import cv2
import numpy as np

from lscan.records import Bytes, Ints

CLIPPED_DN = 255
"""Highest value an 8-bit picture can hold: such a pixel may have seen any amount of light."""

_NEAR_END_DN = 250  # pictures that reach so far are clipped at 255 or not at all
_LEAST_DN = 32  # below it a plateau is darkness
_STRAY = 1e-4  # share of the pixels that lossy coding or a hot pixel may put above the plateau
_SPREAD_DN = 6  # by which lossy coding spreads a plateau
_PILED = 3.0
"""Times that a plateau's three values hold more pixels than four values farther down.  At the
smooth crest of a line that is not clipped they hold 1.3 times as many: the width of a parabola
at the depth d below its top goes with the root of d."""

_FLAT_PX, _WIDEST_PX = 3, 41  # pixels across a clipped crest: fewer may be chance, more no line
_OVERSHOOT = 1.1  # of the plateau: where the flanks of a crest clipped on fewer pixels meet
_FAINT_DN = 4.0  # reading noise and rounding: a fainter flank says no more than that it is dark
_FEWEST = 8  # crests


def clipping_level(lines: Bytes) -> int:
    """The grey value from which pixels are clipped: CLIPPED_DN unless the picture shows another.

    A camera whose range ends below 255 DN, as gain and coding can make it, shows a plateau: many
    pixels have nearly the same highest value, few have values a little less, and the crest of
    a line is flat over several pixels, or its flanks rise as if to a higher crest.

    Parameters
    ----------
    lines : (N, L) array, uint8, DN, the pixels across the line, one row for each entry of the
        stripe
    """
    highest = lines.max(axis=1)
    least = _within_highest(highest, lines.size)
    if least >= _NEAR_END_DN:
        return CLIPPED_DN
    # Values farther down than the plateau and its surroundings do not count.
    limit = max(least - 2 * _SPREAD_DN, 0)
    high = lines[highest >= limit]
    count = np.bincount(high[high >= limit], minlength=CLIPPED_DN + 1)
    above = np.cumsum(count[::-1])[::-1]  # pixels of each value or more
    top = int(np.flatnonzero(above > _STRAY * lines.size)[-1])
    if top >= _NEAR_END_DN or top < _LEAST_DN:
        return CLIPPED_DN
    mode = top - _SPREAD_DN + int(count[top - _SPREAD_DN : top + 1].argmax())
    piled = count[mode - 1 : mode + 2].sum() > _PILED * count[mode - 6 : mode - 2].sum()
    if piled and (_has_flat_crests(lines, mode) or _has_cut_crests(lines, mode)):
        return _foot(count, mode)
    return CLIPPED_DN


def _within_highest(highest: Bytes, pixels: int) -> int:
    """A grey value that more than _STRAY of the pixels reach, by the highest of each line."""
    stray = int(_STRAY * pixels)
    return 0 if stray >= len(highest) else int(np.partition(highest, -stray - 1)[-stray - 1])


def _foot(count: Ints, mode: int) -> int:
    """The lowest value of the plateau: down to where a tenth of its pixels are left."""
    level = mode
    while level > mode - _SPREAD_DN // 2 and 10 * count[level - 1] >= count[mode]:
        level -= 1
    return level


def _has_flat_crests(lines: Bytes, level: int) -> bool:
    """Whether most crests that reach the level stay there for some pixels, but not for many."""
    high = (lines >= level - 2).astype(np.uint8)
    wide = cv2.morphologyEx(high, cv2.MORPH_OPEN, np.ones((1, _WIDEST_PX), np.uint8))
    crest = np.asarray(cv2.subtract(high, wide), np.uint8)
    flat = cv2.erode(crest, np.ones((1, _FLAT_PX), np.uint8)).any(axis=1).sum()
    return bool(flat >= _FEWEST and 2 * flat >= crest.any(axis=1).sum())


def _has_cut_crests(lines: Bytes, level: int) -> bool:
    """Whether the flanks of most crests that reach the level rise as if to a far higher crest.

    A line narrower than _FLAT_PX is clipped on one or two pixels.  The two pixels on either side
    of them are taken to lie on a Gaussian, whose logarithm is a parabola.
    """
    high = lines >= level - 2
    reach = np.flatnonzero(high.any(axis=1))
    first = high[reach].argmax(axis=1)
    last = high.shape[1] - 1 - high[reach, ::-1].argmax(axis=1)
    narrow = (last - first < _FLAT_PX) & (first >= 2) & (last < high.shape[1] - 2)
    reach, first, last = reach[narrow], first[narrow], last[narrow]
    if len(reach) < _FEWEST:
        return False
    places = np.stack([first - 2, first - 1, last + 1, last + 2], axis=1)
    flanks = np.log(np.maximum(lines[reach[:, None], places], _FAINT_DN))
    inner = (last - first) / 2 + 1  # from the crest's middle; the outer pixels are one farther
    outside, inside = flanks[:, [0, 3]].mean(axis=1), flanks[:, [1, 2]].mean(axis=1)
    bend = (inside - outside) / (2 * inner + 1)
    tilt = (flanks[:, 2] - flanks[:, 1]) / (2 * inner)
    crest = inside + bend * inner**2 + tilt**2 / (4 * np.maximum(bend, 1e-6))
    return bool(np.median(crest) > np.log(_OVERSHOOT * level))
