"""Results as JSON, on the screen and in files."""

import json
from pathlib import Path

from pydantic_core import to_jsonable_python

from lscan.files.disk import write_atomically


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
