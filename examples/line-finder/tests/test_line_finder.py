import numpy as np

from lscan.stripe import extract_stripe


def test_it_is_no_worse_than_before(judge_extractor, assert_no_worse):
    assert_no_worse(judge_extractor("line_finder:find_line"), "baseline.json")


def test_every_case_has_half_of_its_line(stripe_case):
    settings = stripe_case.settings.model_copy(update={"extractor": "line_finder:find_line"})
    found = extract_stripe(stripe_case.picture, settings, stripe_case.dark)
    off = np.abs(found.centre_px - stripe_case.truth.centre_px)
    assert np.nanmedian(off) < 1.0
