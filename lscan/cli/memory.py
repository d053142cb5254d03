"""Memory that a process keeps for its next picture."""

import ctypes

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # names of mallopt(3), as malloc.h numbers them
_KEPT_BYTES = 2**28  # the arrays of several pictures of 8 million pixels
_LARGEST_BYTES = 2**25  # glibc's limit for blocks out of memory that is kept


def keep_freed_memory() -> None:
    """Have the C library keep the memory that large arrays free.

    By default it hands that back, and the system clears every page anew for the next array: half
    of the time in which a line is found, as arrays of a picture's size come and go.  Nothing is
    changed where the C library is not glibc.

    References
    ----------
    mallopt(3) of the Linux manual.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # not glibc, or Windows
        return
    mallopt(_MMAP_THRESHOLD, _LARGEST_BYTES)
    mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
