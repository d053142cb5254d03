"""Reading the NetCDF file of a surface: the few arrays wanted, each looked at before it is read.

NetCDF-4 is HDF5, read as containers.py reads it.  NetCDF-3, a format of its own, refers to no other
file, but may say that many arrays share the same bytes: they are mapped, not copied.
"""

import tempfile
import warnings
from collections.abc import Callable, Collection, Mapping
from functools import partial
from math import prod
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from lscan.errors import InputError
from lscan.files.containers import (
    PACKING,
    NetcdfArray,
    as_text,
    hdf5_array,
    in_mm,
    open_hdf5,
    unpacked,
)
from lscan.files.disk import open_regular, read_bytes
from lscan.records import Floats, Status

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
    arrays, attributes = read(path, partial(_wanted, needed, optional, path))
    order = _order(arrays)
    values = {name: _meant(name, array, order, path) for name, array in arrays.items()}
    texts = {name: as_text(value) for name, value in attributes.items()}
    return values, attributes | {name: text for name, text in texts.items() if text is not None}


def _wanted(
    needed: tuple[str, ...], optional: tuple[str, ...], path: Path, there: Collection[str]
) -> list[str]:
    """Names of the arrays to read, of those that are there."""
    missing = [name for name in needed if name not in there]
    if missing:
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
        return {name: _array(file, name, path) for name in names}, attributes


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


def _array(file: h5py.File, name: str, path: Path) -> NetcdfArray:
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


def _order(arrays: Mapping[str, NetcdfArray]) -> dict[str, int]:
    """Places of the dimensions by name: other programs rename them, and change their order.

    That of the track position is that of the profiles.
    """
    profiles = arrays["position"].dimensions
    columns = (name for name in arrays["status"].dimensions if name not in profiles)
    return {name: place for place, name in enumerate((*profiles, *columns, "axis", "mode"))}


def _meant(name: str, array: NetcdfArray, order: Mapping[str, int], path: Path) -> Floats:
    """The numbers that an array stands for."""
    where, attributes = f"{path}: {name}", array.attributes
    for key, ours in {"positive": "up", "cell_methods": "point"}.items():
        value = as_text(attributes.get(key, ours))
        if value is None or not value.endswith(ours):
            raise InputError(f"{key}: of another quantity", where=where, value=value, allowed=ours)
    if name == "status":
        _require_our_codes(attributes, where)
    values = unpacked(array, where)
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
