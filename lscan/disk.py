"""Files written so that a crash or a full disk at any moment leaves no half file behind."""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lscan.errors import DiskError, InputError

_MAKE_WRITABLE = "make it writable, or choose another folder"
_BRING_BACK = "make its folder, or bring it back where it was moved or its disk taken away"
_CHECK_DISK = "check the disk and its cable"
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
}
"""What to do where the system refuses a write, by its error number."""
_FULL_OR_FAILED = frozenset(
    {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.ENODEV, errno.ESTALE}
)


def read_bytes(file: Path) -> bytes:
    """The content of ``file``; InputError where it cannot be read."""
    try:
        return file.read_bytes()
    except OSError as error:
        raise _unreadable(file, error) from error


def list_names(folder: Path) -> set[str]:
    """Names of all that is in ``folder``; InputError where it cannot be read."""
    try:
        return {entry.name for entry in folder.iterdir()}
    except OSError as error:
        raise _unreadable(folder, error) from error


def make_folder(folder: Path) -> None:
    """Make ``folder`` and those above it where they are missing; InputError where it cannot."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot be made a folder: {error.strerror}", where=folder) from error


def temporary_name(name: str) -> str:
    """What a file called ``name`` is called while it is being written."""
    return f".{name}.tmp"


def write_atomically(file: Path, data: bytes) -> None:
    """Write ``data`` to ``file``, synced: at any moment the old file or the whole new one is
    there.

    Raises InputError where the disk refuses; no temporary file stays.
    """
    temporary = file.with_name(temporary_name(file.name))
    with disk_errors(file):
        try:
            descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
            try:
                _write_all(descriptor, data)
                os.fsync(descriptor)
            finally:
                os.close(descriptor)
            temporary.replace(file)
        except BaseException:
            with suppress(OSError):
                temporary.unlink()
            raise
        sync_folder(file.parent)


def append_synced(descriptor: int, data: bytes, file: Path) -> None:
    """Append ``data`` to the open file, synced; where the disk refuses, take it back.

    file: its name, for the InputError raised where the disk refuses.
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


def cut_torn_line(file: Path) -> None:
    """Cut off what stands after the last line end of ``file``, if it has a line end."""
    data = read_bytes(file)
    whole = data.rfind(b"\n") + 1
    if 0 < whole < len(data):
        with disk_errors(file), file.open("r+b") as opened:
            opened.truncate(whole)
            os.fsync(opened.fileno())


def sync_folder(folder: Path) -> None:
    """Make new and renamed entries of ``folder`` safe from a power failure."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def lock_folder(folder: Path) -> int:
    """Descriptor of ``folder``, locked; closing it, or the process's end, frees the lock.

    Raises InputError where another process holds the lock.
    """
    with disk_errors(folder):
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(descriptor)
        raise InputError("is being written by another scan", where=folder) from error
    return descriptor


@contextmanager
def disk_errors(where: Path) -> Iterator[None]:
    """Turn an OSError of the block into an InputError: the file, the reason, what to do.

    Where the disk is full or failed it is the DiskError among them, whose exit code differs.
    """
    try:
        yield
    except OSError as error:
        remedy = REMEDIES.get(error.errno or 0, "choose another place")
        kind = DiskError if error.errno in _FULL_OR_FAILED else InputError
        raise kind(f"cannot be written: {error.strerror}; {remedy}", where=where) from error


def _unreadable(path: Path, error: OSError) -> InputError:
    gone = error.errno in (errno.ENOENT, errno.ENOTDIR)
    remedy = "check its name, and that its disk is there" if gone else "check its permissions"
    if error.errno in (errno.EIO, errno.ENODEV, errno.ESTALE):
        remedy = _CHECK_DISK
    return InputError(f"cannot be read: {error.strerror}; {remedy}", where=path)


def _write_all(descriptor: int, data: bytes) -> None:
    rest = memoryview(data)
    while rest:
        rest = rest[os.write(descriptor, rest) :]
