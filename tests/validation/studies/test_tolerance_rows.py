"""The row of the tolerances' yield, and the study that it is taken from."""

from dataclasses import replace
from pathlib import Path

import pytest
from places import SCENES
from study_examples import study_results

from lscan.errors import MeasurementError
from sim.studies.rig.states import check_keys
from sim.studies.studyfile import load_study
from tests.validation.studies import designs as tolerances


def test_the_row_says_how_far_the_yield_is_off(monkeypatch: pytest.MonkeyPatch) -> None:
    results, _ = study_results()
    monkeypatch.setattr(tolerances, "run_study", lambda *_: results)
    (row,) = tolerances.tolerance_rows(Path(), Path())
    assert row.figure == pytest.approx(0.4)
    assert row.bar == 3
    assert "500 fresh rigs of the geometric tier: 95.4 % (93.2 to 96.9 %)" in row.reference
    monkeypatch.setattr(tolerances, "run_study", lambda *_: replace(results, tolerances=None))
    with pytest.raises(MeasurementError):
        tolerances.tolerance_rows(Path(), Path())


def test_the_study_has_six_causes_and_the_bound_that_is_asked_for() -> None:
    study = load_study(SCENES / "studies" / "tolerances.toml")
    check_keys(study)
    bound = study.file.tolerances
    assert bound is not None
    assert (len(study.causes), bound.most_mm, bound.in_share) == (6, 0.1, 0.95)
