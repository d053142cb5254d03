"""The commands ``lscan suite``: the suites that there are, what one holds, whether it is whole."""

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table
from typer import Argument, Option

from lscan import suites
from lscan.cli.console import Json, note, show, table
from lscan.suites.files import write_suite_wheel
from lscan.version import __version__

SuiteName = Annotated[str, typer.Argument(help="Name of a suite, or its archive or folder.")]


def list_suites(json: Json = False) -> None:
    """List the suites of installed packages and of the user's cache."""
    found = {name: str(path) for name, path in suites.suites_found().items()}
    show(found, *(f"{name}: {path}" for name, path in found.items()), json=json)
    if not found and not json:
        note(
            "no suites: no installed package brings any, and none was rendered here; `lscan-sim "
            "suite make quick` renders one in minutes, there are also chains and full (hours)"
        )


def show_suite(name: SuiteName, json: Json = False) -> None:
    """Show what a suite holds: its cases on each axis."""
    content = suites.open_suite(suites.find_suite(name)).content
    axes = {kind: suites.axes_of(cases) for kind, cases in content.kinds.items()}
    fields = content.model_dump(mode="json", include={"name", "seed", "made_by", "version"})
    counts = ", ".join(f"{count} {kind}" for kind, count in _counts(content).items() if count)
    lines: list[str | Table] = [f"{content.name}: {counts}, seed {content.seed}, {content.made_by}"]
    for kind, counted in axes.items():
        if counted:
            rows = [(axis, value, n) for axis, of in counted.items() for value, n in of.items()]
            lines.append(table(f"{kind} by axis", ["axis", "value", kind], rows))
    show({**fields, **_counts(content), "axes": axes}, *lines, json=json)


def _counts(content: suites.SuiteContent) -> dict[str, int]:
    return {kind: len(cases) for kind, cases in content.kinds.items()}


def verify(name: SuiteName, json: Json = False) -> None:
    """Check every byte of a suite against its manifest, and read every case."""
    path = suites.find_suite(name)
    content = suites.verify_suite(path).content
    counts = _counts(content)
    words = f"{path}: {sum(counts.values())} cases and {len(content.members)} members are whole"
    show({"path": str(path), "name": content.name, **counts}, words, json=json)


def wheel(
    archives: list[Path] = Argument(help="Suite archives."),
    output: Path = Option(Path("out/dist"), "--output", "-o", help="Folder to write to."),
    name: str = Option("lscan-suites", help="Name of the package."),
    version: str = Option(__version__, help="Version of the package."),
    json: Json = False,
) -> None:
    """Pack suites into a wheel; lscan finds them once pip has installed it."""
    written = str(write_suite_wheel(archives, output, name, version))
    show({"wheel": written}, written, json=json)
