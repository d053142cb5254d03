"""Documents written as TOML files."""

import re
from pathlib import Path

import tomli_w

from lscan.config.documents import Document
from lscan.errors import InputError
from lscan.files.disk import write_atomically

_PLAIN_LIST = re.compile(r"""\[\n((?: +(?:[-+.\w]+|"[^"\\\n]*"),\n)+) *\]""")
"""A list of numbers or texts as tomli-w writes it, one a line; no text holds a line end."""


def toml_text(document: Document, heading: str = "") -> str:
    """The document as TOML text, lists of numbers or texts on one line each.

    Parameters
    ----------
    document
        Tables of what TOML has.
    heading
        Comment lines, each with its ``#``, that stand first.

    Returns
    -------
    str
        What ``tomllib`` reads as the same document.

    Examples
    --------
    >>> print(toml_text({"sheet": {"apex_mm": [75.0, 0.0, 900.0]}}, "# The laser."), end="")
    # The laser.
    [sheet]
    apex_mm = [75.0, 0.0, 900.0]
    """
    text = _PLAIN_LIST.sub(_on_one_line, tomli_w.dumps(document))
    return f"{heading}\n{text}" if heading else text


def write_toml(file: Path, document: Document, heading: str = "") -> None:
    """Write a document as TOML, whole or not at all, as ``toml_text`` puts it.

    Parameters
    ----------
    file : Path, replaced where it is there
    document : Document, tables of what TOML has
    heading : str, comment lines, each with its ``#``, that stand first

    Raises
    ------
    InputError
        The disk refuses, or a text, such as a folder's name, is not Unicode.
    """
    try:
        data = toml_text(document, heading).encode()
    except UnicodeEncodeError as error:
        what = "cannot be written as TOML: holds a text that is not Unicode"
        around = error.object[max(0, error.start - 40) : error.end]
        raise InputError(what, where=file, value=around) from error
    write_atomically(file, data)


def _on_one_line(found: re.Match[str]) -> str:
    lines = found[1].rstrip("\n").split("\n")  # splitlines() also splits at U+0085 and the like
    return f"[{', '.join(line.strip(' ,') for line in lines)}]"
