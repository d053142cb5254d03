"""HDF5, ZIP, NPZ and tar files of strangers: each part is looked at before it is read.

Such a file may refer to others, hold links, objects and texts that lead nowhere, and declare more
than there is memory for; of what lscan writes, none does.  What it declares is compared with what
is allowed, and with what is there, before memory is taken for it.

References
----------
The HDF Group, HDF5 File Format Specification, version 3.0, section III.E: the global heap.
IEEE Std 1003.1, pax: the interchange formats ustar and pax.
"""

import io
import os
import re
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from math import prod
from pathlib import Path
from typing import IO, Any, BinaryIO, Literal, TypeAlias, cast

import h5py
import numpy as np
from numpy.typing import NDArray

from lscan.errors import InputError
from lscan.files.disk import open_regular, reading_errors
from lscan.records import Floats, Mask

ReadMember: TypeAlias = Callable[[str, int], bytes]
"""A member's bytes by its name, no more than so many."""
Place: TypeAlias = tuple[int, int]
"""Where a member begins in its file, and its size, bytes."""
MOST_AT_ONCE = 2**24
"""Bytes of the list of members that ends a ZIP file: 180,000 of them."""
MOST_MEMBERS = 2**18
"""Of a tar file."""
MOST_TAR_BYTES = 2**44
"""Of a tar file: no more than file systems hold, since only single members are read."""
_BLOCK = 512  # of a tar file
_FILES = (tarfile.REGTYPE, tarfile.AREGTYPE)
_NOTES = (tarfile.XHDTYPE, tarfile.XGLTYPE)  # of pax, such as times to a nanosecond
_HARMED_ZIP = (
    zipfile.BadZipFile, NotImplementedError, RuntimeError, ValueError, EOFError, OSError,
    struct.error, OverflowError, zlib.error,
)  # fmt: skip
_BOUNDED = {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}  # no more than asked for is unpacked
_OBJECT = struct.Struct("<H6xQ")  # in a global heap of HDF5: its number, its size in bytes
_HEAP = re.compile(rb"GCOL\x01(?=...(.{8}))", re.DOTALL)
_WINDOW = 2**20


@contextmanager
def open_hdf5(
    file: Path, most: int, kind: str = "HDF5", *, texts: bool = False, within: Path | None = None
) -> Iterator[h5py.File]:
    """An HDF5 file, open; whatever HDF5 says of damage becomes one line.

    Parameters
    ----------
    file : Path
    most : int, its largest size, bytes
    kind : str, what it is, for the error
    texts : bool, whether texts will be read, so that those of the whole file are looked at
    within : Path or None, as of ``read_bytes``

    Raises
    ------
    InputError
        As ``read_bytes``, and where it, or what the block reads of it, cannot be read as HDF5.
    """
    with open_regular(file, most, within) as stream:
        try:
            if texts and not _heaps_end(stream):
                raise ValueError("damaged texts")
            try:  # by its name: HDF5 reads a stream in twice the time
                opened = h5py.File(file, "r", locking=False)
            except OSError:  # as where this program has it open in another way
                stream.seek(0)
                opened = h5py.File(stream, "r")
            with opened:
                yield opened
        except InputError:
            raise
        except Exception as error:  # h5py raises whatever fits best to what HDF5 says of damage
            message = " ".join(str(error).split())
            raise InputError(f"cannot be read as {kind}", where=file, value=message) from error


def hdf5_array(group: h5py.Group, name: str, most: int, where: Path) -> h5py.Dataset:
    """An array of an HDF5 file, once it is known to lie in this file and to be not too large.

    Parameters
    ----------
    group : h5py.Group
    name : str, of the array, behind those of the groups that it lies in
    most : int, of numbers in it, or in one of the blocks that it is stored in
    where : Path, the file, for the error

    Raises
    ------
    InputError
        It is not there, a link, stored in other files or too large.
    """
    found: object = group
    for part in name.split("/"):
        found = found[part] if isinstance(found, h5py.Group) and _is_in(found, part) else None
    if not isinstance(found, h5py.Dataset) or found.is_virtual or found.external:
        raise InputError(f"{name}: is not an array in this file", where=where)
    if max(prod(found.shape or ()), prod(found.chunks or (1,))) > most:
        allowed = f"{most} numbers"
        raise InputError(f"{name}: is too large", where=where, value=found.shape, allowed=allowed)
    return found


def _is_in(group: h5py.Group, name: str) -> bool:
    """Whether a group itself holds what is called so; asked in other ways, links are followed."""
    try:
        return bool(group.id.links.get_info(name.encode()).type == h5py.h5l.TYPE_HARD)
    except (KeyError, RuntimeError):  # there is nothing of that name
        return False


def _heaps_end(stream: BinaryIO) -> bool:
    """Whether each global heap, in which HDF5 keeps texts, leads from object to object to its end.

    HDF5 itself goes on for ever where a damaged size leads nowhere or back.
    """
    length, last = stream.seek(0, io.SEEK_END), 0
    for begin, size in _heaps(stream):
        place, end = begin + 16, begin + size
        if end > length:
            continue  # HDF5 refuses it, if it is a heap at all and not numbers that look like one
        if begin < last:
            return False  # a heap within a heap
        while place + 16 <= end:
            stream.seek(place)
            number, inside = _OBJECT.unpack(stream.read(16))
            step = 16 + -(-inside // 8) * 8 if number else inside  # 0: the space that is left
            if not 16 <= step <= end - place:
                return False
            place += step
        last = end
    return True


def _heaps(stream: BinaryIO) -> Iterator[Place]:
    """Where something begins that looks like a heap, and the size it states."""
    begin = 0
    while True:
        stream.seek(begin)
        window = stream.read(_WINDOW + 15)
        for found in _HEAP.finditer(window):
            if found.start() < _WINDOW:
                yield begin + found.start(), int.from_bytes(found[1], "little")
        if len(window) <= _WINDOW:
            return
        begin += _WINDOW


class _PartlyRead(io.RawIOBase):
    """A file read a part at a time, as by several processes at once: none moves another's place.

    A ZIP file states how long its list of members is, which is read at once.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self._place = stream, 0
        self._size = stream.seek(0, io.SEEK_END)

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._place = offset + (0, self._place, self._size)[whence]
        return self._place

    def tell(self) -> int:
        return self._place

    def read(self, size: int = -1) -> bytes:
        """The next bytes, by default all that follow; ValueError where they would be too many."""
        size = self._size - self._place if size < 0 else size
        if size > MOST_AT_ONCE:
            raise ValueError(f"{size} bytes at once")
        if hasattr(os, "pread"):
            data = os.pread(self._stream.fileno(), size, self._place)
        else:  # Windows, where no process is forked, and so none shares this one's place
            self._stream.seek(self._place)
            data = self._stream.read(size)
        self._place += len(data)
        return data

    def close(self) -> None:
        self._stream.close()
        super().close()


def open_zip(file: Path, most: int, kind: str) -> ReadMember:
    """What reads the members of a ZIP file, which must be stored as they are.

    Parameters
    ----------
    file : Path
    most : int, its largest size, bytes
    kind : str, what it is, for the error

    Raises
    ------
    InputError
        As ``read_bytes``, and where it is no ZIP file, or two members have one name.  A member that
        is missing, packed, damaged or too large is named when it is read.
    """
    stream = _PartlyRead(open_regular(file, most))
    try:
        archive = zipfile.ZipFile(cast(IO[bytes], stream))
        names = archive.namelist()
    except _HARMED_ZIP as error:
        stream.close()
        raise InputError(f"is no {kind}: neither folder nor archive", where=file) from error
    if len(set(names)) < len(names):
        raise InputError(f"is no {kind}: two members have one name", where=file)

    def read(name: str, most: int) -> bytes:
        try:
            entry = archive.getinfo(name)
            if entry.compress_type != zipfile.ZIP_STORED or entry.file_size > most:
                raise InputError(f"member {name} is compressed or too large", where=file)
            with archive.open(entry) as opened:
                return b"".join(iter(partial(opened.read, _WINDOW), b""))
        except KeyError as error:
            raise InputError(f"member {name} is missing", where=file) from error
        except _HARMED_ZIP as error:
            raise InputError(f"member {name} cannot be read", where=file) from error

    return read


def npz_arrays(data: bytes, most: int, where: object) -> dict[str, NDArray[Any]]:
    """The arrays of an NPZ file by name.

    Parameters
    ----------
    data : bytes, of the file
    most : int, bytes that they may take in all
    where : the file, for the error

    Raises
    ------
    InputError
        It cannot be read, holds objects, or more than is allowed.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = archive.infolist()
            if not {entry.compress_type for entry in entries} <= _BOUNDED:
                raise ValueError("packed in a way that says not how far it unpacks")
            total = sum(entry.file_size for entry in entries)
            if total > most:
                allowed = f"{most} at most"
                raise InputError("unpacks to too much: bytes", where=where, value=total,
                                 allowed=allowed)  # fmt: skip
            return {
                entry.filename.removesuffix(".npy"): _npy_array(_unpack_member(archive, entry))
                for entry in entries
            }
    except InputError:
        raise
    except Exception as error:  # NumPy raises whatever fits best to what is wrong with a header
        raise InputError("cannot be read as arrays", where=where) from error


def _unpack_member(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    """The bytes of a member, of which no more than it states are unpacked."""
    with archive.open(entry) as opened:
        return opened.read(entry.file_size + 1)


def _npy_array(data: bytes) -> NDArray[Any]:
    """The array of an NPY file; ValueError where it states another size than it has."""
    stream = io.BytesIO(data)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError("of another version")
    shape, by_columns, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype.hasobject or prod(shape) * dtype.itemsize != len(data) - stream.tell():
        raise ValueError("of objects, or of another size than it states")
    order: Literal["F", "C"] = "F" if by_columns else "C"
    return np.ndarray(shape, dtype, data, stream.tell(), order=order).copy("K")


def tar_places(file: Path, most: int, within: Path | None = None) -> dict[str, Place]:
    """Where the members of a tar file begin and how long they are, by name.

    Parameters
    ----------
    file : Path, not compressed
    most : int, bytes of a member
    within : Path or None, as of ``read_bytes``

    Raises
    ------
    InputError
        As ``read_bytes``; a member is a link or another thing than a file, has the name of another,
        is too large or not there; the file is damaged.
    """
    places: dict[str, Place] = {}
    with open_regular(file, MOST_TAR_BYTES, within) as stream, reading_errors(file):
        end, place = stream.seek(0, io.SEEK_END), 0
        while place < end:
            stream.seek(place)
            try:
                head = tarfile.TarInfo.frombuf(stream.read(_BLOCK), "utf-8", "surrogateescape")
            except tarfile.EOFHeaderError:  # type: ignore[attr-defined]
                break  # an empty block ends the file
            except tarfile.HeaderError as error:
                raise InputError("is damaged, or no tar file", where=file, value=place) from error
            begin = place + _BLOCK
            place = begin + -(-head.size // _BLOCK) * _BLOCK
            _check_member(head, begin, end, most, file)
            if head.type in _FILES:
                if head.name in places or len(places) == MOST_MEMBERS:
                    what = f"has a member twice, or more than {MOST_MEMBERS}"
                    raise InputError(what, where=file, value=head.name)
                places[head.name] = begin, head.size
    return places


def _check_member(head: tarfile.TarInfo, begin: int, end: int, most: int, file: Path) -> None:
    """Refuse a member that is no file, nor what may stand between files, or of a wrong size."""
    if not (head.type in _FILES or head.isdir() or head.type in _NOTES):
        raise InputError("a member is a link, or no file", where=file, value=head.name)
    if not 0 <= head.size <= min(most, end - begin):
        raise InputError(f"member {head.name} is too large, or not there: bytes", where=file,
                         value=head.size, allowed=f"{most} at most")  # fmt: skip


# NetCDF after the CF conventions: files that every program can use, and what files of others mean.
#
# References
# ----------
# Eaton et al., NetCDF Climate and Forecast (CF) Metadata Conventions, version
# 1.11: sections 2.2 (types), 2.5.1 (missing data), 3.1 (units) and 8.1 (packed data). Unidata,
# NetCDF Users Guide, appendix A: attribute conventions; netcdf.h: values of what was not written.


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
                characters = np.char.encode(values, "utf-8").view("S1")
                dimensions = (*dimensions, f"{name}_length")
                values = characters.reshape(*values.shape, -1)
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


def unpack(array: NetcdfArray, where: str) -> Floats:
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
    missing = _missing_values(stored, values, notes, where)
    return np.where(missing, np.nan, values) if missing.any() else values


_UNPACKED = {"scale_factor": 1.0, "add_offset": 0.0}


def _numbers(value: Any, most: int, where: str) -> NDArray[Any]:
    """An attribute as one or several numbers."""
    found = np.atleast_1d(np.asarray(value))
    if found.dtype.kind not in "fiu" or not 1 <= found.size <= most:
        raise InputError("is no such number", where=where, value=value)
    return found.astype(found.dtype.newbyteorder("="))


def _missing_values(
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
