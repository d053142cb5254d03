"""Mesh files, read safely: triangles in mm."""

import codecs
import io
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from lscan.errors import InputError
from lscan.files.disk import read_bytes
from lscan.files.polygonfiles import PolygonMesh, read_obj, read_off, read_ply, triangles_of
from lscan.records import Floats, Ints

MOST_BYTES = {"ply": 2**28, "stl": 2**28, "obj": 2**26, "off": 2**26}
"""Of a mesh file, by its ending.  Text takes up to fifty times as much once it is read."""

FURTHEST_MM = 1e6
"""Of a vertex from the origin, along an axis: a kilometre."""

MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}


MERGED_MM = 1e-8
"""Vertices of one step of this length along each axis are one."""

READERS = {"ply": read_ply, "obj": read_obj, "off": read_off}

UNREAD = "unread"
"""Key of a mesh's metadata: what its file says of reflectance that is not read."""

TWICE = "twice"
"""Key of a mesh's metadata, of a file with triangles that stand in it again: a note about them."""


def load_mesh(path: Path, mm_per_unit: float = 1.0) -> trimesh.Trimesh:
    """The triangles of a mesh file, in mm.

    Vertices that coincide are merged, unless the file colours them: two colours may meet there.
    Where it colours faces, each triangle has vertices of its own.  Triangles that stand in the file
    again are left out; ``metadata["twice"]`` says how many.  Other files that the file names
    are not read; ``metadata["unread"]`` names them, and other reflectances that are not read.

    Parameters
    ----------
    path : Path, of the file: PLY, STL, OBJ or OFF
    mm_per_unit : float, mm, of the file's unit of length, see MM_PER_UNIT

    Raises
    ------
    InputError
        Where the file cannot be read, has no triangles or a face that crosses itself.
    """
    kind = path.suffix.lower().removeprefix(".")
    if kind not in MOST_BYTES:
        allowed = ", ".join(f".{name}" for name in MOST_BYTES)
        raise InputError("is no kind of mesh file", where=path, value=path.suffix, allowed=allowed)
    if not (content := read_bytes(path, MOST_BYTES[kind]).removeprefix(codecs.BOM_UTF8)):
        raise InputError("is an empty file", where=path)
    if kind in ("obj", "off") and b"\0" in content:
        raise InputError("is no text, or one in UTF-16; save it as UTF-8", where=path)
    try:
        mesh = _read_stl(content) if kind == "stl" else _triangle_mesh(READERS[kind](content))
    except InputError as error:
        raise InputError(str(error), where=path) from error
    except Exception as error:  # trimesh and NumPy raise whatever they do on what is no such file
        message = f"is not a mesh that can be read: no {kind.upper()}, damaged, or cut short"
        raise InputError(message, where=path) from error
    mesh.vertices *= mm_per_unit
    if np.abs(mesh.vertices).max() > FURTHEST_MM:
        allowed = f"{FURTHEST_MM:g} mm from the origin at most"
        raise InputError("has vertices too far away", where=path, allowed=allowed)
    vertices, faces, kept = weld_mesh(mesh.vertices, mesh.faces)
    if again := len(mesh.faces) - len(faces):
        mesh.metadata[TWICE] = f"repeats triangles, which count once: {again}"
    if mesh.visual.kind == "vertex":
        mesh.update_faces(kept)
        return mesh
    return trimesh.Trimesh(vertices, faces, process=False, metadata=mesh.metadata)


def weld_mesh(vertices: Floats, faces: Ints) -> tuple[Floats, Ints, Ints]:
    """The vertices that faces have, each place once, in their order, the faces of them, and which.

    Of faces with the same corners the first is kept: a copy would close the border of an open mesh,
    and count twice in the mean of normals.  One of the other direction is no copy: two faces back
    to back are a sheet, or a wall between two bodies.

    Parameters
    ----------
    vertices : (N, 3) array, mm; the same are those of one step of MERGED_MM
    faces : (T, 3) array, indices of their vertices
    """
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    if not used.all():
        vertices, faces = vertices[used], (np.cumsum(used) - 1)[faces]
    first, place = _first_of_equals(np.rint(vertices / MERGED_MM).astype(np.int64))
    faces = place[faces]
    a, b, c = faces.T
    lowest = np.minimum(np.minimum(a, b), c)
    after = np.where(a == lowest, b, np.where(b == lowest, c, a))
    kept, _ = _first_of_equals(np.column_stack([lowest, after, a + b + c]))
    return vertices[first], faces if len(kept) == len(faces) else faces[kept], kept


def _first_of_equals(rows: NDArray[np.integer]) -> tuple[Ints, Ints]:
    """The first of all (N, 3) rows that are equal, and (N,) which of those each row equals.

    Sorted by a hash, a column at a time: many millions take little memory.
    """
    key = np.zeros(len(rows), dtype=np.uint64)
    for axis in range(3):
        key ^= rows[:, axis].astype(np.uint64)
        key *= np.uint64(0x9E3779B97F4A7C15)  # odd, its bits without a pattern: 2^64 / golden ratio
        key ^= key >> np.uint64(29)
    order = np.argsort(key)
    new = np.ones(len(rows), dtype=bool)
    new[1:] = key[order[1:]] != key[order[:-1]]
    for axis in range(3):
        own = rows[order, axis]
        if ((own[1:] != own[:-1]) & ~new[1:]).any():  # two of one hash: once in 10^5 large meshes
            _, first, place = np.unique(rows, axis=0, return_index=True, return_inverse=True)
            break
    else:
        first = np.minimum.reduceat(order, np.flatnonzero(new))
        place = np.empty_like(order)
        place[order] = np.cumsum(new) - 1
    rank = np.empty_like(first)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.sort(first), rank[place]


def _triangle_mesh(read: PolygonMesh) -> trimesh.Trimesh:
    """The mesh that a file lists."""
    if read.vertices.shape[1:] != (3,):
        raise InputError("has vertices without three coordinates")
    if len(read.corners) and (read.corners.min() < 0 or read.corners.max() >= len(read.vertices)):
        raise InputError("has triangles of vertices that are not there")
    _require_finite(read.vertices)
    faces, owner = triangles_of(read)
    if len(faces) == 0:
        raise InputError("holds no triangles")
    vertices, colours = read.vertices, read.vertex_colours
    if read.face_colours is not None and colours is None:
        vertices, colours = vertices[faces.ravel()], np.repeat(read.face_colours[owner], 3, axis=0)
        faces = np.arange(faces.size).reshape(-1, 3)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if colours is not None:
        mesh.visual.vertex_colors = np.rint(255 * colours).astype(np.uint8)
    if read.unread:
        mesh.metadata[UNREAD] = read.unread
    return mesh


def _read_stl(content: bytes) -> trimesh.Trimesh:
    count = int.from_bytes(content[80:84], "little")
    if len(content) == 84 + 50 * count and count:
        return _of_binary_stl(content)
    mesh = trimesh.load_mesh(io.BytesIO(content), file_type="stl", process=False)
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError("holds no triangles")
    _require_finite(mesh.vertices)
    return mesh


def _of_binary_stl(content: bytes) -> trimesh.Trimesh:
    """Each triangle: a normal, three corners, two bytes that the format leaves open."""
    row = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("open", "<u2")])
    triangles = np.frombuffer(content, row, offset=84)
    corners = triangles["corners"].reshape(-1, 3)
    _require_finite(corners)
    first, place = _first_of_equals(corners.view(np.uint32))  # -0 is merged with 0 later
    mesh = trimesh.Trimesh(corners[first], place.reshape(-1, 3), process=False)
    # Two conventions of colours there, neither of the format's own.
    if b"COLOR=" in content[:80] or (triangles["open"] & 0x8000).any():
        mesh.metadata[UNREAD] = "colours of an STL file"
    return mesh


def _require_finite(vertices: Floats) -> None:
    if not np.isfinite(vertices).all():
        raise InputError("has vertices that are not finite")
