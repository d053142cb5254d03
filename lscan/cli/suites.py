"""``lscan suite``: the suites that there are, what one holds, and whether it is whole."""

from pathlib import Path
from typing import Annotated

import typer

from lscan.cli.arguments import Json
from lscan.cli.console import command_line, print_json, print_table
from lscan.version import __version__

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


@suite.command("show")
def show_suite(name: SuiteName, json: Json = False) -> None:
    """What a suite holds: its cases on each axis."""
    from lscan.suites import axes_of, find_suite, open_suite

    opened = open_suite(find_suite(name))
    content = opened.content
    axes, of_boards = axes_of(content.cases), axes_of(content.boards)
    if json:
        fields = content.model_dump(mode="json", include={"name", "seed", "made_by", "version"})
        counts = {"cases": len(content.cases), "boards": len(content.boards)}
        print_json({**fields, **counts, "axes": axes, "axes_of_boards": of_boards})
        return
    print(
        f"{content.name}: {len(content.cases)} cases, {len(content.boards)} boards, "
        f"seed {content.seed}, {content.made_by}"
    )
    for title, counted in (("cases", axes), ("boards", of_boards)):
        if counted:
            rows = [(axis, value, n) for axis, of in counted.items() for value, n in of.items()]
            print_table(f"{title} by axis", ["axis", "value", title], rows)


@suite.command("verify")
def verify(name: SuiteName, json: Json = False) -> None:
    """Check every byte of a suite against its manifest, and read every case."""
    from lscan.suites import find_suite, verify_suite

    path = find_suite(name)
    content = verify_suite(path).content
    if json:
        counts = {"cases": len(content.cases), "boards": len(content.boards)}
        print_json({"path": str(path), "name": content.name, **counts})
    else:
        cases = len(content.cases) + len(content.boards)
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
    from lscan.suites.wheel import write_suite_wheel

    written = write_suite_wheel(archives, output, name, version)
    if json:
        print_json({"wheel": str(written)})
    else:
        print(written)
