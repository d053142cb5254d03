"""The page of a study: where each error comes from, in words, tables and plots; self-contained."""

import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from typing import Any

from lscan.figures.page import page_template
from lscan.version import __version__
from sim.studies.budget import (
    CauseBudget,
    CauseFacts,
    CauseScatter,
    DesignTrial,
    ErrorMap,
    IndexConvergence,
    OutputBudget,
    RigComparison,
    StudyResults,
    Tolerances,
)
from sim.studies.design.catalogue import CLASSES
from sim.studies.problem import AFTER, Bounded

# What Plotly draws on the page of a study: traces and layouts as plain data.
#
# A colour is the page's CSS variable, which its script resolves, so that the plots follow its
# theme.
# Nothing is told by colour alone: bars differ by hatching, lines by dashes and marks.


MOST_LETTERS = 34  # of a name beside a plot; the tables have it whole
RECALIBRATED = "after recalibration"
_BAR_PX, _FRAME_PX = 21, 110  # heights of a bar, and of what is about the bars
_FULL = {"color": "var(--first)"}
_HATCHED = {
    "color": "var(--second)",
    "pattern": {"shape": "/", "bgcolor": "var(--paper)", "fgcolor": "var(--second)", "size": 7},
    "line": {"color": "var(--second)", "width": 1},
}
_DOTTED = {
    "color": "var(--third)",
    "pattern": {"shape": ".", "bgcolor": "var(--paper)", "fgcolor": "var(--third)", "size": 6},
    "line": {"color": "var(--third)", "width": 1},
}
_MARKS = ("circle", "square", "diamond", "triangle-up", "cross")
_DASHES = ("solid", "dash", "dot", "dashdot", "longdash")
_COLOURS = ("var(--first)", "var(--second)", "var(--third)")


@dataclass(frozen=True)
class StudyPlot:
    """A plot of the page.

    Attributes
    ----------
    title, caption : str
    data : mapping, for Plotly: traces and layout; of a map and a front, what its script chooses of
    menus : mapping, a choice's label to what can be chosen
    wide : bool, takes the page's whole width
    """

    title: str
    caption: str
    data: Mapping[str, Any]
    menus: Mapping[str, Sequence[str]] = field(default_factory=dict)
    wide: bool = False


def label(name: str) -> str:
    """A name as Plotly shows it: short, and its markup as written.

    Parameters
    ----------
    name : str

    Examples
    --------
    >>> label("tilt <b>")
    'tilt &lt;b&gt;'
    """
    short = name if len(name) <= MOST_LETTERS else f"{name[: MOST_LETTERS - 1]}…"
    return escape(short, quote=False)


def plots_of(
    budget: OutputBudget, maps: Sequence[ErrorMap], scatters: Sequence[CauseScatter]
) -> list[StudyPlot]:
    """All plots of an output, those left out that there is nothing for.

    Parameters
    ----------
    budget : OutputBudget
    maps : sequence of ErrorMap, of any output
    scatters : sequence of CauseScatter, of any output
    """
    found = [
        _tornado(budget),
        _shares(budget, ""),
        _shares(budget.after, f", {RECALIBRATED}") if budget.after else None,
        _convergence(budget.convergence),
        *(_scatter(one, budget.unit) for one in scatters if one.output == budget.name),
        _map([one for one in maps if one.output.removesuffix(AFTER) == budget.name]),
    ]
    return [plot for plot in found if plot]


def _tornado(budget: OutputBudget) -> StudyPlot | None:
    """Each cause alone, the largest on top, before and after recalibration."""
    after = {c.cause: c.alone_rms for c in budget.after.causes} if budget.after else {}
    causes = [c for c in budget.causes if c.alone_rms or after.get(c.cause)]
    largest = {
        c.cause: max(b.value for b in (c.alone_rms, after.get(c.cause)) if b) for c in causes
    }
    causes.sort(key=lambda c: largest[c.cause], reverse=True)
    names = [c.cause for c in causes]
    bars = [_bars("before", [c.alone_rms for c in causes], _FULL)]
    if budget.after:
        bars.append(_bars(RECALIBRATED, [after.get(name) for name in names], _HATCHED))
    layout = _bar_layout(names, len(bars), f"rms error / {budget.unit}")
    if budget.base_rms:
        line = {"color": "var(--ink)", "dash": "dot", "width": 1.5}
        place = {"x0": budget.base_rms, "x1": budget.base_rms, "y0": 0, "y1": 1, "yref": "paper"}
        layout["shapes"] = [{"type": "line", "line": line, **place}]
    caption = (
        "The rms error with each cause alone at work, whiskers its 95 % interval"
        + ("; hatched, calibrated anew before the scan" if budget.after else "")
        + ("; dotted, with none at work." if budget.base_rms else ".")
    )
    data = {"traces": bars, "layout": layout}
    return StudyPlot("Each cause alone", caption, data) if causes else None


def _shares(budget: OutputBudget, when: str) -> StudyPlot | None:
    """First and total Sobol indices with intervals, the largest total on top."""
    causes = [c for c in by_total(budget.causes) if c.total or c.first]
    names = [c.cause for c in causes]
    bars = [
        _bars("total", [c.total for c in causes], _FULL),
        _bars("first order", [c.first for c in causes], _DOTTED),
    ]
    caption = (
        "Sobol indices with 95 % intervals: the share of the variance that is the cause’s own "
        "(first order, dotted), and that it takes part in (total)."
    )
    data = {"traces": bars, "layout": _bar_layout(names, 2, "share of the variance")}
    return StudyPlot(f"Shares of the variance{when}", caption, data) if causes else None


def _bars(name: str, values: Sequence[Bounded | None], marker: Mapping[str, Any]) -> Any:
    """Horizontal bars; where there is no value, none.  Ends of bars are written out."""
    ends = _whiskers([b or Bounded(0.0, 0.0, 0.0) for b in values])
    return {
        "type": "bar",
        "orientation": "h",
        "name": name,
        "x": [b.value if b else None for b in values],
        "y": list(range(len(values))),
        "marker": marker,
        "error_x": ends | {"thickness": 1.2, "width": 3, "color": "var(--ink)"},
        "hovertemplate": "%{x:.3g}<extra>%{fullData.name}</extra>",
    }


def _whiskers(values: Sequence[Bounded]) -> dict[str, Any]:
    return {
        "type": "data",
        "symmetric": False,
        "array": [b.high - b.value for b in values],
        "arrayminus": [b.value - b.low for b in values],
    }


def _bar_layout(names: Sequence[str], series: int, title: str) -> dict[str, Any]:
    # Numbers, not names, place the bars: two names may look alike once they are cut.
    ticks = {"tickvals": list(range(len(names))), "ticktext": [label(name) for name in names]}
    across = {"title": {"text": escape(title)}, "rangemode": "tozero", "side": "bottom"}
    return {
        "height": _FRAME_PX + len(names) * (series * _BAR_PX + 8),
        "barmode": "group",
        "bargap": 0.25,
        "xaxis": across,
        "yaxis": ticks
        | {
            "range": [len(names) - 0.5, -0.5],
            "showgrid": False,
            "zeroline": False,
            "ticksuffix": " ",
        },
        "showlegend": series > 1,
    }


def _convergence(indices: Sequence[IndexConvergence]) -> StudyPlot | None:
    """The largest indices against the number of runs they were computed from."""
    traces = [
        {
            "type": "scatter",
            "mode": "lines+markers",
            "name": f"{label(one.cause)}, {one.index}",
            "x": list(one.runs),
            "y": [b.value for b in one.values],
            "error_y": _whiskers(one.values) | {"thickness": 1.2, "width": 3},
            "line": {"dash": _DASHES[k % 5], "color": _COLOURS[k % 3]},
            "marker": {"symbol": _MARKS[k % 5], "size": 8},
        }
        for k, one in enumerate(indices)
    ]
    runs = sorted({n for one in indices for n in one.runs})
    across = {"title": {"text": "runs"}, "type": "log", "tickvals": runs}
    layout = {
        "height": 340,
        "xaxis": across | {"ticktext": [f"{n:,}" for n in runs]},
        "yaxis": {"title": {"text": "index"}},
    }
    caption = "The largest indices as runs were added, with their 95 % intervals."
    data = {"traces": traces, "layout": layout}
    return StudyPlot("Convergence", caption, data) if traces else None


def _scatter(scatter: CauseScatter, unit: str) -> StudyPlot:
    """The largest cause against the error of the same rigs."""
    dots = {
        "type": "scatter",
        "mode": "markers",
        "x": _round(scatter.values),
        "y": _round(scatter.errors),
        "marker": {"size": 5, "opacity": 0.55, "color": "var(--first)"},
    }
    axes = {
        "xaxis": {"title": {"text": f"{label(scatter.cause)} / {escape(scatter.cause_unit)}"}},
        "yaxis": {"title": {"text": f"error / {escape(unit)}"}},
    }
    caption = "Each dot is a rig with all causes at work; of a field, its rms error."
    data = {"traces": [dots], "layout": {"height": 340, "showlegend": False, **axes}}
    return StudyPlot("The largest cause", caption, data)


def _map(maps: Sequence[ErrorMap]) -> StudyPlot | None:
    """The error over the surface, of the cause and figure that two menus choose."""
    if not maps:
        return None
    figures: dict[str, dict[str, list[float]]] = defaultdict(dict)
    for one in maps:
        state = f", {RECALIBRATED}" if one.output.endswith(AFTER) else ""
        figures[f"rms error{state}"][one.cause] = _round(one.rms)
        figures[f"mean error{state}"][one.cause] = _round(one.mean)
    worst = sorted(maps, key=lambda one: -max(one.rms))
    causes = list(dict.fromkeys(one.cause for one in worst))
    across, along = (_round(axis) for axis in zip(*maps[0].xy_mm, strict=True))
    # By place in the menus.
    chosen = [[figures[figure].get(cause, []) for figure in figures] for cause in causes]
    data = {"kind": "map", "unit": escape(maps[0].unit), "x": across, "y": along, "values": chosen}
    caption = (
        "The error over the surface with this cause alone at work. "
        "Of the mean error, squares are too high and circles too low."
    )
    menus = {"Cause": causes, "Shown": list(figures)}
    return StudyPlot("Over the surface", caption, data, menus)


def front_plot(trials: Sequence[DesignTrial]) -> StudyPlot | None:
    """The designs by three of their objectives, chosen in menus; of two, on the plane.

    Parameters
    ----------
    trials : sequence of DesignTrial
    """
    objectives = list(dict.fromkeys(name for trial in trials for name in trial.objectives))
    if len(objectives) < 2:
        return None
    # By column: names are not used as keys, which JavaScript would order its own way.
    values = [[trial.objectives.get(name) for trial in trials] for name in objectives]
    data = {
        "kind": "front",
        "names": [label(name) for name in objectives],
        "values": values,
        # Along the axis of what is no number, the laser's class; else nothing.
        "orders": [[one for one in CLASSES if one in column] for column in values],
        "front": [trial.on_front for trial in trials],
        "words": [_design_words(trial) for trial in trials],
    }
    caption = (
        "Filled diamonds are on the front: no other design is better in every objective. Circles "
        "were tried. Point at one to see its parts; a click marks its row in the table."
    )
    menus = {f"{axis} axis": objectives for axis in "xyz"[: len(objectives)]}
    return StudyPlot("Designs to choose from", caption, data, menus, wide=True)


def _design_words(trial: DesignTrial) -> str:
    """A design's objectives and parts, one line each."""
    every: dict[str, str | float | None] = {**trial.objectives, **trial.parts}
    if trial.rendered_mm:
        every["rendered error / mm"] = trial.rendered_mm.value
    told = {name: v for name, v in every.items() if v is not None}
    words = [f"{name}: {v if isinstance(v, str) else f'{v:.4g}'}" for name, v in told.items()]
    return "<br>".join(map(label, words))


def largest(budget: OutputBudget) -> CauseBudget | None:
    """The cause with the largest total index, of those whose intervals lie above zero.

    Parameters
    ----------
    budget : OutputBudget
    """
    told_apart = [c for c in budget.causes if c.total and c.total.low > 0]
    return max(told_apart, key=lambda c: c.total.value if c.total else 0.0, default=None)


def by_total(causes: Sequence[CauseBudget]) -> list[CauseBudget]:
    """The causes, the largest total index first; those without one last, as they stand.

    Parameters
    ----------
    causes : sequence of CauseBudget
    """
    return sorted(causes, key=lambda c: -c.total.value if c.total else float("inf"))


def _round(values: Sequence[float]) -> list[float]:
    """Four digits are more than a plot shows, and half of the page."""
    return [float(f"{value:.4g}") for value in values]


# The page of a study: where each error comes from, in words, tables and plots; self-contained.


TOLD_SHARE = 0.1
"""Systematic share of a mean square error that the headline tells."""


def render_page(results: StudyResults) -> str:
    """The page as HTML text; it loads nothing from anywhere.

    Parameters
    ----------
    results : StudyResults
    """
    from plotly.offline import get_plotlyjs  # takes a second

    plots = [plots_of(budget, results.maps, results.scatters) for budget in results.outputs]
    front = front_plot(results.trials)
    every = [plot for part in plots for plot in part] + ([front] if front else [])
    data = json.dumps([plot.data for plot in every], allow_nan=False, separators=(",", ":"))
    template = page_template(
        "sim.studies",
        "report.html.j2",
        figure=figure,
        share=share,
        headline=headline,
        kept=tolerance_sentence,
        compared=comparison_words,
        ranked=ranked_causes,
    )
    return template.render(
        results=results,
        plots=plots,
        front=front,
        every=every,
        varied=_facts_by_name(results.causes),
        failed=sum(results.failures.values()),
        source=json.dumps(results.source, indent=2, ensure_ascii=False, default=str),
        data=data.replace("<", "\\u003c"),  # no name in it can end the script element
        plotly=get_plotlyjs() if every else "",
        version=__version__,
    )


def headline(budget: OutputBudget) -> str:
    """The finding on an output in a sentence or two.

    Parameters
    ----------
    budget : OutputBudget
    """
    words = []
    if budget.range_95:
        low, high = map(figure, budget.range_95)
        words.append(f"95\u00a0% of the errors lie between {low} and {high}\u00a0{budget.unit}.")
    if (same := systematic_share(budget)) > TOLD_SHARE:
        words.append(f"{share(same)} of the mean square error is the same on all rigs.")
    cause = largest(budget)
    if cause and cause.total:
        part = "Most" if cause.total.value > 0.5 else "The largest part"
        words.append(
            f"{part} of the variance of {budget.name} comes from {cause.cause}: "
            f"{share(cause.total.value)} ({_range(cause.total)}), its interactions counted in."
        )
    else:
        words.append(f"No cause’s share of the variance of {budget.name} is told apart from zero.")
    if budget.after:
        words.append(_gain_sentence(budget, budget.after, cause.cause if cause else ""))
    return " ".join(filter(None, words))


def systematic_share(budget: OutputBudget) -> float:
    """Which share of the mean square error is that of the mean error: in no cause's index.

    Parameters
    ----------
    budget : OutputBudget
    """
    if budget.mean is None or budget.rms is None or budget.rms.value == 0:
        return 0.0
    return min((budget.mean.value / budget.rms.value) ** 2, 1.0)


def ranked_causes(budget: OutputBudget) -> list[tuple[CauseBudget, CauseBudget | None]]:
    """The causes as the table has them, the largest first, each with itself after recalibration.

    Parameters
    ----------
    budget : OutputBudget
    """
    after = {cause.cause: cause for cause in budget.after.causes} if budget.after else {}
    return [(cause, after.get(cause.cause)) for cause in by_total(budget.causes)]


def tolerance_sentence(tolerances: Tolerances) -> str:
    """The finding on the tolerances in a sentence or two.

    Parameters
    ----------
    tolerances : Tolerances
    """
    of_rigs = f"of {share(tolerances.in_share)} of all rigs"
    words = [
        f"The bound is {figure(tolerances.most_mm)}\u00a0mm for the {tolerances.output} {of_rigs}, "
        f"which is {_mm(tolerances.stated_mm)} with the stated spreads, and "
        f"{_mm(tolerances.floor_mm)} with none but of what cannot be made tighter."
    ]
    if tolerances.found:
        rule = "weighted by cost" if tolerances.by_cost else "all equally stringent"
        words.append(
            f"With those allowed, {rule}, it is {_mm(tolerances.allowed_mm)}: of "
            f"{tolerances.fresh} rigs drawn anew {share(tolerances.found.value)} keep the bound "
            f"({_range(tolerances.found)})."
        )
    return " ".join([*words, tolerances.note]).strip()


def comparison_text(comparison: RigComparison) -> str:
    """Another rig against a study's own as plain text, for whoever builds one of them.

    Parameters
    ----------
    comparison : RigComparison
    """
    lines, causes = [*comparison_words(comparison), ""], list[str]()
    errors = [["rms error of", "unit", "this rig", "the other", "the other over this", "narrower"]]
    for one in comparison.outputs:
        name = one.name.replace(AFTER, f" {RECALIBRATED}")
        lines.append(f"{name}: {one.verdict}.")
        bounds = map(with_interval, (one.this, one.other, one.ratio))
        errors.append([name, one.unit, *bounds, figure(one.narrower)])
        if one.places > 1:
            parts = [
                [part.part, *map(with_interval, (part.this, part.other, part.difference))]
                for part in one.parts
            ]
            headings = [f"mean square of {name}, {one.unit}²", "this rig", "the other", "change"]
            causes += ["", *_in_columns([headings, *parts])]
    return "\n".join([*lines, "", *_in_columns(errors), *causes])


def comparison_words(comparison: RigComparison) -> list[str]:
    """What differs between two rigs, and what they were compared by, in sentences.

    Parameters
    ----------
    comparison : RigComparison
    """
    changed = [f"{key} {old:g} to {new:g}" for key, (old, new) in comparison.changes.items()]
    told, (this, other) = "; ".join(comparison.told), comparison.failed
    words = [
        f"The other rig: {', '.join(changed)}.",
        f"Its file then states {told}." if told else "",
        f"Compared by {comparison.rigs} rigs of each, on the same draws: with draws of their own, "
        "the interval of a ratio would be so many times as wide as “narrower” says.",
        f"Rigs that failed with either are left out, {this} of this one and {other} of the other."
        if this or other
        else "",
        "Each interval is one of 95 %: of twenty quantities that are the same, one is expected to "
        "look different.",
    ]
    return [one for one in words if one]


def _in_columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table, the first column left-aligned."""
    wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "   ".join([row[0].ljust(wide[0]), *map(str.rjust, row[1:], wide[1:])]).rstrip()
        for row in rows
    ]


def _mm(size: float | None) -> str:
    return "not to be had" if size is None else f"{figure(size)}\u00a0mm"


def _facts_by_name(causes: Sequence[CauseFacts]) -> dict[str, CauseFacts]:
    """The causes by the names in the budgets; of a group one, which says when all are at work."""
    found: dict[str, CauseFacts] = {}
    for cause in causes:
        first = found.setdefault(cause.counted_as, cause)
        if cause.when != first.when:
            found[cause.counted_as] = replace(first, when="mixed")
    return found


def _gain_sentence(before: OutputBudget, after: OutputBudget, cause: str) -> str:
    """What recalibrating takes away."""
    if before.rms is None or after.rms is None:
        return ""
    if after.rms.high >= before.rms.low and after.rms.low <= before.rms.high:
        return "Recalibrating does not change the rms error measurably."
    words = f"Recalibrating takes the rms error {_from_to(before.rms, after.rms, before.unit)}"
    first, second = (
        next((c.alone_rms for c in budget.causes if c.cause == cause), None)
        for budget in (before, after)
    )
    if first and second:
        words += f"; with {cause} alone, {_from_to(first, second, before.unit)}"
    return f"{words}."


def _from_to(first: Bounded, second: Bounded, unit: str) -> str:
    return f"from {figure(first.value)}\u00a0{unit} to {figure(second.value)}\u00a0{unit}"


def figure(value: float | None) -> str:
    """A number with three significant digits, or whole; a true minus; a dash where there is none.

    Parameters
    ----------
    value : float or None

    Examples
    --------
    >>> figure(-0.07391), figure(14336.0), figure(None)
    ('−0.0739', '14336', '—')
    """
    if value is None:
        return "—"
    text = f"{value:.0f}" if 1000 <= abs(value) < 1e7 else f"{value:.3g}"
    return text.replace("-", "−")


def with_interval(bounded: Bounded | None) -> str:
    """A figure with half its interval's width, a dash where there is none.

    Parameters
    ----------
    bounded : Bounded or None

    Examples
    --------
    >>> with_interval(Bounded(0.4127, 0.39, 0.43))
    '0.413 ± 0.02'
    """
    return (
        figure(None) if bounded is None else f"{figure(bounded.value)} ± {bounded.half_width:.1g}"
    )


def share(value: float | None) -> str:
    """A share in percent, with a decimal below ten.

    Parameters
    ----------
    value : float or None

    Examples
    --------
    >>> share(0.6231), share(0.0213)
    ('62\xa0%', '2.1\xa0%')
    """
    if value is None:
        return "—"
    percent = 100 * value
    return f"{percent:z.{0 if abs(percent) >= 9.95 else 1}f}\u00a0%".replace("-", "−")


def _range(bounded: Bounded) -> str:
    """The 95 % interval of a share, in words."""
    return f"95\u00a0%: {share(bounded.low)} to {share(bounded.high)}"
