"""Mesh files, read safely: triangles in mm."""

import io
from pathlib import Path

import numpy as np
import trimesh

from lscan.errors import InputError
from lscan.files.disk import read_bytes
from lscan.files.polygonfiles import read_obj, read_off, read_ply
from lscan.files.polygons import PolygonMesh, triangles_of
from lscan.records import Floats

MOST_BYTES = {"ply": 2**28, "stl": 2**28, "obj": 2**26, "off": 2**26}
"""Of a mesh file, by its ending.  Text takes up to fifty times as much once it is read."""

FURTHEST_MM = 1e6
"""Of a vertex from the origin, along an axis: a kilometre."""

MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}


READERS = {"ply": read_ply, "obj": read_obj, "off": read_off}

UNREAD = "unread"
"""Key of a mesh's metadata: what its file says of reflectance that is not read."""


def load_mesh(path: Path, mm_per_unit: float = 1.0) -> trimesh.Trimesh:
    """The triangles of a mesh file, in mm.

    Vertices that coincide are merged, unless the file colours them: two colours may meet there.
    Where it colours faces, each triangle has vertices of its own.  Other files that the file names
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
    content = read_bytes(path, MOST_BYTES[kind])
    if not content:
        raise InputError("is an empty file", where=path)
    try:
        mesh = _read_stl(content) if kind == "stl" else _in_triangles(READERS[kind](content))
    except InputError as error:
        raise InputError(str(error), where=path) from error
    except Exception as error:  # trimesh and NumPy raise whatever they do on what is no such file
        message = " ".join(f"is not a mesh that can be read: {error}".split())
        raise InputError(message, where=path) from error
    mesh.apply_scale(mm_per_unit)
    if np.abs(mesh.vertices).max() > FURTHEST_MM:
        allowed = f"{FURTHEST_MM:g} mm from the origin at most"
        raise InputError("has vertices too far away", where=path, allowed=allowed)
    if mesh.visual.kind != "vertex":
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return mesh


def _in_triangles(read: PolygonMesh) -> trimesh.Trimesh:
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
    mesh = trimesh.load_mesh(io.BytesIO(content), file_type="stl", process=False)
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError("holds no triangles")
    _require_finite(mesh.vertices)
    # Two conventions, neither of the format's own, of what the two bytes behind a triangle say.
    marked = np.asarray(mesh.face_attributes.get("stl", 0)) & 0x8000
    if b"COLOR=" in content[:80] or marked.any():
        mesh.metadata[UNREAD] = "colours of an STL file"
    return mesh


def _require_finite(vertices: Floats) -> None:
    if not np.isfinite(vertices).all():
        raise InputError("has vertices that are not finite")
