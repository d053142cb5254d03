"""The field table: its command, and that its rows fail where the instrument is wrong."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from places import ROOT

from lscan.calibration.metric.views import CalibrationView, LinePoints
from lscan.calibration.physical import PhysicalMap
from sim.scene import load_scene
from sim.truth import project, sheet_of
from tests.validation.surfaces import sheet, water
from tests.validation.surfaces.drawn import FULL, drawn_rig, metric_frame

SCENES = ROOT / "scenes"


def test_rigs_are_drawn_from_what_is_known() -> None:
    """Of 400 draws mean and scatter lie within 4 standard errors of what [optics] says."""
    scene = load_scene(SCENES / "paper" / "board.toml")
    generator = np.random.default_rng(1)
    rigs = [drawn_rig(scene, generator).tank for _ in range(400)]
    mean, sigma = scene.rig.optics.focal_px or (0.0, 0.0)
    focal = np.array([rig.lens.focal_px for rig in rigs])
    assert abs(focal.mean() - mean) < 4 * sigma / 20
    assert abs(focal.std() / sigma - 1) < 4 / np.sqrt(800)


def test_the_frame_of_the_metric_map_is_seen_in_the_middle() -> None:
    scene = load_scene(SCENES / "metric" / "water.toml")
    frame = metric_frame(scene)
    np.testing.assert_allclose(project(scene, frame.origin_mm[None])[0], [319.5, 239.5], atol=1e-6)
    on_sheet = frame.apply(np.array([[50.0, 0.0, -80.0], [-100.0, 0.0, 60.0]]))
    np.testing.assert_allclose(sheet_of(scene).clearance_mm(on_sheet), 0.0, atol=1e-9)
    np.testing.assert_allclose(frame.rotation @ frame.rotation.T, np.eye(3), atol=1e-12)


def test_a_map_that_is_not_carried_fails_its_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same rigs with the map left as it is: beyond both bars by far."""
    effort = replace(FULL, seeds=(1, 2), plain=True)
    rigs = list(water.refractive_rigs(SCENES, effort))
    assert all(isinstance(rig.plane_map, PhysicalMap) for rig in rigs)
    monkeypatch.setattr(water, "map_for_rig", lambda plane_map, rig: plane_map)
    bias, intervals = water._in_other_water("refractive", rigs, effort)
    assert bias.passed is False and bias.figure > 10 * (bias.bar or 0.0)
    assert intervals.passed is False


def test_points_where_no_line_is_are_wrong() -> None:
    """Three tenths of the columns show the line; what is found in the others is glare."""
    centre = np.where(np.arange(100) < 30, 50.0, np.nan)
    held: Any = SimpleNamespace(centre_px=centre)
    places = np.column_stack([np.arange(100.0), np.full(100, 50.2)])
    for count, wrong in ((100, True), (60, False)):
        line = LinePoints(places[:count], np.full(count, 0.1), "columns")
        assert sheet._is_wrong(held, CalibrationView("view", None, line)) == wrong
