"""Experiments with one fault each: a scan that meets it, and what must hold afterwards."""

import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil
from pathlib import Path
from typing import Final, Literal

import numpy as np

from lscan.acquisition.run import MANIFEST, TABLE, Run, frame_file, open_run
from lscan.errors import InputError, LscanError
from sim.testing.faultbench import FaultBench
from sim.testing.faults import FRAMES, KINDS, InjectedFault, draw_fault
from sim.testing.marks import read_mark
from sim.validation.rows import Row, row

SEED: Final = 5005
LEAST_STRUCK: Final = 0.81
"""Share of the faults that must be injected, 500 of 621: a scan can be over before their moment."""

PLACE_TOLERANCE_MM: Final = 0.02
"""The rig's ``track.options.tolerance_mm``."""

DEVICE_NAMES: Final = {"camera": "camera opencv (device 0): ", "track": "grbl track on bench: "}


@dataclass(frozen=True)
class Outcome:
    """What became of one experiment.

    ended: "tolerated" where the scan came to its end in spite of the fault, else "stopped".
    message: its error line.  kept: frames on disk when it ended.  violation: the first thing
    that did not hold, "" where all did.
    """

    fault: InjectedFault
    seed: int
    injected: bool
    ended: Literal["tolerated", "stopped"]
    message: str
    kept: int
    violation: str


class Violation(Exception):
    """Something that must hold after a fault does not."""


def run_campaign(
    count: int, seed: int, folder: Path, kinds: Sequence[str] = tuple(KINDS)
) -> list[Outcome]:
    """The outcomes of ``count`` experiments, each with one fault.

    The kinds come in turn, each as often as the others; moment and strength of each fault are
    drawn from a generator of seed and number.  folder: for the runs; those of clean
    experiments are removed.
    """
    outcomes = []
    for number in range(count):
        generator = np.random.default_rng([seed, number])
        fault = draw_fault(kinds[number % len(kinds)], generator)
        outcomes.append(run_experiment(fault, seed + number, folder / f"{number:04d}"))
    return outcomes


def run_experiment(fault: InjectedFault, seed: int, path: Path) -> Outcome:
    """The outcome of one scan into the folder ``path`` that meets the fault, and is resumed."""
    ended: Literal["tolerated", "stopped"] = "tolerated"
    message, kept, violation = "", 0, ""
    error: BaseException | None = None
    bench = FaultBench(fault, path, seed)
    try:
        bench.scan()
    except Exception as caught:
        error, ended = caught, "stopped"
        message = "; ".join([str(caught), *getattr(caught, "__notes__", ())])
    finally:
        injected = bench.injected
        bench.clear()  # or a reading thread would be left hanging
    try:
        kept = _check_all(bench, error, message)
    except Violation as found:
        violation = str(found)
    if not violation:
        shutil.rmtree(path)
    return Outcome(fault, seed, injected, ended, message.replace(str(path), "RUN"), kept, violation)


def fault_rows(each: int, seed: int = SEED) -> tuple[list[Row], list[Outcome]]:
    """How many faults were injected and how many did not end clean, and all outcomes.

    each: how many of each kind.
    """
    count = each * len(KINDS)
    with tempfile.TemporaryDirectory(prefix="lscan-faults-") as folder:
        outcomes = run_campaign(count, seed, Path(folder))
    injected = sum(outcome.injected for outcome in outcomes)
    unclean = sum(bool(outcome.violation) for outcome in outcomes)
    least = ceil(LEAST_STRUCK * count)
    return [
        row("faults-injected", injected, bar=least, seed=seed, each=each),
        row("faults-unclean", unclean, seed=seed),
    ], outcomes


def kind_cells(outcomes: Sequence[Outcome]) -> list[list[str]]:
    """Cells of a table: kind of fault, and how many were injected, tolerated, stopping, unclean.

    Parameters
    ----------
    outcomes : sequence, of the campaign's experiments
    """
    counts: dict[str, Counter[str]] = {kind: Counter() for kind in KINDS}
    for outcome in outcomes:
        if outcome.injected:
            counts[outcome.fault.kind].update(["injected", outcome.ended])
        if outcome.violation:
            counts[outcome.fault.kind]["unclean"] += 1
    columns = ("injected", "tolerated", "stopped", "unclean")
    return [[kind, *(str(count[column]) for column in columns)] for kind, count in counts.items()]


# ---- what must hold -------------------------------------------------------------------------


def _check_all(bench: FaultBench, error: BaseException | None, message: str) -> int:
    """The number of frames kept; raises Violation for the first thing that does not hold."""
    check_message(bench, error, message)
    path = bench.folder
    kept = check_folder(path)
    _hold(
        kept >= bench.reported,
        f"lost: {bench.reported} frames were reported as done, {kept} are on disk",
    )
    before = _recorded(path, kept)
    if kept and not _is_torn(path):
        check_frames(open_run(path), bench)
    try:
        run = bench.scan()
    except LscanError as again:
        raise Violation(f"does not go on: {again}") from again
    _hold(run.state == "complete" and len(run) == FRAMES, "resumed, but not complete")
    check_folder(path)
    check_frames(run, bench)
    _hold(_recorded(path, kept) == before, "a recorded frame was touched by resuming")
    expected = {frame_file(path, index).name for index in range(FRAMES)}
    _hold(_names(path / "frames") == expected, "frames/ holds what is no frame")
    _hold(_names(path) == {MANIFEST, TABLE, "frames"}, "the folder holds what is no run")
    return kept


def check_message(bench: FaultBench, error: BaseException | None, message: str) -> None:
    """(a) Borne, or ended in one line that names the device or file and says what to do."""
    kind = KINDS[bench.fault.kind]
    if error is None:
        return
    _hold(isinstance(error, LscanError), f"ended in {type(error).__name__}: {error}")
    _hold(kind.says != "", f"should have been tolerated: {message}")
    _hold("\n" not in message, f"more than one line: {message!r}")
    named = DEVICE_NAMES.get(kind.device, str(bench.folder))
    _hold(message.startswith(named), f"does not name the device or file: {message}")
    _hold(re.search(kind.says, message) is not None, f"does not say what to do: {message}")
    if bench.asked_s:  # a folder was begun, for something was to be written into it
        _hold("go on with --resume" in message, f"does not say what is kept: {message}")


def check_folder(path: Path) -> int:
    """(b) The folder opens and is whole; the number of its frames, 0 where there is none.

    A last row torn because the disk could not even be cut back is reported, with the remedy.
    """
    if not path.exists():
        return 0
    try:
        run = open_run(path)
        run.verify()
        return len(run)
    except InputError as error:
        if "the last row is torn; lscan scan --resume cuts it off" in str(error):
            return len(_rows(path))
        raise Violation(f"does not open: {error}") from error


def check_frames(run: Run, bench: FaultBench) -> None:
    """(c) Each picture was exposed after it was asked for, at rest where it says, once."""
    counters = []
    for index, frame in enumerate(run.frames()):
        mark = read_mark(frame.image)
        if mark is None:
            raise Violation(f"frame {index} is no picture of this camera")
        planned_mm = bench.rig_file.rig.plan.positions_mm()[index]
        _hold(frame.commanded_mm == planned_mm, f"frame {index} was not sent where planned")
        for name in ("commanded_mm", "position_mm"):
            stated_mm = getattr(frame, name)
            _hold(
                abs(mark.head_mm - stated_mm) <= PLACE_TOLERANCE_MM,
                f"frame {index} was exposed at {mark.head_mm:.4f} mm, {name} is {stated_mm:.4f} mm",
            )
        _hold(not mark.moving, f"frame {index} was exposed while the head moved")
        _hold(
            mark.exposed_s >= bench.asked_s[index],
            f"frame {index} was exposed {bench.asked_s[index] - mark.exposed_s:.4f} s before "
            "it was asked for",
        )
        counters.append(mark.counter)
    _hold(all(a < b for a, b in pairwise(counters)), f"pictures repeat: {counters}")


def _hold(condition: bool, otherwise: str) -> None:
    if not condition:
        raise Violation(otherwise)


def _names(folder: Path) -> set[str]:
    return {entry.name for entry in folder.iterdir()}


def _is_torn(path: Path) -> bool:
    return not (path / TABLE).read_bytes().endswith(b"\n")


def _rows(path: Path) -> list[bytes]:
    """The whole rows of the table."""
    return (path / TABLE).read_bytes().split(b"\n")[1:-1]


def _recorded(path: Path, kept: int) -> list[tuple[bytes, bytes]]:
    """Row and picture file of each of the first ``kept`` frames."""
    rows = _rows(path) if kept else []
    return [(rows[index], frame_file(path, index).read_bytes()) for index in range(kept)]
