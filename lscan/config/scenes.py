"""The scenes that come with lscan: found by name, listed, and copied to be changed.

In a checkout they lie beside the packages, in an installed lscan within it.
"""

import os
import re
import shutil
from collections.abc import Callable
from difflib import get_close_matches
from functools import cache
from itertools import takewhile
from pathlib import Path
from typing import Literal

from lscan.errors import InputError
from lscan.files.disk import disk_errors

_PACKAGE = Path(__file__).resolve().parents[1]
SpecKind = Literal["study", "data set", "suite"]
FOLDERS: dict[str, str] = {"study": "studies", "data set": "datasets", "suite": "suites"}
"""Beneath the scenes: the folders of what is no scene, by kind."""
CATALOGUE = "catalogue.toml"  # among the studies, and none


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
    files = [file.relative_to(folder) for file in sorted(folder.rglob("*.toml"))]
    named = [file for file in files if file.parts[0] not in FOLDERS.values()]
    return [file.with_suffix("").as_posix() for file in named]


def scene_about(name: str) -> str:
    """What a scene, rig or board is: the first sentence of the comment that its file begins with.

    Parameters
    ----------
    name : str, as ``scene_names`` gives it
    """
    lines = (scenes_folder() / f"{name}.toml").read_text(encoding="utf-8").splitlines()
    comment = takewhile(lambda line: line.startswith("#"), lines)
    words = " ".join(line.lstrip("# ") for line in comment)
    return re.split(r"(?<!Sec\.)(?<!Fig\.)(?<!Figs\.)(?<=[.?!])\s", words, maxsplit=1)[0]


def spec_names(kind: SpecKind) -> list[str]:
    """Names of the files of a kind that come with lscan, such as paper-budget of the studies.

    Parameters
    ----------
    kind : "study", "data set" or "suite"
    """
    files = sorted((scenes_folder() / FOLDERS[kind]).glob("*.toml"))
    return [file.stem for file in files if file.name != CATALOGUE]


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
    listed = "a name that `lscan scenes` lists"
    return _file(Path(path), "scene", scene_names, listed)


def spec_file(path: Path | str, kind: SpecKind) -> Path:
    """The file at ``path``, or that of a kind and of that name that comes with lscan.

    Parameters
    ----------
    path : Path or str
        A file of that path comes before one of that name.
    kind : "study", "data set" or "suite"

    Raises
    ------
    InputError
        Where there is neither.
    """
    return _file(Path(path), kind, lambda: spec_names(kind))


def _file(path: Path, kind: str, listed: Callable[[], list[str]], allowed: str = "") -> Path:
    """The file at a path, or that of one of the names listed, which are looked up where needed."""
    if path.is_absolute() or os.path.isfile(path):  # noqa: PTH113 - takes any text
        return path
    names = listed()
    if path.as_posix() in names:
        return scenes_folder() / FOLDERS.get(kind, "") / f"{path}.toml"
    if os.path.lexists(path):  # a folder, a link to nowhere: whoever reads it says what is wrong
        return path
    near = get_close_matches(path.as_posix().removesuffix(".toml"), names, n=1)
    suggested = f"; did you mean {near[0]}?" if near else ""
    what = f"cannot be read: there is no such file, and no {kind} of that name{suggested}"
    raise InputError(what, where=path, allowed=f"a TOML file, or {allowed or ', '.join(names)}")


def included_file(folder: Path, name: str) -> Path:
    """What a file in ``folder`` includes: the file beside it, else the scene of that name.

    Parameters
    ----------
    folder : Path
    name : str, as the file states it
    """
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
