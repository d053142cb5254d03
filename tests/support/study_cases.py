"""Studies for tests: of the paper's rig, what is known of its pictures made up, not rendered."""

from dataclasses import replace
from functools import cache

import numpy as np

from lscan.config.documents import Document
from lscan.records import BoardReading, Marks, select
from sim.studies.places import places_of
from sim.studies.prepared import Prepared, on_board
from sim.studies.studyfile import Study, study_of
from sim.truth import board_truth

MARK_PX, SENSOR_PX, SPECKLE_PX = 0.01, 0.02, 0.04


def study_with(causes: Document, **sections: object) -> Study:
    """A study of the paper's rig with a ray-traced map, of few places."""
    places = {"pictures": 4, "columns": 80}
    document = {
        "calibrate": "best/board", "scan": "best/sandwave", "places": places, "cause": causes,
    }  # fmt: skip
    return study_of({**document, **sections}, "study.toml")


@cache
def known_of(calibrate: str = "best/board", scan: str = "best/sandwave") -> Prepared:
    """What would be found on pictures: marks and line without bias, of given scatter."""
    study = study_with(
        {"focal": {"key": "lens.focal_px", "when": "drift", "fixed": 850.0}},
        calibrate=calibrate,
        scan=scan,
    )
    reading = _stated(board_truth(study.calibrate).centres)
    places = places_of(study.scan, 4, 80)
    places = select(places, on_board(study, reading, places))
    count = len(places.frame)
    marks = len(reading.grid.status) + sum(len(ruler.marks.status) for ruler in reading.rulers)
    return Prepared(
        places=places,
        reading=reading,
        marks_bias_px=np.zeros((marks, 2)),
        marks_sigma_px=np.full(marks, MARK_PX),
        line_bias_px=np.zeros(count),
        corrected_px=np.zeros(count),
        sensor_px=np.full(count, SENSOR_PX),
        speckle_px=np.full(count, SPECKLE_PX),
    )


def _stated(reading: BoardReading) -> BoardReading:
    """The reading with the uncertainty of its marks stated."""

    def stated(marks: Marks) -> Marks:
        return replace(marks, sigma_px=np.where(marks.found, MARK_PX, np.nan))

    rulers = tuple(replace(ruler, marks=stated(ruler.marks)) for ruler in reading.rulers)
    return replace(reading, grid=stated(reading.grid), rulers=rulers, dots={}, rings={})
