"""Small scenes for the tests of the truth."""

from typing import Any

import numpy as np
import shapely
import trimesh

from lscan.config.documents import merge
from lscan.config.rig import parse_rig
from lscan.config.targets import GroovedBlock
from sim.scene import Pose, Scene, scene_of

BASE: dict[str, Any] = {
    "camera": {"driver": "sim", "width_px": 640, "height_px": 480},
    "track": {"driver": "sim"},
    "lens": {"focal_px": 850.0, "centre_px": [319.5, 239.5]},
    "head": {"camera_mm": [0.0, -800.0, 400.0], "depression_deg": 30.0},
    "laser": {"power_mw": 10.0, "apex_mm": [0.0, 0.0, 500.0], "fan_half_angle_deg": 45.0},
    "target": {"shape": "none"},
}
BOARD = {"grid": {"columns": 4, "rows": 3, "pitch_mm": 50.0, "dot_diameter_mm": 5.0}}


def tank(**sections: dict[str, Any]) -> Scene:
    """The base scene with sections laid over it."""
    return scene_of(parse_rig(merge(BASE, sections), source="test", trusted=True))


def in_head(xz_mm: np.ndarray) -> np.ndarray:
    """(N, 3) points of the head frame from (N, 2) of its plane y = 0."""
    return np.column_stack([xz_mm[:, 0], np.zeros(len(xz_mm)), xz_mm[:, 1]])


def block_mesh(block: GroovedBlock, pose: Pose) -> trimesh.Trimesh:
    """The grooved block by trimesh's extrusion, in the world."""
    mesh = trimesh.creation.extrude_polygon(shapely.Polygon(block.outline_mm()), block.length_mm)
    x, z, along = np.asarray(mesh.vertices).T  # extruded along its third axis, from 0
    mesh.vertices = pose.apply(np.column_stack([x, along - block.length_mm / 2, z]))
    return mesh
