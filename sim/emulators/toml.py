"""Documents as TOML text, as strict as the reader: what cannot be read back is refused."""

from __future__ import annotations

import math
import re
from typing import Any

from lscan.config.documents import Document
from lscan.errors import InputError

BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
SHORT_ESCAPES = {'"': '\\"', "\\": "\\\\", "\n": "\\n", "\t": "\\t", "\r": "\\r"}


def toml_text(document: Document) -> str:
    """The document as TOML 1.0, its plain keys first and then its tables in their order.

    Tables, texts, truth values, numbers and lists of these.  Raises InputError that names the
    key of anything else, of a number that is not finite and of a text that is not Unicode.
    """
    return "\n".join(_table(document, ())).lstrip("\n") + "\n"


def _table(table: Document, path: tuple[str, ...]) -> list[str]:
    """Lines of a table's own keys, then those of the tables in it."""
    own = {key: value for key, value in table.items() if not isinstance(value, dict)}
    inner = {key: value for key, value in table.items() if isinstance(value, dict)}
    lines = []
    if path and (own or not inner):
        lines += ["", f"[{'.'.join(_key(part, path) for part in path)}]"]
    lines += [f"{_key(key, path)} = {_value(value, (*path, key))}" for key, value in own.items()]
    for key, value in inner.items():
        lines += _table(value, (*path, key))
    return lines


def _key(key: object, path: tuple[str, ...]) -> str:
    if not isinstance(key, str):
        raise _unwritable(path, key, "keys that are texts")
    return key if BARE_KEY.fullmatch(key) else _text(key, path)


def _value(value: Any, path: tuple[str, ...]) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _text(value, path)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise _unwritable(path, value, "finite numbers")
        return repr(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(_value(entry, path) for entry in value)}]"
    if isinstance(value, dict):  # in a list
        entries = [f"{_key(key, path)} = {_value(v, (*path, key))}" for key, v in value.items()]
        return f"{{ {', '.join(entries)} }}" if entries else "{}"
    raise _unwritable(path, value, "tables, texts, true and false, numbers, lists")


def _text(text: str, path: tuple[str, ...]) -> str:
    if any(0xD800 <= ord(letter) <= 0xDFFF for letter in text):
        raise _unwritable(path, text, "Unicode")
    return f'"{"".join(map(_letter, text))}"'


def _letter(letter: str) -> str:
    if letter in SHORT_ESCAPES:
        return SHORT_ESCAPES[letter]
    return f"\\u{ord(letter):04X}" if ord(letter) < 0x20 or ord(letter) == 0x7F else letter


def _unwritable(path: tuple[str, ...], value: object, allowed: str) -> InputError:
    return InputError(
        "cannot be written as TOML", where=".".join(path) or None, value=value, allowed=allowed
    )
