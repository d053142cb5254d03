"""The page of a study: where each error comes from, in words, tables and plots; self-contained."""

import json
from collections.abc import Sequence
from dataclasses import replace

from lscan.figures.style import page_template
from lscan.version import __version__
from sim.studies.intervals import Bounded
from sim.studies.plots import StudyPlot, by_total, front_plot, largest, plots_of
from sim.studies.records import CauseBudget, CauseFacts, OutputBudget, StudyResults, Tolerances

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
    template = page_template(
        "sim.studies",
        "report.html.j2",
        figure=figure,
        share=share,
        headline=headline,
        kept=kept,
        ranked=ranked,
    )
    return template.render(
        results=results,
        plots=plots,
        front=front,
        every=every,
        varied=_counted(results.causes),
        failed=sum(results.failures.values()),
        source=json.dumps(results.source, indent=2, ensure_ascii=False, default=str),
        data=_script_data(every),
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
        words.append(_recalibrated(budget, budget.after, cause.cause if cause else ""))
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


def ranked(budget: OutputBudget) -> list[tuple[CauseBudget, CauseBudget | None]]:
    """The causes as the table has them, the largest first, each with itself after recalibration.

    Parameters
    ----------
    budget : OutputBudget
    """
    after = {cause.cause: cause for cause in budget.after.causes} if budget.after else {}
    return [(cause, after.get(cause.cause)) for cause in by_total(budget.causes)]


def kept(tolerances: Tolerances) -> str:
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


def _mm(size: float | None) -> str:
    return "not to be had" if size is None else f"{figure(size)}\u00a0mm"


def _counted(causes: Sequence[CauseFacts]) -> dict[str, CauseFacts]:
    """The causes by the names in the budgets; of a group one, which says when all are at work."""
    found: dict[str, CauseFacts] = {}
    for cause in causes:
        first = found.setdefault(cause.counted_as, cause)
        if cause.when != first.when:
            found[cause.counted_as] = replace(first, when="mixed")
    return found


def _recalibrated(before: OutputBudget, after: OutputBudget, cause: str) -> str:
    """What recalibrating takes away."""
    if before.rms is None or after.rms is None:
        return ""
    apart = after.rms.high < before.rms.low or after.rms.low > before.rms.high
    if not apart:
        return "Recalibrating does not change the rms error measurably."
    words = f"Recalibrating takes the rms error {_from_to(before.rms, after.rms, before.unit)}"
    first, second = (
        next((c.alone_rms for c in budget.causes if c.cause == cause), None)
        for budget in (before, after)
    )
    alone = (
        f"; with {cause} alone, {_from_to(first, second, before.unit)}" if first and second else ""
    )
    return f"{words}{alone}."


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


def _script_data(plots: list[StudyPlot]) -> str:
    """What the page's script draws; no name in it can end the script element."""
    text = json.dumps([plot.data for plot in plots], allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")
