"""Suites by name: of installed packages, in the user's cache, or a path."""

import logging
from importlib.resources import files
from pathlib import Path

from lscan.config.plugins import broken_plugin, find_entry, installed
from lscan.errors import InputError
from lscan.files.disk import cache_folder

GROUP = "lscan.suites"

_log = logging.getLogger(__name__)


def suite_cache() -> Path | None:
    """The folder of suites that the user rendered; None where there is no cache."""
    cache = cache_folder()
    return None if cache is None else cache / "suites"


def suites_found() -> dict[str, Path]:
    """The suites by name; one of a package goes before one of the cache.

    An entry point of the group ``lscan.suites`` names a package; the suite is its file
    ``NAME.zip``, or its folder NAME.  One that cannot be loaded is left out, and the log says why.
    """
    found = _in_cache()
    for name in installed(GROUP):
        found.pop(name, None)
        try:
            found[name] = _of_package(name)
        except InputError as error:
            _log.warning("a suite is left out: %s", error)
    return found


def _in_cache() -> dict[str, Path]:
    cache = suite_cache()
    entries = sorted(cache.iterdir()) if cache is not None and cache.is_dir() else []
    return {entry.stem: entry for entry in entries if not entry.name.startswith(".")}


def _of_package(name: str) -> Path:
    """Where the suite of that name lies that a package brings."""
    entry = find_entry(GROUP, name, where=GROUP)
    try:
        folder = Path(str(files(entry.value)))
    except (Exception, SystemExit) as error:  # a package may raise anything
        raise broken_plugin(entry, error, where=GROUP) from error
    archive = folder / f"{name}.zip"
    return archive if archive.is_file() else folder / name


def find_suite(name: str) -> Path:
    """Where a suite lies.

    Parameters
    ----------
    name : str, of a suite that is found, or a path

    Raises
    ------
    InputError
        There is none.
    """
    if name in installed(GROUP):
        return _of_package(name)
    if found := _in_cache().get(name):
        return found
    if Path(name).exists():
        return Path(name)
    allowed = (
        ", ".join(suites_found()) or f"a path; lscan-sim suite make {name} renders one of that name"
    )
    raise InputError("no such suite", where="--suite", value=name, allowed=allowed)
