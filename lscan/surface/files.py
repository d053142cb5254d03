"""Files of a surface: NetCDF (kept and read back) and PLY (points for other programs).

The same surface gives the same bytes.
"""

import tempfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import trimesh
from numpy.typing import NDArray

from lscan.config.documents import check
from lscan.errors import InputError
from lscan.files.disk import write_atomically
from lscan.records import Floats, Provenance, Status, Surface, has_value
from lscan.surface.netcdf import PROVENANCE, read_arrays
from lscan.surface.provenance import StoredProvenance
from lscan.version import __version__

DIMENSIONS = ("frame", "column")
SEPARATOR = "; "  # of the corrections
LENGTH = {"units": "mm"}
MODES = {
    "long_name": "displacement along x, y and z by each independent error of calibration and "
    "alignment, when it is one standard deviation large"
}
_Variable = tuple[tuple[str, ...], NDArray[Any], dict[str, Any]]
"""Dimensions, values and attributes."""

PACKED = {"zlib": True, "complevel": 1, "shuffle": True}


def save_surface(path: Path | str, surface: Surface) -> None:
    """Write the surface to a NetCDF-4 file after the CF conventions 1.11.

    x, y, z and the standard uncertainties of x and z are (frame, column) float64 in mm, the
    status a byte with flag_values and flag_meanings, the track position (frame,) in mm.
    Where y is not the track's own, its uncertainty is there too.
    Where the surface has modes, they are there too (compressed), and sigma_calibration is the
    part of the uncertainty of z that they make common to all points.
    x, y and position are the coordinates of the others.  The attributes say what the points have
    been corrected for, the yaw they were aligned with and what they were made from.

    Parameters
    ----------
    path : Path or str, of the file
    surface : Surface, in either frame

    Raises
    ------
    InputError
        Where the file cannot be written.

    Examples
    --------
    >>> import lscan
    >>> surface = lscan.load_surface("surface.nc")
    >>> lscan.save_surface("copy.nc", surface)
    """
    import xarray as xr  # here: it takes half a second, which most commands do without

    arrays, notes = _contents(surface)
    data = xr.Dataset(arrays, attrs=notes).set_coords(["x", "y", "position"])
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "surface.nc"
        packed = {"modes": PACKED} if "modes" in data else {}
        data.to_netcdf(whole, engine="h5netcdf", encoding=packed)
        content = whole.read_bytes()
    write_atomically(Path(path), content)


def load_surface(path: Path | str) -> Surface:
    """The surface that :func:`save_surface` wrote, to the last bit, but for its brightness: None.

    The yaw, which the file has in degrees, is the same to rounding.

    Parameters
    ----------
    path : Path or str, of the file

    Raises
    ------
    InputError
        Where the file cannot be read or is not such a file.

    Examples
    --------
    >>> import lscan
    >>> lscan.load_surface("surface.nc").status.shape
    (2, 640)
    """
    path = Path(path)
    names = ("x", "y", "z", "x_sigma", "z_sigma", "status", "position")
    arrays, attributes = read_arrays(path, names, optional=("y_sigma", "modes"))
    frame, corrections = attributes.get("frame"), attributes.get("corrections", "")
    if not isinstance(frame, str) or frame not in ("head", "workpiece"):
        allowed = "head, workpiece"
        raise InputError("frame: is none of a surface", where=path, value=frame, allowed=allowed)
    if not isinstance(corrections, str):
        raise InputError("corrections: is no text", where=path, value=corrections)
    _check_shapes(path, arrays)
    if not np.isin(arrays["status"], list(Status)).all():
        raise InputError("status: holds what is no status", where=path)
    there = has_value(arrays["status"].astype(np.int64)) & np.isfinite(arrays["z"])
    for name in ("x_sigma", "y_sigma", "z_sigma"):
        if name in arrays and not (arrays[name][there] >= 0).all():
            raise InputError(f"{name}: is no uncertainty at a point that has a value", where=path)
    return Surface(
        xyz_mm=np.stack([arrays["x"], arrays["y"], arrays["z"]], axis=-1),
        sigma_x_mm=arrays["x_sigma"],
        sigma_z_mm=arrays["z_sigma"],
        status=arrays["status"].astype(np.int64),
        position_mm=arrays["position"],
        frame=cast(Literal["head", "workpiece"], frame),
        modes_mm=cast(NDArray[np.float32] | None, arrays.get("modes")),
        sigma_y_mm=arrays.get("y_sigma"),
        corrections=tuple(filter(None, corrections.split(SEPARATOR))),
        yaw_rad=_angle(path, attributes, "yaw_deg"),
        yaw_sigma_rad=_angle(path, attributes, "yaw_sigma_deg"),
        provenance=_provenance(path, attributes),
    )


def _angle(path: Path, attributes: Mapping[str, Any], name: str) -> float | None:
    """An attribute in degrees as rad, None where it is not there."""
    if name not in attributes:
        return None
    value = np.asarray(attributes[name])  # h5netcdf writes numbers as arrays of one
    if value.dtype.kind != "f" or value.size != 1 or not np.isfinite(value).all():
        raise InputError(f"{name}: is no angle", where=path, value=attributes[name])
    return float(np.radians(value.item()))


def _provenance(path: Path, attributes: Mapping[str, Any]) -> Provenance | None:
    """What the file says the surface was made from, None of an older one, which says nothing."""
    known = {name: attributes[name] for name in PROVENANCE if name in attributes}
    if not known:
        return None
    pictures = np.asarray(known.get("pictures", ""))
    if pictures.dtype.kind in "iu" and pictures.size == 1:
        known["pictures"] = pictures.item()
    return check(StoredProvenance, known, where=path).provenance()


def _check_shapes(path: Path, arrays: Mapping[str, Floats]) -> None:
    """Refuse arrays that are not of one surface."""
    shape = arrays["status"].shape
    for name, array in arrays.items():
        wanted = {"position": shape[:1], "modes": (*shape, 3, array.shape[-1])}.get(name, shape)
        if len(shape) != 2 or array.shape != wanted:
            allowed = "(frame, column), of one size; position (frame,); modes with axis and mode"
            raise InputError(f"{name}: wrong shape", where=path, value=array.shape, allowed=allowed)


def save_points(path: Path, surface: Surface) -> None:
    """Write the points that have a value to a binary PLY file: x, y, z in mm as float32.

    Each vertex carries ``sigma_mm``, the standard uncertainty of its z, and ``status``.

    Parameters
    ----------
    path : Path, of the file
    surface : Surface, in either frame

    Raises
    ------
    InputError
        Where there is no point or the file cannot be written.
    """
    keep = has_value(surface.status)
    if not keep.any():
        raise InputError("no point has a value", where=path, allowed="a surface with points")
    cloud = trimesh.PointCloud(surface.xyz_mm[keep])
    cloud.vertex_attributes = {
        "sigma_mm": surface.sigma_z_mm[keep].astype(np.float32),
        "status": surface.status[keep].astype(np.uint8),
    }
    content = cloud.export(file_type="ply")
    write_atomically(path, content)


def _contents(surface: Surface) -> tuple[dict[str, _Variable], dict[str, Any]]:
    """The surface as variables after the CF conventions, and attributes."""
    where = "laser sheet and track" if surface.frame == "head" else "workpiece"

    def array(values: NDArray[Any], long_name: str, **notes: Any) -> _Variable:
        return DIMENSIONS, values, {"long_name": long_name, **notes}

    def sigma(values: Floats, long_name: str) -> _Variable:
        return array(values, long_name, standard_name_modifier="standard_error", **LENGTH)

    x, y, z = np.moveaxis(surface.xyz_mm, -1, 0)
    arrays: dict[str, _Variable] = {
        "x": array(x, f"x in the {where} frame", **LENGTH),
        "y": array(y, f"y in the {where} frame", **LENGTH),
        "z": array(z, f"height in the {where} frame", **LENGTH),
        "x_sigma": sigma(surface.sigma_x_mm, "standard uncertainty of x"),
        "z_sigma": sigma(surface.sigma_z_mm, "standard uncertainty of z"),
        "status": array(
            surface.status.astype(np.int8),
            "why a point has, or has not, a value",
            flag_values=np.array([int(status) for status in Status], dtype=np.int8),
            flag_meanings=" ".join(status.name.lower() for status in Status),
        ),
    }
    beside = {"x": "x_sigma", "y": "", "z": "z_sigma"}
    if surface.sigma_y_mm is not None:
        arrays["y_sigma"] = sigma(surface.sigma_y_mm, "standard uncertainty of y")
        beside["y"] = "y_sigma"
    if surface.modes_mm is not None:
        common = np.sqrt(np.square(surface.modes_mm[..., 2, :], dtype=np.float64).sum(axis=-1))
        name = "part of z_sigma that calibration and alignment give to all points in common"
        arrays["sigma_calibration"] = sigma(common, name)
        beside["z"] += " sigma_calibration"
        arrays["modes"] = ((*DIMENSIONS, "axis", "mode"), surface.modes_mm, {**MODES, **LENGTH})
    for name, sigmas in beside.items():
        arrays[name][2]["ancillary_variables"] = f"{sigmas} status".strip()
    track = {"long_name": "track position of the profile", **LENGTH}
    arrays["position"] = (DIMENSIONS[:1], surface.position_mm, track)
    notes: dict[str, Any] = {
        "Conventions": "CF-1.11",
        "title": "Surface measured by a laser line scanner",
        "source": f"laser line scanner, lscan {__version__}",
        "frame": surface.frame,
        "corrections": SEPARATOR.join(surface.corrections),
    }
    if surface.yaw_rad is not None and surface.yaw_sigma_rad is not None:
        notes["yaw_deg"] = float(np.degrees(surface.yaw_rad))
        notes["yaw_sigma_deg"] = float(np.degrees(surface.yaw_sigma_rad))
    if surface.provenance is not None:
        notes |= asdict(surface.provenance)
    return arrays, notes
