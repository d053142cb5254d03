"""Mesh files, read safely: triangles in mm."""

import io
from pathlib import Path

import numpy as np
import trimesh

from lscan.errors import InputError
from lscan.files.disk import read_bytes

MOST_BYTES = {"ply": 2**28, "stl": 2**28, "obj": 2**26, "off": 2**26}
"""Of a mesh file, by its ending.  Text takes up to fifty times as much once it is read."""

FURTHEST_MM = 1e6
"""Of a vertex from the origin, along an axis: a kilometre."""

MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}


def load_mesh(path: Path, mm_per_unit: float = 1.0) -> trimesh.Trimesh:
    """The triangles of a mesh file, in mm.

    Vertices that coincide are merged, unless the file colours them: two colours may meet
    there.  Colours of faces are not read, nor are other files that the file names.

    Parameters
    ----------
    path : Path, of the file: PLY, STL, OBJ or OFF
    mm_per_unit : float, mm, of the file's unit of length, see MM_PER_UNIT

    Raises
    ------
    InputError
        Where the file cannot be read or has no triangles.
    """
    kind = path.suffix.lower().removeprefix(".")
    if kind not in MOST_BYTES:
        allowed = ", ".join(f".{name}" for name in MOST_BYTES)
        raise InputError("is no kind of mesh file", where=path, value=path.suffix, allowed=allowed)
    content = read_bytes(path, MOST_BYTES[kind])
    if not content:
        raise InputError("is an empty file", where=path)
    try:
        mesh = trimesh.load_mesh(
            io.BytesIO(content),
            file_type=kind,
            process=False,
            skip_materials=kind == "ply",  # else it looks for the picture that one names
        )
    except Exception as error:  # trimesh raises whatever its format readers raise
        message = " ".join(f"is not a mesh that can be read: {error}".split())
        raise InputError(message, where=path) from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError("holds no triangles", where=path)
    if mesh.vertices.shape[1:] != (3,):
        raise InputError("has vertices without three coordinates", where=path)
    if not np.isfinite(mesh.vertices).all():
        raise InputError("has vertices that are not finite", where=path)
    mesh.apply_scale(mm_per_unit)
    if np.abs(mesh.vertices).max() > FURTHEST_MM:
        allowed = f"{FURTHEST_MM:g} mm from the origin at most"
        raise InputError("has vertices too far away", where=path, allowed=allowed)
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise InputError("has triangles of vertices that are not there", where=path)
    if mesh.visual.kind != "vertex":
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return mesh
