"""Studies for tests: of the paper's rig, what is known of its pictures made up, not rendered."""

from functools import cache

from lscan.config.documents import Document
from sim.studies.rig.prepared import Prepared
from sim.studies.studyfile import Study, study_of
from tests.validation.studies.twelve import assumed


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
    return assumed(study)
