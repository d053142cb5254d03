"""Suites by name: of installed packages, in the user's cache, or a path."""

from importlib.resources import files
from pathlib import Path

from lscan.config.plugins import installed
from lscan.errors import InputError, missing_package
from lscan.files.disk import cache_folder

GROUP = "lscan.suites"


def suite_cache() -> Path:
    """The folder of suites that the user rendered."""
    return cache_folder() / "suites"


def suites_found() -> dict[str, Path]:
    """The suites by name; one of a package goes before one of the cache.

    An entry point of the group ``lscan.suites`` names a package; the suite is its file
    ``NAME.zip``, or its folder NAME.
    """
    cache = suite_cache()
    entries = sorted(cache.iterdir()) if cache.is_dir() else []
    found = {entry.stem: entry for entry in entries if not entry.name.startswith(".")}
    for name, entry in installed(GROUP).items():
        try:
            folder = Path(str(files(entry.value)))
        except ModuleNotFoundError as error:
            raise InputError(missing_package(error), where=GROUP, value=name) from error
        archive = folder / f"{name}.zip"
        found[name] = archive if archive.is_file() else folder / name
    return found


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
    found = suites_found()
    if name in found:
        return found[name]
    if Path(name).exists():
        return Path(name)
    allowed = ", ".join(found) or f"a path; lscan-sim suite make {name} renders one of that name"
    raise InputError("no such suite", where="--suite", value=name, allowed=allowed)
