"""Packages of Debian and its kin, installed where this process has the right to."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import TypeVar

from lscan.errors import LscanError

Found = TypeVar("Found")


class PackageError(LscanError):
    """A package could not be installed; the line says what stood in the way."""


def install_first(packages: Sequence[str]) -> None:
    """Install the first of ``packages`` that apt-get offers; its output goes to stderr.

    Parameters
    ----------
    packages : sequence, names of packages, the preferred one first

    Raises
    ------
    PackageError
        apt-get, the right to use it, or such a package is missing.
    """
    admin = _as_root()
    package = _offered(packages)
    if package is None:
        _apt_get(admin, "update")
        package = _offered(packages)
    if package is None:
        raise PackageError(f"apt-get offers none of {', '.join(packages)}")
    if not _apt_get(admin, "install", "-y", "--no-install-recommends", package):
        _apt_get(admin, "update")  # the package list may be older than the archive
        if not _apt_get(admin, "install", "-y", "--no-install-recommends", package):
            raise PackageError(f"apt-get could not install {package}")


def found_or_installed(find: Callable[[], Found], packages: Sequence[str], variable: str) -> Found:
    """What ``find`` finds, the first package on offer installed where it finds nothing.

    Parameters
    ----------
    find : function, raises an LscanError where there is nothing
    packages : sequence, as of ``install_first``
    variable : str, of the environment; where it names a file, nothing is installed

    Raises
    ------
    LscanError
        That of ``find``; where installing failed too, its line says both.
    """
    try:
        return find()
    except LscanError as missing:
        if os.environ.get(variable):
            raise
        try:
            install_first(packages)
        except PackageError as refused:
            raise type(missing)(f"{missing}; {refused}") from refused
    return find()


def _as_root() -> list[str]:
    if not shutil.which("apt-get"):
        raise PackageError("there is no apt-get here to install it with")
    if os.geteuid() == 0:
        return []
    if shutil.which("sudo") and _succeeds("sudo", "-n", "true"):
        return ["sudo", "-n"]
    raise PackageError("installing it takes root or a sudo that asks for no password")


def _offered(packages: Sequence[str]) -> str | None:
    return next((name for name in packages if _succeeds("apt-cache", "show", name)), None)


def _succeeds(*command: str) -> bool:
    quiet = subprocess.DEVNULL
    return subprocess.run(command, stdin=quiet, stdout=quiet, stderr=quiet).returncode == 0


def _apt_get(admin: list[str], *arguments: str) -> bool:
    quietly = ["env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-qq"]
    patiently = ["-o", "DPkg::Lock::Timeout=120"]
    command = [*admin, *quietly, *patiently, *arguments]
    return subprocess.run(command, stdin=subprocess.DEVNULL, stdout=sys.stderr).returncode == 0
