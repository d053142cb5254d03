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
from tests.validation.studies.crosscheck import STAYS, looked_at
from tests.validation.studies.twelve import assumed

STUDY = looked_at(load_study(SCENES / "studies" / "cross-check.toml"), Looked(pictures=2))


@pytest.mark.slow
@pytest.mark.parametrize("cause", list(STAYS)[:1])
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
