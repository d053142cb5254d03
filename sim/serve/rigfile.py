"""The rig file of the emulated hardware: the scene's instrument, with the drivers of real ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lscan.documents import Document
from lscan.rig import Rig
from sim.scene import Scene
from sim.serve.toml import toml_text

HEADING = "# Written by `lscan-sim serve`: the tank as a webcam and a track.\n\n"
LEAST_TIMEOUT_S = 5.0
RENDERS = 5.0  # a picture may wait for this many renderings: of the places passed, and its own


def camera_options(url: str, render_s: float) -> dict[str, Any]:
    """``[camera.options]`` for the stream at ``url`` of a tank that renders in ``render_s``.

    A picture handed out while the head rests is true when it is sent; flush_frames takes care
    of the one that was on its way when the head came to rest.
    """
    timeout_s = round(LEAST_TIMEOUT_S + RENDERS * render_s, 1)
    return {"url": url, "warm_up_frames": 2, "flush_frames": 1, "timeout_s": timeout_s}


def rig_document(scene: Scene, camera: Mapping[str, Any], track: Mapping[str, Any]) -> Document:
    """The scene's own sections without the tank's, and its devices replaced.

    camera, track: ``[camera.options]`` of the driver "opencv", ``[track.options]`` of "grbl".
    """
    instrument = {key: value for key, value in scene.document.items() if key in Rig.model_fields}
    section = {key: value for key, value in instrument["camera"].items() if key != "options"}
    return {
        **instrument,
        "camera": {**section, "driver": "opencv", "options": dict(camera)},
        "track": {"driver": "grbl", "options": dict(track)},
    }


def rig_text(document: Document) -> str:
    """The document as the text of a rig file."""
    return HEADING + toml_text(document)
