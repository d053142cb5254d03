"""The commands ``lscan bench`` and ``lscan leaderboard``: thin faces over lscan.benchmark."""

import sys
from collections.abc import Sequence
from pathlib import Path

import typer
from rich.table import Table
from typer import Argument, Option

from lscan.benchmark import run as drawn, suiterun
from lscan.benchmark.judging import CHAINS
from lscan.cli.console import EXTRACTORS, MAPS, Json, progress_bar, show, table
from lscan.errors import InputError


def bench(
    named: list[str] | None = Argument(None, help="Extractors to judge as well as lscan's own."),
    output: Path = Option(
        Path("out/lscan-bench"), "--output", "-o", help="Folder for bench.json and pictures."
    ),
    extractor: list[str] | None = Option(None, help=f"Another extractor: {EXTRACTORS}"),
    plane_map: list[str] | None = Option(None, "--map", help=f"Another plane map: {MAPS}."),
    only: bool = Option(False, "--only", help="Judge only those that are named."),
    quick: bool = Option(False, "--quick", help="Fewer lines and boards."),
    seed: int = Option(1, min=0, help="Seed of all random numbers."),
    suite: str | None = Option(None, help="Suite: its name or path, or drawn for drawn lines."),
    by: list[str] | None = Option(
        None, help="Axis of the table, from `lscan suite show NAME`; repeat to cross several."
    ),
    boards: bool = Option(
        False, "--boards", help="Judge board readers and plane maps by the suite's boards."
    ),
    reader: list[str] | None = Option(None, help="Another board reader to judge."),
    chain: list[str] | None = Option(None, help="Rig file; judge its chain by the suite's scans."),
    against: Path | None = Option(None, help="bench.json of an earlier run on the same suite."),
    json: Json = False,
) -> None:
    """Judge extractors, board readers, plane maps and chains, your own too, against the truth.

    The exit code is 1 if one exceeds the limits that are set for every method or, with --against,
    if one is worse than it was.
    """
    if reader and not boards:
        raise InputError("needs --boards", where="--reader")
    more = [*(named or ()), *(extractor or ())]
    extractors = () if chain or boards else _each_once(only, drawn.registered_extractors(), more)
    maps = _each_once(only, drawn.MAPS, plane_map)
    if chain and (suite is None or quick or boards or plane_map or more):
        raise InputError("needs the scans of a suite", where="--chain", allowed="--suite alone")
    if boards and (suite is None or quick or more):
        allowed = "--suite, --reader and --map"
        raise InputError("needs the boards of a suite", where="--boards", allowed=allowed)
    if suite is None:
        if by or against:
            where = "--by" if by else "--against"
            raise InputError("needs --suite", where=where)
        _judge_drawn(extractors, maps, output, quick, seed, json)
        return
    if not chain and not boards and (quick or plane_map):
        allowed = "without --suite, or with --boards" if plane_map else "without --suite"
        where = "--map" if plane_map else "--quick"
        raise InputError("does not apply to the lines of a suite", where=where, allowed=allowed)
    if chain:
        roles, unit = {"chain": _each_once(only, CHAINS, chain)}, "mm"
    elif boards:
        readers = _each_once(only, ("read_board",), reader)
        roles, unit = {"reader": readers, "map": maps}, "px, of maps mm"
    else:
        roles, unit = {"extractor": extractors}, "px"
    with progress_bar("bench") as progress:
        run = suiterun.run_suite(suite, roles, seed, progress)
    _end_with_run(run, unit, output, by, against, json)


def _each_once(only: bool, usual: tuple[str, ...], more: list[str] | None) -> tuple[str, ...]:
    """The usual ones, unless only those given are asked for, and those given."""
    return tuple(dict.fromkeys((*(() if only else usual), *(more or ()))))


def _judge_drawn(
    extractors: tuple[str, ...],
    maps: tuple[str, ...],
    output: Path,
    quick: bool,
    seed: int,
    json: bool,
) -> None:
    """Judge by drawn lines and boards; exit code 1 where one is out of its limits."""
    with progress_bar("bench") as progress:
        done = drawn.run_bench(output, extractors, maps, quick, seed, progress)
    lines: list[str | Table] = []
    if done.extractors:
        cells = drawn.table_cells(done.extractors, drawn.EXTRACTOR_COLUMNS)
        lines.append(table("stripe extractors", list(drawn.EXTRACTOR_COLUMNS), cells))
    if done.maps:
        cells = drawn.table_cells(done.maps, drawn.MAP_COLUMNS)
        lines.append(table("plane maps", list(drawn.MAP_COLUMNS), cells))
    refused = {(row.plane_map, row.board, row.refused) for row in done.maps if row.refused}
    for name, board, reason in sorted(refused):
        lines.append(f"{name} on the board {board!r}: refused, {reason}")
    files = f"{output / 'bench.json'}\n{output / 'bench.png'}"
    show(done.content, *lines, files, json=json)
    if done.failed:
        rows = len(done.extractors) + len(done.maps)
        print(f"lscan: {done.failed} of {rows} rows are outside their limits", file=sys.stderr)
        raise typer.Exit(1)


def _end_with_run(
    run: suiterun.SuiteRun,
    unit: str,
    output: Path,
    by: list[str] | None,
    against: Path | None,
    json: bool,
) -> None:
    """Write and print what became of a suite's cases, and what differs from a saved run."""
    suiterun.suite_rows(run, by or ())  # refuses an unknown axis before anything is written
    changed = suiterun.compare_saved(run, against) if against is not None else []
    usual = suiterun.usual_axes(run)
    content = suiterun.write_suite_run(output, run, by or usual)
    tables = [by] if by else [[], *([axis] for axis in usual)]
    lines: list[str | Table] = [_rows_table(run, axes, unit) for axes in tables]
    compared = suiterun.between(run.sums) if against is None else changed
    lines += [one.in_words for one in compared]
    if against is not None and changed:
        lines += suiterun.changes_in_words(run, against)
    if not compared and (against is not None or len(run.sums) > 1):
        lines.append("nothing differs")
    show({**content, "differences": changed}, *lines, str(output / "bench.json"), json=json)
    if worse := sum(one.worse for one in changed):
        figures = "1 figure is" if worse == 1 else f"{worse} figures are"
        print(f"lscan: {figures} worse than in {against}", file=sys.stderr)
        raise typer.Exit(1)


def _rows_table(run: suiterun.SuiteRun, by: Sequence[str], unit: str) -> Table:
    rows = suiterun.suite_rows(run, by)
    axes = list(rows[0].group)
    headings = ["", *axes, "cases", f"bias {unit}", "scatter", "to bound", "found %",
                "wrong %", "sure %", "ghosts %", "3 sigma %", "z", "time"]  # fmt: skip
    cells = [
        [row.extractor, *row.group.values(), row.cases, f"{row.bias_px:+.4f}",
         f"{row.scatter_px:.4f}", f"{row.bound_ratio:.2f}"]
        + [f"{100 * share:.1f}" for share in (row.found, row.wrong, row.sure, row.ghosts,
                                              row.within_3_sigma)]
        + [f"{row.z_ratio:.2f}", f"{row.time:.2f}"]
        for row in rows
    ]  # fmt: skip
    return table(f"by {', '.join(axes)}" if axes else "all cases", headings, cells)


def leaderboard(
    files: list[Path] = Argument(help="bench.json files of runs on suites."),
    output: Path = Option(Path("out/leaderboard.html"), "--output", "-o", help="Page to write."),
    json: Json = False,
) -> None:
    """Rank the methods of saved runs on suites on a page, with a table for each suite."""
    page = str(drawn.write_leaderboard(files, output))
    show({"page": page}, page, json=json)
