"""Whether a run may go on with the rig as it now is: all that its data depend on is unchanged.

What only says how a device is reached and waited for, its driver's ``connection_options``, may
differ: a track that is plugged in again may be another port, and a server another address.
"""

import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from lscan.config.documents import Document
from lscan.config.plugins import find_plugin, installed
from lscan.config.rig import RigFile
from lscan.devices.api import Camera, Identified
from lscan.errors import DeviceError, InputError
from lscan.files.disk import content_sha256

_log = logging.getLogger(__name__)

_GROUPS = {"camera": "lscan.cameras", "track": "lscan.tracks"}


def require_same_rig(begun: RigFile, now: RigFile, where: Path) -> None:
    """Refuse to go on with a run under another rig than it was begun with.

    Parameters
    ----------
    begun : RigFile, the rig the run was begun with
    now : RigFile, the rig it would go on with
    where : Path, the file that keeps the first

    Raises
    ------
    InputError
        The rigs differ; names the key path that differs first, what it was, what it is, and what to
        do.
    """
    was, is_now = _without_connection(begun), _without_connection(now)
    key = first_difference(was, is_now)
    if key is not None:
        raise InputError(
            f"cannot go on: the run was begun {_in_words(key, was)}, this rig comes "
            f"{_in_words(key, is_now)}; restore it in {now.source}, or begin a new scan",
            where=where,
        )


def require_same_camera(begun_with: str | None, camera: Camera) -> None:
    """Refuse to go on with a run with another camera; say so where that cannot be told.

    Parameters
    ----------
    begun_with : str or None, identity of the camera the run was begun with
    camera : Camera, the one it would go on with

    Raises
    ------
    DeviceError
        They are two.
    """
    if not isinstance(camera, Identified):
        return
    if begun_with is None or camera.identity is None:
        _log.warning(
            "nothing tells whether this is the camera the run was begun with (then: %s; now: %s)",
            begun_with or "unknown",
            camera.identity or "unknown",
        )
    elif begun_with != camera.identity:
        raise DeviceError(
            f"cannot go on: the run was begun with the camera {begun_with}, this one is "
            f"{camera.identity}; name the first one as camera.options.device (`lscan devices` "
            "lists what is connected), or begin a new scan"
        )


def require_same_files(files: Mapping[str, str], where: Path) -> None:
    """Refuse files that hold something else than they did.

    Parameters
    ----------
    files : mapping, SHA-256 of what each held, by its path
    where : Path, what was made with them, for the error

    Raises
    ------
    InputError
        Names the first file that is another one, or is gone.
    """
    for file, kept in files.items():
        now = content_sha256(Path(file))
        if now != kept:
            raise InputError(
                f"{'was changed' if now else 'is gone'} since {where} was made with it",
                where=file,
                value=now or None,
                allowed=f"SHA-256 {kept}: bring that file back, or begin anew",
            )


def first_difference(one: Any, other: Any) -> str | None:
    """Key path, such as ``camera.options.seed``, of the first difference of two documents.

    None where there is none.  1 and 1.0 differ: they would not give the same run.json.

    Parameters
    ----------
    one, other : Document, or any part of one
    """
    left, right = dict(_leaves(one)), dict(_leaves(other))
    return next((key for key in [*left, *right] if left.get(key) != right.get(key)), None)


def _leaves(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    if isinstance(value, dict) and value:
        for name, inner in value.items():
            yield from _leaves(inner, f"{key}.{name}" if key else name)
    elif isinstance(value, list) and value:
        for index, inner in enumerate(value):
            yield from _leaves(inner, f"{key}[{index}]")
    else:
        yield key, repr(value)


def _in_words(key: str, document: Mapping[str, Any]) -> str:
    """The key with its value, or that it is not there, or that more than a value is."""
    leaves = dict(_leaves(document))
    if key in leaves:
        return f"with {key} = {leaves[key]}"
    filled = any(leaf.startswith((f"{key}.", f"{key}[")) for leaf in leaves)
    return f"with entries in {key}" if filled else f"without {key}"


def _without_connection(rig_file: RigFile) -> Document:
    """The rig's document less what only says how its devices are reached."""
    kept = dict(rig_file.document)
    for name, group in _GROUPS.items():
        section = dict(kept[name])
        options = section.pop("options", {})
        connection: frozenset[str] = frozenset()
        if section["driver"] in installed(group):  # and names none where it has none
            driver = find_plugin(group, section["driver"])
            connection = getattr(driver, "connection_options", connection)
        lasting = {key: value for key, value in options.items() if key not in connection}
        kept[name] = {**section, "options": lasting} if lasting else section
    return kept
