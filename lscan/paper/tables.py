"""The paper's Tables I to III and its slices, with our numbers beside the printed ones."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lscan.figures.reportfigure import signed
from lscan.paper.published import (
    CHOSEN_MAP,
    OUR_MAPS,
    SLICE_ERRORS_MM,
    TABLE_1,
    TABLE_2,
    TABLE_3,
    Bars,
    Printed,
)

Results = Mapping[str, Any]
PrintedTable = Mapping[str, Mapping[str, Printed]]

_SAME_MM = 0.05  # a nominal this close to the paper's is the same piece, read by a caliper
_OTHER_MAPS = {
    "graticule-2-norulers": "Second rms, no rulers",
    "projective": "Projective",
    "polynomial-3": "Polynomial 3",
    "polynomial-5": "Polynomial 5",
}
LABELS = {ours: theirs for theirs, ours in OUR_MAPS.items()} | _OTHER_MAPS
"""Plane map name to what a table calls it, in the order of its rows."""


@dataclass(frozen=True)
class Length:
    """A measured length; a number that is not known is None.

    error_mm: measured minus nominal.  percent: that error in percent of the nominal length.
    """

    nominal_mm: float | None
    measured_mm: float | None
    sigma_mm: float | None
    error_mm: float | None
    percent: float | None


Beyond = Callable[[Length], bool]
"""Whether an error is larger than what is accepted."""


@dataclass(frozen=True)
class Cell:
    """A number as text, and whether it marks an error beyond the bar."""

    text: str
    beyond: bool = False


@dataclass(frozen=True)
class Row:
    """One line of a table: its label, a short name, the paper's cells and ours.

    ours: by the paper's chain.  best: the same by the best chain, () where there is none.
    """

    label: str
    code: str
    paper: tuple[Cell, ...]
    ours: tuple[Cell, ...]
    best: tuple[Cell, ...] = ()


@dataclass(frozen=True)
class Block:
    """Rows with one head.

    names: what stands in the first column.  paper_heads, our_heads: of the other columns.
    """

    names: str
    rows: tuple[Row, ...]
    paper_heads: tuple[str, ...] = ("mm", "err.", "%")
    our_heads: tuple[str, ...] = ("mm", "σ", "err.", "%")
    caption: str = ""

    @property
    def has_best(self) -> bool:
        """Whether any row has numbers of the best chain."""
        return any(row.best for row in self.rows)


@dataclass(frozen=True)
class Table:
    """One of the paper's tables, or its slices.

    parts: the runs it comes from, "board", "groove" and "sandwave".  chains: the paper's numbers
    beside those of our chains, None where methods compete and there is no best chain.
    blocks: one a feature, and a summary, where methods compete.
    """

    key: str
    title: str
    caption: str
    parts: tuple[str, ...]
    chains: Block | None
    blocks: tuple[Block, ...] = ()
    summary: Block | None = None


def paper_tables(results: Results, bars: Bars) -> list[Table]:
    """Those of Tables I to III, and the slices, that results.json has numbers for."""
    best = results.get("best") or {}
    tables = []
    for key, title, section, printed in (
        ("table-1", "Table I. Distances between known points", "distances", TABLE_1),
        ("table-2", "Table II. Diameters of circles", "diameters", TABLE_2),
    ):
        if results.get(section):
            table = _table_by_method(key, title, results[section], printed, bars)
            chosen = results[section].get(CHOSEN_MAP) or {}
            better = (best.get(section) or {}).get((best.get("chain") or {}).get("plane_map")) or {}
            theirs = {name: row["Second rms"] for name, row in printed.items()}
            if better and chosen:
                chains = _chains(chosen, better, theirs, _beyond_percent(bars))
                table = replace(table, chains=chains)
            tables.append(table)
    if results.get("groove"):
        tables.append(_groove_table(results["groove"], best.get("groove") or {}, bars))
    slices, better = ((r.get("sandwave") or {}).get("slices") or {} for r in (results, best))
    if slices:
        tables.append(_slice_table(slices, better, bars))
    return tables


def read_lengths(section: Results) -> dict[str, Length]:
    """Lengths by feature from a section of results.json, where any key may be missing."""
    return {feature: _read_length(entry) for feature, entry in section.items()}


def _read_length(entry: Results) -> Length:
    keys = ("nominal_mm", "measured_mm", "sigma_mm", "error_mm")
    nominal, measured, sigma, error = (known(entry, key) for key in keys)
    percent = 100 * error / nominal if nominal and error is not None else None
    return Length(nominal, measured, sigma, error, percent)


def known(entry: Results, key: str) -> float | None:
    """The number under ``key``; None where there is none, or none that is finite."""
    number = entry.get(key)
    return float(number) if number is not None and np.isfinite(number) else None


def worst(lengths: Iterable[Length]) -> tuple[float, float] | None:
    """Largest |error| in mm and largest in percent; None where no error is known."""
    known = [(abs(x.error_mm), abs(x.percent or 0.0)) for x in lengths if x.error_mm is not None]
    if not known:
        return None
    return max(error for error, _ in known), max(percent for _, percent in known)


def _table_by_method(
    key: str, title: str, section: Results, printed: PrintedTable, bars: Bars
) -> Table:
    names = [*(n for n in LABELS if n in section), *(n for n in section if n not in LABELS)]
    ours = {name: read_lengths(section[name]) for name in names}
    theirs = {name: _printed_lengths(printed, name, ours[name]) for name in names}
    features = dict.fromkeys(feature for lengths in ours.values() for feature in lengths)
    return Table(
        key,
        title,
        "Measured lengths and errors in mm, the nominal length in parentheses; σ is one standard "
        "uncertainty. Marked "
        f"(▲): errors beyond {bars.board_percent:g} % of the length, the paper's claim.",
        ("board",),
        chains=None,
        blocks=tuple(
            _feature_block(feature, ours, theirs, _beyond_percent(bars)) for feature in features
        ),
        summary=_summary(ours, theirs, bars),
    )


def _beyond_percent(bars: Bars) -> Beyond:
    return lambda length: length.percent is not None and abs(length.percent) > bars.board_percent


def _chains(ours: Results, best: Results, printed: Mapping[str, Printed], beyond: Beyond) -> Block:
    """The paper's lengths beside those of our chains, a feature a row."""
    measured, better = read_lengths(ours), read_lengths(best)
    theirs = _of_same_piece({f: printed[f] for f in measured if f in printed}, measured)
    rows = []
    for feature, length in measured.items():
        row = _row(_heading(feature, length), feature, theirs.get(feature), length, beyond)
        if feature in better:
            row = replace(row, best=_our_cells(better[feature], beyond))
        rows.append(row)
    return Block("Feature", tuple(rows))


def _printed_lengths(
    printed: PrintedTable, name: str, ours: Mapping[str, Length]
) -> dict[str, Length]:
    """The paper's lengths by the fit that our map ``name`` stands for, of the same features."""
    method = next((method for method, map_ in OUR_MAPS.items() if map_ == name), None)
    if method is None:
        return {}
    rows = {feature: printed[feature][method] for feature in ours if feature in printed}
    return _of_same_piece(rows, ours)


def _of_same_piece(printed: Mapping[str, Printed], ours: Mapping[str, Length]) -> dict[str, Length]:
    """The printed lengths whose nominal is ours too: another board's A1A2 is another length."""
    return {
        feature: Length(row.nominal_mm, row.measured_mm, None, row.error_mm, row.percent)
        for feature, row in printed.items()
        if abs((ours[feature].nominal_mm or np.inf) - row.nominal_mm) <= _SAME_MM
    }


def _feature_block(
    feature: str,
    ours: Mapping[str, Mapping[str, Length]],
    theirs: Mapping[str, Mapping[str, Length]],
    beyond: Beyond,
) -> Block:
    mine = {name: lengths[feature] for name, lengths in ours.items() if feature in lengths}
    rows = tuple(
        _row(LABELS.get(name, name), name, theirs[name].get(feature), length, beyond)
        for name, length in mine.items()
    )
    return Block("Method", rows, caption=_heading(feature, next(iter(mine.values()))))


def _groove_table(ours: Results, best: Results, bars: Bars) -> Table:
    def beyond(length: Length) -> bool:
        return length.error_mm is not None and abs(length.error_mm) > bars.groove_mm

    return Table(
        "table-3",
        "Table III. The grooved block",
        "Measured lengths and errors in mm, the nominal length in parentheses; σ is one standard "
        "uncertainty. Marked "
        f"(▲): errors beyond {bars.groove_mm:g} mm, the paper's claim.",
        ("board", "groove"),
        _chains(ours, best, TABLE_3, beyond),
    )


def _slice_table(ours: Results, best: Results, bars: Bars) -> Table:
    def cells(entry: Results) -> tuple[Cell, ...]:
        rmse, low, high = (known(entry, key) for key in ("rmse_mm", "min_mm", "max_mm"))
        ends = (
            Cell(_signed(x, 3), x is not None and abs(x) > bars.sandwave_mm) for x in (low, high)
        )
        return (Cell(_number(rmse, 3)), *ends)

    theirs = tuple(Cell(_signed(error, 1)) for error in SLICE_ERRORS_MM)
    rows = tuple(
        Row(name, name, theirs, cells(entry), cells(best[name]) if name in best else ())
        for name, entry in ours.items()
    )
    return Table(
        "slices",
        "Errors of the slices",
        "Measured minus designed height in mm: rms, lowest and highest. The paper says of all "
        f"slices that most errors lie between its two numbers. Marked (▲): errors beyond "
        f"{bars.sandwave_mm:g} mm, the paper's claim.",
        ("board", "sandwave"),
        Block("Slice", rows, ("from", "to"), ("rms", "from", "to")),
    )


def _summary(
    ours: Mapping[str, Mapping[str, Length]],
    theirs: Mapping[str, Mapping[str, Length]],
    bars: Bars,
) -> Block:
    rows = tuple(
        Row(
            LABELS.get(name, name),
            name,
            _summary_cells(theirs[name].values(), bars),
            _summary_cells(lengths.values(), bars),
        )
        for name, lengths in ours.items()
    )
    heads = ("rms / mm", "largest / mm", "largest / %")
    return Block("Method", rows, heads, heads, caption="All features together")


def _summary_cells(lengths: Iterable[Length], bars: Bars) -> tuple[Cell, ...]:
    known = list(lengths)
    largest = worst(known)
    if largest is None:
        return (Cell("—"),) * 3
    errors = [length.error_mm for length in known if length.error_mm is not None]
    rms = float(np.sqrt(np.mean(np.square(errors))))
    millimetres, percent = largest
    return (
        Cell(f"{rms:.2f}"),
        Cell(f"{millimetres:.2f}"),
        Cell(f"{percent:.2f}", percent > bars.board_percent),
    )


def _row(label: str, code: str, theirs: Length | None, ours: Length, beyond: Beyond) -> Row:
    mine = _our_cells(ours, beyond)
    if theirs is None:
        return Row(label, code, (Cell("—"),) * 3, mine)
    marked = beyond(theirs)
    printed = (
        Cell(_number(theirs.measured_mm, 2)),
        Cell(_signed(theirs.error_mm, 2), marked),
        Cell(_signed(theirs.percent, 2), marked),
    )
    return Row(label, code, printed, mine)


def _our_cells(length: Length, beyond: Beyond) -> tuple[Cell, ...]:
    """Measured length, its sigma, error and percentage."""
    marked = beyond(length)
    return (
        Cell(_number(length.measured_mm, 3)),
        Cell(_number(length.sigma_mm, 3)),
        Cell(_signed(length.error_mm, 3), marked),
        Cell(_signed(length.percent, 2), marked),
    )


def _heading(feature: str, length: Length) -> str:
    """Such as "A₁A₂ (80.00 mm)"."""
    name = feature.translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"))
    return name if length.nominal_mm is None else f"{name} ({length.nominal_mm:.2f} mm)"


def _number(value: float | None, digits: int) -> str:
    return "—" if value is None else f"{value:.{digits}f}"


def _signed(value: float | None, digits: int) -> str:
    return "—" if value is None else signed(value, digits)
