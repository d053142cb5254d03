"""JSON: results on the screen and in files, and files read without trust in them."""

import json
from pathlib import Path
from typing import Any

from pydantic_core import to_jsonable_python

from lscan.errors import InputError
from lscan.files.disk import MOST_TEXT_BYTES, read_text, write_atomically

MOST_LEVELS = 50
"""Of tables and lists in one another; a rig file has six or so."""
TOO_DEEP = "tables and lists too deep in one another"


def read_json(path: Path, most: int = MOST_TEXT_BYTES, within: Path | None = None) -> Any:
    """What a JSON file holds.

    Parameters
    ----------
    path : Path, the file
    most : int, its largest size, bytes
    within : Path or None, a folder whose content is a stranger's, and the file in it: no link out
        of it is followed

    Raises
    ------
    InputError
        The file cannot be read, or as ``parse_json``.
    """
    return parse_json(read_text(path, most, within), path)


def parse_json(text: str | bytes, where: object) -> Any:
    """What a JSON text holds.

    Parameters
    ----------
    text : str or bytes
    where : the file, for the error

    Raises
    ------
    InputError
        It is no JSON, or holds what is no finite number, a null character, or tables too deep in
        one another.
    """
    try:
        content = json.loads(text, parse_constant=_refuse_constant)
    except ValueError as error:  # also of a number of thousands of digits
        raise InputError(f"is not valid JSON: {error}", where=where) from error
    except RecursionError as error:
        what, allowed = f"is not valid JSON: {TOO_DEEP}", f"{MOST_LEVELS} levels"
        raise InputError(what, where=where, allowed=allowed) from error
    check_values(content, where)
    return content


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a number")


def check_values(value: Any, where: object, keys: tuple[str | int, ...] = ()) -> None:
    """Refuse what no later step could take: a null character, and nesting without end.

    Parameters
    ----------
    value : of the types of JSON or TOML
    where : the file, for the error
    keys : tuple, that lead to the value in the file

    Raises
    ------
    InputError
        Names the keys.
    """
    if isinstance(value, dict | list):
        if len(keys) == MOST_LEVELS:
            what = f"{dotted(keys[:3])}...: {TOO_DEEP}"
            raise InputError(what, where=where, allowed=f"{MOST_LEVELS} levels")
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            check_values(key, where, keys)
            check_values(item, where, (*keys, key))
    elif isinstance(value, str) and "\0" in value:
        what = f"{dotted(keys) or 'a key'}: holds a null character"
        raise InputError(what, where=where, value=value, allowed="a text without")


def dotted(keys: tuple[str | int, ...]) -> str:
    """The keys that lead to a value, as one text.

    Parameters
    ----------
    keys : tuple, names and numbers
    """
    return ".".join(map(str, keys))


def json_text(value: object, *, compact: bool = False) -> str:
    """A value as JSON text, without a line end; numbers that are not finite as null.

    Parameters
    ----------
    value : of JSON types, records, paths and NumPy's numbers and arrays
    compact : bool, on one line, without spaces: many times faster

    Examples
    --------
    >>> print(json_text({"rms_mm": float("nan"), "file": Path("a.json")}))
    {
      "rms_mm": null,
      "file": "a.json"
    }
    """
    plain = to_jsonable_python(value, inf_nan_mode="null", fallback=lambda other: other.tolist())
    return json.dumps(plain, separators=(",", ":")) if compact else json.dumps(plain, indent=2)


def write_json(file: Path, value: object) -> None:
    """Write a value as JSON, whole or not at all, as ``json_text`` puts it.

    Parameters
    ----------
    file : Path, replaced where it is there
    value : as of ``json_text``

    Raises
    ------
    InputError
        The disk refuses.
    """
    write_atomically(file, f"{json_text(value)}\n".encode())
