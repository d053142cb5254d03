"""The paper's Tables I to III and its slices beside ours, and which kept their bars."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from lscan.figures.page import signed_number
from lscan.files.disk import packaged_table
from lscan.measure import SliceErrors
from lscan.paper import published as paper
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
from lscan.pipeline import BoardMeasures
from lscan.records import Length

# The paper's Tables I to III and its slices, with our numbers beside the printed ones.

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
        ours = experiment.groove.dimensions
        theirs = _of_same_piece(TABLE_3, ours)
        chains = _chains(ours, groove, theirs, lambda one: abs(one.error_mm) > bars.groove_mm)
        tables.append(ReportTable(**_words("table-3", bars), chains=chains))
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


def _slice_table(
    ours: Mapping[str, SliceErrors], best: Mapping[str, SliceErrors], bars: Bars
) -> ReportTable:
    def cells(errors: SliceErrors) -> Cells:
        ends = (errors.min_mm, errors.max_mm)
        marked = (TableCell(signed_number(end, 3), abs(end) > bars.sandwave_mm) for end in ends)
        return (TableCell(f"{errors.rmse_mm:.3f}"), *marked)

    theirs = tuple(TableCell(signed_number(error, 1)) for error in SLICE_ERRORS_MM)
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
        TableCell(signed_number(length.error_mm, digits), marked),
        TableCell(signed_number(length.percent, 2), marked),
    )


def _heading(feature: str, length: Length) -> str:
    """Such as "A₁A₂ (80.00 mm)"."""
    name = feature.translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"))
    return f"{name} ({length.nominal_mm:.2f} mm)"


# The head of the report: each part's figure beside the paper's, and whether it kept its bar.


@dataclass(frozen=True)
class ReportCheck:
    """One line of the report's head: a figure of ours and whether it kept its bar.

    Attributes
    ----------
    what : str, what was measured
    figure : str, ours
    paper : str, the paper's for the same
    bar : str, what is accepted
    passed : bool or None, None where there is no bar
    """

    what: str
    figure: str
    paper: str
    bar: str
    passed: bool | None


def checks(experiment: Experiment, bars: paper.Bars) -> list[ReportCheck]:
    """What the experiment measured by the paper's chain, and whether it kept its bars.

    Distances of which one was not measured do not pass.

    Parameters
    ----------
    experiment : Experiment, pieces that were not scanned have no lines
    bars : Bars, the largest errors accepted
    """
    board = experiment.board.measures[paper.CHOSEN_MAP]
    groove = experiment.groove.dimensions if experiment.groove else {}
    first, second = (
        [rows["Second rms"] for rows in table.values()] for table in (paper.TABLE_1, paper.TABLE_2)
    )
    percent, missing = bars.board_percent, len(board.unmeasured)
    return [
        *_control_point_checks(experiment),
        *_render_checks(experiment),
        *_length_check("Distances", board.distances, first, percent, "%", missing),
        *_length_check("Diameters", board.diameters, second, percent, "%"),
        *_length_check("Grooved block", groove, paper.TABLE_3.values(), bars.groove_mm, "mm"),
        *_sandwave_checks(experiment, bars.sandwave_mm),
    ]


def _length_check(
    what: str,
    lengths: Mapping[str, Length],
    printed: Collection[paper.PrintedLength],
    bar: float,
    unit: Literal["%", "mm"],
    missing: int = 0,
) -> list[ReportCheck]:
    """The largest errors beside those printed.  missing: how many more were not measured."""
    if not lengths:
        return []
    figure, largest = _largest(lengths.values(), unit)
    if missing:
        figure += f", {missing} of {missing + len(lengths)} not measured"
    kept = largest <= bar and not missing
    theirs, _ = _largest(printed, unit)
    return [ReportCheck(f"{what}, largest error", figure, theirs, f"{bar:g} {unit}", kept)]


def _largest(
    lengths: Collection[Length | paper.PrintedLength], unit: Literal["%", "mm"]
) -> tuple[str, float]:
    """The largest errors as text, and the one in that unit."""
    largest_mm, percent = worst(lengths)
    if unit == "mm":
        return f"{largest_mm:.2f} mm", largest_mm
    return f"{largest_mm:.2f} mm, {percent:.2f} %", percent


def _control_point_checks(experiment: Experiment) -> list[ReportCheck]:
    points = experiment.control_points
    found = f"{points.found} of {points.expected}"
    complete = points.found == points.expected
    lines = [ReportCheck("Control points found", found, "—", "all", complete)]
    if points.rms_px is not None:
        off = f"{points.rms_px:.3f} px rms, {points.max_px:.3f} px at most"
        lines.append(ReportCheck("Control points, distance from the truth", off, "—", "—", None))
    return lines


def _render_checks(experiment: Experiment) -> list[ReportCheck]:
    if experiment.truth is None:
        return []
    line = experiment.truth.render_check
    off = f"{line.stripe_rms_px:.3f} px rms, {line.stripe_max_px:.3f} px at most"
    return [ReportCheck("Line in the picture, distance from the truth", off, "—", "—", None)]


def _sandwave_checks(experiment: Experiment, bar_mm: float) -> list[ReportCheck]:
    if (sandwave := experiment.sandwave) is None:
        return []
    lines = [_slice_check(name, errors, bar_mm) for name, errors in sandwave.errors.items()]
    if (yaw_deg := sandwave.alignment.yaw_deg) is None:
        return lines
    true = f" (true {experiment.truth.yaw_deg:.3f}°)" if experiment.truth else ""
    found, theirs = f"{yaw_deg:.3f}°{true}", f"{paper.YAW_DEG:.2f}°"
    return [ReportCheck("Yaw of the sheet", found, theirs, "—", None), *lines]


def _slice_check(name: str, errors: SliceErrors, bar_mm: float) -> ReportCheck:
    low, high = (signed_number(error, 1) for error in paper.SLICE_ERRORS_MM)
    least, most = errors.min_mm, errors.max_mm
    return ReportCheck(
        f"Slice {name}, error",
        f"{signed_number(least, 2)} to {signed_number(most, 2)} mm, rmse {errors.rmse_mm:.2f} mm",
        f"most within {low} to {high} mm",
        f"±{bar_mm:g} mm",
        max(-least, most) <= bar_mm,
    )
