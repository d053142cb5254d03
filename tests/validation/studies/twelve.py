"""A study of twelve causes on the paper's rig, of which nothing is rendered beforehand."""

import tempfile
import time
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from lscan.calibration.marks import joined_marks
from lscan.config.documents import Document, write_toml
from lscan.config.rig import parse_rig
from lscan.errors import MeasurementError
from lscan.records import Floats, select
from sim.scene import Scene, load_scene, scene_of
from sim.studies.executor import open_workers
from sim.studies.results import identity_of, open_store
from sim.studies.rig.prepared import Prepared, on_board, stated_reading
from sim.studies.rig.states import ScanPlaces, places_of
from sim.studies.running import RigSource, StudyOptions, run_rows
from sim.studies.study import run_study
from sim.studies.studyfile import Study, study_of
from sim.truth import board_truth
from tests.validation.rows import Row, row

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
    reading = stated_reading(truth, np.full(len(status), MARK_PX), status)
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


# What a budget of twelve causes in rendered physics costs, and how well its indices are known.


RENDERED = 256
LARGEST = 3
STUDY: Final[Document] = {
    "name": "twelve causes in rendered physics",
    "calibrate": "best/board",
    "scan": "best/sandwave",
    "tier": "both",
    "places": {"pictures": 8, "columns": 24},  # the sandwave, reduced: a line in eight pictures
    "precision": {
        "base": 1024, "most": 1024, "rendered": RENDERED, "half_width": 0.05, "alone": 16,
    },
    "cause": CAUSES,
}  # fmt: skip


def rendered_rows(folder: Path, options: StudyOptions | None = None) -> list[Row]:
    """Minutes of the study, and half the 95 % intervals of the three largest indices.

    Parameters
    ----------
    folder : Path, of the study's runs
    options : StudyOptions, optional

    Raises
    ------
    MeasurementError
        The study has no indices of rendered rigs.
    """
    file = folder.with_suffix(".toml")
    write_toml(file, STUDY)
    began_s = time.perf_counter()
    results = run_study(file, folder, options)
    minutes = (time.perf_counter() - began_s) / 60
    (height,) = (output for output in results.outputs if output.name == "height")
    found = [row("study-rendered", minutes, seed=results.seed, most=RENDERED, causes=len(CAUSES))]
    for kind in ("total", "first-order"):
        indices = {c.cause: c.total if kind == "total" else c.first for c in height.causes}
        known = {cause: index for cause, index in indices.items() if index is not None}
        if len(known) < LARGEST:
            raise MeasurementError("the study has no indices of rendered rigs")
        for cause in sorted(known, key=lambda cause: -known[cause].value)[:LARGEST]:
            index = known[cause]
            words = {"low": index.low, "high": index.high, "value": index.value}
            name = "study-rendered-index"
            found.append(
                row(name, index.half_width, seed=results.seed, cause=cause, kind=kind, **words)
            )
    return found


# How long a budget of twelve causes takes in the geometric tier.


RIGS = 14_336  # 1024 base samples of 12 causes
MINUTES = {"graticule-2": 5.0, "refractive": 20.0}
PARTS = 5  # timed one by one: their spread says what else the machine did
SEED = 14


def speed_rows(rows: int, workers: int = 2) -> list[Row]:
    """Minutes that 14,336 rigs take with either map, from fewer.

    Parameters
    ----------
    rows : int, rigs that are timed, at least as many as there are PARTS
    workers : int, processes
    """
    found = []
    for plane_map, bar in MINUTES.items():
        minutes = RIGS / 60 * seconds_a_row(plane_map, rows, workers)
        words: dict[str, Any] = {
            "plane_map": plane_map,
            "workers": workers,
            "rows": rows,
            "rigs": RIGS,
        }
        words |= {"low": minutes.min(), "high": minutes.max()}
        figure = float(np.median(minutes))
        found.append(row("study-speed", figure, bar=bar, seed=SEED, **words))
    return found


def seconds_a_row(plane_map: str, rows: int, workers: int) -> Floats:
    """(PARTS,) s of wall time a row, once every worker has made its problem.

    Parameters
    ----------
    plane_map : str
    rows : int, in all parts
    workers : int, processes
    """
    study = twelve(plane_map)
    source = source_of(study, assumed(study, scan_places()))
    numbers = np.random.default_rng(SEED).random((rows + 2 * workers, len(study.causes)))
    with (
        tempfile.TemporaryDirectory(prefix="lscan-study-") as name,
        open_store(Path(name), identity_of(source)) as store,
        open_workers(workers) as able,
    ):
        run_rows(source, numbers[rows:], store, able)
        seconds = []
        for part in np.array_split(numbers[:rows], PARTS):
            began_s = time.perf_counter()
            run_rows(source, part, store, able)
            seconds.append((time.perf_counter() - began_s) / len(part))
    return np.array(seconds)
