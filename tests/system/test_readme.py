"""The README names every key of a scene file, every scene, and no key that there is not."""

from __future__ import annotations

import re
from importlib.metadata import entry_points

import pytest
from places import ROOT
from pydantic import BaseModel

from lscan.acquisition.replay import ReplayOptions
from lscan.config.rig import (
    CameraSection,
    NoiseSection,
    OpticsSection,
    Plan,
    ShaftSection,
    SheetSection,
    StripeSection,
)
from lscan.devices.grbl import SerialTrackOptions
from lscan.devices.manual import ManualOptions
from lscan.devices.opencv_camera.options import OpencvOptions
from sim.devices import CameraOptions, TrackOptions
from sim.scene import (
    AmbientLight,
    DomePort,
    Drift,
    FlatPort,
    Floor,
    Head,
    Laser,
    LaserLine,
    Lens,
    Render,
    Sand,
    Sensor,
    Target,
    Texture,
    Water,
)
from sim.validation.physics.gallery import scene_files

README = (ROOT / "README.md").read_text(encoding="utf-8")
SCENE_FILES = README.split("## Scene files")[1].split("\n## ")[0]
# A table's own section, with what stands in sections of its own beneath it.
SECTIONS: dict[str, tuple[type[BaseModel], ...]] = {
    "camera.options": (CameraOptions,),
    "track.options": (TrackOptions,),
    "lens": (Lens,),
    "head": (Head,),
    "port": (FlatPort, DomePort),
    "laser": (Laser, LaserLine, Drift),
    "water": (Water,),
    "light": (AmbientLight,),
    "floor": (Floor,),
    "target": (Target, Texture, Sand),
    "sensor": (Sensor,),
    "render": (Render,),
}


def text_of(section: str) -> str:
    """What stands from the section's name at the start of a line or sentence to the next."""
    start = re.search(rf"(?:^|\. )`\[{re.escape(section)}\]`", SCENE_FILES, re.MULTILINE)
    assert start is not None, section
    rest = SCENE_FILES[start.end() :]
    end = re.search(r"(?:^|\. )`\[[a-z.]+\]`", rest, re.MULTILINE)
    return rest[: end.start()] if end else rest


def names(code: str) -> set[str]:
    """Every word within backticks that may be a key."""
    found: set[str] = set()
    for span in re.findall(r"`([^`]+)`", code):
        found |= set(re.findall(r"\b[a-z][a-z0-9_]*\b", span))
    return found


@pytest.mark.parametrize("section", SECTIONS)
def test_every_key_is_told_and_none_is_made_up(section: str) -> None:
    text = text_of(section)
    keys = {key for model in SECTIONS[section] for key in model.model_fields}
    assert keys <= names(text), sorted(keys - names(text))
    first_cells = [line.split("|")[1] for line in text.splitlines() if line.startswith("|")]
    told = {word for cell in first_cells for word in re.findall(r"`([a-z][a-z0-9_]*)`", cell)}
    assert told <= keys, sorted(told - keys)


def test_every_scene_is_listed() -> None:
    listed = (ROOT / "scenes" / "README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([a-z0-9/-]+\.toml)` \|", listed, re.MULTILINE)
    folder = ROOT / "scenes"
    files = {path.relative_to(folder).as_posix() for path in scene_files(folder)}
    assert sorted(rows) == sorted(files)


@pytest.mark.parametrize(
    "model",
    [
        CameraSection,
        Plan,
        OpencvOptions,
        SerialTrackOptions,
        ManualOptions,
        ReplayOptions,
        StripeSection,
        NoiseSection,
        OpticsSection,
        SheetSection,
        ShaftSection,
    ],
)
def test_every_key_of_a_rig_file_is_told(model: type[BaseModel]) -> None:
    rig_files = README.split("## Rig files")[1].split("\n## ")[0]
    missing = set(model.model_fields) - names(rig_files)
    assert not missing, sorted(missing)


def test_every_map_and_extractor_is_told() -> None:
    told = names_of_methods(README.split("## Plane maps and stripe extractors")[1])
    for group in ("lscan.extractors", "lscan.planemaps"):
        ours = {entry.name for entry in entry_points(group=group) if "lscan." in entry.value}
        assert ours <= told, sorted(ours - told)


def names_of_methods(text: str) -> set[str]:
    """What stands in backticks in the first cells, families without their variants."""
    cells = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    spans = {span for cell in cells for span in re.findall(r"`([^`]+)`", cell)}
    return spans | {span.split("-")[0] for span in spans}
