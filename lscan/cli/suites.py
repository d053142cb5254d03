"""``lscan suite``: the suites that there are, what one holds, and whether it is whole."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lscan.cli.arguments import Json
from lscan.cli.console import command_line, note, print_json, print_table
from lscan.version import __version__

if TYPE_CHECKING:
    from lscan.suites import SuiteContent

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
