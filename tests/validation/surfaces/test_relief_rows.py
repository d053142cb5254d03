"""The rows of fine relief: right for an exact scan, beyond their bars for an uncorrected one."""

from dataclasses import replace

import numpy as np
import pytest

from lscan.config.rig import SheetSection
from lscan.records import Surface
from lscan.surface.sheetresponse import transfer
from sim.studies.concavity import ShortScan
from tests.validation.surfaces import relief
from tests.validation.surfaces.drawn import FULL

SHEET = SheetSection(thickness_mm=1.5, camera_mm=(0.0, -870.0, 300.0), apex_mm=(0.0, 0.0, 250.0))
EFFORT = replace(FULL, seeds=(1, 2))


def _scan(gain_of: float) -> relief.ReliefScan:
    """A scan of small waves of 12 mm, shown with 1, or where ``gain_of`` is 1 with H."""
    y, x = np.meshgrid(np.arange(100.0), 0.9 * np.arange(80.0), indexing="ij")
    wave = np.cos(2 * np.pi * y / 12)
    shown = 1 + gain_of * (transfer(np.array([1 / 12]), 0.75)[0] - 1)
    true, found = -330 + wave, -330 + shown * wave
    ok = np.zeros(y.shape, dtype=np.int64)
    surface = Surface(np.stack([x, y, found], axis=-1), 0 * x, 0 * x, ok, y[:, 0])
    return relief.ReliefScan(ShortScan(found, surface, true, ok == 0), SHEET, 0.0)


def test_an_uncorrected_scan_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relief, "correct_thickness", lambda surface, sheet, yaw: surface)
    intervals, height, *gains = relief._judged(relief.RIPPLES, _scan(1.0), EFFORT)
    assert intervals.passed is False and height.passed is False
    expected = transfer(np.array([1 / 12]), 0.75)[0]
    assert gains[0].figure == pytest.approx(expected, abs=0.02)
