"""Parts: what stands in the tank, as triangle meshes of one surface each."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import shapely
import trimesh
from shapely.geometry import MultiPolygon, Polygon

from lscan.records import Floats, Ints
from sim.scene import Pose


@dataclass(frozen=True)
class Finish:
    """How a surface reflects; the fields are those of a scene file's target.

    Attributes
    ----------
    kind : str, "matt" scatters diffusely, "wet" has a glossy coat over it, "mirror" is metal
    roughness : float, slope of the facets of coat or metal, 0.02 to 1
    coat_index : float, refractive index of the coat
    """

    kind: Literal["matt", "wet", "mirror"] = "matt"
    roughness: float = 0.1
    coat_index: float = 1.5


@dataclass(frozen=True)
class Paint:
    """A reflectance that varies over a part, as a picture laid over it.

    Attributes
    ----------
    levels : (H, W) array, reflectances from 0 to 1, the uppermost row first
    uv : (N, 2) array, of every vertex: (0, 0) is the picture's lower left corner, (1, 1) its upper
        right one; it repeats beyond
    """

    levels: Floats
    uv: Floats


@dataclass(frozen=True)
class MeshPart:
    """A mesh of one surface, in mm.

    Attributes
    ----------
    name : str, of the part
    mesh : Trimesh, mm, frame of the target or of the world
    albedo : float, its reflectance, which ``paint`` multiplies where there is one
    smooth : bool, shade it with interpolated vertex normals
    finish : Finish, how it reflects
    paint : Paint or None, its reflectance by place, if it varies
    """

    name: str
    mesh: trimesh.Trimesh
    albedo: float
    smooth: bool = False
    finish: Finish = Finish()
    paint: Paint | None = None


def moved(part: MeshPart, pose: Pose) -> MeshPart:
    """The part, out of the pose's inner frame into its outer one."""
    mesh = part.mesh
    normals = mesh.vertex_normals @ pose.rotation.T if part.smooth else None
    mesh = plain_mesh(pose.apply(np.asarray(mesh.vertices)), mesh.faces)
    mesh.metadata = part.mesh.metadata
    if normals is not None:
        mesh.vertex_normals = normals
    return replace(part, mesh=mesh)


def plain_mesh(vertices: Floats, faces: Ints) -> trimesh.Trimesh:
    """The mesh of vertices and faces, just as they are.

    Parameters
    ----------
    vertices : (N, 3) array, mm
    faces : (M, 3) array, indices of their vertices, counter-clockwise seen from outside
    """
    return trimesh.Trimesh(vertices, faces, process=False)


def plane_mesh(shape: Polygon | MultiPolygon, axes: tuple[int, int]) -> trimesh.Trimesh:
    """Triangles of a shape in the plane of two axes: (0, 1) faces along z, (0, 2) against y."""
    meshes = []
    for polygon in shapely.get_parts(shape):
        plan, faces = trimesh.creation.triangulate_polygon(polygon, engine="earcut")
        vertices = np.zeros((len(plan), 3))
        vertices[:, axes] = plan
        meshes.append(plain_mesh(vertices, faces))  # earcut's are counter-clockwise
    return trimesh.util.concatenate(meshes)


def grid_faces(rows: int, columns: int) -> Ints:
    """Two triangles a cell of a grid of vertices laid row by row, facing up.

    Parameters
    ----------
    rows, columns : int, of vertices: x rises along a row, y from row to row
    """
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    c, d = index[1:, 1:].ravel(), index[1:, :-1].ravel()
    return np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
