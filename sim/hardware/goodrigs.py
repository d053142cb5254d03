"""Rig files that are right, one for each combination of drivers, each stating all it may state.

They name files beside them, which :func:`write_beside` makes: a recorded run, a video, a mesh
and a picture.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from lscan.devices.grbl import SerialTrackOptions
from lscan.devices.manual import ManualOptions
from lscan.devices.opencv_camera import OpencvOptions
from lscan.devices.replay import ReplayOptions
from lscan.documents import Document, Strict
from lscan.records import Frame
from lscan.rig import Rig, parse_rig
from lscan.runwriter import create_run
from sim.devices import CameraOptions, TrackOptions
from sim.scene import Tank

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
_SOURCES: dict[str, Document] = {"opencv": {"device": 0}, "replay": {"run_file": "run"}, "sim": {}}
_TRAVEL = {"min_mm": 0.0, "max_mm": 10.0}
_TRACK_OPTIONS: dict[str, Document] = {
    "grbl": {"port": "none", **_TRAVEL},
    "manual": _TRAVEL,
    "replay": {"run_file": "run"},
    "sim": _TRAVEL,
}
_PLAN = {"start_mm": 0.0, "step_mm": 1.0, "frames": 2}

_BOARD: Document = {
    "grid": {"columns": 4, "rows": 3, "pitch_mm": 50.0, "dot_diameter_mm": 5.0},
    "ruler": [{"direction": "vertical", "at_mm": -20.0, "first_mm": 0.0, "last_mm": -100.0}],
    "dot": [
        {"name": "A", "x_mm": 25.0, "z_mm": -25.0},
        {"name": "B", "x_mm": 75.0, "z_mm": -25.0},
    ],
    "ring": [{"name": "E", "x_mm": 25.0, "z_mm": -75.0, "diameter_mm": 10.0}],
    "distances": [["A", "B"]],
}
_INSTRUMENT: Document = {
    "stripe": {"blur_px": 0.7, "noise": {"read_dn": 1.0}},
    "optics": {"focal_px": [800.0, 80.0], "centre_u_px": [8.0, 1.0], "centre_v_px": [8.0, 1.0]},
    "sheet": {
        "thickness_mm": 1.5,
        "camera_mm": [0.0, -500.0, 0.0],
        "apex_mm": [0.0, 0.0, 900.0],
    },
    "board": _BOARD,
}
_TANK: Document = {
    "lens": {"focal_px": 20.0, "centre_px": [7.5, 7.5], "focus_mm": 800.0},
    "head": {"camera_mm": [75.0, -500.0, 290.0]},
    "port": {"kind": "flat"},
    "laser": {
        "power_mw": 10.0,
        "apex_mm": [75.0, 0.0, 900.0],
        "drift": {},
        "lines": [{"tilt_deg": 0.0, "share": 0.5}],
    },
    "target": {
        "shape": "board",
        "texture": {"file": "picture.png", "size_mm": [10.0, 10.0]},
        "sand": {},
    },
    "floor": {"z_mm": -200.0},
}


@dataclass(frozen=True)
class Part:
    """A table of a rig file that one model checks.

    prefix: the keys that lead to the table; () is the whole file.  sections: those of the
    model's fields that are set wrong in this rig.
    """

    model: type[Strict]
    prefix: tuple[str, ...]
    sections: tuple[str, ...]


@dataclass(frozen=True)
class GoodRig:
    """A rig file that is right, and the parts of it that are to be set wrong."""

    name: str
    document: Document
    parts: tuple[Part, ...]


def good_rigs() -> list[GoodRig]:
    """Rigs that together hold every field: rich ones, then one for each pair of drivers."""
    every = tuple(Rig.model_fields)
    block, wave = {"kind": "grooved-block"}, {"kind": "sandwave"}
    dome, mesh = {"kind": "dome"}, {"shape": "mesh", "file": "mesh.ply"}
    tank = Part(Tank, (), tuple(Tank.model_fields))
    odd = Part(Tank, (), ("port", "target"))
    rigs = [
        _rig("opencv", "grbl", Part(Rig, (), every), **_INSTRUMENT, workpiece=block),
        _rig("opencv", "manual", Part(Rig, (), ("workpiece",)), workpiece=wave),
        _rig("sim", "sim", tank, board=_BOARD, **_TANK),
        _rig("sim", "manual", odd, **{**_TANK, "port": dome, "target": mesh}),
    ]
    devices = Part(Rig, (), ("camera", "track", "plan"))
    for camera in CAMERAS:
        beside = {"board": _BOARD, **_TANK} if camera == "sim" else {}
        rigs += [_rig(camera, track, devices, **beside) for track in TRACKS]
    sources: tuple[Document, ...] = ({"url": "http://127.0.0.1/x"}, {"file": "video.avi"})
    return rigs + [_rig("opencv", "manual", devices, source) for source in sources]


def write_beside(folder: Path) -> None:
    """Make in ``folder`` the files that the good rigs name."""
    for name in ("video.avi", "mesh.ply", "picture.png"):
        (folder / name).touch()
    width_px, height_px = SIZE_PX
    camera = {"driver": "gone", "width_px": width_px, "height_px": height_px}
    document = {"camera": camera, "track": {"driver": "gone"}, "plan": _PLAN}
    rig_file = parse_rig(document, source="rig.toml", trusted=True)
    with create_run(folder / "run", rig_file) as writer:
        for index, position_mm in enumerate(rig_file.rig.plan.positions_mm()):
            image = np.full((height_px, width_px), 10, dtype=np.uint8)
            writer.append(Frame(image, index, position_mm, position_mm, 0.1 * index, 20.0))


def _rig(
    camera: str, track: str, part: Part, source: Document | None = None, **sections: Any
) -> GoodRig:
    """The rig of two drivers with its defaults written out.  source: of an opencv camera."""
    camera_options = _SOURCES[camera] if source is None else source
    if source is None:  # of a stream or a file, what only a device has may not even be stated
        camera_options = _written_out(CAMERAS[camera], camera_options)
    width_px, height_px = SIZE_PX
    size = {"width_px": width_px, "height_px": height_px}
    rig = {
        "camera": {"driver": camera, **size, "options": camera_options},
        "track": {"driver": track, "options": _written_out(TRACKS[track], _TRACK_OPTIONS[track])},
        "plan": _PLAN,
        **{key: value for key, value in sections.items() if key in Rig.model_fields},
    }
    tank = {key: value for key, value in sections.items() if key in Tank.model_fields}
    document = _written_out(Rig, rig) | (_written_out(Tank, tank) if tank else {})
    options = (
        Part(CAMERAS[camera], ("camera", "options"), tuple(CAMERAS[camera].model_fields)),
        Part(TRACKS[track], ("track", "options"), tuple(TRACKS[track].model_fields)),
    )
    return GoodRig(f"{camera} and {track}", document, (part, *options))


def _written_out(model: type[Strict], document: Document) -> Document:
    """The document with every default that is not None stated."""
    return model.model_validate(document).model_dump(mode="json", exclude_none=True)


def as_toml(document: Document) -> str:
    """The document as TOML text, one line for each of its keys."""
    return "".join(f"{key} = {_value(value)}\n" for key, value in document.items())


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(_value, value))}]"
    if isinstance(value, date):
        return value.isoformat()
    return json.dumps(value) if isinstance(value, str) else repr(value)
