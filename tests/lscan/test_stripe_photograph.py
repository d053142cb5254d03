"""The stripe in a real picture: a red laser on a bust and on the turntable's rim.

The line is overexposed for most of its length, up to 15 px wide, and interrupted where the
helmet, the chin and the collar overhang.  960 × 1280 px, the same view with the laser off.
"""

from pathlib import Path

import cv2
import numpy as np
import pytest

from lscan.records import Status, has_value
from lscan.rig import StripeSection
from lscan.stripe import extract_stripe

FOLDER = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "webcam"
PHOTOGRAPHS = FOLDER / "bust_laser_on.png", FOLDER / "bust_laser_off.png"

# Corners (u, v) of the line, read off the photograph by eye, to about 5 px: from the crest of
# the helmet down to the foot of the bust, and on the white rim of the turntable.  The line is
# not seen on the black turntable between the two, nor on the wall above the helmet.
BUST = np.array(
    [
        (595, 54), (560, 96), (531, 151), (530, 166), (523, 187), (511, 210), (517, 232),
        (550, 259), (567, 268), (579, 303), (567, 313), (573, 348), (565, 378), (561, 403),
        (562, 464), (555, 504), (550, 522), (526, 534), (522, 607), (550, 608), (548, 633),
        (559, 640), (563, 671), (549, 681), (561, 731), (572, 787), (571, 852), (559, 859),
        (559, 903), (552, 913), (558, 933), (545, 953), (541, 988), (550, 1024), (577, 1064),
        (598, 1118),
    ]
)  # fmt: skip
RIM = np.array([(778, 1228), (778, 1273)])
HELMET_GAP = (259, 268)  # rows between which no line is seen
BY_EYE_PX = 15  # reading error, half the line's width, and steps between corners


@pytest.fixture(scope="module")
def stripe():
    if not all(path.is_file() for path in PHOTOGRAPHS):
        pytest.skip("the photographs are not here")
    lit, dark = (cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB) for path in PHOTOGRAPHS)
    return extract_stripe(lit, StripeSection(axis="rows"), background=dark)


def rows_of(corners):
    return np.arange(corners[0, 1], corners[-1, 1] + 1)


@pytest.mark.parametrize("corners", [BUST, RIM], ids=["bust", "rim"])
def test_the_line_is_found_where_it_is(stripe, corners):
    rows = rows_of(corners)
    centre = stripe.centre_px[rows]
    expected = np.interp(rows, corners[:, 1], corners[:, 0])
    found = np.isfinite(centre)
    assert (np.abs(centre - expected)[found] <= BY_EYE_PX).all()
    # Missing may be only the ends, which are read to 5 px, and the gap under the helmet.
    missing = rows[~found]
    at_end = (missing < rows[0] + 5) | (missing > rows[-1] - 5)
    in_gap = (missing > HELMET_GAP[0]) & (missing < HELMET_GAP[1])
    assert (at_end | in_gap).all()


def test_the_line_is_found_nowhere_else(stripe):
    expected = np.concatenate([rows_of(BUST), rows_of(RIM)])
    found = np.flatnonzero(has_value(stripe.status))
    distance = np.abs(found[:, None] - expected).min(axis=1)
    assert distance.max() <= 5  # the reading error of the line's ends
    without = ~has_value(stripe.status)
    assert (stripe.status[without] == Status.NO_PEAK).all()


def test_overexposed_rows_say_so_and_are_less_certain(stripe):
    saturated, sound = stripe.status == Status.SATURATED, stripe.status == Status.OK
    # To the eye the line is white in the middle on face, neck and chest.
    assert (stripe.status[700:930] == Status.SATURATED).mean() > 0.9
    assert (stripe.status[1230:1270] == Status.OK).all()
    assert np.median(stripe.sigma_px[saturated]) > np.median(stripe.sigma_px[sound])
    assert (stripe.sigma_px[saturated | sound] > 0).all()
