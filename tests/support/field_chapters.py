"""Chapters of a field table, for processes of their own: little is imported here, which each of
those pays for."""

from pathlib import Path

from sim.validation.field.effort import FieldEffort
from sim.validation.rows import Row


def good(scenes: Path, effort: FieldEffort) -> list[Row]:
    """One row that passes."""
    return [Row("good", "itself", 1.0, 2.0, "mm", "made up", len(effort.seeds))]


def bad(scenes: Path, effort: FieldEffort) -> list[Row]:
    """One row that does not."""
    return [Row("bad", str(effort.photographs), 3.0, 2.0, "mm", "made up")]
