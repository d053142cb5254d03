"""The section ``[shaft]`` as a file by itself, to be included in a rig file."""

from __future__ import annotations

from pathlib import Path

from lscan.config.documents import check, read_document
from lscan.config.rig import ShaftSection
from lscan.errors import InputError
from lscan.files.disk import write_atomically
from lscan.surface.shaft import section_of
from lscan.surface.shaftfit import ShaftFit


def save_shaft(path: Path, fit: ShaftFit) -> None:
    """Write the shaft found as a TOML file that a rig file can name in its ``include``.

    Numbers are written in full.  Raises InputError where the file cannot be written.
    """
    lines = [
        f"# Found from {fit.points} points of a scan, {fit.rms_mm:.4f} mm rms off the workpiece.",
        "[shaft]",
    ]
    for key, value in section_of(fit.shaft).model_dump().items():
        numbers = ", ".join(map(repr, value)) if isinstance(value, tuple) else None
        lines.append(f"{key} = {value!r}" if numbers is None else f"{key} = [{numbers}]")
    write_atomically(path, ("\n".join(lines) + "\n").encode())


def load_shaft(path: Path) -> ShaftSection:
    """The ``[shaft]`` of a TOML file, whatever else stands in it.

    Raises InputError where the file cannot be read, has no such section or a bad one.
    """
    document = read_document(path)
    if not isinstance(document.get("shaft"), dict):
        raise InputError("has no section [shaft]", where=path)
    return check(ShaftSection, document["shaft"], where=path, prefix="shaft")
