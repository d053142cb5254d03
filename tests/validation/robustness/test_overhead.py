"""The stopwatch of acquisition's overhead: what it counts, and what it leaves out."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from lscan.records import Bytes
from tests.validation.robustness.overhead import PlainSaver, frame_times

SMALL = (16, 20, 3)


@dataclass
class FakeClock:
    """Goes on only when released."""

    now_s: float = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def pictures() -> list[Bytes]:
    generator = np.random.default_rng(6)
    return [generator.integers(0, 256, SMALL, dtype=np.uint8) for _ in range(3)]


def slow_syncs(clock: FakeClock, seconds: float) -> Callable[[int], None]:
    def fsync(descriptor: int) -> None:
        clock.now_s += seconds

    return fsync


def test_plain_savings_are_timed_and_are_no_part_of_the_overhead(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pictures: list[Bytes]
) -> None:
    """Syncs of 2 ms: one a plain saving, and as before three a frame and two at the end."""
    clock = FakeClock()
    monkeypatch.setattr(os, "fsync", slow_syncs(clock, 0.002))
    saver = PlainSaver(tmp_path / "plain.png", clock)
    times_s = frame_times(tmp_path / "a", pictures, 7, clock, saver)
    np.testing.assert_allclose(saver.saved_s, [0.002] * 7, atol=1e-9)
    np.testing.assert_allclose(times_s, [0.006] * 6 + [0.010], atol=1e-9)
    assert (cv2.imread(str(tmp_path / "plain.png")) == pictures[6 % 3]).all()
