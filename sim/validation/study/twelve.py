"""A study of twelve causes on the paper's rig, of which nothing is rendered beforehand."""

from functools import cache
from typing import Any, Final

import numpy as np

from lscan.calibration.planemap import joined_marks
from lscan.config.documents import Document
from lscan.config.rig import parse_rig
from lscan.records import select
from sim.scene import Scene, load_scene, scene_of
from sim.studies.rig.prepared import Prepared, on_board, stated
from sim.studies.rig.states import ScanPlaces, places_of
from sim.studies.run.running import RigSource
from sim.studies.studyfile import Study, study_of
from sim.truth import board_truth

MARK_PX: Final = 0.01
SENSOR_PX: Final = 0.02
SPECKLE_PX: Final = 0.04
"""Scatter of marks and line as pictures of the best chain show it, rounded."""

SCAN: Final = "best/sandwave"
PLACES: Final = {"pictures": 16, "columns": 40}
CAUSES: Final[Document] = {
    "noise": {"key": "sensor.noise", "when": "noise"},
    "speckle": {"key": "sensor.speckle", "when": "noise"},
    "board-off": {
        "key": "calibrate.target.position_mm.1", "when": "as-built", "normal": [0, 0.1],
    },
    "board-lean": {"key": "calibrate.target.tilt_x_deg", "when": "as-built", "normal": [0, 0.02]},
    "port": {"key": "port.tilt_x_deg", "when": "drift", "normal": [0, 0.02]},
    "gap": {"key": "port.gap_mm", "when": "as-built", "normal": [10, 0.5]},
    "salinity": {"key": "water.salinity_psu", "when": "drift", "uniform": [0, 5]},
    "sheet": {"key": "laser.tilt_deg", "when": "drift", "normal": [0, 0.01]},
    "focal": {"key": "lens.focal_px", "when": "drift", "normal": [0, 5e-4], "relative": True},
    "camera": {"key": "head.depression_deg", "when": "drift", "normal": [0, 0.005], "off": True},
    "pointing": {"key": "laser.tilt_deg", "when": "each-frame", "normal": [0, 0.01]},
    "screw": {
        "key": "track_errors.periodic_mm", "when": "as-built", "fixed": 0.05,
        "with": {"track_errors.pitch_mm": 8, "track_errors.phase_deg": 30},
    },
}  # fmt: skip


def twelve(plane_map: str, causes: Document = CAUSES) -> Study:
    """The study, its rig calibrated with a plane map of that name.

    Parameters
    ----------
    plane_map : str, its full name
    causes : dict, optional, others
    """
    document: dict[str, Any] = {
        "calibrate": "best/board", "scan": SCAN, "places": PLACES, "cause": causes,
    }  # fmt: skip
    scenes = tuple(_with_map(load_scene(document[key]), plane_map) for key in ("calibrate", "scan"))
    return study_of(document, "twelve causes", (scenes[0], scenes[1]))


def _with_map(scene: Scene, plane_map: str) -> Scene:
    changed = {**scene.document, "calibration": {"plane_map": plane_map}}
    return scene_of(parse_rig(changed, source=scene.source, trusted=True))


@cache
def scan_places() -> ScanPlaces:
    """The places of the study's scan: the same with every map and cause, they take seconds."""
    return places_of(load_scene(SCAN), **PLACES)


def assumed(study: Study, places: ScanPlaces | None = None) -> Prepared:
    """What would be found on pictures: marks and line without bias, of a usual scatter.

    Parameters
    ----------
    study : Study
    places : ScanPlaces or None, of its scan where they are known
    """
    truth = board_truth(study.calibrate).centres
    status = joined_marks(truth).status
    reading = stated(truth, np.full(len(status), MARK_PX), status)
    places = places or places_of(study.scan, study.file.places.pictures, study.file.places.columns)
    places = select(places, on_board(study, reading, places))
    count, marks = len(places.frame), len(status)
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


def source_of(study: Study, prepared: Prepared) -> RigSource:
    """What a worker makes the geometric tier of a study from.

    Parameters
    ----------
    study : Study
    prepared : Prepared
    """
    documents = study.document, study.calibrate.document, study.scan.document
    return RigSource("geometric", *documents, prepared.packed(), study.source)
