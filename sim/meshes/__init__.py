"""Meshes of what stands in the tank, exact to the nominal shapes, in mm.

Each shape is a few parts (sim.meshes.parts); a part is a triangle mesh of one surface.
"""

from sim.meshes.parts import Finish, MeshPart, Paint, reflectance_at
from sim.meshes.target import scene_parts, target_mesh, target_parts

__all__ = [
    "Finish", "MeshPart", "Paint", "reflectance_at", "scene_parts", "target_mesh",
    "target_parts",
]  # fmt: skip
