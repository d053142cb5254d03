"""Parts: what stands in the tank, as triangle meshes of one surface each."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import shapely
import trimesh
from shapely.geometry import MultiPolygon, Polygon

from lscan.errors import InputError
from lscan.files.pictures import read_picture
from lscan.records import Bytes, Floats, Ints
from sim.scene import Pose
from sim.scene.matter import Texture


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


def move_part(part: MeshPart, pose: Pose) -> MeshPart:
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


# Reflectances: at the laser's wavelength, out of a picture, out of a mesh's vertex colours.


LUMINANCE = (0.2126, 0.7152, 0.0722)  # of linear red, green and blue: ITU-R BT.709
# Two texels between whose centres, at u = 1/4 and 3/4, a picture rises linearly from 0 to 1.
RAMP = np.array([[0.0, 1.0]])


def reflectance_at(
    albedo: float | tuple[tuple[float, float], ...], wavelength_nm: float, where: object = None
) -> float:
    """Reflectance at a wavelength, 0 to 1; linear between the pairs.

    Parameters
    ----------
    albedo : float or tuple, a number, or (nm, reflectance) pairs of rising wavelength
    wavelength_nm : float, nm
    where : str or Path, what the error names as the place of the albedo

    Raises
    ------
    InputError
        The wavelength lies outside the pairs.
    """
    if not isinstance(albedo, tuple):
        return albedo
    nm, reflectance = np.array(albedo).T
    if not nm[0] <= wavelength_nm <= nm[-1]:
        what = "albedo is not given at the laser's wavelength in nm"
        raise InputError(what, where=where, value=wavelength_nm, allowed=f"{nm[0]:g} to {nm[-1]:g}")
    return float(np.interp(wavelength_nm, nm, reflectance))


def picture_paint(texture: Texture, plan_mm: Floats) -> Paint:
    """The texture's picture over vertices at ``plan_mm``, (N, 2) in the plane it is laid in.

    The picture stands upright: its lower left corner at ``corner_mm``, its columns along the
    plane's first axis, its rows against the second.  Raises InputError where it cannot be read.
    """
    picture = read_picture(Path(texture.file))
    uv = (plan_mm - np.array(texture.corner_mm)) / np.array(texture.size_mm)
    return Paint(luminance(picture) / 255, uv)


def vertex_paint(mesh: trimesh.Trimesh) -> Paint | None:
    """The mesh's vertex colours as reflectances, linear over each triangle; None without any.

    Each vertex is pointed at its level on a ramp, because a paint is always a picture.
    """
    if mesh.visual.kind != "vertex":
        return None
    levels = luminance(np.asarray(mesh.visual.vertex_colors)[:, :3]) / 255
    return Paint(RAMP, np.column_stack([0.25 + 0.5 * levels, np.full(len(levels), 0.5)]))


def luminance(image: Bytes) -> Floats:
    """Grey level, 0 to 255, of a (H, W) grey picture, or of (..., 3) linear RGB."""
    return image.astype(float) if image.shape[-1:] != (3,) else image @ np.array(LUMINANCE)
