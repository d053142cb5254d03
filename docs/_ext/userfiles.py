"""Which models check the files a user writes: what the reference of keys is made from."""

from collections.abc import Iterable
from dataclasses import replace

from modelkeys import Section, sections

from lscan.acquisition.replay import ReplayOptions
from lscan.calibration.metric.views import ViewsDocument
from lscan.config.board import Board
from lscan.config.rig import Rig
from lscan.config.targets import ShapesDocument
from lscan.devices.grbl import SerialTrackOptions
from lscan.devices.manual import ManualOptions
from lscan.devices.opencv_camera.options import OpencvOptions
from sim.datasets.datasetspec import DatasetFile
from sim.datasets.suite import SuiteSpecFile
from sim.devices import CameraOptions, TrackOptions
from sim.scene.file import TankSections
from sim.studies.design.catalogue import Catalogue
from sim.studies.studyfile import StudyFile

IN_RIG_ONLY = ("board",)  # its keys are those of a board file


def _without(found: list[Section], names: tuple[str, ...]) -> list[Section]:
    return [part for part in found if part.name.split(".")[0] not in names]


def _of_parts(found: Iterable[Section]) -> list[Section]:
    """The catalogue's tables, of those with the same keys the first; none that a scene has."""
    by_model = {part.model: part for part in reversed(list(found)) if part.name != "track.errors"}
    return [replace(part, variant="catalogue") for part in reversed(by_model.values())]


FILES: dict[str, list[Section]] = {
    "rig": _without(list(sections(Rig)), IN_RIG_ONLY),
    "camera-options": [
        Section("camera.options", OpencvOptions, "opencv"),
        Section("camera.options", ReplayOptions, "replay"),
        Section("camera.options", CameraOptions, "sim"),
    ],
    "track-options": [
        Section("track.options", SerialTrackOptions, "grbl"),
        Section("track.options", ManualOptions, "manual"),
        Section("track.options", ReplayOptions, "replay"),
        Section("track.options", TrackOptions, "sim"),
    ],
    "scene": list(sections(TankSections)),
    "board": list(sections(Board)),
    "shapes": list(sections(ShapesDocument)),
    "study": list(sections(StudyFile)),
    "dataset": list(sections(DatasetFile)),
    "suite": list(sections(SuiteSpecFile)),
    "catalogue": _of_parts(sections(Catalogue)),
    "views": _without(list(sections(ViewsDocument)), ("optics",)),
}
"""The sections of each kind of file, in the order of the models."""
