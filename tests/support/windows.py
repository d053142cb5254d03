"""lscan as Windows would have it, as far as that can be shown on another system.

    python tests/support/windows.py 'devices' 'extract picture.png'

runs commands of lscan; without any it imports every module of it.  Exit code 1 where one fails.
Modules of lscan, and they alone, are given an ``os`` and a ``signal`` without what Windows lacks,
none of POSIX's modules, and an ``msvcrt`` whose locks are those of this system.  What else differs
on Windows, such as its paths, consoles and drivers, shows there alone.
"""

import builtins
import errno
import fcntl
import importlib
import importlib.metadata
import importlib.resources
import importlib.util
import os
import pkgutil
import shlex
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

MISSING = "fcntl", "grp", "posix", "pty", "pwd", "readline", "resource", "syslog", "termios", "tty"
LACKING = {
    "os": "O_CLOEXEC O_DIRECTORY O_NOCTTY O_NOFOLLOW O_NONBLOCK O_SYNC fork getegid geteuid getgid "
    "getloadavg getuid killpg mkfifo nice openpty pread pwrite sched_getaffinity setsid statvfs "
    "sysconf ttyname uname",
    "signal": "SIGALRM SIGCHLD SIGHUP SIGKILL SIGPIPE SIGPWR SIGQUIT SIGTSTP SIGTTIN SIGTTOU "
    "SIGUSR1 SIGUSR2 SIGXCPU SIG_BLOCK SIG_SETMASK alarm pause pthread_sigmask setitimer",
}
"""Names that "Availability: Unix" is said of in Python's documentation."""
O_BINARY = 0x8000


class Seen(ModuleType):
    """A module as Windows has it: without some names, and with others."""

    def __init__(self, name: str, **others: Any) -> None:
        super().__init__(name)
        self.__dict__.update(others)

    def __getattr__(self, name: str) -> Any:
        if name in LACKING.get(self.__name__, "").split():
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        return getattr(sys.modules[self.__name__], name)


def open_file(path: Any, flags: int, mode: int = 0o777) -> int:
    """As ``os.open`` of Windows: no folder is opened, and what is not binary is translated."""
    if Path(path).is_dir():
        raise PermissionError(errno.EACCES, "Permission denied", str(path))
    assert flags & O_BINARY or path == os.devnull, f"{path} is opened as text"
    return os.open(path, flags & ~O_BINARY, mode)


def lock(descriptor: int, mode: int, _: int) -> None:
    """As ``msvcrt.locking``, which names another error where there is a lock."""
    try:
        fcntl.flock(descriptor, mode)
    except BlockingIOError as error:
        raise PermissionError(errno.EACCES, "Permission denied") from error


def import_module(name: str, package: str | None = None) -> ModuleType:
    """As that of ``importlib``."""
    if name in MISSING:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)
    return SEEN.get(name) or importlib.import_module(name, package)


MSVCRT = Seen("msvcrt", locking=lock, LK_NBLCK=fcntl.LOCK_EX | fcntl.LOCK_NB)
SEEN = {
    "os": Seen("os", open=open_file, O_BINARY=O_BINARY),
    "signal": Seen("signal", SIGBREAK=signal.SIGTTIN),  # number 21 on both
    "sys": Seen("sys", platform="win32"),
    "importlib": Seen("importlib", import_module=import_module),
    "msvcrt": MSVCRT,
}


def become_windows() -> None:
    """Let modules of lscan, none of which has been imported, import what Windows has."""
    real = builtins.__import__

    def import_for(name: str, names: Any = None, *rest: Any, **named: Any) -> ModuleType:
        asks = str((names or {}).get("__name__"))
        if asks.partition(".")[0] == "lscan" and name in (*MISSING, *SEEN):
            return import_module(name)
        return real(name, names, *rest, **named)

    builtins.__import__ = import_for
    for name in ("HOME", "XDG_CACHE_HOME"):
        os.environ.pop(name, None)


def main(commands: Sequence[str]) -> int:
    """The exit code of the program."""
    become_windows()
    import lscan

    for module in pkgutil.walk_packages(lscan.__path__, "lscan.") if not commands else ():
        importlib.import_module(module.name)
    from lscan.cli.app import app
    from lscan.cli.console import run_command_line

    for command in commands:
        sys.argv = ["lscan", *shlex.split(command)]
        try:
            run_command_line(app, "lscan")
        except SystemExit as left:
            if left.code:
                return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
