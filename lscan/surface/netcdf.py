"""Reading the NetCDF file of a surface: the few arrays wanted, each looked at before it is read.

NetCDF-4 is HDF5, whose files may refer to others, declare more numbers than there is memory for,
and hold objects; of what a surface is made of, none does.

References
----------
The HDF Group, HDF5 File Format Specification, version 3.0, section III.E: the global heap.
"""

import io
import re
import struct
from collections.abc import Mapping
from math import prod
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from lscan.errors import InputError
from lscan.files.disk import read_bytes
from lscan.records import Floats

MOST_POINTS = 2**25
"""Of a surface: 4096 pictures of the largest camera."""
MOST_BYTES = 64 * MOST_POINTS
"""Of a surface's file: up to eight numbers a point, not compressed."""
MOST_MODE_NUMBERS = 8 * MOST_POINTS
"""Of the displacements by the modes, three numbers a point and mode in single precision."""
PROVENANCE = ("rig", "pictures", "extractor", "plane_map", "calibration_sha256")
"""Attributes that are the fields of records.Provenance."""
ATTRIBUTES = ("frame", "corrections", "yaw_deg", "yaw_sigma_deg", *PROVENANCE)
_OBJECT = struct.Struct("<H6xQ")  # in a global heap: its number, its size in bytes


def read_arrays(
    path: Path, needed: tuple[str, ...], optional: tuple[str, ...]
) -> tuple[Mapping[str, Floats], Mapping[str, Any]]:
    """The arrays of a surface's file by name, and its attributes.

    Parameters
    ----------
    path : Path, of the file
    needed, optional : tuple of str, names of arrays of real numbers; the latter may be missing

    Returns
    -------
    arrays : mapping, by name, of one, two or, the modes, four dimensions
    attributes : mapping, those of ``ATTRIBUTES`` that are there

    Raises
    ------
    InputError
        Where the file cannot be read, an array is missing, or is not such an array.
    """
    content = read_bytes(path, MOST_BYTES)
    if not _heaps_end(content):
        raise InputError("cannot be read as NetCDF", where=path, value="damaged texts")
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            present = set(file)  # asking the file for a name follows its link
            missing = [name for name in needed if name not in present]
            if missing:
                allowed = ", ".join(needed)
                raise InputError(
                    "is not a surface of lscan", where=path, value=missing, allowed=allowed
                )
            names = [*needed, *(name for name in optional if name in present)]
            attributes = {name: file.attrs[name] for name in ATTRIBUTES if name in file.attrs}
            return {name: _array(file, name, path) for name in names}, attributes
    except InputError:
        raise
    except Exception as error:  # h5py raises whatever fits best to what HDF5 says of damage
        message = " ".join(str(error).split())
        raise InputError("cannot be read as NetCDF", where=path, value=message) from error


def _heaps_end(content: bytes) -> bool:
    """Whether each global heap, in which HDF5 keeps texts, leads from object to object to its end.

    HDF5 itself goes on for ever where a damaged size leads nowhere or back.
    """
    last = 0
    for found in re.finditer(rb"GCOL\x01(?=...(.{8}))", content, re.DOTALL):
        place, end = found.start() + 16, found.start() + int.from_bytes(found[1], "little")
        if end > len(content):
            continue  # HDF5 refuses it, if it is a heap at all and not numbers that look like one
        if found.start() < last:
            return False  # a heap within a heap
        while place + 16 <= end:
            number, size = _OBJECT.unpack_from(content, place)
            step = 16 + -(-size // 8) * 8 if number else size  # 0: the space that is left
            if not 16 <= step <= end - place:
                return False
            place += step
        last = end
    return True


def _array(file: h5py.File, name: str, path: Path) -> Floats:
    """One array, once it is known to be of numbers, not too many, and in this file."""
    link, found = file.get(name, getlink=True), None
    if isinstance(link, h5py.HardLink):
        found = file[name]
    if not isinstance(found, h5py.Dataset) or found.is_virtual or found.external:
        raise InputError(f"{name}: is not an array in this file", where=path)
    plain = found.dtype.kind in "fi" and found.dtype.itemsize <= 8 and found.ndim in (1, 2, 4)
    if not plain:
        value = f"{found.dtype} in {found.ndim} dimensions"
        raise InputError(f"{name}: is not an array of numbers", where=path, value=value)
    largest = max(prod(found.shape), prod(found.chunks or (1,)))
    most = MOST_MODE_NUMBERS if found.ndim == 4 else MOST_POINTS
    if largest > most:
        allowed = f"{most} numbers"
        raise InputError(f"{name}: is too large", where=path, value=found.shape, allowed=allowed)
    array: Floats = np.asarray(found[()])
    return array
