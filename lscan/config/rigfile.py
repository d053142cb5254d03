"""The rig file, read and checked: its sections, and the drivers, extractor and map it names.

A rig file is TOML (documents.py).  Sections that belong to a driver (the tank's lens, water
and laser, say) may stand in the same file: each driver names the sections it owns and checks
them itself, so a scene file of the tank is a rig file too.
"""

from dataclasses import dataclass
from math import degrees
from pathlib import Path
from typing import Any

from lscan.config.documents import Document, check, merge, read_document
from lscan.config.plugins import find_plugin, find_plugin_or_function
from lscan.config.rig import Rig
from lscan.errors import InputError


@dataclass(frozen=True)
class RigFile:
    """A rig as read: the model, the whole merged document it came from, and from where.

    Attributes
    ----------
    rig : Rig, all that does not belong to drivers
    document : Document, all sections, the drivers' included, with the board's file read in, so that
        it stands alone: it is what a run folder keeps
    source : str, the file, for errors

    Examples
    --------
    >>> import lscan
    >>> rig_file = lscan.load_rig("paper/sandwave")
    >>> rig_file.rig.plan.frames, rig_file.rig.plan.step_mm
    (400, 0.5)
    """

    rig: Rig
    document: Document
    source: str

    def section(self, name: str) -> Document:
        """A driver's own section of the document, {} where the file has none.

        Parameters
        ----------
        name : str, of the section
        """
        return self.document.get(name, {})


def load_rig(path: Path | str) -> RigFile:
    """The rig, or scene, described by the TOML file at ``path``, or the scene of that name.

    Parameters
    ----------
    path : Path or str
        A file of that path comes before a scene of that name.

    Raises
    ------
    InputError
        Where the file cannot be read, holds an unknown key, driver, extractor or plane map,
        where a driver refuses a section of its own, or where the drivers cannot do with the
        laser what the plan says.

    Examples
    --------
    >>> import lscan
    >>> lscan.load_rig("paper/sandwave").rig.camera.driver
    'sim'
    """
    document = inline_board(read_document(path), source=str(path))
    rig_file = parse_rig(document, source=str(path))
    for driver in drivers_of(rig_file.rig, rig_file.source):
        driver.validate(rig_file)
    _check_names(rig_file)
    _check_laser(rig_file)
    return rig_file


def parse_rig(document: Document, source: str, trusted: bool = False) -> RigFile:
    """The rig in an already merged document.

    Parameters
    ----------
    document : dict
        Its includes merged, the board's file read in.
    source : str
        Where it came from, for messages.
    trusted : bool
        Its driver sections need no check, as those of a run folder, which were checked when it
        was written; the drivers then need not be installed.

    Raises
    ------
    InputError
        Where it is not a rig, or holds an unknown key.
    """
    own = {key: value for key, value in document.items() if key in Rig.model_fields}
    if not {"camera", "track"} & own.keys():
        raise InputError(
            "is no rig: it has neither [camera] nor [track]",
            where=source,
            allowed="a rig file, or a scene; `lscan scenes` lists those that come with lscan",
        )
    rig = check(Rig, own, where=source)
    if not trusted and len(own) < len(document):
        known = set(Rig.model_fields).union(*(one.sections for one in drivers_of(rig, source)))
        unknown = sorted(set(document) - known)
        if unknown:
            what, value = f"{unknown[0]}: unknown section", document[unknown[0]]
            raise InputError(what, where=source, value=value, allowed=", ".join(sorted(known)))
    _check_shaft(rig, source)
    return RigFile(rig=rig, document=document, source=source)


def _check_shaft(rig: Rig, source: str) -> None:
    """Refuse more than a full turn about a shaft, and a sheet's thickness together with one."""
    if rig.shaft is None:
        return
    plan = rig.plan
    turn_deg = degrees((plan.frames - 1) * abs(plan.step_mm) / rig.shaft.arc_radius_mm)
    if turn_deg > 360 * (1 + 1e-9):
        raise InputError(
            "plan: turns the head by more than a full turn about [shaft]",
            where=source,
            value=f"{turn_deg:g} deg",
            allowed="360 deg or less",
        )
    if rig.sheet is not None:
        raise InputError(
            "sheet: its thickness is corrected for on a linear track only",
            where=source,
            allowed="[sheet] or [shaft], not both",
        )


def inline_board(document: Document, source: str) -> Document:
    """The document with ``[board] file = ...`` replaced by what that file holds.

    Parameters
    ----------
    document : Document, as ``read_document`` gives it
    source : str, the document's own file, for the error

    Raises
    ------
    InputError
        The board's file cannot be read.
    """
    board = document.get("board")
    if not isinstance(board, dict) or "file" not in board:
        return document
    if not isinstance(board["file"], str):
        raise InputError("board.file: must be a path", where=source, value=board["file"])
    rest = {key: value for key, value in board.items() if key != "file"}
    try:
        read = read_document(Path(board["file"]))
    except InputError as error:
        raise InputError(f"board.file: must be a file of a board: {error}", where=source) from error
    return {**document, "board": merge(read, rest)}


def _check_names(rig_file: RigFile) -> None:
    """Refuse an unknown extractor or plane map before a scan, not after it."""
    extractor, source = rig_file.rig.stripe.extractor, rig_file.source
    find_plugin_or_function("lscan.extractors", extractor, where=f"{source}: stripe.extractor")
    name, where = rig_file.rig.calibration.plane_map, f"{source}: calibration.plane_map"
    family, _, variant = name.partition("-")
    solver = find_plugin("lscan.planemaps", family, where=where)
    # A solver from elsewhere may lack the check; it then refuses when it is called.
    check_variant = getattr(solver, "check_variant", None)
    if check_variant is None:
        return
    try:
        check_variant(variant)
    except InputError as error:
        raise InputError(error.what, where=where, value=name, allowed=error.allowed) from error


def _check_laser(rig_file: RigFile) -> None:
    """Refuse a plan for the laser that the drivers cannot carry out."""
    rig, plan = rig_file.rig, rig_file.rig.plan
    camera, track = drivers_of(rig, rig_file.source)
    where = f"{rig_file.source}: plan.laser"
    if plan.laser != "untouched" and not getattr(track, "switches_laser", False):
        what = f"track driver {rig.track.driver!r} switches no laser"
        raise InputError(what, where=where, value=plan.laser, allowed="untouched")
    if plan.paired and not getattr(camera, "takes_dark", False):
        what = f"camera driver {rig.camera.driver!r} takes no pictures with the laser off"
        raise InputError(what, where=where, value=plan.laser, allowed="untouched, on")


def drivers_of(rig: Rig, source: str) -> tuple[Any, Any]:
    """The rig's camera driver and its track driver.

    Parameters
    ----------
    rig : Rig, its ``camera.driver`` and ``track.driver`` name the drivers
    source : str, the rig's file, for the error

    Raises
    ------
    InputError
        There is no such driver.
    """
    return (
        find_plugin("lscan.cameras", rig.camera.driver, where=f"{source}: camera.driver"),
        find_plugin("lscan.tracks", rig.track.driver, where=f"{source}: track.driver"),
    )
