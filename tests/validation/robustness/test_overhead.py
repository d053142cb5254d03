"""The stopwatch of acquisition's overhead: what it counts, and what it leaves out."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from places import ROOT

from lscan.acquisition.run import open_run
from lscan.records import Bytes
from tests.validation.robustness import overhead
from tests.validation.robustness.effort import FULL
from tests.validation.robustness.overhead import PlainSaver, frame_times, overhead_rows

SCENE = ROOT / "scenes" / "paper" / "sandwave.toml"
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


@pytest.mark.parametrize("slow_s", [0.0, 0.5])
def test_a_slow_camera_does_not_raise_the_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pictures: list[Bytes], slow_s: float
) -> None:
    """Three syncs of 2 ms a frame, of picture, folder and row: 6 ms, whatever the camera takes;
    the last frame has in addition the two by which the run is marked complete."""
    clock = FakeClock()
    monkeypatch.setattr(os, "fsync", slow_syncs(clock, 0.002))

    def wait_for_the_camera(picture: Bytes) -> None:
        clock.now_s += slow_s

    times_s = frame_times(tmp_path / "a", pictures, 7, clock, wait_for_the_camera)
    np.testing.assert_allclose(times_s, [0.006] * 6 + [0.010], atol=1e-9)


def test_what_is_timed_is_a_whole_scan(tmp_path: Path, pictures: list[Bytes]) -> None:
    """Each frame is written, in its turn; none is left out of the figure."""
    times_s = frame_times(tmp_path / "a", pictures, 7)
    run = open_run(tmp_path / "a")
    assert (run.state, len(run)) == ("complete", 7)
    run.verify()
    for index, frame in enumerate(run.frames()):
        np.testing.assert_array_equal(frame.image, pictures[index % 3])
    assert times_s.shape == (7,)
    assert (times_s > 0).all()


def test_the_rows_are_ratios_to_saving_the_same_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pictures: list[Bytes]
) -> None:
    """On a machine twice as slow both take twice as long, and the figures stay."""
    monkeypatch.setattr(overhead, "noisy_pictures", lambda scene: pictures)

    def times_on(slowness: float) -> Callable[..., np.ndarray]:
        def known_times(
            path: Path, pictures: list[Bytes], frames: int, aside: PlainSaver
        ) -> np.ndarray:
            aside.saved_s += [0.010 * slowness] * frames
            taken = np.array([0.004] * (frames - 1) + [0.004 + 0.001 * frames])
            return slowness * taken

        return known_times

    for slowness in (1.0, 2.0):
        monkeypatch.setattr(overhead, "frame_times", times_on(slowness))
        rows = overhead_rows(FULL.overhead_frames, tmp_path, SCENE)
        assert [row.figure for row in rows] == pytest.approx([0.4, 0.5])
    assert [row.what.rpartition(": ")[2] for row in rows] == ["median", "mean"]
    assert all(f"{FULL.overhead_frames} frames" in row.what for row in rows)
    assert FULL.overhead_frames >= 200
    assert {(row.unit, row.seed, row.passed) for row in rows} == {("ratio", overhead.SEED, True)}
    assert list(tmp_path.iterdir()) == [], "nothing is left behind"


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


def test_the_pictures_are_of_the_tank_with_its_noise() -> None:
    first, second = overhead.noisy_pictures(SCENE, count=2)
    assert first.shape == (480, 640, 3)
    assert first.dtype == np.uint8
    different = (first != second).mean()
    assert different > 0.5, "noise reaches most pixels, so no picture is easy to compress"
    again, _ = overhead.noisy_pictures(SCENE, count=2)
    np.testing.assert_array_equal(first, again)
