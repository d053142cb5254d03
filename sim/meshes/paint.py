"""Reflectances: at the laser's wavelength, out of a picture, out of a mesh's vertex colours."""

from pathlib import Path

import numpy as np
import trimesh

from lscan.errors import InputError
from lscan.files.pictures import read_picture
from lscan.records import Bytes, Floats
from sim.meshes.parts import Paint
from sim.scene.matter import Texture

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
        raise InputError(
            "albedo is not given at the laser's wavelength in nm",
            where=where,
            value=wavelength_nm,
            allowed=f"{nm[0]:g} to {nm[-1]:g}",
        )
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
