"""The true line under a rolling shutter: closed form, fixed point, limits."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from truth_scenes import tank

from lscan.records import Status
from sim.scene import Scene
from sim.truth import StripeTruth, stripe_truth
from sim.truth.stripe import _join_rows, row_positions_mm, standing_truth
from sim.truth.surfaces import surfaces_of

HEIGHT = 480


def ramp(speed: float, readout: float, axis: str = "columns", **head: Any) -> Scene:
    """The grooved block leaning, on a floor."""
    return tank(
        workpiece={"kind": "grooved-block"},
        target={"shape": "workpiece", "position_mm": [-100.0, 0.0, -100.0], "tilt_x_deg": 25.0},
        floor={"z_mm": -140.0},
        head={"speed_mm_s": speed, **head},
        sensor={"readout_ms": readout},
        stripe={"axis": axis},
    )


def wave(speed: float, readout: float) -> Scene:
    """The sandwave, moving along its steep side."""
    return tank(
        workpiece={"kind": "sandwave"},
        target={"shape": "workpiece", "position_mm": [-75.0, -75.0, -100.0], "turn_deg": 20.0},
        head={"speed_mm_s": speed},
        sensor={"readout_ms": readout},
    )


def standing(scene: Scene, position_mm: float) -> StripeTruth:
    return standing_truth(scene, surfaces_of(scene), position_mm)


def test_rows_stand_where_the_head_is_in_mid_exposure():
    scene = wave(30.0, 20.0)
    rows = np.array([0.0, HEIGHT / 2, HEIGHT])
    # 30 mm/s for 20 ms are 0.6 mm, half of it on either side of the middle.
    assert row_positions_mm(scene, 5.0, rows) == pytest.approx([4.7, 5.0, 5.3], abs=1e-12)


@pytest.mark.parametrize(("speed", "readout"), [(0.0, 30.0), (50.0, 0.0)])
def test_without_motion_or_read_out_nothing_changes(speed, readout):
    expected, found = standing(wave(speed, readout), 3.0), stripe_truth(wave(speed, readout), 3.0)
    assert np.array_equal(found.centre_px, expected.centre_px, equal_nan=True)
    assert np.array_equal(found.xz_mm, expected.xz_mm, equal_nan=True)
    assert np.array_equal(found.status, expected.status)


def test_a_column_shows_the_line_of_its_row_s_time():
    scene = wave(-40.0, 30.0)
    truth = stripe_truth(scene, 3.0)
    still = standing(scene, 3.0)
    inner = (truth.status == Status.OK) & (truth.edge_px > 3)
    assert inner.sum() > 100
    assert np.abs(truth.centre_px - still.centre_px)[inner].max() > 0.01  # else nothing moved
    # Each column's own fixed point: the head put where it stands for the row it is seen in.
    for column in np.flatnonzero(inner)[::80]:
        place = row_positions_mm(scene, 3.0, truth.centre_px[column])
        there = standing(scene, float(place))
        assert there.centre_px[column] == pytest.approx(truth.centre_px[column], abs=1e-4)
        assert there.xz_mm[column] == pytest.approx(truth.xz_mm[column], abs=1e-3)


def test_a_slope_is_sheared_as_on_paper():
    # On a plane v is smooth in the position: to first order in the travel the line moves by
    # dv/ds (v/H - 1/2) T, divided by 1 - dv/ds T/H for the row itself moves.
    scene = ramp(20.0, 30.0)
    travel, step = 0.6, 0.2
    before, still, after = (standing(scene, s) for s in (-step, 0.0, step))
    truth = stripe_truth(scene, 0.0)
    same = np.all([t.status == Status.OK for t in (before, still, after, truth)], axis=0)
    same &= np.all([t.face == truth.face for t in (before, still, after)], axis=0)
    same &= truth.edge_px > 3
    assert same.sum() > 200
    rate = (after.centre_px - before.centre_px)[same] / (2 * step)
    late = (still.centre_px[same] / HEIGHT - 0.5) * travel
    expected = still.centre_px[same] + rate * late / (1 - rate * travel / HEIGHT)
    assert np.abs(rate * late).max() > 0.02
    assert np.abs(truth.centre_px[same] - expected).max() < 1e-3  # second order: 0.3^2 / 100 px


def test_each_row_has_the_time_of_its_own_exposure():
    scene = ramp(20.0, 30.0, "rows", roll_deg=90.0)
    truth = stripe_truth(scene, 0.0)
    good = np.flatnonzero((truth.status == Status.OK) & (truth.edge_px > 3))
    assert len(good) > 100
    for row in good[::200]:
        there = standing(scene, float(row_positions_mm(scene, 0.0, np.array(float(row)))))
        assert truth.centre_px[row] == pytest.approx(there.centre_px[row], abs=1e-4)


def test_a_line_that_is_never_where_the_shutter_is_does_not_show():
    still = standing(wave(0.0, 0.0), 0.0)
    column = np.flatnonzero(still.status == Status.OK)[0]
    row = still.centre_px[column]
    before = replace(still, centre_px=np.full_like(still.centre_px, np.nan))
    for late, status in ((5.0, Status.OK), (25.0, Status.NO_PEAK)):
        # The line comes up when the shutter has gone on by ``late`` rows; it moves 10 a step.
        rows = row + late + np.array([-20.0, -10.0, 0.0])
        joined = _join_rows([before, before, still], rows)
        assert joined.status[column] == status
        assert np.isfinite(joined.centre_px[column]) == (status == Status.OK)
        assert joined.lit[column] == (status == Status.OK)
