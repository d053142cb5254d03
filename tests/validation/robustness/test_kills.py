"""Scans killed and resumed: how the figure is made, and that it can fail."""

from pathlib import Path

import pytest

from tests.validation.robustness import acquisition as kills
from tests.validation.robustness.acquisition import folder_bytes, kill_runs


@pytest.mark.slow
def test_killed_scans_are_finished_to_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Scans of direct light, which begin in half the time; those of ``make validate`` show all."""
    monkeypatch.setattr(kills, "KILLS_A_RUN", 2)
    scene = tmp_path / "direct.toml"
    scene.write_text('include = "paper/sandwave"\n[render]\nscatter_samples = 0\n')
    runs = kill_runs(scene, count=1, seed=1, frames=20)
    assert sum(len(run.kept) for run in runs) >= 1
    assert all(run.same for run in runs)
    assert all(0 <= kept <= 20 for run in runs for kept in run.kept)


def test_a_byte_or_a_file_too_many_is_a_difference(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name / "frames").mkdir(parents=True)
        (tmp_path / name / "frames" / "000000.png").write_bytes(b"picture")
    assert folder_bytes(tmp_path / "a") == folder_bytes(tmp_path / "b")
    (tmp_path / "b" / "frames" / ".000001.png.tmp").touch()
    assert folder_bytes(tmp_path / "a") != folder_bytes(tmp_path / "b")
    (tmp_path / "b" / "frames" / ".000001.png.tmp").unlink()
    (tmp_path / "b" / "frames" / "000000.png").write_bytes(b"picturE")
    assert folder_bytes(tmp_path / "a") != folder_bytes(tmp_path / "b")
