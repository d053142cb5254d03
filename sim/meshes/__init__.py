"""Meshes of what stands in the tank, exact to the nominal shapes, in mm.

Each shape is a few parts (sim.meshes.parts); a part is a triangle mesh of one surface.
"""

from sim.meshes.board import CIRCLE_CORNERS, board_parts
from sim.meshes.paint import reflectance_at
from sim.meshes.parts import Finish, MeshPart, Paint
from sim.meshes.sand import sanded_sandwave_mesh
from sim.meshes.target import floor_part, load_mesh, scene_parts, target_mesh, target_parts
from sim.meshes.workpieces import (
    WAVE_STEP_MM,
    grooved_block_mesh,
    sandwave_body,
    sandwave_parts,
)

__all__ = [
    "CIRCLE_CORNERS",
    "WAVE_STEP_MM",
    "Finish",
    "MeshPart",
    "Paint",
    "board_parts",
    "floor_part",
    "grooved_block_mesh",
    "load_mesh",
    "reflectance_at",
    "sanded_sandwave_mesh",
    "sandwave_body",
    "sandwave_parts",
    "scene_parts",
    "target_mesh",
    "target_parts",
]
