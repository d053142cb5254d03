"""The hardware table's run: what it writes beside the rows goes into a folder beside their file."""

from pathlib import Path
from typing import Any

import pytest
from places import SCENES

from sim.validation.robustness import run


@pytest.mark.parametrize(
    ("output", "folder"), [("deep/hardware.json", "deep/hardware"), ("rows", "rows-runs")]
)
def test_runs_and_screenshot_lie_beside_the_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, output: str, folder: str
) -> None:
    written: list[Path] = []

    def chapter(*given: Any) -> list[Any]:
        written.extend(
            path for path in given if isinstance(path, Path) and tmp_path in path.parents
        )
        return []

    for name in ("livepage_rows", "moving_rows", "overhead_rows", "agreement_rows"):
        monkeypatch.setattr(run, name, chapter)
    for name in ("kill_rows", "field_rows"):
        monkeypatch.setattr(run, name, lambda *_: [])
    monkeypatch.setattr(run, "fault_rows", lambda *_: ([], []))
    run.run_hardware(SCENES, tmp_path / output, quick=True)
    beside = tmp_path / folder
    assert beside.is_dir() and (tmp_path / output).is_file()
    assert written == [beside / "live", beside / "moving", beside, beside / "agreement"]
