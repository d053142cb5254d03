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
}


@cache
def installed(group: str) -> dict[str, EntryPoint]:
    """The entry points of a group by name; looked for once, since every package is read for it."""
    return {entry.name: entry for entry in sorted(entry_points(group=group))}


def find_plugin(group: str, name: str, where: object = None) -> Any:
    """The object registered under ``name`` in an entry-point group of this project.

    group: "lscan.cameras", "lscan.tracks", "lscan.extractors" or "lscan.planemaps".
    Raises InputError that lists the names there are, or names the package that it lacks.
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
    """Whether a name is of a function to be imported, not of an installed plug-in."""
    return ":" in name


def find_plugin_or_function(group: str, name: str, where: object = None) -> Any:
    """The object registered under ``name``, or the function ``package.module:function``.

    Raises InputError where there is none.
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
