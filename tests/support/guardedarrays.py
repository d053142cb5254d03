"""Memory for NumPy's arrays that nobody can read past: behind each of them lies a forbidden page.

Compiled kernels read whole vectors of numbers.  Behind an array of NumPy's there may be nothing
of the process, so that it dies; mostly there is something, and nobody notices.  With this
allocator it dies always.
"""

import ctypes
import mmap
from collections.abc import Callable

import numpy as np

LEAST_BYTES = 4096  # smaller arrays come from the C library: two mappings each would be too many
_SET_HANDLER = 304  # PyDataMem_SetHandler in the table of NumPy's C API, since 1.22
_PAGE, _ALIGNED = mmap.PAGESIZE, 8
_NONE, _READ_WRITE, _PRIVATE = 0, mmap.PROT_READ | mmap.PROT_WRITE, 0x22  # also anonymous

_libc = ctypes.CDLL(None, use_errno=True)
for _name in ("mmap", "malloc", "calloc"):
    getattr(_libc, _name).restype = ctypes.c_void_p
_VOID, _SIZE = ctypes.c_void_p, ctypes.c_size_t
_libc.mmap.argtypes = [_VOID, _SIZE, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_long]
_libc.munmap.argtypes = [_VOID, _SIZE]
_libc.mprotect.argtypes = [_VOID, _SIZE, ctypes.c_int]
_libc.malloc.argtypes, _libc.free.argtypes = [_SIZE], [_VOID]


class _Handler(ctypes.Structure):
    """PyDataMem_Handler of NumPy's C API, with its PyDataMemAllocator."""

    _fields_ = [
        ("name", ctypes.c_char * 127),
        ("version", ctypes.c_uint8),
        ("context", _VOID),
        ("malloc", _VOID),
        ("calloc", _VOID),
        ("realloc", _VOID),
        ("free", _VOID),
    ]


_mapped: dict[
    int, tuple[int, int, int]
] = {}  # by address: where its pages begin, their bytes; its own
_kept: list[object] = []  # what NumPy holds by address alone


def _allocate(_: int | None, size: int) -> int:
    if size < LEAST_BYTES:
        return int(_libc.malloc(max(size, 1)) or 0)
    length = -(-size // _PAGE) * _PAGE
    start = _libc.mmap(None, length + _PAGE, _READ_WRITE, _PRIVATE, -1, 0)
    if start in (None, 2**64 - 1) or _libc.mprotect(start + length, _PAGE, _NONE):
        return 0
    address = int(start + length - -(-size // _ALIGNED) * _ALIGNED)
    _mapped[address] = start, length + _PAGE, size
    return address


def _zeroed(context: int | None, count: int, size: int) -> int:
    address = _allocate(context, count * size)
    if address and address not in _mapped:  # fresh pages are zero
        ctypes.memset(address, 0, count * size)
    return address


def _free(_: int | None, address: int | None, size: int) -> None:
    if address in _mapped:
        start, length, _ = _mapped.pop(address)
        _libc.munmap(start, length)
    elif address:
        _libc.free(address)


def _resized(context: int | None, address: int | None, size: int) -> int:
    fresh = _allocate(context, size)
    if address and fresh:
        known = (
            _mapped[address][2] if address in _mapped else _libc.malloc_usable_size(_VOID(address))
        )
        ctypes.memmove(fresh, address, min(known, size))
        _free(context, address, 0)
    return fresh


def guard_arrays() -> None:
    """Put a forbidden page behind each array that NumPy makes from now on, in this thread."""
    numbers = (_VOID, _SIZE)
    kinds: list[tuple[Callable[..., int | None], object]] = [
        (_allocate, ctypes.CFUNCTYPE(_VOID, *numbers)),
        (_zeroed, ctypes.CFUNCTYPE(_VOID, _VOID, _SIZE, _SIZE)),
        (_resized, ctypes.CFUNCTYPE(_VOID, _VOID, _VOID, _SIZE)),
        (_free, ctypes.CFUNCTYPE(None, _VOID, _VOID, _SIZE)),
    ]
    calls = [kind(function) for function, kind in kinds]
    handler = _Handler(b"guarded", 1, None, *(ctypes.cast(call, _VOID) for call in calls))
    python = ctypes.pythonapi
    python.PyCapsule_New.restype = ctypes.py_object
    python.PyCapsule_New.argtypes = [_VOID, ctypes.c_char_p, _VOID]
    python.PyCapsule_GetPointer.restype = _VOID
    python.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    capsule = python.PyCapsule_New(ctypes.addressof(handler), b"mem_handler", None)
    _kept.extend([calls, handler, capsule])
    table = python.PyCapsule_GetPointer(np._core._multiarray_umath._ARRAY_API, None)
    entry = ctypes.cast(table, ctypes.POINTER(_VOID))[_SET_HANDLER]
    ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.py_object)(entry)(capsule)
