"""The measures of the house, each with its bar: ``make house`` prints them.

    python tests/support/house.py

Exit code 1 where one is beyond its bar.
"""

import ast
import io
import sys
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from places import ROOT, tracked

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
    modules = root_modules(root)
    twice = repeated_classes(root)
    code = {name: sum(map(code_lines, modules_of(root / name))) for name in ("lscan", "sim")}
    readme = (root / "README.md").read_text(encoding="utf-8").splitlines()
    return [
        HouseRow("modules at the root of lscan", len(modules), 6, ", ".join(modules)),
        HouseRow("lines of README.md", len(readme), 150),
        HouseRow("lines of code of lscan and sim", sum(code.values()), 54_940, str(code)),
        HouseRow("lines of code of the tests", sum(map(code_lines, modules_of(root / "tests")))),
        HouseRow("class names used more than once", len(twice), 0, ", ".join(twice)),
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
        print(f"{row.what:35} {row.figure:>8,} {bar:>10} {verdict:6} {row.note}".rstrip())
    return 0 if all(row.passed for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
