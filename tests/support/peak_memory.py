"""The most memory that a program takes, measured in a process of its own."""

import subprocess
import sys
import textwrap

LONGEST_S = 120  # only a program that hangs takes as long

_MEASURE = """
import resource
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    run()
except LscanError as error:
    print(error)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


def refused_within(imports: str, call: str) -> tuple[str, int]:
    """The one line with which ``call`` is refused, and the MiB that it took at its most.

    imports: statements whose memory does not count.  Anything but an LscanError, a crash or a
    call that ends without one fails.
    """
    program = f"{imports}\nfrom lscan.errors import LscanError\ndef run():\n"
    program += textwrap.indent(call, "    ") + _MEASURE
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=LONGEST_S
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 2, f"not refused, or not in one line: {lines}"
    return lines[0], int(lines[1])
