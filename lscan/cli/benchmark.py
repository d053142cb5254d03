"""The command ``lscan bench``: a thin face over lscan.benchmark."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from lscan.cli.arguments import Json
from lscan.cli.console import print_json, print_table, progress_bar


def bench(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for bench.json and bench.png.")
    ] = Path("out/lscan-bench"),
    extractor: Annotated[
        list[str] | None, typer.Option(help="One more: a name, or package.module:function.")
    ] = None,
    plane_map: Annotated[
        list[str] | None, typer.Option("--map", help="One more plane map, such as polynomial-4.")
    ] = None,
    only: Annotated[
        bool, typer.Option("--only", help="Those of --extractor and --map, and no others.")
    ] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer lines and boards.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of all random numbers.")] = 1,
    json: Json = False,
) -> None:
    """Judge stripe extractors and plane maps, one's own too, where the truth is known.

    The exit code is 1 where one is out of the limits that every method must keep to.
    """
    from lscan.benchmark.page import EXTRACTOR_COLUMNS, MAP_COLUMNS, table_cells
    from lscan.benchmark.run import MAPS, registered_extractors, run_bench

    extractors = _taking_part(() if only else registered_extractors(), extractor)
    maps = _taking_part(() if only else MAPS, plane_map)
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


def _taking_part(usual: tuple[str, ...], more: list[str] | None) -> tuple[str, ...]:
    """The usual ones and those given, each once."""
    return tuple(dict.fromkeys((*usual, *(more or ()))))
