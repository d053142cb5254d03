"""The rig file of the emulated hardware: the scene's instrument, with the drivers of real ones."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from lscan.config.documents import Document
from lscan.config.rig import Rig
from sim.scene import Scene, camera_pose
from sim.water import water_optics

HEADING = "# Written by `lscan-sim serve`: the tank as a webcam and a track."
TIMEOUT_S = 30.0
"""For a picture: it may wait for several renderings, of the places passed and its own, each of
seconds on a busy machine.  Not measured: the same scene gives the same file each time."""


def rig_document(
    scene: Scene, url: str, track: Mapping[str, Any], *, switched_laser: bool = False
) -> Document:
    """The scene's own sections without the tank's, its devices replaced, and ``[sheet]``.

    url: of the camera's stream, for the driver "opencv".  track: ``[track.options]`` of "grbl".
    switched_laser: the track lights the laser, so a plan that says nothing of it gets "on".
    """
    # A picture handed out while the head rests is true when it is sent; flush_frames takes care
    # of the one that was on its way when the head came to rest.
    camera = {"url": url, "warm_up_frames": 2, "flush_frames": 1, "timeout_s": TIMEOUT_S}
    instrument = {key: value for key, value in scene.document.items() if key in Rig.model_fields}
    section = {key: value for key, value in instrument["camera"].items() if key != "options"}
    if switched_laser:
        instrument["plan"] = {"laser": "on", **instrument.get("plan", {})}
    sheet = sheet_section(scene)
    if sheet is not None:
        instrument = {"sheet": sheet, **instrument}
    return {
        **instrument,
        "camera": {**section, "driver": "opencv", "options": camera},
        "track": {"driver": "grbl", "options": dict(track)},
    }


def sheet_section(scene: Scene) -> dict[str, Any] | None:
    """``[sheet]`` as a ruler at the scene's head would measure it, the thickness to 0.01 mm.

    The thickness is that at the place the camera looks at, where its axis meets the head's
    plane y = 0.  None for a camera that does not look at that plane from before it.
    """
    laser, pose = scene.tank.laser, camera_pose(scene.tank.head)
    axis = pose.rotation[:, 2]
    if pose.origin_mm[1] >= 0 or axis[1] <= 0:
        return None
    seen_mm = pose.origin_mm - axis * pose.origin_mm[1] / axis[1]
    index = water_optics(scene.tank.water, laser.wavelength_nm).index
    distance_mm = np.linalg.norm([seen_mm - np.array(laser.apex_mm)], axis=1)
    return {
        "thickness_mm": round(float(laser.half_thickness_mm(distance_mm, index)[0]), 2),
        "camera_mm": list(scene.tank.head.camera_mm),
        "apex_mm": list(laser.apex_mm),
    }
