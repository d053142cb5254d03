import numpy as np

from lscan.stripe import extract_stripe


def test_it_is_no_worse_than_before(judge_extractor, assert_no_worse):
    assert_no_worse(judge_extractor("line_finder:find_line"), "baseline.json")


def test_most_of_every_line_is_within_its_width(stripe_case):
    settings = stripe_case.settings.model_copy(update={"extractor": "line_finder:find_line"})
    found, truth = extract_stripe(stripe_case.picture, settings), stripe_case.truth
    off = np.abs(found.centre_px - truth.centre_px) > truth.sigma_px
    assert np.count_nonzero(off) <= len(off) / 2
