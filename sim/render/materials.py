"""Surfaces: a part as a Mitsuba mesh with its finish, its albedo and its paint.

No finish has a delta lobe: the integrators connect a surface to the laser's apex, which a
perfect mirror would reflect with probability 0.
"""

from typing import Any

import mitsuba as mi
import numpy as np

from lscan.errors import InputError
from sim.meshes import MeshPart
from sim.render.backend import load_mitsuba
from sim.render.plugins.arrays import floats, indices

load_mitsuba()  # the variant: Mitsuba's classes depend on it


def mitsuba_shape(part: MeshPart, water_index: float) -> mi.Mesh:
    """The part as a Mitsuba mesh under water of the index ``water_index``, in mm.

    Raises InputError where a wet part's coat is not denser than the water.
    """
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(surface(part, water_index))
    mesh, paint = part.mesh, part.paint
    shape = mi.Mesh(
        part.name,
        vertex_count=len(mesh.vertices),
        face_count=len(mesh.faces),
        has_vertex_normals=part.smooth,
        has_vertex_texcoords=paint is not None,
        props=props,
    )
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = floats(mesh.vertices)
    parameters["faces"] = indices(mesh.faces)
    if part.smooth:
        parameters["vertex_normals"] = floats(mesh.vertex_normals)
    if paint is not None:
        parameters["vertex_texcoords"] = floats(paint.uv)
    parameters.update()
    return shape


def surface(part: MeshPart, water_index: float) -> dict[str, Any]:
    """Mitsuba's description of the part's two-sided scattering function.

    matt: Lambert's.  wet: a matt ground under a coat whose facets have Beckmann's distribution
    of slopes, light reflected to and fro between both included ("nonlinear"; Saunderson 1942).
    mirror: facets alike, of metal that reflects ``albedo`` at every angle.
    Facets shade each other and light that meets two of them is lost, so a rough coat or
    mirror reflects less than its albedo.  Raises InputError as ``mitsuba_shape``.
    """
    reflectance, finish = _reflectance(part), part.finish
    bsdf: dict[str, Any]
    if finish.kind == "matt":
        bsdf = {"type": "diffuse", "reflectance": reflectance}
    elif finish.kind == "wet":
        if finish.coat_index <= water_index:
            what = "a coat must be denser than the water"
            where = "target.coat_index"
            allowed = f"above {water_index:.4f}"
            raise InputError(what, where=where, value=finish.coat_index, allowed=allowed)
        bsdf = {
            "type": "roughplastic",
            "int_ior": finish.coat_index,
            "ext_ior": water_index,
            "alpha": finish.roughness,
            "nonlinear": True,
            "diffuse_reflectance": reflectance,
        }
    else:
        bsdf = {
            "type": "roughconductor",
            "material": "none",
            "alpha": finish.roughness,
            "specular_reflectance": reflectance,
        }
    return {"type": "twosided", "bsdf": bsdf}


def _reflectance(part: MeshPart) -> dict[str, Any]:
    """The part's albedo, or its paint times its albedo, as a texture of Mitsuba's."""
    if part.paint is None:
        return {"type": "spectrum", "value": part.albedo}
    upwards = part.paint.levels[::-1]  # Mitsuba's first row lies at v = 0, ours at v = 1
    levels = (part.albedo * upwards).astype(np.float32)
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(levels[..., np.newaxis])),
        "raw": True,
        "filter_type": "bilinear",
        "wrap_mode": "repeat",
        "accel": False,  # a GPU's own filter has 8 bit between two texels
    }
