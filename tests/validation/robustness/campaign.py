"""Experiments with one fault each: a scan that meets it, and what must hold afterwards."""

import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import pairwise
from math import ceil
from pathlib import Path
from typing import Final, Literal
from unittest.mock import patch

import numpy as np

from lscan.acquisition.run import MANIFEST, TABLE, Run, frame_file, open_run
from lscan.config.documents import toml_text
from lscan.config.plugins import find_plugin, installed
from lscan.config.rig import load_rig
from lscan.errors import InputError, LscanError
from tests.validation.robustness.faults import FRAMES, KINDS, FaultBench, InjectedFault, draw_fault
from tests.validation.robustness.faulty import read_mark
from tests.validation.robustness.rigfiles import (
    MOST_SHOWN,
    GoodRig,
    WrongField,
    crossed_rigs,
    dotted,
    good_rigs,
    write_beside,
    wrong_fields,
)
from tests.validation.rows import Row, row

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


# Every field of a rig file set wrong, one at a time: refused by its key, and no device touched.
#
# Each wrong rig (tests.validation.robustness.rigfiles) is read from a real file.


NOT_OURS = re.compile(r"(?i)input should|validation error|traceback|constrained|nonetype|pydantic")
"""Words that no message may hold: they speak of the program, not of the file."""


def shortcoming(wrong: WrongField, file: Path, read: Callable[[Path], object] = load_rig) -> str:
    """Why the refusal of a wrong rig, written to ``file``, falls short; "" where it does not.

    read: what reads a rig file.
    """
    file.unlink(missing_ok=True)  # to write over a file waits for the disk
    file.write_text(toml_text(wrong.document), encoding="utf-8")
    return fault_of_refusal(wrong, file, read)


def fault_of_refusal(wrong: WrongField, file: Path, read: Callable[[Path], object]) -> str:
    """Why the refusal of a wrong rig falls short; "" where it does not.

    Parameters
    ----------
    wrong : WrongField, what is wrong
    file : Path, that the rig is read from
    read : callable, what reads a rig file
    """
    try:
        read(file)
    except InputError as error:
        return _lacking(str(error), wrong, file)
    except Exception as error:
        return f"raises {type(error).__name__}: {error}"
    return "is accepted"


def _lacking(message: str, wrong: WrongField, file: Path) -> str:
    """What a message does not say of a wrong field, with the message; "" where it says all."""
    shown = [] if wrong.change is None else [f"got {repr(wrong.change)[:MOST_SHOWN]}"]
    lacking, rest = [], message
    for text in (str(file), dotted(wrong.keys), *shown):
        lacking += [] if text in message else [text]
        rest = rest.replace(text, "", 1)  # a limit of 0 is not said by a path with a 0 in it
    lacking += [word for word in wrong.words if not _says(rest, word)]
    if "\n" in message:
        lacking.append("one line")
    if NOT_OURS.search(message):
        lacking.append("words of the file alone")
    return f"lacks {lacking}: {message}" if lacking else ""


def _says(text: str, word: str) -> bool:
    """Whether a text holds a word; a number must stand alone in it."""
    return re.search(rf"(?<![\w.-]){re.escape(word)}(?!\w|\.\d)", text) is not None


@contextmanager
def devices_guarded() -> Iterator[list[str]]:
    """The devices opened while this lasts, of all drivers installed; none is really opened."""
    touched: list[str] = []

    def opening(name: str) -> Callable[..., None]:
        def opened(*_: object, **__: object) -> None:
            touched.append(name)
            raise AssertionError(f"{name} was opened")

        return opened

    targets = ["cv2.VideoCapture", "serial.Serial", "sim.devices.SimCamera", "sim.devices.SimTrack"]
    with ExitStack() as stack:
        for group in ("lscan.cameras", "lscan.tracks"):
            for name in installed(group):
                kind = type(find_plugin(group, name))
                stack.enter_context(patch.object(kind, "open", opening(f"{group} {name}")))
        for target in targets:
            stack.enter_context(patch(target, opening(target)))
        yield touched


def try_all(every: int = 1) -> tuple[list[tuple[WrongField, str]], list[str]]:
    """Every wrong rig, or one in so many, and the devices that were touched.

    Beside each rig why its refusal falls short, "" where it does not.  Raises AssertionError
    where a rig that ought to be right is refused.
    """
    rigs = good_rigs()
    with tempfile.TemporaryDirectory() as name, devices_guarded() as touched:
        folder = Path(name)
        write_beside(folder)
        for rig in rigs:
            _assert_good(rig, folder / "good.toml")
        wrongs = [wrong for rig in rigs for wrong in wrong_fields(rig)]
        wrongs += crossed_rigs(rigs)
        file = folder / "my-rig.toml"
        return [(wrong, shortcoming(wrong, file)) for wrong in wrongs[::every]], touched


def _assert_good(rig: GoodRig, file: Path) -> None:
    file.write_text(toml_text(rig.document), encoding="utf-8")
    try:
        load_rig(file)
    except InputError as error:
        raise AssertionError(f"the rig {rig.name} ought to be right: {error}") from error


def field_rows(every: int = 1) -> list[Row]:
    """The figures for a rig file with any one field wrong: how many, refused how, touching what.

    every: one in so many of them is tried.
    """
    tried, touched = try_all(every)
    return [
        row("fields-tried", len(tried), bar=500 // every),
        row("fields-badly-refused", sum(fault != "" for _, fault in tried)),
        row("fields-touching-devices", len(touched)),
    ]
