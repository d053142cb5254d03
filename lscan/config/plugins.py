"""Drivers, extractors and plane maps by name: installed ones, or a function of the user's."""

import importlib
import traceback
from collections.abc import Sequence
from functools import cache
from importlib.metadata import EntryPoint, entry_points, packages_distributions, version
from pathlib import Path
from typing import Any

from lscan.errors import InputError, missing_package

_KINDS = {
    "lscan.cameras": "camera driver",
    "lscan.tracks": "track driver",
    "lscan.extractors": "stripe extractor",
    "lscan.planemaps": "family of plane maps",
    "lscan.boardreaders": "reader of control points",
    "lscan.suites": "suite",
    "pytest11": "plug-in of pytest",
}
_OURS = "lscan"
_HERE, _PYTHON = Path(__file__).parents[1], Path(importlib.__file__).parents[1]


@cache
def _entry_points(group: str) -> dict[str, list[EntryPoint]]:
    """All entry points of a group by name; looked for once, since every package is read for it."""
    found: dict[str, list[EntryPoint]] = {}
    for entry in sorted(entry_points(group=group)):
        found.setdefault(entry.name, []).append(entry)
    return found


def installed(group: str) -> tuple[str, ...]:
    """The names of a group's entry points, in alphabetical order.

    Parameters
    ----------
    group : str, a key of ``_KINDS``, such as "lscan.cameras"
    """
    return tuple(_entry_points(group))


def find_entry(group: str, name: str, where: object = None) -> EntryPoint:
    """The one entry point of a name.

    Parameters
    ----------
    group : str, as of ``installed``
    name : str, of the entry point
    where : the file or key, for the error

    Raises
    ------
    InputError
        There is no such name (lists those there are), or two: which is meant is not known.
    """
    kind, found = _KINDS.get(group, group), _entry_points(group).get(name, [])
    if not found:
        raise InputError(f"no such {kind}", where=where, value=name,
                         allowed=", ".join(installed(group)))  # fmt: skip
    if len(found) > 1:
        packages = " and ".join(sorted(map(_package, found)))
        raise InputError(f"{packages} register a {kind} of one name", where=where, value=name,
                         allowed="one of them; uninstall the other")  # fmt: skip
    return found[0]


def find_plugin(group: str, name: str, where: object = None) -> Any:
    """The object registered under a name in an entry-point group of this project.

    Parameters
    ----------
    group : str, as of ``installed``
    name : str, of the entry point
    where : the file or key, for the error

    Raises
    ------
    InputError
        As ``find_entry``, or it cannot be loaded: names the package that registers it.
    """
    entry = find_entry(group, name, where)
    try:
        return entry.load()
    except (Exception, SystemExit) as error:  # a stranger's module may raise anything
        raise broken_plugin(entry, error, where) from error


def broken_plugin(entry: EntryPoint, error: BaseException, where: object = None) -> InputError:
    """The error that says which package's plug-in cannot be loaded, and why.

    Parameters
    ----------
    entry : EntryPoint
    error : what loading it raised
    where : the file or key
    """
    if isinstance(error, ModuleNotFoundError) and _is_ours(entry):
        return InputError(missing_package(error), where=where, value=entry.name)
    what = f"cannot be loaded from the package {_package(entry)}: {foreign_error(error)}"
    allowed = f"the package mended or uninstalled; {entry.group} names {entry.name} = {entry.value}"
    return InputError(what, where=where, value=entry.name, allowed=allowed)


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


def refuse_code(extractor: str, where: object, allowed: str = "") -> None:
    """Refuse a stranger's file that names a function by its module: it would be run.

    Parameters
    ----------
    extractor : str, the file's ``stripe.extractor``
    where : the file
    allowed : str, what would let it pass

    Raises
    ------
    InputError
        It names code.
    """
    if names_code(extractor):
        raise InputError(
            f"stripe.extractor: names code, which would be run{allowed and '; '}{allowed}",
            where=where,
            value=extractor,
            allowed=", ".join(installed("lscan.extractors")),
        )


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
        found = getattr(importlib.import_module(module), function)
    except Exception as error:  # a module of the user's may raise anything
        allowed = f"a name that can be imported, its folder in PYTHONPATH: {foreign_error(error)}"
        raise InputError(what, where=where, value=name, allowed=allowed) from error
    if not callable(found):
        raise InputError(what, where=where, value=name, allowed="a function")
    return found


def foreign_error(error: BaseException) -> str:
    """What code that is not lscan's raised, in one line, with the file and line it stands in.

    Parameters
    ----------
    error : as it was caught
    """
    said = " ".join(f"{type(error).__name__}: {error}".split())
    if not (frames := frames_of_others(error)):
        return said
    folder = Path(frames[0].filename).parent  # what it calls further on may be of a library
    place = [frame for frame in frames if Path(frame.filename).parent == folder][-1]
    return f"{said} ({place.filename} line {place.lineno})"


def frames_of_others(error: BaseException) -> Sequence[traceback.FrameSummary]:
    """The frames of an error that are in files, none of them lscan's, the outermost first.

    Parameters
    ----------
    error : as it was caught
    """
    frames = traceback.extract_tb(error.__traceback__)
    return [frame for frame in frames if _is_of_others(Path(frame.filename))]


def _is_of_others(file: Path) -> bool:
    """Whether a file is neither lscan's nor Python's own; of "<frozen ...>" there is none."""
    is_python = file.is_relative_to(_PYTHON) and "site-packages" not in file.parts
    # Where that package has been imported, its entry points take the place of Python's own.
    is_finder = file.parent.name == "importlib_metadata"
    return not (is_python or is_finder or file.is_relative_to(_HERE) or str(file).startswith("<"))


def others_versions(group: str, name: str) -> dict[str, str]:
    """Version by name of the package that a plug-in comes from; {} of lscan's own.

    Parameters
    ----------
    group : str, as of ``installed``
    name : str, of the entry point, a plane map's full name, or ``package.module:function``; of a
        module that belongs to no package, or a plug-in that is not there, nothing is known
    """
    if names_code(name):
        packages = _packages().get(name.partition(".")[0].partition(":")[0], [])
        return {package: version(package) for package in packages if package != _OURS}
    known = _entry_points(group)
    entries = known.get(name) or known.get(name.partition("-")[0], [])
    dists = [entry.dist for entry in entries if not _is_ours(entry)]
    return {dist.name: dist.version for dist in dists if dist is not None}


def with_package(group: str, name: str) -> str:
    """The name of a plug-in, behind it its package and version where it is not lscan's own.

    Parameters
    ----------
    group, name : str, as of ``others_versions``

    Examples
    --------
    >>> with_package("lscan.extractors", "centroid-relative")
    'centroid-relative'
    """
    packages = [f"{package} {of}" for package, of in others_versions(group, name).items()]
    return f"{name} ({', '.join(packages)})" if packages else name


@cache
def _packages() -> dict[str, list[str]]:
    return {module: list(of) for module, of in packages_distributions().items()}


def _is_ours(entry: EntryPoint) -> bool:
    return entry.dist is not None and entry.dist.name == _OURS


def _package(entry: EntryPoint) -> str:
    return "unknown" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"
