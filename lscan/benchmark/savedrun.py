"""Runs on suites kept in files: bench.json, and what differs from one."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from typing import Any

from lscan.benchmark.against import Difference, before_and_after, differences
from lscan.benchmark.judging import SUMS, CaseSums
from lscan.benchmark.suiterun import SuiteRun, suite_rows
from lscan.benchmark.worst import draw_worst
from lscan.config.plugins import others_versions
from lscan.errors import InputError
from lscan.files.disk import make_folder, read_json, write_atomically, write_json

VERSION = 1
MOST_SAVED_BYTES = 2**28
_GROUPS = ("lscan.extractors", "lscan.boardreaders", "lscan.planemaps")


@dataclass(frozen=True)
class SavedRun:
    """What a bench.json says.

    Attributes
    ----------
    suite : str, the suite's identity: runs of another are not comparable
    sums : mapping, by method and case
    rows : sequence of mappings, of its table, as SuiteRow
    """

    suite: str
    sums: Mapping[str, Mapping[str, CaseSums]]
    rows: Sequence[Mapping[str, Any]]


def write_suite_run(folder: Path, run: SuiteRun, by: Sequence[str]) -> dict[str, Any]:
    """Write bench.json, and the worst columns of each extractor as a picture.

    Parameters
    ----------
    folder : Path, made where it is missing
    run : SuiteRun
    by : sequence of str, the axes of the table in bench.json

    Returns
    -------
    What bench.json holds.
    """
    make_folder(folder)
    content = saved_run(run, by)
    write_json(folder / "bench.json", content)
    for one in run.judged:
        if one.worst:
            name = one.extractor.replace(":", ".")
            write_atomically(folder / f"worst-{name}.png", draw_worst(one))
    return content


def saved_run(run: SuiteRun, by: Sequence[str] = ()) -> dict[str, Any]:
    """What bench.json holds of a run, of JSON types; ``compare_saved`` takes such a file.

    Parameters
    ----------
    run : SuiteRun
    by : sequence of str, the axes of its table
    """
    return {
        "version": VERSION,
        "suite": run.identity,
        "packages": {
            package: version
            for one in run.judged
            for group in _GROUPS
            for package, version in others_versions(group, one.extractor).items()
        },
        "rows": [asdict(row) for row in suite_rows(run, by)],
        "sums": list(SUMS),
        "extractors": {
            one.extractor: {case: list(astuple(sums)) for case, sums in one.sums.items()}
            for one in run.judged
        },
    }


def read_saved(file: Path) -> SavedRun:
    """The saved run in a file.

    Parameters
    ----------
    file : Path, a bench.json

    Raises
    ------
    InputError
        The file is none.
    """
    content = read_json(file, MOST_SAVED_BYTES)
    try:
        known = [list(SUMS), list(SUMS[:-1])]  # runs of before have no scores
        if content["version"] != VERSION or content["sums"] not in known:
            raise ValueError
        sums = {
            str(name): {case: CaseSums(*map(float, of)) for case, of in cases.items()}
            for name, cases in content["extractors"].items()
        }
        rows = [
            {**row, "cases": int(row["cases"]), "extractor": str(row["extractor"]),
             "time": None if row["time"] is None else float(row["time"])}
            for row in content["rows"]
        ]  # fmt: skip
        return SavedRun(str(content["suite"]), sums, rows)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        allowed = "a bench.json of lscan bench --suite"
        raise InputError("is no saved run", where=file, allowed=allowed) from error


def compare_saved(run: SuiteRun, file: Path) -> list[Difference]:
    """What differs from a saved run of the same suite, for each method that both have.

    Parameters
    ----------
    run : SuiteRun
    file : Path, a bench.json

    Raises
    ------
    InputError
        The file is none, or of another suite, or has none of the methods.
    """
    found = [differences(name, now, before) for name, now, before in _in_both(run, file)]
    return [one for of in found for one in of]


def changes_in_words(run: SuiteRun, file: Path) -> list[str]:
    """A line for each method of a run and of a saved run: its bias and rms error in both.

    Parameters
    ----------
    run : SuiteRun
    file : Path, a bench.json

    Raises
    ------
    InputError
        As ``compare_saved``.
    """
    return [f"{name}: {before_and_after(now, old)}" for name, now, old in _in_both(run, file)]


def _in_both(
    run: SuiteRun, file: Path
) -> list[tuple[str, Mapping[str, CaseSums], Mapping[str, CaseSums]]]:
    """Of the methods that a run and a saved run have, name, sums of the run, and saved sums."""
    saved = read_saved(file)
    if saved.suite != run.identity:
        raise InputError("is of another suite", where=file, value=saved.suite, allowed=run.identity)
    both = [one for one in run.judged if one.extractor in saved.sums]
    if not both:
        allowed = ", ".join(saved.sums)
        raise InputError("has none of these extractors", where=file, allowed=allowed)
    return [(one.extractor, one.sums, saved.sums[one.extractor]) for one in both]
