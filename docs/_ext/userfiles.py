"""Which models check the files a user writes: what the reference of keys is made from."""

from modelkeys import Section, sections

from lscan.acquisition.replay import ReplayOptions
from lscan.calibration.multiview.viewsfile import ViewsDocument
from lscan.config.board import Board
from lscan.config.rig import Rig
from lscan.config.shapes import ShapesDocument
from lscan.devices.grbl import SerialTrackOptions
from lscan.devices.manual import ManualOptions
from lscan.devices.opencv_camera.options import OpencvOptions
from sim.devices import CameraOptions, TrackOptions
from sim.scene.file import TankSections

IN_RIG_ONLY = ("board",)  # its keys are those of a board file


def _without(found: list[Section], names: tuple[str, ...]) -> list[Section]:
    return [part for part in found if part.name.split(".")[0] not in names]


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
    "views": _without(list(sections(ViewsDocument)), ("optics",)),
}
"""The sections of each kind of file, in the order of the models."""
