"""What the demo compares and scans; the demo itself is run in tests/system."""

import numpy as np
import pytest
from places import SCENES
from truth_scenes import tank

from lscan.config.rig import load_rig
from sim.demo import CHECK_EDGE_PX, stripe_errors, thin_out
from sim.render.tank import Tank
from sim.truth import stripe_truth


def test_a_scan_that_is_thinned_out_goes_as_far() -> None:
    whole = load_rig(SCENES / "paper" / "sandwave.toml")
    few = thin_out(whole, 100).rig.plan
    plan = whole.rig.plan
    assert few.frames == 100 < plan.frames
    assert few.frames * few.step_mm == pytest.approx(plan.frames * plan.step_mm)
    assert few.start_mm == plan.start_mm


def test_columns_with_a_whole_line_are_compared_with_the_truth_and_no_others() -> None:
    """A line of 72 columns on the floor, within 0.05 px as without noise and in clear water."""
    scene = tank(
        camera={"width_px": 96, "height_px": 64},
        lens={"focal_px": 850.0, "centre_px": [47.5, 31.5]},
        floor={"z_mm": -62.0},
        laser={"fan_half_angle_deg": 3.0, "power_mw": 0.3},
    )
    truth = stripe_truth(scene, 0.0)
    errors = stripe_errors(Tank(scene), 0.0, samples=16, scatter_samples=0)
    assert len(errors) == np.count_nonzero(truth.edge_px > CHECK_EDGE_PX) == 72 - 2 * 5
    assert np.abs(errors).max() < 0.05
