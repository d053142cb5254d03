"""The rows of single errors beside a trial's, by a rig of which nothing is rendered."""

from dataclasses import replace

import numpy as np
import pytest
from places import SCENES

from lscan.records import Floats
from sim.studies.problem import NOMINAL, columns
from sim.studies.rig.evaluation import GeometricRig
from sim.studies.rig.prepared import Prepared
from sim.studies.rig.states import states_of
from sim.studies.studyfile import Looked, Study, load_study
from tests.validation.studies import crosscheck
from tests.validation.studies.crosscheck import STAYS, TRIAL_MM, as_in_the_trial, looked_at
from tests.validation.studies.twelve import assumed

STUDY = looked_at(load_study(SCENES / "studies" / "cross-check.toml"), Looked(pictures=4))


@pytest.mark.parametrize("cause", STAYS)
def test_a_picture_is_off_by_its_draw_as_by_the_same_number_in_all(cause: str) -> None:
    known = assumed(STUDY)
    frame = known.places.frame
    row = _only(cause, 0.3)
    found = _height(STUDY, known, row)
    (change,) = states_of(STUDY, row).scan.tank.change
    for number in np.unique(frame).tolist():
        still = STUDY.file.cause[STAYS[cause]].model_copy(
            update={"fixed": change.offset(number, 0)}
        )
        causes = {**STUDY.file.cause, STAYS[cause]: still}
        same = replace(STUDY, file=STUDY.file.model_copy(update={"cause": causes}))
        alike = _height(same, known, _only(STAYS[cause], 0.5))
        here = frame == number
        assert np.abs(alike[here]).max() > 0.01
        # Both find the lit points to 1e-7 mm.
        np.testing.assert_allclose(found[here], alike[here], rtol=0, atol=1e-6)


def _only(cause: str, share: float) -> Floats:
    row = np.full(len(STUDY.causes), NOMINAL)
    row[STUDY.causes.index(cause)] = share
    return row


def _height(study: Study, known: Prepared, row: Floats) -> Floats:
    rig = GeometricRig(study, known)
    return rig.evaluate(row)[columns(rig.outputs)["height"]]


def test_the_trial_had_light_of_the_first_order_and_single_pictures() -> None:
    scan = as_in_the_trial(STUDY).scan
    assert STUDY.scan.rig.sheet is not None
    assert scan.rig.sheet is None
    assert scan.tank.render.scatter_samples == 0
    assert scan.tank.render.samples == STUDY.scan.tank.render.samples


def test_each_figure_of_the_trial_has_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crosscheck, "prepare", assumed)
    monkeypatch.setattr(crosscheck, "RenderedRig", GeometricRig)
    monkeypatch.setattr(crosscheck, "rms_with", lambda *_: 0.1)
    rows = crosscheck.cross_check_rows(SCENES, Looked(pictures=2, columns=40), seeds=1)
    single, implied, tiers = rows[: len(TRIAL_MM)], rows[-4::2], rows[-3::2]
    assert [row.figure for row in single] == pytest.approx(
        [100 * abs(0.1 / trial - 1) for trial in TRIAL_MM.values()]
    )
    assert [row.figure for row in tiers] == [0, 0]
    # 0.074 mm of noise, and a fifth of what 1.15 and 0.73 mm are without it.
    found = [100 * abs(0.1 / by_hand - 1) for by_hand in (0.2412, 0.1631)]
    assert [row.figure for row in implied] == pytest.approx(found, abs=0.05)
    said = [row for row in single if "ask for" in row.reference]
    assert [row.what.split(" at work")[0].split()[-1] for row in said] == list(STAYS)
    assert "1.45 times" in said[0].reference
