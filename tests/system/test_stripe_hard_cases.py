"""Every extractor on the pictures that are hard to read: right points or right status codes.

The grooved block in the tank with the full sensor model, speckle too; the window of the paper's
picture that holds the block.  What is asked of each column with a value: within four of its
own sigmas of a point of the line that is really there, with at most 0.3 % beyond (a normal
error is beyond in 0.006 %, that of a pixel-wide uniform distribution never).
"""

from dataclasses import replace
from functools import lru_cache
from importlib.metadata import entry_points
from typing import Any

import cv2
import numpy as np
import pytest
from places import SCENES

from lscan.config.documents import merge
from lscan.config.rig import StripeSection, parse_rig
from lscan.records import Status, has_value
from lscan.stripe import extract_stripe
from sim.render.tank import Tank
from sim.scene import load_scene, scene_of
from sim.sensor import Webcam
from sim.truth import stripe_truth

EXTRACTORS = sorted(entry.name for entry in entry_points(group="lscan.extractors"))
LEFT, TOP, WIDTH, HEIGHT = 170, 310, 300, 150
SEEDS = (1, 2, 3, 4)
# The centre of a column's line is that of one point only where no other is blurred into it:
# away from the ends of what is lit and seen, by the width of the blur and the sheet (1.3 px)
# thrice.
EDGE_PX = 4.0

TWO_LINES = {
    "lines": [{"tilt_deg": 0.0, "share": 0.7}, {"tilt_deg": 3.0, "share": 0.3}],
    "power_mw": 13.0,
}
TWINS = {
    "lines": [{"tilt_deg": 0.0, "share": 0.5}, {"tilt_deg": 3.0, "share": 0.5}],
    "power_mw": 18.0,
}
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "clear": ("paper/groove.toml", {}),
    "harbor": ("waters/harbor.toml", {}),
    "dark": ("targets/dark.toml", {}),
    "mirror": ("targets/mirror.toml", {}),
    "saturated": ("paper/groove.toml", {"laser": {"power_mw": 30.0}}),
    "two lines": ("paper/groove.toml", {"laser": TWO_LINES}),
    "twins": ("paper/groove.toml", {"laser": TWINS}),
    "no line": ("paper/groove.toml", {"laser": {"on": False}}),
}


@lru_cache(maxsize=len(CASES))
def pictures(case):
    """The scene, and one picture for each seed from a single render of few samples."""
    name, changes = CASES[case]
    document = load_scene(SCENES / name).document
    centre = [319.5 - LEFT, 239.5 - TOP]
    # Light of higher orders matters where water or metal sends it.
    scatter_samples = 8 if case in ("harbor", "mirror") else 0
    small = {
        "camera": {"width_px": WIDTH, "height_px": HEIGHT},
        "lens": {"centre_px": centre},
        "render": {"samples": 16, "scatter_samples": scatter_samples},
    }
    scene = scene_of(parse_rig(merge(merge(document, small), changes), source=case))
    layers, webcam = Tank(scene).render(0.0), Webcam(scene)
    # Scattered light is smooth; the specks that few random samples leave in it are not there.
    layers = replace(layers, scattered=cv2.medianBlur(layers.scattered, 5))
    exposure_ms = scene.rig.camera.exposure_ms
    exposed = [webcam.expose(layers, exposure_ms, np.random.default_rng(seed)) for seed in SEEDS]
    return scene, exposed


@lru_cache(maxsize=len(CASES))
def truth_of(case):
    return stripe_truth(pictures(case)[0], 0.0)


@lru_cache(maxsize=100)
def found_in(case, extractor):
    """The stripes of all pictures of a case."""
    _, exposed = pictures(case)
    settings = StripeSection(extractor=extractor, threshold_dn=15.0)
    return [extract_stripe(picture, settings) for picture in exposed]


def pulls(stripes, truth):
    """(error / sigma) of all columns with a value where the line is clear of its ends."""
    clear = (truth.status == Status.OK) & ~truth.multiple & (truth.edge_px > EDGE_PX)
    each = []
    for stripe in stripes:
        valued = clear & has_value(stripe.status)
        each.append((stripe.centre_px - truth.centre_px)[valued] / stripe.sigma_px[valued])
    return np.concatenate(each), clear


@pytest.mark.parametrize("extractor", EXTRACTORS)
@pytest.mark.parametrize(
    "case",
    [
        "clear",
        "saturated",
        *(
            pytest.param(case, marks=pytest.mark.slow)
            for case in ("two lines", "harbor", "dark", "mirror")
        ),
    ],
)
def test_never_a_wrong_number_with_a_small_sigma(case, extractor):
    stripes = found_in(case, extractor)
    pull, clear = pulls(stripes, truth_of(case))
    assert len(pull) >= 0.95 * len(SEEDS) * clear.sum()  # "not found" is no way out
    assert (np.abs(pull) > 4).mean() <= 0.003
    for stripe in stripes:
        without = ~has_value(stripe.status)
        assert np.isnan(stripe.centre_px[without]).all()
        assert np.isnan(stripe.sigma_px[without]).all()
        assert (stripe.sigma_px[~without] > 0).all()


@pytest.mark.parametrize("extractor", EXTRACTORS)
def test_where_neither_line_is_the_brighter_no_number_is_given(extractor):
    first = truth_of("twins")
    both = (first.status == Status.OK) & (first.edge_px > EDGE_PX)
    for stripe in found_in("twins", extractor):
        right = has_value(stripe.status) & both
        # A column whose second line is shadowed has one line only, and may be measured.
        assert (stripe.status[both] == Status.AMBIGUOUS).mean() > 0.5
        error = np.abs(stripe.centre_px - first.centre_px)[right]
        assert (error > 4 * stripe.sigma_px[right]).sum() <= 0.003 * both.sum()


@pytest.mark.parametrize("extractor", EXTRACTORS)
def test_without_a_line_nothing_is_found(extractor):
    for stripe in found_in("no line", extractor):
        assert (stripe.status == Status.NO_PEAK).all()


@pytest.mark.parametrize("extractor", EXTRACTORS)
def test_what_is_hidden_is_not_found(extractor):
    truth = truth_of("clear")
    # Well within a shadow nothing of the line's blur is left.
    hidden = truth.status != Status.OK
    deep = hidden & np.roll(hidden, 4) & np.roll(hidden, -4)
    assert deep.sum() >= 4
    for stripe in found_in("clear", extractor):
        assert not has_value(stripe.status[deep]).any()
