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
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from math import prod
from pathlib import Path
from typing import IO, Any, BinaryIO, Literal, TypeAlias, cast

import h5py
import numpy as np
from numpy.typing import NDArray

from lscan.errors import InputError
from lscan.files.disk import open_regular, reading_errors

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
        data = os.pread(self._stream.fileno(), size, self._place)
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
                entry.filename.removesuffix(".npy"): _npy_array(_unpacked(archive, entry))
                for entry in entries
            }
    except InputError:
        raise
    except Exception as error:  # NumPy raises whatever fits best to what is wrong with a header
        raise InputError("cannot be read as arrays", where=where) from error


def _unpacked(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
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
