"""The command ``lscan bench``: a thin face over lscan.benchmark."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lscan.cli.console import (
    EXTRACTORS,
    MAPS,
    Json,
    command_line,
    note,
    print_json,
    print_table,
    progress_bar,
)
from lscan.errors import InputError
from lscan.version import __version__

if TYPE_CHECKING:
    from lscan.benchmark.suiterun import SuiteRow, SuiteRun
    from lscan.suites import SuiteContent


def bench(
    named: Annotated[
        list[str] | None, typer.Argument(help="Extractors to judge beside lscan's own.")
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for bench.json and pictures.")
    ] = Path("out/lscan-bench"),
    extractor: Annotated[list[str] | None, typer.Option(help=f"One more: {EXTRACTORS}")] = None,
    plane_map: Annotated[
        list[str] | None, typer.Option("--map", help=f"One more plane map: {MAPS}.")
    ] = None,
    only: Annotated[
        bool, typer.Option("--only", help="Those that are named, and no others.")
    ] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer lines and boards.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of all random numbers.")] = 1,
    suite: Annotated[
        str | None,
        typer.Option("--suite", help="A suite's name or path; drawn: drawn lines as a suite."),
    ] = None,
    by: Annotated[
        list[str] | None,
        typer.Option(
            "--by",
            help="Axis of the suite's table, as `lscan suite show NAME` lists them; several cross.",
        ),
    ] = None,
    boards: Annotated[
        bool,
        typer.Option(
            "--boards", help="Judge by the suite's boards: readers of control points, and --map."
        ),
    ] = False,
    reader: Annotated[
        list[str] | None, typer.Option("--reader", help="One more reader of control points.")
    ] = None,
    chain: Annotated[
        list[str] | None,
        typer.Option("--chain", help="Judge a rig file's chain by the suite's scans."),
    ] = None,
    against: Annotated[
        Path | None, typer.Option("--against", help="bench.json of a run on the same suite.")
    ] = None,
    json: Json = False,
) -> None:
    """Judge extractors, readers of boards, plane maps and chains, one's own too, by the truth.

    The exit code is 1 where one is out of the limits that every method must keep to, or with
    --against where one is worse than it was.
    """
    from lscan.benchmark.judging import CHAINS
    from lscan.benchmark.run import MAPS, registered_extractors
    from lscan.benchmark.suiterun import run_suite

    if reader and not boards:
        raise InputError("is for boards", where="--reader", allowed="--boards beside it")
    more = [*(named or ()), *(extractor or ())]
    if chain:
        if suite is None or quick or boards or plane_map or more:
            raise InputError("is for the scans of a suite", where="--chain",
                             allowed="--suite alone beside it")  # fmt: skip
        with progress_bar("bench") as progress:
            chains = _taking_part(() if only else CHAINS, chain)
            run = run_suite(suite, {"chain": chains}, progress=progress)
        _end_with_run(run, "mm", output, by, against, json)
        return
    if boards:
        if suite is None or quick or more:
            allowed = "--suite, --reader and --map"
            raise InputError("is for readers and maps on a suite", where="--boards",
                             allowed=allowed)  # fmt: skip
        readers = _taking_part(() if only else ("read_board",), reader)
        maps = _taking_part(() if only else MAPS, plane_map)
        with progress_bar("bench") as progress:
            run = run_suite(suite, {"reader": readers, "map": maps}, progress=progress)
        _end_with_run(run, "px, of maps mm", output, by, against, json)
        return
    extractors = _taking_part(() if only else registered_extractors(), more)
    if suite is not None:
        if quick or plane_map:
            allowed = (
                "drawn pictures, or with --boards a suite's" if plane_map else "drawn pictures"
            )
            where = "--map" if plane_map else "--quick"
            raise InputError("is not for the lines of a suite", where=where, allowed=allowed)
        with progress_bar("bench") as progress:
            run = run_suite(suite, {"extractor": extractors}, seed, progress)
        _end_with_run(run, "px", output, by, against, json)
        return
    if by or against:
        where = "--by" if by else "--against"
        raise InputError("is for suites", where=where, allowed="--suite beside it")
    _bench_drawn(
        extractors, _taking_part(() if only else MAPS, plane_map), output, quick, seed, json
    )


def _bench_drawn(
    extractors: tuple[str, ...],
    maps: tuple[str, ...],
    output: Path,
    quick: bool,
    seed: int,
    json: bool,
) -> None:
    from lscan.benchmark.run import EXTRACTOR_COLUMNS, MAP_COLUMNS, run_bench, table_cells

    with progress_bar("bench") as progress:
        done = run_bench(output, extractors, maps, quick, seed, progress)
    if json:
        print_json(done.content)
    else:
        if done.extractors:
            cells = table_cells(done.extractors, EXTRACTOR_COLUMNS)
            print_table("stripe extractors", list(EXTRACTOR_COLUMNS), cells)
        if done.maps:
            print_table("plane maps", list(MAP_COLUMNS), table_cells(done.maps, MAP_COLUMNS))
        refused = {(row.plane_map, row.board, row.refused) for row in done.maps if row.refused}
        for name, board, reason in sorted(refused):
            print(f"{name} on the board {board!r}: refused, {reason}")
        print(f"{output / 'bench.json'}\n{output / 'bench.png'}")
    if done.failed:
        rows = len(done.extractors) + len(done.maps)
        print(f"lscan: {done.failed} of {rows} rows out of their limits", file=sys.stderr)
        raise typer.Exit(1)


def _end_with_run(
    run: "SuiteRun",
    unit: str,
    output: Path,
    by: list[str] | None,
    against: Path | None,
    json: bool,
) -> None:
    """Write and print what became of a suite's cases, and what differs from a saved run."""
    from lscan.benchmark.suiterun import (
        between,
        changes_in_words,
        compare_saved,
        suite_rows,
        usual_axes,
        write_suite_run,
    )

    suite_rows(run, by or ())  # refuses an unknown axis before anything is written
    changed = compare_saved(run, against) if against is not None else []
    content = write_suite_run(output, run, by or usual_axes(run))
    if json:
        print_json({**content, "differences": changed})
    else:
        tables = [by] if by else [[], *([axis] for axis in usual_axes(run))]
        for axes in tables:
            _print_rows(suite_rows(run, axes), unit)
        compared = between(run.sums) if against is None else changed
        for one in compared:
            print(one.in_words)
        if against is not None and changed:
            print(*changes_in_words(run, against), sep="\n")
        if not compared and (against is not None or len(run.sums) > 1):
            print("nothing differs")
        print(output / "bench.json")
    worse = sum(one.worse for one in changed)
    if worse:
        figures = "1 figure is" if worse == 1 else f"{worse} figures are"
        print(f"lscan: {figures} worse than in {against}", file=sys.stderr)
        raise typer.Exit(1)


def leaderboard(
    files: Annotated[list[Path], typer.Argument(help="bench.json of runs on suites.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The page.")] = Path(
        "out/leaderboard.html"
    ),
    json: Json = False,
) -> None:
    """Rank what saved runs on suites say, on a page of its own: a table for each suite."""
    from lscan.benchmark.run import write_leaderboard

    page = write_leaderboard(files, output)
    if json:
        print_json({"page": str(page)})
    else:
        print(page)


def _print_rows(rows: "Sequence[SuiteRow]", unit: str) -> None:
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
    print_table(f"by {', '.join(axes)}" if axes else "all cases", headings, cells)


def _taking_part(usual: tuple[str, ...], more: list[str] | None) -> tuple[str, ...]:
    """The usual ones and those given, each once."""
    return tuple(dict.fromkeys((*usual, *(more or ()))))


# ``lscan suite``: the suites that there are, what one holds, and whether it is whole.


suite = command_line("Suites of rendered pictures with their truth: list, show, verify, wheel.")
SuiteName = Annotated[str, typer.Argument(help="Name of a suite, or its archive or folder.")]


@suite.command("list")
def list_suites(json: Json = False) -> None:
    """The suites of installed packages and of the user's cache."""
    from lscan.suites import suites_found

    found = {name: str(path) for name, path in suites_found().items()}
    if json:
        print_json(found)
        return
    for name, path in found.items():
        print(f"{name}: {path}")
    if not found:
        note(
            "no suites: no installed package brings any, and none was rendered here; `lscan-sim "
            "suite make quick` renders one in minutes, there are also chains and full (hours)"
        )


@suite.command("show")
def show_suite(name: SuiteName, json: Json = False) -> None:
    """What a suite holds: its cases on each axis."""
    from lscan.suites import axes_of, find_suite, open_suite

    opened = open_suite(find_suite(name))
    content = opened.content
    axes = {kind: axes_of(cases) for kind, cases in content.kinds.items()}
    if json:
        fields = content.model_dump(mode="json", include={"name", "seed", "made_by", "version"})
        print_json({**fields, **_counts(content), "axes": axes})
        return
    counts = ", ".join(f"{count} {kind}" for kind, count in _counts(content).items() if count)
    print(f"{content.name}: {counts}, seed {content.seed}, {content.made_by}")
    for kind, counted in axes.items():
        if counted:
            rows = [(axis, value, n) for axis, of in counted.items() for value, n in of.items()]
            print_table(f"{kind} by axis", ["axis", "value", kind], rows)


def _counts(content: "SuiteContent") -> dict[str, int]:
    return {kind: len(cases) for kind, cases in content.kinds.items()}


@suite.command("verify")
def verify(name: SuiteName, json: Json = False) -> None:
    """Check every byte of a suite against its manifest, and read every case."""
    from lscan.suites import find_suite, verify_suite

    path = find_suite(name)
    content = verify_suite(path).content
    if json:
        print_json({"path": str(path), "name": content.name, **_counts(content)})
    else:
        cases = sum(_counts(content).values())
        print(f"{path}: {cases} cases and {len(content.members)} members are whole")


@suite.command("wheel")
def wheel(
    archives: Annotated[list[Path], typer.Argument(help="Archives of suites.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder.")] = Path("out/dist"),
    name: Annotated[str, typer.Option("--name", help="Of the package.")] = "lscan-suites",
    version: Annotated[str, typer.Option("--version", help="Of the package.")] = __version__,
    json: Json = False,
) -> None:
    """Pack suites as a wheel, which lscan finds once pip has installed it."""
    from lscan.suites.files import write_suite_wheel

    written = write_suite_wheel(archives, output, name, version)
    if json:
        print_json({"wheel": str(written)})
    else:
        print(written)
