"""Files: read without trust in what is there, written whole or not at all.

Reading: what is given may come from a stranger.  A FIFO would be waited for without end, a device
read without end; so only regular files are read, and no more of them than is allowed.
Writing: a crash or a full disk at any moment leaves no half file behind, and no link is followed.
What Windows lacks of POSIX is met here: flags of ``open``, folders that are locked and synced.
"""

import codecs
import errno
import hashlib
import importlib
import json
import os
import secrets
import shutil
import stat
import sys
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.resources import files
from io import BufferedReader
from pathlib import Path
from typing import Any

from pydantic_core import to_jsonable_python

from lscan.errors import DiskError, InputError

_MAKE_WRITABLE = "make it writable, or choose another folder"
_BRING_BACK = "make its folder, or bring it back where it was moved or its disk taken away"
_CHECK_DISK = "check the disk and its cable"
CLOSE_FILES = "close what holds so many files open, or raise the limit (ulimit -n)"
REMEDIES = {
    errno.ENOSPC: "make room on the disk",
    errno.EDQUOT: "make room on the disk, or have the quota raised",
    errno.EFBIG: "raise the limit for the size of files (ulimit -f)",
    errno.EROFS: _MAKE_WRITABLE,
    errno.EACCES: _MAKE_WRITABLE,
    errno.EPERM: _MAKE_WRITABLE,
    errno.ENOENT: _BRING_BACK,
    errno.ENOTDIR: _BRING_BACK,
    errno.EIO: _CHECK_DISK,
    errno.ENODEV: _CHECK_DISK,
    errno.ESTALE: _CHECK_DISK,
    errno.EMFILE: CLOSE_FILES,
    errno.ENFILE: CLOSE_FILES,
    errno.ELOOP: "put the file itself there instead of a link to it",
}
"""What to do where the system refuses a write, by its error number."""
_FULL_OR_FAILED = frozenset(
    {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.ENODEV, errno.ESTALE}
    | {errno.EMFILE, errno.ENFILE}
)

_TEMPORARIES = f".*.{'[0-9a-f]' * 8}.tmp"

LOCK = ".lock"
"""What holds the lock of a folder where the folder itself cannot be locked, as on Windows."""
_TRIES, _TRIED_EVERY_S = 50, 0.02

MOST_TEXT_BYTES = 2**20
"""Of a file that is written by hand, and of a run.json, which keeps one."""


def read_bytes(file: Path, most: int, within: Path | None = None) -> bytes:
    """The content of a regular file.

    Parameters
    ----------
    file
        Where it is; links are followed.
    most
        Its largest size in bytes.
    within
        A folder whose content is a stranger's, and ``file`` in it: no link out of it is followed.

    Returns
    -------
    bytes
        All that it holds.

    Raises
    ------
    InputError
        Where it is missing, no regular file, larger than ``most``, or outside ``within``.
    """
    with open_regular(file, most, within) as opened, reading_errors(file):
        size = os.fstat(opened.fileno()).st_size
        data = opened.read(size)  # memory is taken for as much as is asked for
        data += opened.read(most + 1 - len(data)) if opened.peek(1) else b""
    if len(data) > most:  # it grew, or said nothing of its size
        raise _too_large(file, len(data), most)
    return data


def open_regular(file: Path, most: int, within: Path | None = None) -> BufferedReader:
    """A regular file, open for reading.

    Parameters
    ----------
    file, most, within
        As of ``read_bytes``.

    Raises
    ------
    InputError
        As ``read_bytes``.
    """
    if within is not None:
        require_within(file, within)
    with reading_errors(file):
        # Looked at before it is opened, since opening alone wakes some devices, and again after,
        # since it may have been replaced.
        _require_regular(file.stat(), file, most)
        descriptor = os.open(file, _flags("RDONLY", "NONBLOCK", "NOCTTY", "CLOEXEC"))
        opened = os.fdopen(descriptor, "rb")
    try:
        _require_regular(os.fstat(descriptor), file, most)
    except InputError:
        opened.close()
        raise
    return opened


@contextmanager
def reading_errors(where: Path) -> Iterator[None]:
    """Turn an OSError of the block into an InputError: the file, the reason, what to do.

    Parameters
    ----------
    where : Path, the file, for the error

    Raises
    ------
    InputError
        In place of the OSError.
    """
    try:
        yield
    except OSError as error:
        raise _unreadable(where, error) from error


def read_text(file: Path, most: int = MOST_TEXT_BYTES, within: Path | None = None) -> str:
    """The text of a regular file in UTF-8, without the byte-order mark that some programs write.

    Parameters
    ----------
    file : Path, links are followed
    most : int, its largest size, bytes
    within : Path or None, a folder whose content is a stranger's, and the file in it: no link out
        of it is followed

    Raises
    ------
    InputError
        The file is not UTF-8 text, or as ``read_bytes``.
    """
    data = read_bytes(file, most, within)
    try:
        return data.removeprefix(codecs.BOM_UTF8).decode("utf-8")
    except UnicodeDecodeError as error:
        wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        value = "UTF-16; save it as UTF-8" if wide else None
        raise InputError("is not UTF-8 text", where=file, value=value) from error


def content_sha256(path: Path) -> str:
    """SHA-256 of what a file holds, or a folder's own files and their names; "" of nothing there.

    Parameters
    ----------
    path : Path, links are followed

    Raises
    ------
    InputError
        It cannot be read.
    """
    try:
        if path.is_dir():
            files = sorted(file for file in path.iterdir() if file.is_file())
            text = "".join(f"{file.name}\0{content_sha256(file)}\n" for file in files)
            return hashlib.sha256(text.encode()).hexdigest()
        if not path.is_file():  # nor waited for, where it is a FIFO
            return ""
        with path.open("rb") as opened:
            return hashlib.file_digest(opened, "sha256").hexdigest()
    except OSError as error:
        raise _unreadable(path, error) from error


def require_within(path: Path, folder: Path) -> None:
    """Refuse a path that leads out of a folder.

    Parameters
    ----------
    path : Path, followed through links
    folder : Path, followed through links

    Raises
    ------
    InputError
        The path lies outside the folder.
    """
    followed = os.path.realpath(path)
    if not Path(followed).is_relative_to(os.path.realpath(folder)):
        what = f"is a link that leads out of {folder}"
        allowed = "what lies in the folder itself; copy it there"
        raise InputError(what, where=path, value=followed, allowed=allowed)


def list_names(folder: Path) -> set[str]:
    """Names of all that is in a folder.

    Parameters
    ----------
    folder : Path, the folder

    Raises
    ------
    InputError
        The folder cannot be read.
    """
    with reading_errors(folder):
        return {entry.name for entry in folder.iterdir()}


def make_folder(folder: Path) -> None:
    """Make a folder and those above it where they are missing.

    Parameters
    ----------
    folder : Path, the folder

    Raises
    ------
    InputError
        The folder cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made a folder: {error.strerror}", where=folder) from error


def temporary_name(name: str) -> str:
    """What a file is called while it is being written: another name for each writer of it.

    Parameters
    ----------
    name : str, of the file, without its folder

    Examples
    --------
    >>> temporary_name("run.json") == temporary_name("run.json")
    False
    """
    return f".{name}.{secrets.token_hex(4)}.tmp"


def remove_temporaries(folder: Path) -> None:
    """Remove what killed writers left in a folder.

    Parameters
    ----------
    folder : Path, locked, so that nobody else is writing in it

    Raises
    ------
    InputError
        The disk refuses.
    """
    with disk_errors(folder):
        for left in folder.glob(_TEMPORARIES):
            if left.is_dir() and not left.is_symlink():
                shutil.rmtree(left)
            else:
                left.unlink()


def write_atomically(file: Path, data: bytes) -> None:
    """Write a file, synced: at any moment the old file or the whole new one is there.

    Of several writers at once, the last to finish wins.  No temporary file stays, unless the
    process is killed.

    Parameters
    ----------
    file : Path, replaced where it is there
    data : bytes, all that the file is to hold

    Raises
    ------
    InputError
        The disk refuses; ``DiskError`` where it is full or failed.
    """
    with new_file(file) as descriptor:
        _write_all(descriptor, data)


@contextmanager
def new_file(file: Path) -> Iterator[int]:
    """Descriptor of a file to write, as ``write_atomically`` does: in its place after the block.

    Parameters
    ----------
    file : Path, replaced where it is there, once the block has ended without an error

    Raises
    ------
    InputError
        The disk refuses; ``DiskError`` where it is full or failed.
    """
    temporary = file.parent / temporary_name(file.name)
    with disk_errors(file):
        try:
            new = _flags("WRONLY", "CREAT", "EXCL", "NOFOLLOW")
            descriptor = os.open(temporary, new, 0o666)
            try:
                yield descriptor
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
            _replace(temporary, file)
        except BaseException:
            with suppress(OSError):
                temporary.unlink()
            raise
        sync_folder(file.parent)


def append_synced(descriptor: int, data: bytes, file: Path) -> None:
    """Append to an open file, synced; where the disk refuses, the file is as long as before.

    Parameters
    ----------
    descriptor : int, of the file, open for appending
    data : bytes, what is appended
    file : Path, its name, for the error

    Raises
    ------
    InputError
        The disk refuses; ``DiskError`` where it is full or failed.
    """
    with disk_errors(file):
        length = os.fstat(descriptor).st_size
        try:
            _write_all(descriptor, data)
            os.fsync(descriptor)
        except OSError:
            with suppress(OSError):
                os.ftruncate(descriptor, length)
            raise


def open_to_append(file: Path) -> int:
    """Descriptor of a file that is there, opened to be appended to.

    Parameters
    ----------
    file : Path, the file itself, no link

    Raises
    ------
    InputError
        The file is a link, or cannot be opened.
    """
    with disk_errors(file):
        if file.is_symlink():  # for systems without O_NOFOLLOW
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
        return os.open(file, _flags("WRONLY", "APPEND", "NOFOLLOW"))


def cut_torn_line(file: Path, most: int) -> None:
    """Cut off what stands after the last line end of a file, if it has a line end.

    Parameters
    ----------
    file : Path, the file itself, no link
    most : int, its largest size, bytes

    Raises
    ------
    InputError
        The file is a link, or as ``read_bytes``.
    """
    data = read_bytes(file, most, within=file.parent)
    whole = data.rfind(b"\n") + 1
    if 0 < whole < len(data):
        descriptor = open_to_append(file)
        try:
            with disk_errors(file):
                os.ftruncate(descriptor, whole)
                os.fsync(descriptor)
        finally:
            os.close(descriptor)


def sync_folder(folder: Path) -> None:
    """Make new and renamed entries of a folder safe from a power failure, as far as the system can.

    Windows opens no folder, and so syncs none.

    Parameters
    ----------
    folder : Path, the folder

    Raises
    ------
    OSError
        The disk refuses; ``disk_errors`` translates it.
    """
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, _flags("RDONLY", "DIRECTORY"))
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def lock_folder(folder: Path, writer: str = "scan") -> int:
    """Descriptor of a folder, locked; closing it, or the process's end, frees the lock.

    On Windows, which opens no folder, it is of the file LOCK in it, which stays.

    Parameters
    ----------
    folder : Path, the folder
    writer : str, what writes it, for the error

    Raises
    ------
    InputError
        Another process holds the lock, the folder cannot be opened, or its file system has no
        locks, as some of networks have none.
    """
    with disk_errors(folder):
        if hasattr(os, "O_DIRECTORY"):
            descriptor = os.open(folder, _flags("RDONLY", "DIRECTORY"))
        else:
            descriptor = os.open(folder / LOCK, _flags("RDWR", "CREAT"))
    try:
        _lock(descriptor)
    except OSError as error:
        os.close(descriptor)
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            raise InputError(f"is being written by another {writer}", where=folder) from error
        what = f"cannot be locked against another {writer}: {error.strerror}"
        allowed = "a folder on a file system with flock, as local disks are"
        raise InputError(what, where=folder, allowed=allowed) from error
    return descriptor


@contextmanager
def disk_errors(where: Path) -> Iterator[None]:
    """Turn an OSError of the block into an InputError: the file, the reason, what to do.

    Parameters
    ----------
    where : Path, the file, for the error

    Raises
    ------
    InputError
        In place of the OSError; ``DiskError``, whose exit code differs, where the disk is full or
        failed.
    """
    try:
        yield
    except OSError as error:
        remedy = REMEDIES.get(error.errno or 0, "choose another place")
        kind = DiskError if error.errno in _FULL_OR_FAILED else InputError
        raise kind(f"cannot be written: {error.strerror}; {remedy}", where=where) from error


def _flags(*names: str) -> int:
    """Those flags of ``os.open`` that this system has, and Windows' for line ends left alone."""
    return sum(getattr(os, f"O_{name}", 0) for name in (*names, "BINARY"))


def _lock(descriptor: int) -> None:
    """Lock an open file or folder at once; OSError where another process holds the lock."""
    try:
        fcntl = importlib.import_module("fcntl")
    except ModuleNotFoundError:  # Windows
        msvcrt = importlib.import_module("msvcrt")
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    else:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _replace(temporary: Path, file: Path) -> None:
    """Put a file in another's place.

    Windows refuses as long as somebody reads the other, and so is asked again for a second.
    """
    for left in reversed(range(_TRIES if sys.platform == "win32" else 1)):
        try:
            temporary.replace(file)
            return
        except PermissionError:
            if not left:
                raise
            time.sleep(_TRIED_EVERY_S)


def _require_regular(status: os.stat_result, file: Path, most: int) -> None:
    if not stat.S_ISREG(status.st_mode):
        what = next((name for test, name in _KINDS.items() if test(status.st_mode)), "no file")
        raise InputError(f"cannot be read: it is {what}", where=file, allowed="a regular file")
    if status.st_size > most:
        raise _too_large(file, status.st_size, most)


_KINDS = {
    stat.S_ISDIR: "a folder",
    stat.S_ISFIFO: "a FIFO",
    stat.S_ISCHR: "a device",
    stat.S_ISBLK: "a device",
    stat.S_ISSOCK: "a socket",
}


def _too_large(file: Path, size: int, most: int) -> InputError:
    allowed = f"{most} at most"
    return InputError("is too large: bytes", where=file, value=size, allowed=allowed)


def _unreadable(path: Path, error: OSError) -> InputError:
    gone = error.errno in (errno.ENOENT, errno.ENOTDIR, errno.ENAMETOOLONG)
    remedy = "check its name, and that its disk is there" if gone else "check its permissions"
    if error.errno in (errno.EMFILE, errno.ENFILE):
        remedy = CLOSE_FILES
    if error.errno in (errno.EIO, errno.ENODEV, errno.ESTALE):
        remedy = _CHECK_DISK
    return InputError(f"cannot be read: {error.strerror}; {remedy}", where=path)


def _write_all(descriptor: int, data: bytes) -> None:
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(descriptor, rest) :]


# Tables that lie beside the modules of this package, as TOML.


def packaged_table(package: str, name: str) -> Any:
    """The table of a TOML file of a package.

    Parameters
    ----------
    package : str, dotted name of the package
    name : str, of the file, such as "topics.toml"
    """
    return tomllib.loads(files(package).joinpath(name).read_text(encoding="utf-8"))


# JSON: results on the screen and in files, and files read without trust in them.


MOST_LEVELS = 50
"""Of tables and lists in one another; a rig file has six or so."""
TOO_DEEP = "tables and lists too deep in one another"


def read_json(path: Path, most: int = MOST_TEXT_BYTES, within: Path | None = None) -> Any:
    """What a JSON file holds.

    Parameters
    ----------
    path : Path, the file
    most : int, its largest size, bytes
    within : Path or None, a folder whose content is a stranger's, and the file in it: no link out
        of it is followed

    Raises
    ------
    InputError
        The file cannot be read, or as ``parse_json``.
    """
    return parse_json(read_text(path, most, within), path)


def parse_json(text: str | bytes, where: object) -> Any:
    """What a JSON text holds.

    Parameters
    ----------
    text : str or bytes
    where : the file, for the error

    Raises
    ------
    InputError
        It is no JSON, or holds what is no finite number, a null character, or tables too deep in
        one another.
    """
    try:
        content = json.loads(text, parse_constant=_refuse_constant)
    except ValueError as error:  # also of a number of thousands of digits
        raise InputError(f"is not valid JSON: {error}", where=where) from error
    except RecursionError as error:
        what, allowed = f"is not valid JSON: {TOO_DEEP}", f"{MOST_LEVELS} levels"
        raise InputError(what, where=where, allowed=allowed) from error
    check_values(content, where)
    return content


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a number")


def check_values(value: Any, where: object, keys: tuple[str | int, ...] = ()) -> None:
    """Refuse what no later step could take: a null character, and nesting without end.

    Parameters
    ----------
    value : of the types of JSON or TOML
    where : the file, for the error
    keys : tuple, that lead to the value in the file

    Raises
    ------
    InputError
        Names the keys.
    """
    if isinstance(value, dict | list):
        if len(keys) == MOST_LEVELS:
            what = f"{dotted(keys[:3])}...: {TOO_DEEP}"
            raise InputError(what, where=where, allowed=f"{MOST_LEVELS} levels")
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            check_values(key, where, keys)
            check_values(item, where, (*keys, key))
    elif isinstance(value, str) and "\0" in value:
        what = f"{dotted(keys) or 'a key'}: holds a null character"
        raise InputError(what, where=where, value=value, allowed="a text without")


def dotted(keys: tuple[str | int, ...]) -> str:
    """The keys that lead to a value, as one text.

    Parameters
    ----------
    keys : tuple, names and numbers
    """
    return ".".join(map(str, keys))


def json_text(value: object, *, compact: bool = False) -> str:
    """A value as JSON text, without a line end; numbers that are not finite as null.

    Parameters
    ----------
    value : of JSON types, records, paths and NumPy's numbers and arrays
    compact : bool, on one line, without spaces: many times faster

    Examples
    --------
    >>> print(json_text({"rms_mm": float("nan"), "file": Path("a.json")}))
    {
      "rms_mm": null,
      "file": "a.json"
    }
    """
    plain = to_jsonable_python(value, inf_nan_mode="null", fallback=lambda other: other.tolist())
    return json.dumps(plain, separators=(",", ":")) if compact else json.dumps(plain, indent=2)


def write_json(file: Path, value: object) -> None:
    """Write a value as JSON, whole or not at all, as ``json_text`` puts it.

    Parameters
    ----------
    file : Path, replaced where it is there
    value : as of ``json_text``

    Raises
    ------
    InputError
        The disk refuses.
    """
    write_atomically(file, f"{json_text(value)}\n".encode())
