"""Rig files that are right: every field stated in one of them, every pair of drivers in one.

They name files beside them, which :func:`write_beside` makes: a recorded run, a video, a mesh
and a picture.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lscan.acquisition.replay import ReplayOptions
from lscan.acquisition.writer import create_run
from lscan.config.documents import Document, Strict
from lscan.config.rig import Rig
from lscan.config.rigfile import parse_rig
from lscan.devices.grbl import SerialTrackOptions
from lscan.devices.manual import ManualOptions
from lscan.devices.opencv_camera import OpencvOptions
from lscan.files.packaged import packaged_table
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
_SECTIONS: Document = packaged_table("sim.testing", "goodrigs.toml")
_TANK, _SHAFT = _SECTIONS["tank"], _SECTIONS["shaft"]
_BLOCK: Document = {"kind": "grooved-block"}


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
    rigs = [*_instruments(), *_tanks(), *_sources()]
    pairs = {rig.drivers for rig in rigs}
    for camera in CAMERAS:
        beside = _TANK if camera == "sim" else {}
        rigs += [_rig(camera, track, **beside) for track in TRACKS if (camera, track) not in pairs]
    return rigs


def _instruments() -> list[GoodRig]:
    """Rigs that hold every section of the instrument itself."""
    whole, board = _SECTIONS["instrument"], _SECTIONS["board"]
    turned: Document = {"workpiece": {"kind": "sandwave"}, "shaft": _SHAFT}
    return [
        _rig("opencv", "manual", _of(Rig, "name", *whole), **whole),
        _rig("replay", "manual", _of(Rig, *turned), **turned),
        _rig("opencv", "grbl", _of(Rig, "board", "workpiece"), board=board, workpiece=_BLOCK),
    ]


def _tanks() -> list[GoodRig]:
    """Rigs that hold every section of the tank, each kind of port and shape of target."""
    rest = [name for name in TankSections.model_fields if name not in ("head", "target")]
    head = {**_TANK["head"], "shaft": _SHAFT}
    turned = _TANK | {"head": head, "port": {"kind": "dome"}, "target": _SECTIONS["mesh"]}
    board = _TANK | {"board": _SECTIONS["board"], "target": {"shape": "board", "sand": {}}}
    piece = _TANK | {"workpiece": _BLOCK, "target": _SECTIONS["textured"]}
    return [
        _rig("sim", "sim", _of(TankSections, *rest), switched="pairs", **_TANK),
        _rig("sim", "manual", _of(TankSections, "head", "port"), shaft=_SHAFT, **turned),
        _rig("sim", "grbl", switched="pairs", **board),
        _rig("sim", "sim", _of(TankSections, "target"), **piece),
    ]


def _sources() -> list[GoodRig]:
    """Rigs that hold every option of every driver, and each source of an opencv camera's."""
    plan = _of(Rig, "camera", "track", "plan")
    return [
        _rig("opencv", "grbl", plan, _of_camera("opencv"), _of_track("grbl"), switched="pairs"),
        _rig("opencv", "manual", _of_track("manual")),
        _rig("replay", "replay", _of_camera("replay"), _of_track("replay"), switched="on"),
        _rig("opencv", "sim", _of_track("sim"), switched="on"),
        _rig("sim", "manual", _of_camera("sim"), **_TANK),
        _rig("opencv", "manual", source={"url": "http://127.0.0.1/x"}),
        _rig("opencv", "grbl", source={"file": "video.avi"}, switched="on"),
    ]


def _of(model: type[Strict], *sections: str) -> RigPart:
    return RigPart(model, (), sections)


def _of_camera(driver: str) -> RigPart:
    return RigPart(CAMERAS[driver], ("camera", "options"))


def _of_track(driver: str) -> RigPart:
    return RigPart(TRACKS[driver], ("track", "options"))


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
    document = {"camera": camera, "track": {"driver": "gone"}, "plan": _SECTIONS["plan"]}
    rig_file = parse_rig(document, source="rig.toml", trusted=True)
    with create_run(folder / "run", rig_file) as writer:
        for index, position_mm in enumerate(rig_file.rig.plan.positions_mm()):
            image = np.full((height_px, width_px), 10, dtype=np.uint8)
            writer.append(Frame(image, index, position_mm, position_mm, 0.1 * index, 20.0))


def _rig(
    camera: str,
    track: str,
    *parts: RigPart,
    source: Document | None = None,
    switched: str = "untouched",
    **sections: Any,
) -> GoodRig:
    """The rig of two drivers with its defaults written out.

    source: of an opencv camera.  switched: the plan for the laser.
    """
    camera_options = _SECTIONS["sources"][camera] if source is None else source
    if source is None:  # of a stream or a file, what only a device has may not even be stated
        camera_options = _written_out(CAMERAS[camera], camera_options)
    track_options = _written_out(TRACKS[track], _SECTIONS["track_options"][track])
    width_px, height_px = SIZE_PX
    size = {"width_px": width_px, "height_px": height_px}
    rig = {
        "camera": {"driver": camera, **size, "options": camera_options},
        "track": {"driver": track, "options": track_options},
        "plan": {**_SECTIONS["plan"], "laser": switched},
        **{key: value for key, value in sections.items() if key in Rig.model_fields},
    }
    tank = {key: value for key, value in sections.items() if key in TankSections.model_fields}
    written = _written_out(Rig, rig)
    stated = {name: written[name] for name in ("name", *rig)}
    document = stated | (_written_out(TankSections, tank) if tank else {})
    return GoodRig(f"{camera} and {track}", document, parts)


def _written_out(model: type[Strict], document: Document) -> Document:
    """The document with every default that is not None stated."""
    return model.model_validate(document).model_dump(mode="json", exclude_none=True)
