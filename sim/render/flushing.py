"""Numbers below 1e-38 taken for 0, as Dr.Jit's own threads do, in the thread that calls too.

The calling thread keeps them, and with one thread Dr.Jit has no others: light that is read as the
ratio of two faint numbers would differ with the number of threads, by up to 0.3 %.
"""

import ctypes
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager

CAN_FLUSH = sys.platform == "linux" and platform.machine() == "x86_64"
# Where C's environment of floating point has the register MXCSR, and its bits that take numbers
# below 1e-38 for 0 as results and as operands (System V ABI, AMD64).
_WORDS, _MXCSR, _FLUSH = 8, 7, 0x8040


@contextmanager
def flushing(on: bool = True) -> Iterator[None]:
    """Take numbers below 1e-38 for 0 in this thread, where ``CAN_FLUSH``, until the block ends.

    Parameters
    ----------
    on : bool, False: do not, for code that counts on them
    """
    if not CAN_FLUSH:
        yield
        return
    before = (ctypes.c_uint32 * _WORDS)()
    library = ctypes.CDLL("libm.so.6")
    library.fegetenv(before)
    within = type(before).from_buffer_copy(before)
    within[_MXCSR] = before[_MXCSR] | _FLUSH if on else before[_MXCSR] & ~_FLUSH
    library.fesetenv(within)
    try:
        yield
    finally:
        library.fesetenv(before)
