"""Reading the NetCDF file of a surface: the few arrays wanted, each looked at before it is read.

NetCDF-4 is HDF5, whose files may refer to others, declare more numbers than there is memory for,
and hold objects; of what a surface is made of, none does.
"""

import io
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
    content = io.BytesIO(read_bytes(path, MOST_BYTES))
    try:
        with h5py.File(content, "r") as file:
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
