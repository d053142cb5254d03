"""Files of a surface: NetCDF (kept and read back), clouds and grids for other programs.

The same surface gives the same bytes.
"""

import tempfile
import warnings
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict
from functools import partial
from math import prod
from pathlib import Path
from typing import Any, Literal, cast

import h5py
import numpy as np
from numpy.typing import NDArray

from lscan.config.documents import check
from lscan.errors import InputError
from lscan.files.clouds import Cloud, cloud_writer
from lscan.files.containers import (
    PACKING,
    NetcdfArray,
    as_text,
    hdf5_array,
    in_mm,
    netcdf_bytes,
    open_hdf5,
    unpack,
)
from lscan.files.disk import open_regular, read_bytes, write_atomically
from lscan.files.rasters import Raster, esri_ascii_bytes, geotiff_bytes, sdf_bytes, x3p_bytes
from lscan.records import Floats, Mask, Provenance, Status, Surface, has_value
from lscan.surface.grid import HeightGrid
from lscan.surface.surface import StoredProvenance
from lscan.version import __version__

# Reading the NetCDF file of a surface: the few arrays wanted, each looked at before it is read.
#
# NetCDF-4 is HDF5, as files/containers.py reads it.  NetCDF-3, a format of its own, refers to no
# other file, but may say that many arrays share the same bytes: they are mapped, not copied.


DIMENSIONS = ("frame", "column")
MOST_POINTS = 2**25
"""Of a surface: 4096 pictures of the largest camera."""
MOST_MODE_NUMBERS = 8 * MOST_POINTS
"""Of the displacements by the modes, three numbers a point and mode in single precision."""
MOST_BYTES = 64 * MOST_POINTS + 4 * MOST_MODE_NUMBERS
"""Of a surface's file: up to eight numbers a point and the modes, not compressed."""
PROVENANCE = ("rig", "pictures", "extractor", "plane_map", "calibration_sha256")
"""Attributes that are the fields of records.Provenance."""
ATTRIBUTES = ("frame", "corrections", "yaw_deg", "yaw_sigma_deg", *PROVENANCE)
MEANING = (
    "units", "positive", "cell_methods", "flag_values", "flag_meanings", "_Unsigned", *PACKING,
)  # fmt: skip
"""Attributes of an array that change what its numbers mean."""


def read_arrays(
    path: Path, needed: tuple[str, ...], optional: tuple[str, ...]
) -> tuple[Mapping[str, Floats], Mapping[str, Any]]:
    """The arrays of a surface's file by name, and its attributes.

    Parameters
    ----------
    path : Path, of the file, NetCDF-4 or NetCDF-3
    needed, optional : tuple of str, names of arrays of real numbers; the latter may be missing

    Returns
    -------
    arrays : mapping, by name, of one, two or, the modes, four dimensions: the numbers that are
        meant, profiles first and columns second, lengths in mm, NaN where one is missing
    attributes : mapping, those of ``ATTRIBUTES`` that are there, texts as str

    Raises
    ------
    InputError
        Where the file cannot be read, an array is missing, or is not such an array.
    """
    with open_regular(path, MOST_BYTES) as stream:
        read = _read_classic if stream.read(3) == b"CDF" else _read_hdf5
    arrays, attributes = read(path, partial(_names_to_read, needed, optional, path))
    # Other programs rename the dimensions, and change their order; the track position's is that of
    # the profiles.
    profiles = arrays["position"].dimensions
    columns = (name for name in arrays["status"].dimensions if name not in profiles)
    order = {name: place for place, name in enumerate((*profiles, *columns, "axis", "mode"))}
    values = {name: _physical_values(name, array, order, path) for name, array in arrays.items()}
    texts = {name: as_text(value) for name, value in attributes.items()}
    return values, attributes | {name: text for name, text in texts.items() if text is not None}


def _names_to_read(
    needed: tuple[str, ...], optional: tuple[str, ...], path: Path, there: Collection[str]
) -> list[str]:
    """Names of the arrays to read, of those that are there."""
    if missing := [name for name in needed if name not in there]:
        allowed = ", ".join(needed)
        raise InputError("is not a surface of lscan", where=path, value=missing, allowed=allowed)
    if "sigma_calibration" in there and "modes" not in there:
        allowed = "a surface with them, or without sigma_calibration, their sum"
        raise InputError("modes: are lost", where=path, allowed=allowed)
    return [*needed, *(name for name in optional if name in there)]


_Wanted = Callable[[Collection[str]], list[str]]
_Read = tuple[dict[str, NetcdfArray], dict[str, Any]]


def _read_hdf5(path: Path, wanted: _Wanted) -> _Read:
    """The wanted arrays as they are stored, and those of ATTRIBUTES that are there."""
    with open_hdf5(path, MOST_BYTES, "NetCDF", texts=True) as file:
        names = wanted(set(file))  # asking the file for a name follows its link
        attributes = {name: file.attrs[name] for name in ATTRIBUTES if name in file.attrs}
        return {name: _read_array(file, name, path) for name in names}, attributes


def _read_classic(path: Path, wanted: _Wanted) -> _Read:
    """The same of NetCDF-3."""
    content = read_bytes(path, MOST_BYTES)
    if content[3:4] == b"\x05":
        allowed = "NetCDF-4, as nccopy -k nc4 makes it"
        raise InputError("is a kind of NetCDF not read", where=path, value="CDF-5", allowed=allowed)
    try:
        return _classic_arrays(content, path, wanted)
    except InputError:
        raise
    except Exception as error:  # the reader raises whatever fits best to what is damaged
        message = " ".join(str(error).split())
        raise InputError("cannot be read as NetCDF", where=path, value=message) from error


def _classic_arrays(content: bytes, path: Path, wanted: _Wanted) -> _Read:
    from scipy.io import netcdf_file  # here: most surfaces are NetCDF-4

    with tempfile.TemporaryFile() as copy, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the arrays outlive the file, whose bytes stay mapped
        copy.write(content)
        copy.seek(0)
        with netcdf_file(copy, mmap=True) as file:
            arrays = {}
            for name in wanted(file.variables):
                found = file.variables[name]
                _require_numbers(name, found.data, path)
                notes = {key: getattr(found, key) for key in MEANING if hasattr(found, key)}
                arrays[name] = NetcdfArray(tuple(found.dimensions), np.array(found.data), notes)
            return arrays, {key: getattr(file, key) for key in ATTRIBUTES if hasattr(file, key)}


def _read_array(file: h5py.File, name: str, path: Path) -> NetcdfArray:
    """One array, once it is known to be of numbers, not too many, and in this file."""
    found = hdf5_array(file, name, _most(name), path)
    _require_numbers(name, found, path)
    attributes = {key: found.attrs[key] for key in MEANING if key in found.attrs}
    return NetcdfArray(_dimensions(found), np.asarray(found[()]), attributes)


def _most(name: str) -> int:
    return MOST_MODE_NUMBERS if name == "modes" else MOST_POINTS


def _require_numbers(name: str, found: Any, path: Path) -> None:
    """Refuse what is no array of numbers, or declares too many."""
    dtype, ndim = found.dtype, found.ndim
    if not (dtype.kind in "fiu" and dtype.itemsize <= 8 and ndim in (1, 2, 4)):
        value = f"{dtype} in {ndim} dimensions"
        raise InputError(f"{name}: is not an array of numbers", where=path, value=value)
    if prod(found.shape) > _most(name):
        allowed = f"{_most(name)} numbers"
        raise InputError(f"{name}: is too large", where=path, value=found.shape, allowed=allowed)


def _dimensions(found: h5py.Dataset) -> tuple[str, ...]:
    """Names of an array's dimensions; none where the file is HDF5 without them."""
    if "DIMENSION_LIST" in found.attrs:
        scales = [next(iter(dimension.values())).name for dimension in found.dims]
        return tuple(scale.rpartition("/")[2] for scale in scales)
    return (found.name[1:],) if found.is_scale else ()


def _physical_values(name: str, array: NetcdfArray, order: Mapping[str, int], path: Path) -> Floats:
    """The numbers that an array stands for."""
    where, attributes = f"{path}: {name}", array.attributes
    for key, ours in {"positive": "up", "cell_methods": "point"}.items():
        value = as_text(attributes.get(key, ours))
        if value is None or not value.endswith(ours):
            raise InputError(f"{key}: of another quantity", where=where, value=value, allowed=ours)
    if name == "status":
        _require_our_codes(attributes, where)
    values = unpack(array, where)
    if name != "status":
        values = in_mm(values, as_text(attributes.get("units")), where)
    places = [order.get(dimension, len(DIMENSIONS)) for dimension in array.dimensions]
    return values.transpose(np.argsort(places, kind="stable")) if places else values


def _require_our_codes(attributes: Mapping[str, Any], where: str) -> None:
    """Refuse a status whose codes mean something else than they do here."""
    meanings = as_text(attributes.get("flag_meanings", "")) or ""
    codes = np.atleast_1d(attributes.get("flag_values", ())).tolist()
    ours = {status.name.lower(): int(status) for status in Status}
    stated = dict(zip(meanings.split(), codes, strict=False))
    if other := {name: code for name, code in stated.items() if ours.get(name) != code}:
        raise InputError("flag_meanings: are other ones", where=where, value=other, allowed=ours)


# Files of a surface: NetCDF (kept and read back) and clouds (points for other programs).


SEPARATOR = "; "  # of the corrections
LENGTH = {"units": "mm"}
MODES = {
    "long_name": "displacement along x, y and z by each independent error of calibration and "
    "alignment, when it is one standard deviation large"
}
COORDINATES = "x y position"
COMMON = "sigma_calibration"
UNLIKE = 0.05  # of the size of modes: packed ones are rounded


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
    require_storable(Path(path), *surface.status.shape)
    if surface.modes_mm is not None and surface.modes_mm.size > MOST_MODE_NUMBERS:
        allowed = f"{MOST_MODE_NUMBERS} numbers"
        shape = surface.modes_mm.shape
        raise InputError("modes: are too many for a file", where=path, value=shape, allowed=allowed)
    write_atomically(Path(path), netcdf_bytes(*_contents(surface)))


def require_storable(path: Path, frames: int, columns: int) -> None:
    """Refuse a surface of more points than its readers accept.

    Parameters
    ----------
    path : Path, of the file that it is for
    frames, columns : int

    Raises
    ------
    InputError
        There are more than ``MOST_POINTS``.
    """
    if frames * columns > MOST_POINTS:
        raise InputError(
            "the surface has too many points for a file", where=path,
            value=f"{frames} profiles of {columns} columns", allowed=f"{MOST_POINTS} points",
        )  # fmt: skip


def load_surface(path: Path | str) -> Surface:
    """The surface that :func:`save_surface` wrote, to the last bit, but for its brightness: None.

    The yaw, which the file has in degrees, is the same to rounding.  Where another program has
    rewritten the file, packed numbers, missing ones, other units of length and another order of
    the dimensions are followed; a point without x, y or z has no data.

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
    arrays, attributes = read_arrays(path, names, optional=("y_sigma", "modes", COMMON))
    frame, corrections = attributes.get("frame"), attributes.get("corrections", "")
    if not isinstance(frame, str) or frame not in ("head", "workpiece"):
        allowed = "head, workpiece"
        raise InputError("frame: is none of a surface", where=path, value=frame, allowed=allowed)
    if not isinstance(corrections, str):
        raise InputError("corrections: is no text", where=path, value=corrections)
    _check_shapes(path, arrays)
    if not np.isin(arrays["status"], list(Status)).all():
        raise InputError("status: holds what is no status", where=path)
    if not np.isfinite(arrays["position"]).all():
        raise InputError("position: is not known of each profile", where=path)
    xyz = np.stack([arrays[name] for name in "xyz"], axis=-1)
    codes = arrays["status"].astype(np.int64)
    there = has_value(codes) & np.isfinite(xyz).all(axis=-1)
    for name in ("x_sigma", "y_sigma", "z_sigma"):
        if name in arrays and not (arrays[name][there] >= 0).all():
            raise InputError(f"{name}: is no uncertainty at a point that has a value", where=path)
        if name in arrays and np.isinf(arrays[name][there]).any():
            raise InputError(f"{name}: is infinite at a point that has a value", where=path)
    if "modes" in arrays:
        _require_whole_modes(path, arrays["modes"], arrays.get(COMMON), there)
    return Surface(
        xyz_mm=xyz,
        sigma_x_mm=arrays["x_sigma"],
        sigma_z_mm=arrays["z_sigma"],
        # Another program may have taken a point's x, y or z away.
        status=np.where(has_value(codes) & ~there, Status.NO_DATA, codes),
        position_mm=arrays["position"],
        frame=cast(Literal["head", "workpiece"], frame),
        modes_mm=arrays["modes"].astype(np.float32) if "modes" in arrays else None,
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
    value = np.asarray(attributes[name])  # NetCDF-4 has numbers as arrays of one
    if value.dtype.kind != "f" or value.size != 1 or not np.isfinite(value).all():
        raise InputError(f"{name}: is no angle", where=path, value=attributes[name])
    return float(np.radians(value.item()))


def _provenance(path: Path, attributes: Mapping[str, Any]) -> Provenance | None:
    """What the file says the surface was made from, None of an older one, which says nothing."""
    if not (known := {name: attributes[name] for name in PROVENANCE if name in attributes}):
        return None
    pictures = np.asarray(known.get("pictures", ""))
    if pictures.dtype.kind in "iu" and pictures.size == 1:
        known["pictures"] = pictures.item()
    return check(StoredProvenance, known, where=path).provenance()


def _require_whole_modes(path: Path, modes: Floats, common: Floats | None, there: Mask) -> None:
    """Refuse modes of which another program has dropped some, or what some points have of them.

    common: (F, N) mm, what they are of z in all; None where the file does not say.
    """
    total = np.sqrt(np.square(modes[..., 2, :], dtype=np.float64).sum(axis=-1))[there]
    if not np.isfinite(modes[there]).all():
        raise InputError("modes: are not known at a point that has a value", where=path)
    if common is None or total.size == 0:
        return
    stated = common[there]
    apart = np.abs(total - stated) > UNLIKE * (stated + np.median(stated))
    if np.isnan(stated).any() or apart.any():
        what = f"modes: are not those whose size {COMMON} states"
        allowed = "all modes, as the file was written with"
        raise InputError(what, where=path, value=f"{int(apart.sum())} points", allowed=allowed)


def _check_shapes(path: Path, arrays: Mapping[str, Floats]) -> None:
    """Refuse arrays that are not of one surface."""
    shape = arrays["status"].shape
    for name, array in arrays.items():
        wanted = {"position": shape[:1], "modes": (*shape, 3, array.shape[-1])}.get(name, shape)
        if len(shape) != 2 or array.shape != wanted:
            allowed = "(frame, column), of one size; position (frame,); modes with axis and mode"
            raise InputError(f"{name}: wrong shape", where=path, value=array.shape, allowed=allowed)


def save_points(path: Path, surface: Surface) -> None:
    """Write the points that have a value to a cloud for other programs, by the suffix.

    ``.ply``: PLY, in mm in single precision.  ``.e57``: E57, in metres in double precision.
    ``.las`` and ``.laz``: LAS 1.4, in metres in steps of 0.1 um; they need
    ``pip install 'lscan[clouds]'``.  Each point carries its uncertainty, its status and, where the
    surface has it, its brightness (``ply_bytes``, ``e57_bytes``, ``las_bytes``).

    Parameters
    ----------
    path : Path, of the file
    surface : Surface, in either frame

    Raises
    ------
    InputError
        For another suffix, where a package is missing, there is no point, or the file cannot be
        written.
    """
    as_bytes = cloud_writer(path)
    keep = has_value(surface.status)
    if not keep.any():
        raise InputError("no point has a value", where=path, allowed="a surface with points")
    sigmas = {"x": surface.sigma_x_mm, "y": surface.sigma_y_mm, "z": surface.sigma_z_mm}
    cloud = Cloud(
        surface.xyz_mm[keep],
        {axis: sigma[keep] for axis, sigma in sigmas.items() if sigma is not None},
        surface.status[keep],
        None if surface.brightness is None else surface.brightness[keep],
        surface.frame,
    )
    write_atomically(path, as_bytes(cloud))


def _contents(surface: Surface) -> tuple[dict[str, NetcdfArray], dict[str, Any]]:
    """The surface as arrays after the CF conventions, and attributes."""
    where = "laser sheet and track" if surface.frame == "head" else "workpiece"

    def array(values: NDArray[Any], long_name: str, **notes: Any) -> NetcdfArray:
        return NetcdfArray(DIMENSIONS, values, {"long_name": long_name, **notes})

    def measured_array(values: NDArray[Any], long_name: str, **notes: Any) -> NetcdfArray:
        return array(values, long_name, coordinates=COORDINATES, **notes)

    x, y, z = np.moveaxis(surface.xyz_mm, -1, 0)
    # Of z alone: what stands beside a coordinate is lost in iris.
    beside = "z_sigma status" + (surface.modes_mm is not None) * f" {COMMON}"
    codes = np.array([int(status) for status in Status], dtype=np.int8)
    arrays = {
        "x": array(x, f"x in the {where} frame", **LENGTH),
        "y": array(y, f"y in the {where} frame", **LENGTH),
        "z": measured_array(
            z, f"height in the {where} frame", ancillary_variables=beside, **LENGTH
        ),
        "x_sigma": measured_array(surface.sigma_x_mm, "standard uncertainty of x", **LENGTH),
        "z_sigma": measured_array(surface.sigma_z_mm, "standard uncertainty of z", **LENGTH),
        "status": measured_array(
            surface.status.astype(np.int8),
            "why a point has, or has not, a value",
            flag_values=codes,
            flag_meanings=" ".join(status.name.lower() for status in Status),
        ),
    }
    if surface.sigma_y_mm is not None:
        arrays["y_sigma"] = measured_array(
            surface.sigma_y_mm, "standard uncertainty of y", **LENGTH
        )
    if surface.modes_mm is not None:
        common = np.sqrt(np.square(surface.modes_mm[..., 2, :], dtype=np.float64).sum(axis=-1))
        name = "part of z_sigma that calibration and alignment give to all points in common"
        arrays[COMMON] = measured_array(common, name, **LENGTH)
        modes = {**MODES, "coordinates": COORDINATES, **LENGTH}
        arrays["modes"] = NetcdfArray((*DIMENSIONS, "axis", "mode"), surface.modes_mm, modes)
    track = {"long_name": "track position of the profile", **LENGTH}
    arrays["position"] = NetcdfArray(DIMENSIONS[:1], surface.position_mm, track)
    return arrays, _notes("Surface", surface)


def _notes(what: str, surface: Surface) -> dict[str, Any]:
    """The attributes of a file made from a surface."""
    notes: dict[str, Any] = {
        "title": f"{what} measured by a laser line scanner",
        "source": f"laser line scanner, lscan {__version__}",
        "frame": surface.frame,
        "corrections": SEPARATOR.join(surface.corrections),
    }
    if surface.yaw_rad is not None and surface.yaw_sigma_rad is not None:
        notes["yaw_deg"] = float(np.degrees(surface.yaw_rad))
        notes["yaw_sigma_deg"] = float(np.degrees(surface.yaw_sigma_rad))
    if surface.provenance is not None:
        notes |= asdict(surface.provenance)
    return notes


# Files of a regular grid, for programs of maps, images and roughness.


_OF_ONE_BAND = {".asc": esri_ascii_bytes, ".x3p": x3p_bytes, ".sdf": sdf_bytes}
GRIDS = (".nc", ".tif", ".tiff", *_OF_ONE_BAND)
_HEIGHT, _SIGMA, _COUNT = "height z, mm", "standard uncertainty of z, mm", "points of the cell"


def save_grid(path: Path | str, grid: HeightGrid, surface: Surface) -> list[Path]:
    """Write a grid of heights, their uncertainties and the points of each cell, by the suffix.

    ``.nc``: NetCDF-4 after the CF conventions 1.11, x and y as axes of their own; what calibration
    gives to all heights in common is told apart, as ``sigma_calibration``.  ``.tif``: GeoTIFF of
    three bands.  ``.asc`` (ESRI ASCII), ``.x3p`` (ISO 25178-72) and ``.sdf`` (ISO 25178-71): two
    files, the uncertainty in NAME-sigma, without the number of points; X3P and SDF in metres.

    Parameters
    ----------
    path : Path or str, of the file
    grid : HeightGrid
    surface : Surface, that it was made from

    Returns
    -------
    list of Path, the files written

    Raises
    ------
    InputError
        For another suffix, a grid of more than 65,535 cells along a side for SDF, or where the file
        cannot be written.

    Examples
    --------
    >>> import lscan
    >>> from lscan.surface import grid_cells, save_grid
    >>> surface = lscan.load_surface("surface.nc")
    >>> [str(file) for file in save_grid("grid.asc", grid_cells(surface, 40.0), surface)]
    ['grid.asc', 'grid-sigma.asc']
    """
    path, kind = Path(path), Path(path).suffix.lower()
    if kind not in GRIDS:
        raise InputError("no such kind of grid", where=path, value=kind, allowed=", ".join(GRIDS))
    bands = {_HEIGHT: grid.z_mm, _SIGMA: grid.sigma_z_mm, _COUNT: grid.points.astype(float)}
    half_mm = grid.cell_mm / 2
    west_mm, south_mm = float(grid.x_mm[0] - half_mm), float(grid.y_mm[0] - half_mm)
    raster = Raster(west_mm, south_mm, grid.cell_mm, bands, f"lscan, {surface.frame} frame")
    if kind == ".nc":
        files = {path: netcdf_bytes(_grid_arrays(grid), _notes("Heights", surface))}
    elif kind in _OF_ONE_BAND:
        beside = path.with_name(f"{path.stem}-sigma{path.suffix}")
        of_bands = {path: _HEIGHT, beside: _SIGMA}
        files = {file: _OF_ONE_BAND[kind](raster, band) for file, band in of_bands.items()}
    else:
        files = {path: geotiff_bytes(raster)}
    for file, content in files.items():
        write_atomically(file, content)
    return list(files)


def _grid_arrays(grid: HeightGrid) -> dict[str, NetcdfArray]:
    """The grid as arrays after the CF conventions."""
    plan = ("y", "x")

    def axis(values: Floats, name: str) -> NetcdfArray:
        # Without a standard name axis = "Y" stands for the latitude (CF 1.11, section 4).
        plane = {"axis": name.upper(), "standard_name": f"projection_{name}_coordinate"}
        notes = {"long_name": f"{name} of the cells' middles", **plane, **LENGTH}
        return NetcdfArray((name,), values, notes)

    beside = "z_sigma points" + (grid.modes_mm is not None) * f" {COMMON}"
    height = {"long_name": "height at the cell's middle", "ancillary_variables": beside, **LENGTH}
    sigma = {"long_name": "standard uncertainty of z", **LENGTH}
    arrays = {
        "x": axis(grid.x_mm, "x"),
        "y": axis(grid.y_mm, "y"),
        "z": NetcdfArray(plan, grid.z_mm, height),
        "z_sigma": NetcdfArray(plan, grid.sigma_z_mm, sigma),
        "points": NetcdfArray(
            plan, grid.points.astype(np.int32), {"long_name": _COUNT, "units": "1"}
        ),
    }
    if grid.modes_mm is not None:
        name = "part of z_sigma that calibration and alignment give to all cells in common"
        common = np.sqrt((grid.modes_mm**2).sum(axis=-1))
        arrays[COMMON] = NetcdfArray(plan, common, {"long_name": name, **LENGTH})
    return arrays
