"""The stripe in a real picture: a red laser on a bust and on the turntable's rim.

The line is overexposed for most of its length, up to 15 px wide, and interrupted where the
helmet, the chin and the collar overhang.  960 × 1280 px, the same view with the laser off.
"""

from importlib.metadata import entry_points

import cv2
import numpy as np
import pytest
from places import PHOTOGRAPHS

from lscan.config.rig import StripeSection
from lscan.records import Status, has_value
from lscan.stripe import extract_stripe

FOLDER = PHOTOGRAPHS / "webcam"
TAKEN = FOLDER / "bust_laser_on.png", FOLDER / "bust_laser_off.png"

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
BY_EYE_PX = 15  # reading error, half the line's width, and steps between corners
# Rows that carry the line, first and last: read off crops of both photographs side by side,
# three times enlarged, and of the difference of their red channels, three times brightened.
# The gap is the helmet's overhang.  Below the bust the difference shows a trace of about 8 DN
# across the black turntable, a fifth of the threshold: too faint for a line.
CARRIED = [(53, 261), (266, 1118), (1227, 1273)]
ROW_BY_EYE = 3  # px to which the first and the last rows are read
EXTRACTORS = sorted(entry.name for entry in entry_points(group="lscan.extractors"))


@pytest.fixture(scope="module")
def photographs():
    if not all(path.is_file() for path in TAKEN):
        pytest.skip("the photographs are not here")
    return [cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB) for path in TAKEN]


@pytest.fixture(scope="module", params=EXTRACTORS)
def stripe(request, photographs):
    lit, dark = photographs
    chosen = StripeSection(axis="rows", extractor=request.param)
    return extract_stripe(lit, chosen, background=dark)


def carried_rows():
    return np.concatenate([np.arange(first, last + 1) for first, last in CARRIED])


def test_the_line_is_found_on_the_rows_that_carry_it(stripe):
    assert has_value(stripe.status[carried_rows()]).mean() >= 0.95  # the bar


def test_the_line_is_found_nowhere_else(stripe):
    found = np.flatnonzero(has_value(stripe.status))
    distance = np.abs(found[:, None] - carried_rows()).min(axis=1)
    assert distance.max() <= ROW_BY_EYE
    without = ~has_value(stripe.status)
    assert np.isin(stripe.status[without], [Status.NO_PEAK, Status.AMBIGUOUS]).all()


@pytest.mark.parametrize("corners", [BUST, RIM], ids=["bust", "rim"])
def test_the_line_is_found_where_it_is(stripe, corners):
    rows = np.arange(corners[0, 1], corners[-1, 1] + 1)
    centre = stripe.centre_px[rows]
    expected = np.interp(rows, corners[:, 1], corners[:, 0])
    found = np.isfinite(centre)
    assert (np.abs(centre - expected)[found] <= BY_EYE_PX).all()


def test_overexposed_rows_say_so(stripe):
    # To the eye the line is white in the middle on face, neck and chest.
    assert (stripe.status[700:930] == Status.SATURATED).mean() > 0.9
    assert not (stripe.status[1230:1270] == Status.SATURATED).any()
    assert (stripe.sigma_px[has_value(stripe.status)] > 0).all()


def test_the_papers_extractor_is_less_certain_of_overexposed_rows(photographs):
    lit, dark = photographs
    stripe = extract_stripe(lit, StripeSection(axis="rows"), background=dark)
    saturated, sound = stripe.status == Status.SATURATED, stripe.status == Status.OK
    assert np.median(stripe.sigma_px[saturated]) > np.median(stripe.sigma_px[sound])
