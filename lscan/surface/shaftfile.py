"""The section ``[shaft]`` as a file by itself, to be included in a rig file."""

from pathlib import Path

from lscan.config.documents import check, read_document, write_toml
from lscan.config.rig import ShaftSection
from lscan.errors import InputError
from lscan.surface.shaft import section_of
from lscan.surface.shaftfit import ShaftFit


def save_shaft(path: Path, fit: ShaftFit) -> None:
    """Write the shaft found as a TOML file that a rig file can name in its ``include``.

    Numbers are written in full.

    Parameters
    ----------
    path : Path, of the file
    fit : ShaftFit, mm and rad; the file has degrees

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    found = (
        f"# Found from {fit.points} points of a scan, {fit.rms_mm:.4f} mm rms off the workpiece."
    )
    write_toml(path, {"shaft": section_of(fit.shaft).model_dump()}, found)


def load_shaft(path: Path) -> ShaftSection:
    """The ``[shaft]`` of a TOML file, whatever else it holds.

    Parameters
    ----------
    path : Path, of the file

    Raises
    ------
    InputError
        Where the file cannot be read, has no such section or a bad one.
    """
    document = read_document(path)
    if not isinstance(document.get("shaft"), dict):
        raise InputError("has no section [shaft]", where=path)
    return check(ShaftSection, document["shaft"], where=path, prefix="shaft")
