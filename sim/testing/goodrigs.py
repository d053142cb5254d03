"""Rig files that are right: every field stated in one of them, every pair of drivers in one.

They name files beside them, which :func:`write_beside` makes: a recorded run, a video, a mesh
and a picture.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import product
from pathlib import Path

import numpy as np

from lscan.acquisition.replay import ReplayOptions
from lscan.acquisition.writer import create_run
from lscan.config.documents import Document, Strict, merge
from lscan.config.rig import Rig, parse_rig
from lscan.devices.grbl import SerialTrackOptions
from lscan.devices.manual import ManualOptions
from lscan.devices.opencv_camera import OpencvOptions
from lscan.files.disk import packaged_table
from lscan.records import Frame
from sim.devices import CameraOptions, TrackOptions
from sim.scene.file import TankSections

SIZE_PX = (16, 16)
CAMERAS: dict[str, type[Strict]] = {
    "opencv": OpencvOptions,
    "replay": ReplayOptions,
    "sim": CameraOptions,
}
TRACKS: dict[str, type[Strict]] = {
    "grbl": SerialTrackOptions,
    "manual": ManualOptions,
    "replay": ReplayOptions,
    "sim": TrackOptions,
}
_TABLE: Document = packaged_table("sim.testing", "goodrigs.toml")


@dataclass(frozen=True)
class RigPart:
    """A table of a rig file that one model checks.

    prefix: the keys that lead to the table; () is the whole file.  sections: those of the
    model's fields that are set wrong in this rig, () for all.
    """

    model: type[Strict]
    prefix: tuple[str, ...]
    sections: tuple[str, ...] = ()


@dataclass(frozen=True)
class GoodRig:
    """A rig file that is right, and the parts of it that are to be set wrong.

    Attributes
    ----------
    name : str, for messages
    document : Document, the rig file's tables
    parts : tuple, each a table of the document, and the model that checks it
    """

    name: str
    document: Document
    parts: tuple[RigPart, ...]

    @property
    def drivers(self) -> tuple[str, str]:
        """The names of its camera's and its track's driver."""
        return self.document["camera"]["driver"], self.document["track"]["driver"]


def good_rigs() -> list[GoodRig]:
    """Rigs that together hold every field, and every pair of drivers.

    Each field is to be set wrong in one of them only, and each rig holds little besides: some
    thousands of files are read.
    """
    rigs = [_rig(**rig) for rig in _TABLE["rig"]]
    pairs = {rig.drivers for rig in rigs}
    for camera, track in product(CAMERAS, TRACKS):
        if (camera, track) not in pairs:
            rigs.append(_rig(camera, track, ["tank"] if camera == "sim" else []))
    return rigs


def write_beside(folder: Path) -> None:
    """Make the files that the good rigs name: a video, a mesh, a picture and a run.

    Parameters
    ----------
    folder : Path, of the rig file
    """
    for name in ("video.avi", "mesh.ply", "picture.png"):
        (folder / name).touch()
    width_px, height_px = SIZE_PX
    camera = {"driver": "gone", "width_px": width_px, "height_px": height_px}
    document = {"camera": camera, "track": {"driver": "gone"}, "plan": _TABLE["plan"]}
    rig_file = parse_rig(document, source="rig.toml", trusted=True)
    with create_run(folder / "run", rig_file) as writer:
        for index, position_mm in enumerate(rig_file.rig.plan.positions_mm()):
            image = np.full((height_px, width_px), 10, dtype=np.uint8)
            writer.append(Frame(image, index, position_mm, position_mm, 0.1 * index, 20.0))


def _rig(
    camera: str,
    track: str,
    sections: Sequence[str] = (),
    source: Document | None = None,
    laser: str = "untouched",
    wrong: Mapping[str, Sequence[str]] | None = None,
) -> GoodRig:
    """The rig of two drivers with its defaults written out, as goodrigs.toml describes it."""
    laid = reduce(merge, (_TABLE["sections"][name] for name in sections), Document())
    options = source  # of a stream or a file, what only a device has may not even be stated
    if options is None:
        options = _written_out(CAMERAS[camera], _TABLE["camera_options"][camera])
    width_px, height_px = SIZE_PX
    size = {"width_px": width_px, "height_px": height_px}
    track_options = _written_out(TRACKS[track], _TABLE["track_options"][track])
    rig = {
        "camera": {"driver": camera, **size, "options": options},
        "track": {"driver": track, "options": track_options},
        "plan": {**_TABLE["plan"], "laser": laser},
        **{key: value for key, value in laid.items() if key in Rig.model_fields},
    }
    tank = {key: value for key, value in laid.items() if key in TankSections.model_fields}
    written = _written_out(Rig, rig)
    document = {name: written[name] for name in ("name", *rig)}
    if tank:
        document |= _written_out(TankSections, tank)
    places: dict[str, tuple[type[Strict], tuple[str, ...]]] = {
        "file": (Rig, ()),
        "tank": (TankSections, ()),
        "camera": (CAMERAS[camera], ("camera", "options")),
        "track": (TRACKS[track], ("track", "options")),
    }
    parts = (RigPart(*places[name], tuple(fields)) for name, fields in (wrong or {}).items())
    return GoodRig(f"{camera} and {track}", document, tuple(parts))


def _written_out(model: type[Strict], document: Document) -> Document:
    """The document with every default that is not None stated."""
    return model.model_validate(document).model_dump(mode="json", exclude_none=True)
