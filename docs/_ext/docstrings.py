"""Docstrings as the code has them, made ready for Sphinx, and references to what is not public.

The project's records describe their fields in lines such as ``xyz_mm: (F, N, 3) points``, continued
by indented ones.  Sphinx reads them as a list once they are written as one.  A parameter of
numpydoc stands in one line, ``image_px : (N, 2) array, px, of (u, v)``: only the first word after
the shape is a type that Sphinx can refer to, and the rest becomes its text.
"""

import re
import sys
from typing import Any

from docutils import nodes

FIELDS = re.compile(r"^(\s*)((?:[a-zA-Z_]\w*)(?:, [a-zA-Z_]\w*)*): (\S.*)$")
HEADING = re.compile(r"^-{3,}$")
SHAPE = r"(?P<shape>\([^)]*\)(?: or \([^)]*\))*) "
DESCRIBED = re.compile(rf"^(?P<names>\w+(?:, \w+)*) : (?:{SHAPE})?(?P<type>[^,;]+), (?P<text>.+)$")


def types_apart(
    _app: Any, _what: str, _name: str, _obj: Any, _options: Any, lines: list[str]
) -> None:
    """Take what follows a type in a line ``name : type, text`` to a line of its own."""
    written: list[str] = []
    for line in lines:
        described = DESCRIBED.match(line)
        if described is None:
            written.append(line)
            continue
        shape = described["shape"]
        text = f"{shape}, {described['text']}" if shape else described["text"]
        written += [f"{described['names']} : {described['type']}", f"    {text}"]
    lines[:] = written


def fields_as_list(
    _app: Any, _what: str, _name: str, _obj: Any, _options: Any, lines: list[str]
) -> None:
    """Turn lines ``name: text`` of a docstring without numpydoc sections into a list."""
    if any(HEADING.match(line.strip()) for line in lines):
        return
    written: list[str] = []
    listing = False
    for line in lines:
        field = FIELDS.match(line)
        if field and not line.startswith("  "):
            if not listing and written and written[-1]:
                written.append("")
            written.append(f"* **{field.group(2)}**: {field.group(3)}")
            listing = True
        elif listing and line.startswith("  "):
            written.append(f"  {line.strip()}")
        else:
            if listing and line:
                written.append("")
            listing = False
            written.append(line)
    lines[:] = written


def internal_name(_app: Any, _env: Any, node: Any, content: nodes.Element) -> nodes.Element | None:
    """A reference to a name of the project that has no entry of its own: its text, no link.

    A name that does not exist stays a missing reference.
    """
    if node.get("refdomain") != "py":
        return None
    target = str(node["reftarget"])
    return content if _exists(target) else None


def _exists(target: str) -> bool:
    owner, _, name = target.rpartition(".")
    modules = [module for path, module in list(sys.modules.items()) if _ours(path)]
    if not owner:
        return any(name in vars(module) for module in modules)
    module = sys.modules.get(owner)
    if module is not None and _ours(owner):
        return hasattr(module, name)
    outer, _, inner = owner.rpartition(".")
    holder = getattr(sys.modules.get(outer), inner, None) if _ours(outer) else None
    return holder is not None and hasattr(holder, name)


def _ours(path: str) -> bool:
    return path.split(".")[0] in ("lscan", "sim")
