"""Drivers, extractors and plane maps by name: installed ones, or a function of the user's."""

from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from lscan.errors import InputError, missing_package

_KINDS = {
    "lscan.cameras": "camera driver",
    "lscan.tracks": "track driver",
    "lscan.extractors": "stripe extractor",
    "lscan.planemaps": "family of plane maps",
    "lscan.boardreaders": "reader of control points",
}


@cache
def installed(group: str) -> dict[str, EntryPoint]:
    """The entry points of a group by name; looked for once, since every package is read for it.

    Parameters
    ----------
    group : str, "lscan.cameras", "lscan.tracks", "lscan.extractors" or "lscan.planemaps"
    """
    return {entry.name: entry for entry in sorted(entry_points(group=group))}


def find_plugin(group: str, name: str, where: object = None) -> Any:
    """The object registered under a name in an entry-point group of this project.

    Parameters
    ----------
    group : str, "lscan.cameras", "lscan.tracks", "lscan.extractors" or "lscan.planemaps"
    name : str, of the entry point
    where : the file or key, for the error

    Raises
    ------
    InputError
        There is no such name (lists those there are), or a package that it needs is missing.
    """
    found = installed(group)
    if name not in found:
        kind = _KINDS.get(group, group)
        raise InputError(f"no such {kind}", where=where, value=name, allowed=", ".join(found))
    try:
        return found[name].load()
    except ModuleNotFoundError as error:
        raise InputError(missing_package(error), where=where, value=name) from error


def names_code(name: str) -> bool:
    """Whether a name is of a function to be imported, not of an installed plug-in.

    Parameters
    ----------
    name : str, of a plug-in, or ``package.module:function``

    Examples
    --------
    >>> names_code("centroid-relative"), names_code("package.module:function")
    (False, True)
    """
    return ":" in name


def find_plugin_or_function(group: str, name: str, where: object = None) -> Any:
    """The object registered under a name, or the function that the name is of.

    Parameters
    ----------
    group : str, as of ``find_plugin``
    name : str, of the entry point, or ``package.module:function``
    where : the file or key, for the error

    Raises
    ------
    InputError
        There is none, or it cannot be imported.
    """
    if not names_code(name):
        return find_plugin(group, name, where)
    module, _, function = name.partition(":")
    what = f"no such {_KINDS.get(group, group)}"
    try:
        found = getattr(import_module(module), function)
    except Exception as error:  # a module of the user's may raise anything
        allowed = " ".join(
            f"a name that can be imported, its folder in PYTHONPATH: {error}".split()
        )
        raise InputError(what, where=where, value=name, allowed=allowed) from error
    if not callable(found):
        raise InputError(what, where=where, value=name, allowed="a function")
    return found
