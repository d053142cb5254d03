"""Packages of strangers that register plug-ins, as an installer would leave them on the path."""

from functools import cache
from pathlib import Path

import pytest

from lscan.config import plugins


def install_package(
    monkeypatch: pytest.MonkeyPatch, folder: Path, name: str, entries: str, code: str = ""
) -> None:
    """A package NAME 2.0 of one module NAME: its entry points as in entry_points.txt, its code."""
    info = folder / f"{name}-2.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 2.0\n")
    (info / "entry_points.txt").write_text(entries)
    (info / "top_level.txt").write_text(f"{name}\n")
    (folder / f"{name}.py").write_text(code)
    monkeypatch.syspath_prepend(str(folder))
    for known in (plugins._entry_points, plugins._packages):
        monkeypatch.setattr(plugins, known.__name__, cache(known.__wrapped__))
