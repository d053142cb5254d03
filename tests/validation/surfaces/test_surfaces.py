"""The field table: its command, and that its rows fail where the instrument is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from places import ROOT

from lscan.calibration.physical import PhysicalMap
from sim.scene import load_scene
from tests.validation.surfaces import water
from tests.validation.surfaces.drawn import FULL, drawn_rig

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


def test_a_map_that_is_not_carried_fails_its_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same rigs with the map left as it is: beyond both bars by far."""
    effort = replace(FULL, seeds=(1, 2), plain=True)
    rigs = list(water.refractive_rigs(SCENES, effort))
    assert all(isinstance(rig.plane_map, PhysicalMap) for rig in rigs)
    monkeypatch.setattr(water, "map_for_rig", lambda plane_map, rig: plane_map)
    bias, intervals = water._in_other_water("refractive", rigs, effort)
    assert bias.passed is False and bias.figure > 10 * (bias.bar or 0.0)
    assert intervals.passed is False
