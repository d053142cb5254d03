"""The measures of the house, each with its bar: ``make house`` prints them.

    python tests/support/house.py

Exit code 1 where one is beyond its bar.
"""

import ast
import io
import re
import sys
import tokenize
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from places import ROOT, tracked

PACKAGES = ("lscan", "sim")
SMALL = 60
MOST_FILES = 6  # of a way through the project
NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


@dataclass(frozen=True)
class HouseRow:
    """One measure.  most: its bar, None where there is none.  note: what it counts, by name."""

    what: str
    figure: int
    most: int | None = None
    note: str = ""

    @property
    def passed(self) -> bool:
        """Whether the figure is within its bar."""
        return self.most is None or self.figure <= self.most


def house_rows(root: Path = ROOT) -> list[HouseRow]:
    """All measures of the checkout at ``root``."""
    at_root, twice = root_modules(root), repeated_classes(root)
    modules = [path for name in PACKAGES for path in modules_of(root / name)]
    lines = {path: code_lines(path) for path in modules}
    code = {
        name: sum(lines[path] for path in modules if path.is_relative_to(root / name))
        for name in PACKAGES
    }
    small = [p for p in modules if len(p.read_text(encoding="utf-8").splitlines()) < SMALL]
    rooms = Counter(path.parent for path in modules if path.name != "__init__.py")
    fullest = max(rooms, key=lambda room: rooms[room])
    imports = sum(map(import_lines, modules))
    tests = sum(map(code_lines, modules_of(root / "tests")))
    readme = (root / "README.md").read_text(encoding="utf-8").splitlines()
    return [
        HouseRow("modules of lscan and sim", len(modules), 270),
        HouseRow(f"of these of less than {SMALL} lines", len(small), 41),
        HouseRow("modules of the fullest room", rooms[fullest], 12, str(fullest.relative_to(root))),
        HouseRow("modules at the root of lscan", len(at_root), 7, ", ".join(at_root)),
        HouseRow("lines of code of lscan and sim", sum(code.values()), 49_200, str(code)),
        HouseRow("of these lines of imports", imports, 4_200),
        HouseRow("lines of code of tests and validation", tests, 58_700),
        HouseRow("class names used more than once", len(twice), 0, ", ".join(twice)),
        HouseRow("lines of README.md", len(readme), 150),
        *(HouseRow(f"files: {what}", len(files), MOST_FILES) for what, files in ways(root).items()),
    ]


def modules_of(folder: Path) -> list[Path]:
    """Every Python file beneath a folder, as git tracks them."""
    return tracked(folder, "*.py")


def root_modules(root: Path = ROOT) -> list[str]:
    """Names of the modules of lscan that lie in no room."""
    return sorted(p.stem for p in modules_of(root / "lscan") if p.parent == root / "lscan")


def repeated_classes(root: Path = ROOT) -> dict[str, list[str]]:
    """Each class name that stands for several classes of lscan and sim, and where they are.

    A leading underscore makes no other name of it.
    """
    found = defaultdict(list)
    for path in (*modules_of(root / "lscan"), *modules_of(root / "sim")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                found[node.name.lstrip("_")].append(f"{path.relative_to(root)}:{node.lineno}")
    return {name: places for name, places in sorted(found.items()) if len(places) > 1}


def ways(root: Path = ROOT) -> dict[str, list[Path]]:
    """The ways through the project that docs/explanation/architecture.md lists, file by file.

    Raises
    ------
    ValueError
        A file of one is not there, or none before it imports it and it is no plug-in.
    """
    page = (root / "docs/explanation/architecture.md").read_text(encoding="utf-8")
    table = page.split("## Five ways through it")[1].split("\n## ")[0]
    found = {}
    for what, cells in re.findall(r"^\| ([^|]+) \| (`[^|]+`) \|$", table, re.MULTILINE):
        files = [root / name for name in re.findall(r"`([^`]+\.py)`", cells)]
        imported = plugin_files(root)
        for place, path in enumerate(files):
            if not path.is_file() or (place and path not in imported):
                raise ValueError(f"{what}: {path} is not there, or not imported on the way to it")
            imported |= imported_files(path, root)
        found[what.replace("`", "")] = files
    return found


def imported_files(path: Path, root: Path = ROOT) -> set[Path]:
    """The files of the project that a module imports, anywhere in it."""
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    named = [node for node in nodes if isinstance(node, ast.ImportFrom) and node.module]
    modules = {str(node.module) for node in named}
    modules |= {f"{node.module}.{alias.name}" for node in named for alias in node.names}
    faces = {root / Path(*module.split(".")) / "__init__.py" for module in modules}
    files = {(root / Path(*module.split("."))).with_suffix(".py") for module in modules}
    for face in filter(Path.is_file, faces):  # a name that its package's face offers
        files |= imported_files(face, root) if face != path else set()
    return files


def plugin_files(root: Path = ROOT) -> set[Path]:
    """The files that the entry points of pyproject.toml name: found by name, imported by none."""
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    named = [target for group in project["entry-points"].values() for target in group.values()]
    modules = [target.split(":")[0].replace(".", "/") for target in named]
    return {root / f"{module}.py" for module in modules}


def import_lines(path: Path) -> int:
    """Lines of a module's import statements."""
    nodes = ast.walk(ast.parse(path.read_text(encoding="utf-8")))
    found = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
    return sum((node.end_lineno or node.lineno) - node.lineno + 1 for node in found)


def code_lines(path: Path) -> int:
    """Lines that hold code: docstrings, comments and blank lines do not count."""
    text = path.read_text(encoding="utf-8")
    code: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in NO_CODE:
            code |= set(range(token.start[0], token.end[0] + 1))
    return len(code - set(_docstring_lines(ast.parse(text))))


def _docstring_lines(tree: ast.Module) -> Iterator[int]:
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for node in ast.walk(tree):
        if isinstance(node, documented) and ast.get_docstring(node, clean=False) is not None:
            first = node.body[0]
            yield from range(first.lineno, (first.end_lineno or first.lineno) + 1)


def main() -> int:
    """Print the rows; the exit code."""
    rows = house_rows()
    for row in rows:
        bar = "" if row.most is None else f"<= {row.most:,}"
        verdict = "" if row.most is None else ("ok" if row.passed else "BEYOND")
        print(f"{row.what:42} {row.figure:>8,} {bar:>10} {verdict:6} {row.note}".rstrip())
    return 0 if all(row.passed for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
