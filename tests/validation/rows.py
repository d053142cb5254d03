"""Rows, a figure beside its bar each, and the topics and requests that they are measured for."""

import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import isfinite, nan
from pathlib import Path
from typing import Any

from scipy.special import ndtr

from lscan.errors import LscanError
from lscan.figures.page import ReportFigure
from lscan.files.disk import make_folder, packaged_table, write_json

# The rows of every figures file: a figure beside its bar, and what it was held against.


@dataclass(frozen=True)
class Row:
    """One figure: how far something is from its reference, and how far it may be.

    Attributes
    ----------
    what : str, the quantity
    reference : str, the closed form, the published value or the renderer it is held against
    figure : float, as measured, in ``unit``
    bar : float or None, the largest figure allowed, in ``unit``; None where the figure is only
        reported
    unit : str, of figure and bar
    tolerance_from : str, where the bar comes from
    seed : int or None, of the random numbers used, None where there are none
    at_least : bool, the figure must instead be no smaller than the bar
    noisy : bool, noise moves the figure, so that the few samples of a quick run may put it beyond
        its bar
    quick : bool, it was measured in such a run
    power : float or None, the probability that the figure would be beyond its bar with the fault
        that the row is there for, by default a deviation FAULT times as large as required; None
        where chance plays no part, or where it is not known.  A row with less than LEAST_POWER
        decides nothing where it is within its bar, and is not judged
    error : str, what kept it from being measured, "" where nothing did
    """

    what: str
    reference: str
    figure: float
    bar: float | None
    unit: str
    tolerance_from: str
    seed: int | None = None
    at_least: bool = False
    noisy: bool = False
    quick: bool = False
    power: float | None = None
    error: str = ""

    @property
    def decides(self) -> bool:
        """Whether the row would see its fault."""
        return self.power is None or self.power >= LEAST_POWER

    @property
    def passed(self) -> bool | None:
        """Whether the figure is a number on the right side of its bar.

        None where a number is not judged: it has no bar, a quick run's noise could spoil it, or it
        would be within its bar with the fault too.
        """
        if self.error or not isfinite(self.figure):
            return False
        if self.bar is None or (self.quick and self.noisy):
            return None
        if not (self.figure >= self.bar if self.at_least else self.figure <= self.bar):
            return False
        return True if self.decides else None

    def as_json(self) -> dict[str, Any]:
        """The row as the figures file holds it; a figure that is no number is null there."""
        written = asdict(self) | {
            "figure": float(self.figure) if isfinite(self.figure) else None,
            "bar": None if self.bar is None else float(self.bar),
            "passed": self.passed,
        }
        left_out = {"noisy", *(name for name in ("at_least", "error") if not written[name])}
        if self.power is None:
            left_out.add("power")
        return {name: value for name, value in written.items() if name not in left_out}


ROWS: Mapping[str, Mapping[str, Any]] = packaged_table("tests.validation", "rows.toml")


FAULT, LEAST_POWER = 2.0, 0.9


def power_of(fault: float, bar: float, noise: float) -> float:
    """The probability that a figure is beyond its bar.

    Parameters
    ----------
    fault : float, what the figure would be without noise
    bar : float, its upper limit
    noise : float, the figure's standard uncertainty, taken for normal
    """
    return float(ndtr((fault - bar) / noise)) if noise > 0 else float(fault > bar)


def row(
    key: str,
    figure: float,
    *,
    bar: float | None = None,
    seed: int | None = None,
    sigma: float | None = None,
    power: float | None = None,
    **words: Any,
) -> Row:
    """The row of that key of rows.toml.

    bar: where the table has none.  sigma: the figure's standard uncertainty, of which follows how
    surely FAULT times the bar would be seen; or that power itself.  words: what stands in the
    braces of its texts.
    """
    texts: dict[str, Any] = {
        name: value.format(**words) if isinstance(value, str) else value
        for name, value in ROWS[key].items()
    }
    found = Row(**{"bar": bar, **texts}, figure=figure, seed=seed, power=power)
    if sigma is None or found.bar is None:
        return found
    return replace(found, power=power_of(FAULT * found.bar, found.bar, sigma))


@dataclass(frozen=True)
class ScenePicture:
    """A picture for the page: its scene's name and file, and the JPEG as a data URI.

    compared: it shows the way its light of higher orders was rendered, beside the other way.
    """

    name: str
    file: str
    uri: str
    compared: bool = False


@dataclass(frozen=True)
class Topic:
    """One topic of the page.

    key: short name, unique on the page.  title: a few words.  text: what is compared and
    why that convinces, two or three sentences.  figures, pictures: for the page.  seconds: how
    long it took to measure.
    """

    key: str
    title: str
    text: str
    rows: tuple[Row, ...]
    figures: tuple[ReportFigure, ...] = ()
    pictures: tuple[ScenePicture, ...] = ()
    seconds: float = 0.0


@dataclass(frozen=True)
class Request:
    """What a run of the validation is asked for.

    scenes: folder of the scene files.  folder: where runs and other files go beside the rows.
    quick: every row, with the least effort.  full: with all the effort there is, where a theme
    knows more than the usual one.  photographs: folder of the real pictures, whose rows are left
    out where it is None.
    """

    scenes: Path
    folder: Path
    quick: bool = False
    full: bool = False
    photographs: Path | None = None


Chapter = Callable[[], "list[Row] | Topic"]
Chapters = Mapping[str, Chapter]


class RowFile:
    """A figures file that always holds all the rows measured so far.

    Parameters
    ----------
    path : Path
        The JSON file, a list of rows; its folder is made.
    quick : bool
        Whether the rows are those of a quick run, and marked as such.

    Raises
    ------
    InputError
        Where the disk refuses, before anything has been measured.
    """

    def __init__(self, path: Path, quick: bool) -> None:
        self.path, self.quick = path, quick
        self._parts: dict[int, list[Row]] = {}
        self._write()

    @property
    def rows(self) -> list[Row]:
        """All rows so far, in the order of their places."""
        return [row for _, part in sorted(self._parts.items()) for row in part]

    def add(self, rows: Iterable[Row], place: int | None = None) -> list[Row]:
        """The rows, marked where the run is quick, once the file holds them too.

        place: their rank in the file, behind all others if None.
        """
        part = [replace(row, quick=self.quick) for row in rows]
        self._parts[max(self._parts, default=-1) + 1 if place is None else place] = part
        self._write()
        return part

    def _write(self) -> None:
        write_rows(self.path, self.rows)


def measured_rows(what: str, measure: Callable[[], Iterable[Row]]) -> list[Row]:
    """The rows that ``measure`` returns; a single failed one where it ends with an error.

    Parameters
    ----------
    what : str, what is measured; the name of the failed row
    measure : callable, takes nothing and returns rows
    """
    try:
        return list(measure())
    except Exception as error:  # whatever it is, the other figures are still wanted
        return [failed_row(what, error)]


def topic_of(name: str, chapter: Chapter) -> Topic:
    """What a chapter measures; where it ends with an error, a failed row that says so.

    Parameters
    ----------
    name : str, of the chapter
    chapter : callable, takes nothing and returns rows or a topic
    """
    key, text, started = name.replace(" ", "-"), "", time.perf_counter()
    try:
        found = chapter()
    except Exception as error:  # whatever it is, the other figures are still wanted
        found, text = [failed_row(name, error)], "It ended with an error and has no figures."
    if not isinstance(found, Topic):
        found = Topic(key, name.capitalize(), text, tuple(found))
    return replace(found, seconds=found.seconds or time.perf_counter() - started)


def failed_row(what: str, error: Exception) -> Row:
    """The row of a measurement that ended with ``error``: no figure, and the message."""
    message = " ".join(str(error).split())
    if not isinstance(error, LscanError):  # an error of the program: say where it arose
        place = traceback.extract_tb(error.__traceback__)[-1:]
        arose = "".join(f" ({Path(frame.filename).name}:{frame.lineno})" for frame in place)
        message = f"{type(error).__name__}: {message}{arose}"
    return Row(what, "none: not measured", nan, None, "", "every row is measured", error=message)


def all_passed(rows: Iterable[Row]) -> bool:
    """Whether no row failed; rows that are not judged do not count.

    Parameters
    ----------
    rows : iterable, of any chapters
    """
    return all(row.passed is not False for row in rows)


def rows_of(topics: Iterable[Topic]) -> list[Row]:
    """All rows of the topics, in order."""
    return [row for topic in topics for row in topic.rows]


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write the rows as a JSON list.

    Parameters
    ----------
    path : Path, the file; its folder is made
    rows : sequence, of any chapters

    Raises
    ------
    InputError
        The disk refuses.
    """
    make_folder(path.parent)
    write_json(path, [row.as_json() for row in rows])


def undecided(row: Row) -> str:
    """That a row decides nothing, for behind what it is; "" where it does."""
    if row.decides:
        return ""
    return f" (decides nothing: would see its fault with a probability of {row.power:.0%})"


HEADINGS = ("what", "figure", "bar", "unit", "within")
VERDICTS = {True: "yes", False: "NO", None: "-"}


def table_cells(rows: Iterable[Row]) -> list[list[str]]:
    """Cells of the printed table beneath HEADINGS; an error follows what it prevented.

    Parameters
    ----------
    rows : iterable, of any chapters
    """
    return [
        [
            row.what + (f": {row.error}" if row.error else "") + undecided(row),
            number(row.figure),
            "" if row.bar is None else number(row.bar),
            row.unit,
            VERDICTS[row.passed],
        ]
        for row in rows
    ]


def number(value: float) -> str:
    """The number with two significant digits, or whole; powers of ten for very small and large.

    A figure just below a hundred percent keeps a decimal.
    """
    if value == 0 or not isfinite(value):
        return f"{value:g}"
    if abs(value) >= 100:
        return f"{value:.0f}" if abs(value) < 1e6 else f"{value:.1e}"
    if abs(value) >= 99:
        return f"{value:.1f}"
    return f"{value:.2g}" if abs(value) >= 1e-3 else f"{value:.1e}"
