"""The rows of a budget in rendered physics, and the study that they are taken from."""

from dataclasses import replace
from pathlib import Path

import pytest
from study_examples import study_results

from lscan.errors import MeasurementError
from sim.studies.rig.states import check_keys
from sim.studies.studyfile import load_study
from tests.validation.studies import chapters as run, twelve as rendered


def test_the_rows_are_of_the_three_largest_indices_of_either_kind(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    results, _ = study_results()
    monkeypatch.setattr(rendered, "run_study", lambda *_: results)
    minutes, *indices = rendered.rendered_rows(tmp_path / "rendered")
    assert minutes.figure < 1 and minutes.bar == 30
    (height,) = (output for output in results.outputs if output.name == "height")
    expected = []
    for kind in ("total", "first"):
        widths = {
            getattr(cause, kind).value: getattr(cause, kind).half_width for cause in height.causes
        }
        expected += [widths[value] for value in sorted(widths, reverse=True)[:3]]
    assert [row.figure for row in indices] == expected
    assert {row.bar for row in indices} == {0.05}


def test_a_study_without_indices_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    results, _ = study_results()
    outputs = tuple(replace(output, causes=output.causes[:2]) for output in results.outputs)
    monkeypatch.setattr(rendered, "run_study", lambda *_: replace(results, outputs=outputs))
    with pytest.raises(MeasurementError, match="no indices"):
        rendered.rendered_rows(tmp_path / "rendered")


def test_the_study_has_twelve_causes_and_what_is_rendered_at_most(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    results, _ = study_results()
    monkeypatch.setattr(rendered, "run_study", lambda *_: results)
    rendered.rendered_rows(tmp_path / "rendered")
    study = load_study(tmp_path / "rendered.toml")
    check_keys(study)
    precision = study.file.precision
    assert (len(study.causes), study.file.tier) == (12, "both")
    assert (precision.rendered, precision.half_width) == (256, 0.05)


def test_an_earlier_measurements_runs_do_not_stay(tmp_path: Path) -> None:
    """A study refuses a folder with runs: the second measurement would be a failed row."""
    folder = tmp_path / "study" / "rendered"
    assert run._none_of_before(folder) == folder
    (folder / "runs").mkdir(parents=True)
    assert not run._none_of_before(folder).exists()
    assert folder.parent.exists()
