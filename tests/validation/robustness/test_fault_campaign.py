"""The campaign of injected faults: clean on lscan as it is, and not on one that is broken."""

import logging
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lscan.acquisition.scan
import lscan.acquisition.writer
from lscan.acquisition.run import FrameRow, open_run
from lscan.acquisition.writer import RunWriter
from lscan.devices.grbl import SerialTrack
from lscan.devices.opencv_camera import OpencvCamera
from lscan.errors import DeviceError, InputError
from lscan.records import Frame
from tests.validation.robustness import campaign
from tests.validation.robustness.campaign import KINDS, Outcome, run_campaign
from tests.validation.robustness.faults import FRAMES, InjectedFault, Phase
from tests.validation.robustness.faulty import ExposureMark, draw_mark, read_mark


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """Warnings of a camera that is opened anew, by the hundred."""
    logging.disable(logging.WARNING)
    yield
    logging.disable(logging.NOTSET)


def violations(outcomes: list[Outcome]) -> list[str]:
    return [f"{outcome.fault}: {outcome.violation}" for outcome in outcomes if outcome.violation]


# ---- lscan as it is ---------------------------------------------------------------------


def test_a_fault_of_every_kind_ends_clean(tmp_path: Path) -> None:
    outcomes = run_campaign(len(KINDS), seed=1, folder=tmp_path)
    assert violations(outcomes) == []
    assert [outcome.fault.kind for outcome in outcomes] == list(KINDS)
    assert all(outcome.injected for outcome in outcomes)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_hundred_faults_end_clean_at_any_moment(tmp_path: Path) -> None:
    """More of those after which nobody waits for a time-out."""
    kinds = [kind for kind in KINDS if kind not in ("camera hung", "camera clock set")]
    outcomes = run_campaign(4 * len(kinds), 2, tmp_path, kinds)
    assert violations(outcomes) == []
    assert all(outcome.injected for outcome in outcomes)
    # A campaign that always stops, or never, would test only half of what it says.
    ended = [outcome.ended for outcome in outcomes]
    assert len(outcomes) // 10 < ended.count("tolerated") < len(outcomes) // 2
    assert {outcome.kept for outcome in outcomes} == set(range(FRAMES + 1))


# ---- what a picture carries -------------------------------------------------------------


def test_a_mark_is_read_back_or_not_at_all() -> None:
    image = np.random.default_rng(1).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    assert read_mark(image) is None
    mark = ExposureMark(counter=7, exposed_s=123.456, head_mm=-0.004, moving=True)
    draw_mark(image, mark)
    assert read_mark(image) == mark
    assert read_mark(image[:, :, ::-1]) == mark
    assert read_mark(image[:, :, 0]) is None
    assert read_mark(image[:, :20]) is None
    image[0, 3, 1] ^= 1
    assert read_mark(image) is None
    image[0, 3] ^= 1
    assert read_mark(image) is None


# ---- lscan, broken: each check sees its fault -------------------------------------------


def first_violation(
    path: Path, kind: str, phase: Phase, strength: float = np.inf, part: float = 0.99
) -> str:
    """What the checks say of one experiment, with the fault in the third frame's turn."""
    fault = InjectedFault(kind, 2, phase, part, strength, stamped=False)
    return campaign.run_experiment(fault, 1, path / "run").violation


def broken(message: str) -> Callable[..., Any]:
    def fail(*_: Any, **__: Any) -> Any:
        raise DeviceError(message)

    return fail


@pytest.mark.parametrize(
    ("failing", "violation"),
    [
        (broken("something failed"), "does not name the device or file"),
        (broken("camera opencv (device 0): failed"), "does not say what to do"),
        (broken("camera opencv (device 0): gone\ncheck cable and power"), "more than one line"),
        (lambda *_, **__: 1 / 0, "ended in ZeroDivisionError"),
    ],
)
def test_an_unclear_end_is_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: Callable[..., Any], violation: str
) -> None:
    """(a)"""
    real = lscan.acquisition.scan.acquire_into

    def unclear(writer: RunWriter, *args: Any) -> Any:
        try:
            return real(writer, *args)
        except DeviceError:
            return failing()

    monkeypatch.setattr(lscan.acquisition.scan, "acquire_into", unclear)
    assert violation in first_violation(tmp_path, "camera gone", "before the grab")


def test_an_end_that_does_not_say_what_is_kept_is_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """(a)"""
    monkeypatch.setattr(RunWriter, "__exit__", lambda self, *_: self.close())
    violation = first_violation(tmp_path, "camera gone", "before the grab")
    assert "does not say what is kept" in violation


def test_a_torn_picture_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """(b) It has its name and its row, and half of its bytes."""

    def trusting(file: Path, data: bytes) -> None:
        half = "000001" in file.name
        file.write_bytes(data[: len(data) // 2] if half else data)

    monkeypatch.setattr(lscan.acquisition.writer, "write_atomically", trusting)
    assert "does not open" in first_violation(tmp_path, "camera gone", "before the grab")


def test_an_accepted_black_picture_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """(c)"""
    monkeypatch.setattr(OpencvCamera, "_fault", lambda *_: "")
    violation = first_violation(tmp_path, "camera black", "before the grab")
    assert violation == "frame 2 is no picture of this camera"


@pytest.mark.parametrize(
    ("phase", "violation"),
    [
        ("before the move", r"frame 2 was exposed at 3\.0\d* mm, commanded_mm is 5\.0"),
        ("before the grab", r"frame 2 was exposed \d\.\d+ s before it was asked for"),
    ],
)
def test_an_old_picture_is_seen(tmp_path: Path, phase: Phase, violation: str) -> None:
    """(c) A camera without time stamps that holds back more than is flushed cannot be known."""
    assert re.fullmatch(violation + ".*", first_violation(tmp_path, "camera late", phase, 2000))


@pytest.mark.parametrize(
    ("kind", "phase"), [("alarm", "in mid-move"), ("stuck", "before the move")]
)
def test_a_wrong_place_is_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, phase: Phase
) -> None:
    """(c) A track that takes a command for its result."""
    monkeypatch.setattr(SerialTrack, "move_to", believing(SerialTrack.move_to))
    violation = first_violation(tmp_path, kind, phase, part=0.5)
    assert re.fullmatch(r"frame 2 was exposed at .* mm, commanded_mm is 5\.0+ mm", violation)


def believing(real: Callable[[SerialTrack, float], float]) -> Callable[[SerialTrack, float], float]:
    """``move_to`` that answers, where the real one fails, the position it was sent to."""

    def move_to(self: SerialTrack, position_mm: float) -> float:
        try:
            return real(self, position_mm)
        except DeviceError:
            return position_mm

    return move_to


def test_a_frame_reported_too_early_is_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """(d)"""
    real = RunWriter.append

    def lazy(self: RunWriter, frame: Frame) -> None:
        if frame.index == 1:
            self.written += 1  # to be written later, which a fault then prevents
        elif frame.index == 0:
            real(self, frame)
        else:
            raise InputError(f"{self.path}: Input/output error; check the disk")

    monkeypatch.setattr(RunWriter, "append", lazy)
    violation = first_violation(tmp_path, "disk error", "before the move")
    assert violation.startswith("lost: 2 frames were reported as done, 1 are on disk")


def test_a_resume_that_fails_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """(e)"""
    monkeypatch.setattr(
        lscan.acquisition.scan, "resume_run", broken("camera opencv (device 0): was stopped before")
    )
    assert "does not go on" in first_violation(tmp_path, "camera gone", "before the grab")


def test_a_resume_that_touches_the_run_is_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """(e)"""
    real = RunWriter.finish

    def spoiling(self: RunWriter) -> Any:
        run = real(self)
        retaken(self.path)
        return open_run(run.path)

    monkeypatch.setattr(RunWriter, "finish", spoiling)
    violation = first_violation(tmp_path, "camera gone", "before the grab")
    assert "was touched by resuming" in violation


def retaken(path: Path) -> None:
    """Write the first row anew, with another time; everything else holds."""
    table = path / "frames.csv"
    header, first, *others = table.read_text().split("\n")
    row = FrameRow.from_text(first, table)
    later = replace(row, time_s=row.time_s - 1e-6).as_text()
    table.write_text("\n".join([header, later, *others]))
