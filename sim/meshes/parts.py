"""Parts: what stands in the tank, as triangle meshes of one surface each, workpieces among them."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import shapely
import trimesh
from shapely.geometry import MultiPolygon, Polygon, box

from lscan.config.targets import GroovedBlock, Sandwave
from lscan.errors import InputError
from lscan.files.pictures import grey_dn, read_picture
from lscan.records import Floats, GreyValues, Ints
from sim.scene import Pose
from sim.scene.matter import Ripples, RoughBlock, Sand, Texture


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
    return Paint(np.minimum(luminance(grey_dn(picture)) / 255, 1.0), uv)


def vertex_paint(mesh: trimesh.Trimesh) -> Paint | None:
    """The mesh's vertex colours as reflectances, linear over each triangle; None without any.

    Each vertex is pointed at its level on a ramp, because a paint is always a picture.
    """
    if mesh.visual.kind != "vertex":
        return None
    levels = luminance(np.asarray(mesh.visual.vertex_colors)[:, :3]) / 255
    return Paint(RAMP, np.column_stack([0.25 + 0.5 * levels, np.full(len(levels), 0.5)]))


def luminance(image: GreyValues) -> Floats:
    """Grey level, 0 to 255, of a (H, W) grey picture, or of (..., 3) linear RGB."""
    return image.astype(float) if image.shape[-1:] != (3,) else image @ np.array(LUMINANCE)


# The paper's test pieces as meshes in their workpiece frames.


# Chord error of the sandwave's facets: step² · max|z''| / 8 = 0.25 · 0.22 / 8 = 7 µm.
WAVE_STEP_MM = 0.5


def grooved_block_mesh(block: GroovedBlock) -> trimesh.Trimesh:
    """The grooved block in its workpiece frame."""
    prism = trimesh.creation.extrude_polygon(Polygon(block.outline_mm()), block.length_mm)
    x, z, along = prism.vertices.T
    turned = np.column_stack([x, block.length_mm / 2 - along, z])
    return plain_mesh(turned, prism.faces)


def sandwave_parts(piece: Sandwave, albedo: float) -> list[MeshPart]:
    """The sandwave block in its workpiece frame: wave, curtain to the rim, rim, body, wedges."""
    wave, border = _wave_patch(piece)
    low, high = -piece.rim_mm, piece.side_mm + piece.rim_mm
    ring = box(low, low, high, high).difference(box(0, 0, piece.side_mm, piece.side_mm))
    rest = [_curtain(border), plane_mesh(ring, (0, 1)), sandwave_body(piece)]
    for plan in piece.wedge_plans_mm():
        rest.append(trimesh.creation.extrude_polygon(Polygon(plan), piece.wedge.height_mm))
    return [
        MeshPart("sandwave", wave, albedo, smooth=True),
        MeshPart("block", trimesh.util.concatenate(rest), albedo),
    ]


def _wave_patch(piece: Sandwave) -> tuple[trimesh.Trimesh, Floats]:
    """The wave's mesh and its border, (N, 3), counter-clockwise and closed."""
    count = int(np.ceil(piece.side_mm / WAVE_STEP_MM)) + 1
    axis = np.linspace(0.0, piece.side_mm, count)
    x, y = np.meshgrid(axis, axis)
    z = piece.height_mm(x, y)
    points = np.stack([x, y, z], axis=-1)
    mesh = plain_mesh(points.reshape(-1, 3), grid_faces(count, count))
    mesh.vertex_normals = piece.normals(x.ravel(), y.ravel())
    sides = [points[0], points[:, -1], points[-1, ::-1], points[::-1, 0]]
    return mesh, np.concatenate(sides)


def _curtain(border: Floats) -> trimesh.Trimesh:
    """The upright strip between the wave's border and the rim's level z = 0."""
    count = len(border)
    foot = border * [1.0, 1.0, 0.0]
    i = np.arange(count - 1)
    faces = np.vstack(
        [np.column_stack([i, i + 1, i + count]), np.column_stack([i + 1, i + count + 1, i + count])]
    )
    return plain_mesh(np.vstack([border, foot]), faces)


def sandwave_body(piece: Sandwave) -> trimesh.Trimesh:
    """Sides and underside of the sandwave block: a box without its lid."""
    low, high = -piece.rim_mm, piece.side_mm + piece.rim_mm
    body = trimesh.creation.box(bounds=[[low, low, -piece.body_mm], [high, high, 0.0]])
    return body.submesh([body.face_normals[:, 2] < 0.5], append=True)


# A block whose upper side is a draw of a random field, with ripples where they are asked for.


PADDING = 2
"""Sides of the periodic field that the block is cut from, in its own: opposite sides of the block
then have nothing to do with each other."""
MOST_VERTICES = 4_000_000
MM_PER_CM = 10.0


def rough_heights(block: RoughBlock) -> tuple[Floats, Floats, Floats]:
    """Where the upper side's vertices lie.

    Parameters
    ----------
    block : RoughBlock

    Returns
    -------
    x_mm : (C,) array, mm, frame of the block
    y_mm : (R,) array, mm
    z_mm : (R, C) array, mm

    Raises
    ------
    InputError
        There would be more than four million vertices, or heights reach through the block.
    """
    x, y = (np.linspace(0.0, side, round(side / block.step_mm) + 1) for side in block.size_mm)
    if len(x) * len(y) > MOST_VERTICES:
        raise InputError(
            "target.rough: has too many vertices", value=len(x) * len(y),
            allowed=f"{MOST_VERTICES} or fewer: make step_mm longer",
        )  # fmt: skip
    z = np.zeros((len(y), len(x)))
    if block.w2_cm4 > 0:
        z += _field(block, x, y)
    if block.ripples is not None:
        z += ripple_heights(block.ripples, x, y[:, np.newaxis])
    if z.min() <= -block.depth_mm:
        raise InputError(
            "target.rough: its heights reach through the block", value=f"{z.min():.4g} mm",
            allowed=f"above depth_mm = -{block.depth_mm:g} mm",
        )  # fmt: skip
    return x, y, z


def ripple_heights(ripples: Ripples, x_mm: Floats, y_mm: Floats) -> Floats:
    """mm, heights of ripples, between minus and plus half of their height.

    Parameters
    ----------
    ripples : Ripples
    x_mm, y_mm : array, mm, frame of the block
    """
    way = np.radians(ripples.heading_deg)
    turns = (np.cos(way) * x_mm + np.sin(way) * y_mm) / ripples.wavelength_mm
    smooth, sharp = np.cos(2 * np.pi * turns) / 2, 0.5 - np.abs(np.sin(np.pi * turns))
    return ripples.height_mm * ((1 - ripples.crests) * smooth + ripples.crests * sharp)


def rough_density(block: RoughBlock, along_y: Floats, along_x: Floats) -> Floats:
    """The random field's spectrum W2, cm^4, its integral over the plane the mean square height.

    Parameters
    ----------
    block : RoughBlock
    along_y, along_x : array, rad/cm, components of the wavenumber

    References
    ----------
    APL-UW TR 9407 (1994), sec. IV, with the plane of wavenumbers stretched along ``heading_deg``.
    """
    way = np.radians(block.heading_deg)
    along = np.cos(way) * along_x + np.sin(way) * along_y
    across = np.cos(way) * along_y - np.sin(way) * along_x
    square = along**2 / block.ratio + across**2 * block.ratio
    lengths_cm = np.array([block.longest_mm, block.shortest_mm]) / MM_PER_CM
    low, high = (2 * np.pi / lengths_cm) ** 2
    inside = (square >= low) & (square <= high)
    return np.where(inside, block.w2_cm4 * np.where(inside, square, 1.0) ** (-block.gamma2 / 2), 0)


def rough_block_mesh(block: RoughBlock) -> trimesh.Trimesh:
    """The block in its own frame, mm: the rough side, four sides and the underside.

    Parameters
    ----------
    block : RoughBlock

    Raises
    ------
    InputError
        As ``rough_heights``.
    """
    x, y, z = rough_heights(block)
    across, along = np.meshgrid(x, y)
    top = np.stack([across, along, z], axis=-1)
    number = np.arange(z.size).reshape(z.shape)
    edges = [number[0], number[:, -1], number[-1, ::-1], number[::-1, 0]]  # counter-clockwise
    corners = top.reshape(-1, 3)[[edge[0] for edge in edges]]
    faces = [grid_faces(*z.shape)]
    for side, edge in enumerate(edges):  # a fan each: long triangles have small boxes in plan
        here, there = z.size + side, z.size + (side + 1) % 4
        foot = np.full(len(edge) - 1, here)
        faces += [np.column_stack([edge[:-1], foot, edge[1:]]), np.array([[edge[-1], here, there]])]
    faces.append(z.size + np.array([[0, 2, 1], [0, 3, 2]]))
    below = corners * [1, 1, 0] - [0, 0, block.depth_mm]
    return plain_mesh(np.concatenate([top.reshape(-1, 3), below]), np.concatenate(faces))


def random_fields(
    density: Callable[[Floats, Floats], Floats],
    shape: tuple[int, int],
    step_cm: tuple[float, float],
    padding: int,
    generator: np.random.Generator,
) -> tuple[Floats, Floats]:
    """Two independent draws of a random field, (R, C), cm.

    Parameters
    ----------
    density : callable, of (2 R, 1) and (1, 2 C) wavenumbers along y and x, rad/cm: W2 in cm^4
    shape : (R, C)
    step_cm : float, cm, along y and along x
    padding : int, sides of the periodic field that they are cut from, in their own
    generator : Generator
    """
    size = tuple(padding * count for count in shape)
    ky, kx = (
        np.asarray(2 * np.pi * np.fft.fftfreq(count, step), dtype=float)
        for count, step in zip(size, step_cm, strict=True)
    )
    area = (2 * np.pi) ** 2 / (size[0] * size[1] * step_cm[0] * step_cm[1])
    spread = np.sqrt(density(ky[:, np.newaxis], kx[np.newaxis]) * area)
    drawn = generator.standard_normal((2, *size))
    both = np.fft.fft2(spread * (drawn[0] + 1j * drawn[1]))[: shape[0], : shape[1]]
    return both.real, both.imag


def _field(block: RoughBlock, x: Floats, y: Floats) -> Floats:
    """(R, C) mm, a draw of the random field."""
    steps = tuple(float(axis[1] - axis[0]) / MM_PER_CM for axis in (y, x))
    field, _ = random_fields(
        partial(rough_density, block),
        (len(y), len(x)),
        (steps[0], steps[1]),
        PADDING,
        np.random.default_rng(block.seed),
    )
    return MM_PER_CM * field


# A coat of sand on the sandwave block.


# Facets a grain: fewer would flatten the caps.
FACETS_PER_GRAIN = 3


def sanded_sandwave_mesh(piece: Sandwave, sand: Sand) -> trimesh.Trimesh:
    """The block's whole upper side under a coat of grains, and its body, workpiece frame.

    The grains lie on a jittered square pack; each is a sphere sunk to its middle, so the
    coat is the upper envelope of their caps.
    """
    step = sand.grain_mm / FACETS_PER_GRAIN
    low, high = -piece.rim_mm, piece.side_mm + piece.rim_mm
    count = int(np.ceil((high - low) / step)) + 1
    axis = np.linspace(low, high, count)
    x, y = np.meshgrid(axis, axis)
    z = _bare_height(piece, x, y) + _coat_height(sand, x - low, y - low)
    top = plain_mesh(np.column_stack([x.ravel(), y.ravel(), z.ravel()]), grid_faces(count, count))
    return trimesh.util.concatenate([top, sandwave_body(piece)])


def _bare_height(piece: Sandwave, x: Floats, y: Floats) -> Floats:
    """Height of the uncoated block at (x, y): wave, rim or wedge."""
    inside = (x >= 0) & (x <= piece.side_mm) & (y >= 0) & (y <= piece.side_mm)
    z = np.where(inside, piece.height_mm(x, y), 0.0)
    wedge, middle = piece.wedge, piece.side_mm / 2
    share = 1 - np.abs(y - middle) / (wedge.base_mm / 2)
    from_side = np.minimum(x + piece.rim_mm, piece.side_mm + piece.rim_mm - x)
    return np.where(from_side <= wedge.reach_mm * share, wedge.height_mm, z)


def _coat_height(sand: Sand, x: Floats, y: Floats) -> Floats:
    """Height of the grains' envelope at (x, y), both from 0 upwards."""
    generator = np.random.default_rng(sand.seed)
    cells = int(np.ceil(max(x.max(), y.max()) / sand.grain_mm)) + 3
    jitter = generator.uniform(-0.25, 0.25, (2, cells, cells))
    radius = sand.grain_mm / 2 * generator.uniform(1 - sand.spread, 1 + sand.spread, (cells, cells))
    column, row = (x / sand.grain_mm).astype(int) + 1, (y / sand.grain_mm).astype(int) + 1
    height = np.zeros_like(x)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            i, j = row + down, column + right
            centre_x = (j - 0.5 + jitter[0, i, j]) * sand.grain_mm
            centre_y = (i - 0.5 + jitter[1, i, j]) * sand.grain_mm
            cap = radius[i, j] ** 2 - (x - centre_x) ** 2 - (y - centre_y) ** 2
            height = np.maximum(height, np.sqrt(np.maximum(cap, 0.0)))
    return height
