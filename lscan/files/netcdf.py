"""NetCDF after the CF conventions: files that every program can use, and what files of others mean.

References
----------
Eaton et al., NetCDF Climate and Forecast (CF) Metadata Conventions, version 1.11: sections 2.2
(types), 2.5.1 (missing data), 3.1 (units) and 8.1 (packed data).
Unidata, NetCDF Users Guide, appendix A: attribute conventions; netcdf.h: values of what was not
written.
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from lscan.errors import InputError
from lscan.records import Floats, Mask

CONVENTIONS = "CF-1.11"

_SYMBOLS = {"um": 1e-3, "mm": 1.0, "cm": 10.0, "dm": 100.0, "m": 1000.0, "km": 1e6, "in": 25.4}
MM_PER_UNIT = _SYMBOLS | {"µm": 1e-3, "inch": 25.4, "inches": 25.4}
MM_PER_UNIT |= {
    f"{prefix}{ending}": _SYMBOLS[symbol]
    for prefix, symbol in {"micro": "um", "milli": "mm", "centi": "cm", "": "m"}.items()
    for ending in ("meter", "meters", "metre", "metres")
}
"""Of the units of length that UDUNITS knows, those that a surface may be in."""

PACKING = {
    "scale_factor": 1, "add_offset": 1, "_FillValue": 1, "missing_value": 16,
    "valid_min": 1, "valid_max": 1, "valid_range": 2,
}  # fmt: skip
"""Attributes of packed numbers and of missing ones, and how many numbers each is at most."""

NOT_WRITTEN = {
    "i2": -(2**15) + 1, "i4": -(2**31) + 1, "u2": 2**16 - 1, "u4": 2**32 - 1,
    "f4": 9.969209968386869e36, "f8": 9.969209968386869e36,
}  # fmt: skip
"""By types, what stands where nothing was written and the file names no value for it."""

_COMPRESSED = {"compression": "gzip", "compression_opts": 1, "shuffle": True}


@dataclass(frozen=True)
class NetcdfArray:
    """One array of a file.

    Attributes
    ----------
    dimensions : tuple of str, their names; none where the file does not name them
    values : array, of numbers, or of str to be written
    attributes : mapping, by name
    """

    dimensions: tuple[str, ...]
    values: NDArray[Any]
    attributes: Mapping[str, Any]


def netcdf_bytes(arrays: Mapping[str, NetcdfArray], attributes: Mapping[str, Any]) -> bytes:
    """A NetCDF-4 file, of the types alone that NetCDF-3 has too.

    Texts are characters and whole numbers have 32 bits: many a program loses or refuses NetCDF-4's
    strings and its whole numbers of 64 bits.  Arrays of more than two dimensions are compressed.

    Parameters
    ----------
    arrays : mapping, by name; one that is called as its dimension has a value everywhere
    attributes : mapping, of the file; Conventions are added
    """
    import h5netcdf  # here: it takes a while, and most commands write none

    stream = io.BytesIO()
    with h5netcdf.File(stream, "w") as file:
        for name, array in arrays.items():
            dimensions, values = array.dimensions, array.values
            if values.dtype.kind == "U":
                dimensions, values = (*dimensions, f"{name}_length"), _characters(values)
            for dimension, size in zip(dimensions, values.shape, strict=True):
                if dimension not in file.dimensions:
                    file.dimensions[dimension] = size
            may_lack = values.dtype.kind == "f" and name not in dimensions
            variable = file.create_variable(
                name, dimensions, data=values, dtype=values.dtype,
                fillvalue=values.dtype.type(np.nan) if may_lack else None,
                **(_COMPRESSED if values.ndim > 2 else {}),
            )  # fmt: skip
            notes = {"_Encoding": "utf-8"} if array.values.dtype.kind == "U" else {}
            notes |= array.attributes
            variable.attrs.update({key: _portable(one) for key, one in notes.items()})
        whole = {"Conventions": CONVENTIONS, **attributes}
        file.attrs.update({key: _portable(one) for key, one in whole.items()})
    return stream.getvalue()


def _characters(texts: NDArray[np.str_]) -> NDArray[np.bytes_]:
    """Texts (N,) as their characters (N, L)."""
    encoded = np.char.encode(texts, "utf-8")
    return encoded.view("S1").reshape(*texts.shape, -1)


def _portable(value: Any) -> Any:
    """The value of an attribute in a type of NetCDF-3."""
    if isinstance(value, str):
        text = value.encode()
        return np.array(text, dtype=h5py.string_dtype("utf-8", max(len(text), 1)))
    return np.int32(value) if isinstance(value, int) else value


def as_text(value: Any) -> str | None:
    """An attribute as text, None where it is none; others write text as bytes or as arrays of one.

    Parameters
    ----------
    value : as h5py or SciPy reads it
    """
    if isinstance(value, h5py.Empty):
        return ""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    if isinstance(value, bytes):
        value = value.decode("utf-8", errors="replace")
    return value.rstrip("\0") if isinstance(value, str) else None


def unpacked(array: NetcdfArray, where: str) -> Floats:
    """The numbers that are meant: of packed ones those they stand for, NaN where one is missing.

    Parameters
    ----------
    array : NetcdfArray, as stored
    where : str, file and array, for the error

    Raises
    ------
    InputError
        An attribute that changes what the numbers mean cannot be followed.
    """
    stored = array.values.astype(array.values.dtype.newbyteorder("="), copy=False)
    notes = {
        name: _numbers(array.attributes[name], most, f"{where}: {name}")
        for name, most in PACKING.items()
        if name in array.attributes
    }
    if as_text(array.attributes.get("_Unsigned")) == "true" and stored.dtype.kind == "i":
        signed, unsigned = stored.dtype, np.dtype(f"u{stored.itemsize}")
        notes |= {key: one.view(unsigned) for key, one in notes.items() if one.dtype == signed}
        stored = stored.view(unsigned)
    values: Floats = stored if stored.dtype.kind == "f" else stored.astype(float)
    if "scale_factor" in notes or "add_offset" in notes:
        scale, offset = (float(notes.get(key, [one])[0]) for key, one in _UNPACKED.items())
        if not (np.isfinite([scale, offset]).all() and scale):
            value = f"{scale:g}, {offset:g}"
            raise InputError("scale_factor, add_offset: no packing", where=where, value=value)
        values = values.astype(float) * scale + offset
    missing = _missing(stored, values, notes, where)
    return np.where(missing, np.nan, values) if missing.any() else values


_UNPACKED = {"scale_factor": 1.0, "add_offset": 0.0}


def _numbers(value: Any, most: int, where: str) -> NDArray[Any]:
    """An attribute as one or several numbers."""
    found = np.atleast_1d(np.asarray(value))
    if found.dtype.kind not in "fiu" or not 1 <= found.size <= most:
        raise InputError("is no such number", where=where, value=value)
    return found.astype(found.dtype.newbyteorder("="))


def _missing(
    stored: NDArray[Any], values: Floats, notes: Mapping[str, NDArray[Any]], where: str
) -> Mask:
    """Where an array has no value.

    Limits are those of the stored numbers, unless they are fractions and these are not.
    """
    marks = [(key, mark) for key in ("_FillValue", "missing_value") for mark in notes.get(key, ())]
    if "_FillValue" not in notes and (kind := stored.dtype.str[1:]) in NOT_WRITTEN:
        marks.append(("", NOT_WRITTEN[kind]))
    missing = np.zeros(stored.shape, dtype=bool)
    for key, mark in marks:
        if stored.dtype.kind != "f" and not float(mark).is_integer():
            value = f"{mark:g}"
            raise InputError(f"{key}: is not of the array's type", where=where, value=value)
        with np.errstate(over="ignore"):
            missing |= stored == (stored.dtype.type(mark) if stored.dtype.kind == "f" else mark)
    least, most = notes.get("valid_range", (None, None))
    limits = {
        np.less: notes.get("valid_min", least), np.greater: notes.get("valid_max", most),
    }  # fmt: skip
    for beyond, limit in limits.items():
        if limit is not None:
            missing |= beyond(values if np.asarray(limit).dtype.kind == "f" else stored, limit)
    return missing


def in_mm(values: Floats, unit: str | None, where: str) -> Floats:
    """Lengths in mm.

    Parameters
    ----------
    values : array, in the unit
    unit : str or None, as a file states it
    where : str, file and array, for the error

    Raises
    ------
    InputError
        There is no such unit of length.
    """
    if unit is None or unit.strip() not in MM_PER_UNIT:
        allowed = ", ".join(_SYMBOLS)
        raise InputError("units: is no unit of length", where=where, value=unit, allowed=allowed)
    factor = MM_PER_UNIT[unit.strip()]
    return values if factor == 1.0 else values * factor
