"""The scenes that come with lscan: found by name, listed, and copied to be changed.

In a checkout they lie beside the packages, in an installed lscan within it.
"""

import os
import shutil
from difflib import get_close_matches
from functools import cache
from pathlib import Path

from lscan.errors import InputError
from lscan.files.disk import disk_errors

_PACKAGE = Path(__file__).resolve().parents[1]


@cache
def scenes_folder() -> Path:
    """The folder of the scenes that come with lscan.

    Raises
    ------
    InputError
        Where they are missing, as in an installation that somebody has taken apart.
    """
    places = (_PACKAGE / "scenes", _PACKAGE.parent / "scenes")
    for place in places:
        if (place / "paper").is_dir():
            return place
    raise InputError("has lost its scenes; install lscan again", where=_PACKAGE)


def scene_names() -> list[str]:
    """Names of all files of scenes, rigs and boards that come with lscan, such as paper/board."""
    folder = scenes_folder()
    files = sorted(folder.rglob("*.toml"))
    return [file.relative_to(folder).with_suffix("").as_posix() for file in files]


def scene_file(path: Path | str) -> Path:
    """The file at ``path``, or the scene of that name that comes with lscan.

    Parameters
    ----------
    path : Path or str
        A file of that path comes before a scene of that name.

    Raises
    ------
    InputError
        Where there is neither.
    """
    path = Path(path)
    if path.is_absolute() or os.path.isfile(path):  # noqa: PTH113 - takes any text
        return path
    if path.as_posix() in scene_names():
        return scenes_folder() / f"{path}.toml"
    if os.path.lexists(path):  # a folder, a link to nowhere: whoever reads it says what is wrong
        return path
    near = get_close_matches(path.as_posix().removesuffix(".toml"), scene_names(), n=1)
    suggested = f"; did you mean {near[0]}?" if near else ""
    raise InputError(
        f"cannot be read: there is no such file, and no scene of that name{suggested}",
        where=path,
        allowed="a TOML file, or a name that `lscan scenes` lists",
    )


def included_file(folder: Path, name: str) -> Path:
    """What a file in ``folder`` includes: the file beside it, else the scene of that name."""
    beside = folder / name
    if not os.path.isfile(beside) and name in scene_names():  # noqa: PTH113 - takes any text
        return scenes_folder() / f"{name}.toml"
    return beside


def copy_scenes(folder: Path) -> None:
    """Copy all scenes that come with lscan to a new folder.

    Parameters
    ----------
    folder : Path, a folder that is not there yet

    Raises
    ------
    InputError
        The folder is there already, or cannot be made.
    """
    if os.path.lexists(folder):
        raise InputError("is there already", where=folder, allowed="a new folder")
    with disk_errors(folder):
        shutil.copytree(scenes_folder(), folder)
