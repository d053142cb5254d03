"""Chapters of an accuracy table, for processes of their own: little is imported here, which each
of those pays for."""

from pathlib import Path

from sim.validation.accuracy.effort import AccuracyEffort
from sim.validation.rows import Row


def good(scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """One row that passes."""
    return [Row("good", "itself", 1.0, 2.0, "mm", "made up", len(effort.seeds))]


def bad(scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """One row that does not."""
    return [Row("bad", "itself", 3.0, 2.0, "mm", "made up", len(effort.seeds))]


def ends(scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """No row."""
    raise ValueError("only 3 tops")
