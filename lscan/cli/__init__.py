"""The command line: one module a topic; each command is a thin face over a public function."""

import sys
from importlib.util import find_spec

if find_spec("fcntl") is None:
    # Here, before any command's module is loaded: most of them write files, which are locked so.
    print(
        "lscan: needs Linux or another system with POSIX file locks (Python's module fcntl), "
        "which is not this one; on Windows, install it in WSL",
        file=sys.stderr,
    )
    sys.exit(2)
