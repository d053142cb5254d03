"""The paper's Tables I to III and its slices, with our numbers beside the printed ones."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lscan.figures.style import signed
from lscan.files.disk import packaged_table
from lscan.measure import SliceErrors
from lscan.measurement import BoardMeasures
from lscan.paper.experiment import Experiment
from lscan.paper.published import (
    CHOSEN_MAP,
    OUR_MAPS,
    SLICE_ERRORS_MM,
    TABLE_1,
    TABLE_2,
    TABLE_3,
    Bars,
    PrintedLength,
    PrintedTable,
)
from lscan.records import Length

Lengths = Mapping[str, Length]
"""By feature, such as "A1A2"."""
Beyond = Callable[[Length | PrintedLength], bool]
"""Whether an error is larger than what is accepted."""

_WORDS = packaged_table("lscan.paper", "tables.toml")
_SAME_MM = 0.05  # a nominal this close to the paper's is the same piece, read by a caliper
_METHODS = {ours: theirs for theirs, ours in OUR_MAPS.items()}
_OTHER_MAPS = {
    "graticule-2-norulers": "Second rms, no rulers",
    "projective": "Projective",
    "polynomial-3": "Polynomial 3",
    "polynomial-5": "Polynomial 5",
}
LABELS = _METHODS | _OTHER_MAPS
"""Plane map name to what a table calls it, in the order of its rows."""


@dataclass(frozen=True)
class TableCell:
    """A number of a table.

    Attributes
    ----------
    text : str, as it is shown
    beyond : bool, whether it marks an error beyond the bar
    """

    text: str
    beyond: bool = False


Cells = tuple[TableCell, ...]
NO_CELLS: Cells = (TableCell("—"),) * 3


@dataclass(frozen=True)
class TableRow:
    """One line of a table.

    Attributes
    ----------
    label : str, what the row is of
    code : str, a short name
    paper : tuple of TableCell, the paper's numbers
    ours : tuple of TableCell, by the paper's chain
    best : tuple of TableCell, the same by the best chain, () where there is none
    """

    label: str
    code: str
    paper: Cells
    ours: Cells
    best: Cells = ()


@dataclass(frozen=True)
class TableBlock:
    """Rows with one head.

    Attributes
    ----------
    names : str, what stands in the first column
    rows : tuple of TableRow, in their order
    paper_heads, our_heads : tuple of str, heads of the other columns
    caption : str, "" where there is none
    """

    names: str
    rows: tuple[TableRow, ...]
    paper_heads: tuple[str, ...] = ("mm", "err.", "%")
    our_heads: tuple[str, ...] = ("mm", "σ", "err.", "%")
    caption: str = ""

    @property
    def has_best(self) -> bool:
        """Whether any row has numbers of the best chain."""
        return any(row.best for row in self.rows)


@dataclass(frozen=True)
class ReportTable:
    """One of the paper's tables, or its slices.

    Attributes
    ----------
    key : str, short name, unique on the page
    title, caption : str, in words
    parts : sequence of str, the runs it comes from, "board", "groove" and "sandwave"
    chains : TableBlock or None, the paper's numbers beside those of our chains; None where methods
        compete and there is no best chain
    blocks : tuple of TableBlock, one a feature, where methods compete
    summary : TableBlock or None, where methods compete
    """

    key: str
    title: str
    caption: str
    parts: Sequence[str]
    chains: TableBlock | None
    blocks: tuple[TableBlock, ...] = ()
    summary: TableBlock | None = None


def paper_tables(experiment: Experiment, bars: Bars) -> list[ReportTable]:
    """Those of Tables I to III, and the slices, that the experiment has numbers for.

    Parameters
    ----------
    experiment : Experiment, lengths in mm
    bars : Bars, the largest errors accepted
    """
    measures, best = experiment.board.measures, experiment.best
    distances = {name: found.distances for name, found in measures.items()}
    diameters = {name: found.diameters for name, found in measures.items()}
    nothing = BoardMeasures({}, {}, {})
    better = best.board.measures[best.chain.plane_map] if best else nothing
    tables = [_table_by_method("table-1", distances, better.distances, TABLE_1, bars)]
    if diameters[CHOSEN_MAP]:
        tables.append(_table_by_method("table-2", diameters, better.diameters, TABLE_2, bars))
    if experiment.groove:
        groove = best.groove.dimensions if best and best.groove else {}
        tables.append(_groove_table(experiment.groove.dimensions, groove, bars))
    if experiment.sandwave:
        slices = best.sandwave.errors if best and best.sandwave else {}
        tables.append(_slice_table(experiment.sandwave.errors, slices, bars))
    return tables


def worst(lengths: Collection[Length | PrintedLength]) -> tuple[float, float]:
    """The largest |error| in mm, and the largest in percent.

    Parameters
    ----------
    lengths : collection of Length or PrintedLength, mm, one or more
    """
    largest_mm = max(abs(length.error_mm) for length in lengths)
    return largest_mm, max(abs(length.percent) for length in lengths)


def _table_by_method(
    key: str, by_map: Mapping[str, Lengths], best: Lengths, printed: PrintedTable, bars: Bars
) -> ReportTable:
    """Table I or II: our lengths by plane map, and those of the best chain."""

    def beyond(length: Length | PrintedLength) -> bool:
        return abs(length.percent) > bars.board_percent

    order = [*(n for n in LABELS if n in by_map), *(n for n in by_map if n not in LABELS)]
    ours = {name: by_map[name] for name in order}
    theirs = {name: _printed_by(name, printed, ours[name]) for name in order}
    features = dict.fromkeys(feature for lengths in ours.values() for feature in lengths)
    return ReportTable(
        **_words(key, bars),
        chains=_chains(ours[CHOSEN_MAP], best, theirs[CHOSEN_MAP], beyond) if best else None,
        blocks=tuple(_feature_block(feature, ours, theirs, beyond) for feature in features),
        summary=_summary(ours, theirs, bars),
    )


def _groove_table(ours: Lengths, best: Lengths, bars: Bars) -> ReportTable:
    theirs = _of_same_piece(TABLE_3, ours)
    chains = _chains(ours, best, theirs, lambda length: abs(length.error_mm) > bars.groove_mm)
    return ReportTable(**_words("table-3", bars), chains=chains)


def _slice_table(
    ours: Mapping[str, SliceErrors], best: Mapping[str, SliceErrors], bars: Bars
) -> ReportTable:
    def cells(errors: SliceErrors) -> Cells:
        ends = (errors.min_mm, errors.max_mm)
        marked = (TableCell(signed(end, 3), abs(end) > bars.sandwave_mm) for end in ends)
        return (TableCell(f"{errors.rmse_mm:.3f}"), *marked)

    theirs = tuple(TableCell(signed(error, 1)) for error in SLICE_ERRORS_MM)
    rows = tuple(
        TableRow(name, name, theirs, cells(errors), cells(best[name]) if name in best else ())
        for name, errors in ours.items()
    )
    block = TableBlock("Slice", rows, ("from", "to"), ("rms", "from", "to"))
    return ReportTable(**_words("slices", bars), chains=block)


def _words(key: str, bars: Bars) -> dict[str, Any]:
    """Key, title, caption and parts, as ReportTable takes them."""
    words = _WORDS[key]
    return {**words, "key": key, "caption": words["caption"].format(bars=bars)}


def _printed_by(name: str, printed: PrintedTable, ours: Lengths) -> Mapping[str, PrintedLength]:
    """The paper's lengths by the fit that our map ``name`` stands for, of the same features."""
    if name not in _METHODS:
        return {}
    return _of_same_piece({key: rows[_METHODS[name]] for key, rows in printed.items()}, ours)


def _of_same_piece(printed: Mapping[str, PrintedLength], ours: Lengths) -> dict[str, PrintedLength]:
    """The printed lengths whose nominal is ours too: another board's A1A2 is another length."""
    return {
        feature: row
        for feature, row in printed.items()
        if feature in ours and abs(ours[feature].nominal_mm - row.nominal_mm) <= _SAME_MM
    }


def _chains(
    ours: Lengths, best: Lengths, theirs: Mapping[str, PrintedLength], beyond: Beyond
) -> TableBlock:
    """The paper's lengths beside those of our chains, a feature a row."""
    rows = tuple(
        TableRow(
            _heading(feature, length),
            feature,
            _cells(theirs.get(feature), beyond),
            _cells(length, beyond),
            _cells(best[feature], beyond) if feature in best else (),
        )
        for feature, length in ours.items()
    )
    return TableBlock("Feature", rows)


def _feature_block(
    feature: str,
    ours: Mapping[str, Lengths],
    theirs: Mapping[str, Mapping[str, PrintedLength]],
    beyond: Beyond,
) -> TableBlock:
    mine = {name: lengths[feature] for name, lengths in ours.items() if feature in lengths}
    rows = []
    for name, length in mine.items():
        cells = (_cells(shown, beyond) for shown in (theirs[name].get(feature), length))
        rows.append(TableRow(LABELS.get(name, name), name, *cells))
    return TableBlock("Method", tuple(rows), caption=_heading(feature, length))


def _summary(
    ours: Mapping[str, Lengths], theirs: Mapping[str, Mapping[str, PrintedLength]], bars: Bars
) -> TableBlock:
    rows = []
    for name, lengths in ours.items():
        cells = (_summary_cells(shown.values(), bars) for shown in (theirs[name], lengths))
        rows.append(TableRow(LABELS.get(name, name), name, *cells))
    heads = ("rms / mm", "largest / mm", "largest / %")
    return TableBlock("Method", tuple(rows), heads, heads, caption="All features together")


def _summary_cells(lengths: Collection[Length | PrintedLength], bars: Bars) -> Cells:
    if not lengths:
        return NO_CELLS
    largest_mm, largest_percent = worst(lengths)
    rms_mm = float(np.sqrt(np.mean([length.error_mm**2 for length in lengths])))
    return (
        TableCell(f"{rms_mm:.2f}"),
        TableCell(f"{largest_mm:.2f}"),
        TableCell(f"{largest_percent:.2f}", largest_percent > bars.board_percent),
    )


def _cells(length: Length | PrintedLength | None, beyond: Beyond) -> Cells:
    """Length, ours with its sigma, error and percentage; dashes where the paper has none."""
    if length is None:
        return NO_CELLS
    sigma = () if isinstance(length, PrintedLength) else (TableCell(f"{length.sigma_mm:.3f}"),)
    digits, marked = (3 if sigma else 2), beyond(length)
    return (
        TableCell(f"{length.measured_mm:.{digits}f}"),
        *sigma,
        TableCell(signed(length.error_mm, digits), marked),
        TableCell(signed(length.percent, 2), marked),
    )


def _heading(feature: str, length: Length) -> str:
    """Such as "A₁A₂ (80.00 mm)"."""
    name = feature.translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"))
    return f"{name} ({length.nominal_mm:.2f} mm)"
