"""The bench's judgement: the lower end of the ratio's interval over its runs."""

import numpy as np
import pytest
from places import SCENES

from lscan.config.rig import load_rig
from lscan.records import Floats
from sim.scene import Scene
from tests.validation import picturespeed, speed as bench
from tests.validation.speed import FULL, gain_of

PAPER = SCENES / "paper"


def pairs(generator: np.random.Generator, count: int) -> Floats:
    """Log-normal costs; the ratio of their means is e."""
    return np.exp(generator.normal((0.0, 1.0), 0.5, (count, 2)))


def test_the_interval_holds_the_true_ratio() -> None:
    """In 95 % of repeats, less what the percentile interval of 16 runs is known to lack.

    With 400 repeats the standard error of the share is 1.1 %; percentile intervals of small
    samples are too short by about the factor sqrt(15/16) and by t against normal quantiles,
    1.96 against 2.13: 92 % of a normal quantity.
    """
    generator = np.random.default_rng(3)
    gains = [gain_of(pairs(generator, 16)) for _ in range(400)]
    held = np.mean([gain.low <= np.e <= gain.high for gain in gains])
    assert held >= 0.92 - 3 * 0.011
    assert all(gain.low <= gain.ratio <= gain.high for gain in gains)


def test_more_runs_narrow_the_interval() -> None:
    """As 1 / sqrt(n): 64 times the runs, an eighth of the width, within a factor of two."""
    generator = np.random.default_rng(4)
    few, many = gain_of(pairs(generator, 16)), gain_of(pairs(generator, 1024))
    assert (many.high - many.low) < (few.high - few.low) / 4


def test_the_lower_end_is_judged() -> None:
    """One lucky run among bad ones raises the ratio, and not the lower end."""
    costs = np.array([[1.0, 100.0]] * 15 + [[1.0, 5000.0]])
    gain = gain_of(costs)
    assert gain.ratio > bench.BARS["line core"] > gain.low
    row = bench._gain_row("line core, all orders", gain, FULL, bench.BARS["line core"])
    assert row.passed is False and row.figure == gain.low
    assert f"{gain.ratio:.3g}" in row.reference and f"{gain.high:.3g}" in row.reference


@pytest.mark.parametrize("times, passed", [(2.0, False), (4.0, True)])
def test_pictures_are_judged_by_their_whole_times(
    times: float, passed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All stages of a picture count: medians of pictures of one way, sums of a scan's."""

    def seconds(tanks: list[tuple[tuple[float, bool], int]], pictures: int) -> Floats:
        (_, sampled), orders = tanks[0]
        assert sampled == (orders == 0) and tanks[1][1] == 1
        return np.array([[[0.2, 0.1, 0.1]] * pictures, [[0.2 / times] * 2 + [0.0]] * pictures])

    def tank(scene: Scene, *, sampled: bool = False) -> tuple[float | None, bool]:
        return scene.tank.water.turbidity_ntu, sampled

    monkeypatch.setattr(picturespeed, "Tank", tank)
    monkeypatch.setattr(picturespeed, "stage_seconds", seconds)
    rig_file = load_rig(PAPER / "sandwave.toml")
    monkeypatch.setattr(picturespeed, "scan_seconds", lambda *_: 0.4 / times)
    *stages, gain = picturespeed.picture_times(rig_file, 3)
    assert len(stages) == 6 and gain.passed is passed and gain.figure == pytest.approx(times)
    (turbid,) = picturespeed.turbid_time(rig_file, 2)
    assert turbid.figure == pytest.approx(times) and turbid.passed is False
