"""The line on curved targets in the tank: the corrections halve what concavity does to it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from places import SCENES

from lscan.records import Status
from sim.scene import load_scene
from sim.studies.concavity import cases, concavity_errors, sheet_of, whole_line


def test_the_whole_line_is_found_where_there_is_one() -> None:
    rows = np.arange(60.0)
    centre = np.linspace(25.3, 31.8, 50)
    light = 3.0 + 100 * np.exp(-0.5 * ((rows - centre[:, None]) / 1.3) ** 2)
    light[40:] = 3.0
    stripe = whole_line(light)
    # A Gaussian summed at whole pixels: off by exp(-2 pi² 1.3²) at most, and its cut tails.
    np.testing.assert_allclose(stripe.centre_px[:40], centre[:40], atol=1e-6)
    assert (stripe.status[40:] == Status.NO_PEAK).all()
    assert np.isnan(stripe.centre_px[40:]).all()


def test_the_sheet_is_specified_as_in_the_scene() -> None:
    scene = load_scene(SCENES / "paper" / "sandwave.toml")
    sheet, yaw_rad = sheet_of(scene)
    assert sheet.thickness_mm == 1.5
    assert sheet.camera_mm == (225.0, -866.0254, 300.0)
    assert yaw_rad == pytest.approx(np.radians(2.2))


@pytest.mark.slow
def test_corrections_remove_most_of_the_error_on_another_target(tmp_path: Path) -> None:
    """On a sphere in a thicker sheet, neither of which the relations were derived on.

    A correction has to remove at least half.
    """
    chosen = {case.name: case for case in cases(SCENES, tmp_path)}
    case = chosen["sphere, sheet of 2.5 mm"]
    assert not case.derived
    errors = concavity_errors(replace(case, positions_mm=case.positions_mm[2:-2]))
    assert errors.points > 300
    assert errors.rms_mm[2] < 0.5 * errors.rms_mm[0]
    assert errors.q99_mm[2] < 0.5 * errors.q99_mm[0]
