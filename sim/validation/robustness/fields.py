"""Every field of a rig file set wrong, one at a time: refused by its key, and no device touched.

Each wrong rig (sim.testing.wrongfields) is read from a real file.
"""

import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from unittest.mock import patch

from lscan.config.documents import toml_text
from lscan.config.plugins import find_plugin, installed
from lscan.config.rig import load_rig
from lscan.errors import InputError
from sim.testing.goodrigs import GoodRig, good_rigs, write_beside
from sim.testing.wrongfields import MOST_SHOWN, WrongField, crossed_rigs, dotted, wrong_fields
from sim.validation.rows import Row, row

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
