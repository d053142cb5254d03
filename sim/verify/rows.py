"""The rows of the evidence: a figure beside its bar, and what each was held against."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

from lscan.disk import make_folder, write_atomically
from lscan.figures.exhibit import Exhibit


@dataclass(frozen=True)
class Row:
    """One figure: how far the tank is from its reference, and how far it may be.

    what: the quantity.  reference: the closed form, the published value or the renderer it
    is held against.  figure, bar: the largest deviation found and allowed, both in ``unit``;
    at_least: the figure must instead be no smaller than the bar.
    tolerance_from: where the bar comes from.  seed: of the random numbers used, None where
    there are none.
    """

    what: str
    reference: str
    figure: float
    bar: float
    unit: str
    tolerance_from: str
    seed: int | None = None
    at_least: bool = False

    @property
    def passed(self) -> bool:
        """Whether the figure is a number on the right side of its bar."""
        kept = self.figure >= self.bar if self.at_least else self.figure <= self.bar
        return bool(isfinite(self.figure) and kept)

    def as_json(self) -> dict[str, Any]:
        """The row as verify.json holds it; a figure that is no number is null there."""
        side = {"at_least": True} if self.at_least else {}
        return {
            "what": self.what,
            "reference": self.reference,
            "figure": float(self.figure) if isfinite(self.figure) else None,
            "bar": float(self.bar),
            "unit": self.unit,
            "tolerance_from": self.tolerance_from,
            "seed": self.seed,
            "passed": self.passed,
            **side,
        }


@dataclass(frozen=True)
class Check:
    """One topic of the evidence.

    key: short name, unique on the page.  title: a few words.  text: what is compared and
    why that convinces, two or three sentences.  exhibits: figures for the page.
    """

    key: str
    title: str
    text: str
    rows: tuple[Row, ...]
    exhibits: tuple[Exhibit, ...] = ()


def rows_of(checks: Iterable[Check]) -> list[Row]:
    """All rows of the checks, in order."""
    return [row for check in checks for row in check.rows]


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write the rows to ``path`` as a JSON list; InputError where the disk refuses."""
    text = json.dumps([row.as_json() for row in rows], indent=2, allow_nan=False)
    make_folder(path.parent)
    write_atomically(path, f"{text}\n".encode())


def table_cells(rows: Iterable[Row]) -> list[list[str]]:
    """Cells of the printed table: what, figure, bar, unit, result."""
    return [
        [row.what, number(row.figure), number(row.bar), row.unit, "yes" if row.passed else "NO"]
        for row in rows
    ]


def number(value: float) -> str:
    """The number with two significant digits; powers of ten where it is small."""
    if value == 0 or not isfinite(value):
        return f"{value:g}"
    return f"{value:.2g}" if abs(value) >= 1e-3 else f"{value:.1e}"
