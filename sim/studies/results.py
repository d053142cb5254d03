"""The files of a study: results.json, runs.nc with every run, and the page report.html."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from lscan.errors import InputError
from lscan.files.containers import NetcdfArray, netcdf_bytes
from lscan.files.disk import make_folder, read_text, write_atomically
from lscan.files.jsonfiles import write_json
from lscan.version import __version__
from sim.studies.budget import CauseFacts, StudyResults, StudyRuns
from sim.studies.page import render_page
from sim.studies.problem import AGAIN, ALL, Design, Output, columns
from sim.studies.rig.states import correlate, share_of
from sim.studies.store import Results
from sim.studies.studyfile import Cause, Study

RESULTS, RUNS, PAGE = "results.json", "runs.nc", "report.html"
MOST_BYTES = 2**28
"""Of results.json: a hundred fields of a thousand places with fifty causes are half of it."""
_IN_UNIT = ("base_rms", "mean", "standard_uncertainty", "range_95", "rms", "stated_rms")
"""Of a budget and of a map, what is in the output's unit; in the file the name ends in it."""
_RESULTS = TypeAdapter(StudyResults)


def write_results(folder: Path, results: StudyResults, runs: StudyRuns) -> None:
    """Write the three files into a folder, each whole or not at all; same results, same bytes.

    Parameters
    ----------
    folder : Path, made where it is missing
    results : StudyResults
    runs : StudyRuns

    Raises
    ------
    InputError
        The disk refuses.
    """
    make_folder(folder)
    write_atomically(folder / RUNS, runs_netcdf(runs, results.name))
    write_json(folder / RESULTS, as_document(results))
    write_atomically(folder / PAGE, render_page(results).encode())


def as_document(results: StudyResults) -> dict[str, Any]:
    """What results.json holds: units in the names.

    Parameters
    ----------
    results : StudyResults
    """
    return _rename_numbers(asdict(results), lambda name, unit: (name, name + _suffix(unit)))


def load_results(folder: Path) -> StudyResults:
    """What ``write_results`` wrote to results.json.

    Parameters
    ----------
    folder : Path

    Raises
    ------
    InputError
        The file cannot be read or is not such a file.
    """
    file = folder / RESULTS
    try:
        document = json.loads(read_text(file, MOST_BYTES))
        document = _rename_numbers(document, lambda name, unit: (name + _suffix(unit), name))
        return _RESULTS.validate_python(document)
    except ValidationError as error:
        first = error.errors()[0]
        where = f"{file}: {'.'.join(map(str, first['loc']))}"
        raise InputError(first["msg"], where=where) from error
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise InputError("holds no results of a study", where=file) from error


def runs_netcdf(runs: StudyRuns, title: str) -> bytes:
    """Every run as NetCDF-4 after the CF conventions 1.11.

    ``number`` is (run, cause); each cause that has a unit has a variable ``value: NAME`` (run,),
    each output one ``error: NAME``, (run,) or of a field (run, place).  Names keep the study's
    words, but for "/", which NetCDF forbids.

    Parameters
    ----------
    runs : StudyRuns
    title : str, of the study
    """
    number = {"long_name": "number that the distribution's quantile is taken at", "units": "1"}
    names = np.array([cause.name for cause in runs.causes])
    data = {
        "block": _array("run", np.array(runs.blocks), long_name="what the run is for"),
        "status": _array("run", np.array(runs.statuses), long_name="ok, or the error"),
        "cause": _array("cause", names, long_name="name of the cause"),
        "number": NetcdfArray(("run", "cause"), runs.rows, number),
    }
    for k, cause in enumerate(runs.causes):
        if cause.unit is not None:
            words = f"{', '.join(cause.keys)}: {cause.distribution}, {cause.when}"
            name, unit = _variable("value", cause.name), _udunit(cause.unit)
            data[name] = _array("run", runs.physical[:, k], units=unit, long_name=words)
    for output in runs.outputs:
        values = runs.values[:, columns(runs.outputs)[output.name]]
        words = f"{output.name}, measured less true"
        attributes = {"units": _udunit(output.unit), "long_name": words}
        name = _variable("error", output.name)
        shape = ("run", _variable("place", output.name)) if output.size > 1 else ("run",)
        data[name] = NetcdfArray(shape, values if output.size > 1 else values[:, 0], attributes)
    return netcdf_bytes(data, {"title": title, "source": f"lscan {__version__}"})


def _array(dimension: str, values: np.ndarray, **attributes: str) -> NetcdfArray:
    return NetcdfArray((dimension,), values, attributes)


UNKNOWN_UNITS = ("", "px", "psu", "NTU", "e-")
"""That UDUNITS does not know, by which CF states units: there they are 1, and named in words."""


def _udunit(unit: str) -> str:
    """A unit as UDUNITS reads it, which takes "mm per 9 mm" for an area."""
    over, _, under = unit.partition(" per ")
    if under:
        return f"{over}/({under})"
    return "1" if unit in UNKNOWN_UNITS else {"deg": "degree"}.get(unit, unit)


def _variable(kind: str, name: str) -> str:
    return f"{kind}: {name}".replace("/", "_")


def _suffix(unit: str) -> str:
    """Such as ``_mm`` or ``_deg_per_m``."""
    return "_" + unit.replace("/", "_per_").replace("%", "percent").replace(" ", "_")


def _rename_numbers(document: dict[str, Any], names: Any) -> dict[str, Any]:
    """The document with the numbers in an output's unit renamed by ``names`` of name and unit."""
    causes = {cause["name"]: cause["unit"] for cause in document["causes"]}

    def changed(record: dict[str, Any], fields: tuple[str, ...], unit: str) -> dict[str, Any]:
        renamed = dict(names(field, unit) for field in fields)
        return {renamed.get(name, name): value for name, value in record.items()}

    def cause(record: dict[str, Any], unit: str) -> dict[str, Any]:
        record = changed(record, ("alone_rms",), unit)
        return changed(record, ("sensitivity",), f"{unit}/{causes.get(record['cause']) or 1}")

    def budget(record: dict[str, Any]) -> dict[str, Any]:
        unit, after = record["unit"], record["after"]
        record = record | {"causes": [cause(one, unit) for one in record["causes"]]}
        return changed(record | {"after": after and budget(after)}, _IN_UNIT, unit)

    maps = [changed(one, _IN_UNIT, one["unit"]) for one in document["maps"]]
    return document | {"outputs": [budget(one) for one in document["outputs"]], "maps": maps}


# The runs of a study with their causes' numbers, as files and budgets have them.


UNITS = {
    "_mm": "mm", "_deg": "deg", "_px": "px", "_nm": "nm", "_mw": "mW", "_ms": "ms", "_c": "°C",
    "_psu": "psu", "_ppm": "ppm", "_per_m": "1/m", "_ntu": "NTU", "_mpa": "MPa", "_e": "e-",
}  # fmt: skip


def runs_of(
    study: Study, design: Design, results: Results, outputs: tuple[Output, ...]
) -> StudyRuns:
    """The runs of a design.

    Parameters
    ----------
    study : Study
    design : Design
    results : Results, of its rows
    outputs : tuple of Output
    """
    rows, facts = design.rows, tuple(map(_facts, *zip(*study.file.cause.items(), strict=True)))
    root = study.correlation_root()
    shares = np.stack([correlate(row, root) for row in rows])
    physical = np.full(rows.shape, np.nan)
    for column, cause in enumerate(study.file.cause.values()):
        if cause.when in ("noise", "each-frame"):
            continue
        for n in np.flatnonzero(np.isfinite(shares[:, column])):
            physical[n, column] = share_of(study, cause, float(shares[n, column]))
    names = [ALL if block == AGAIN else block for block, _ in design.labels]
    return StudyRuns(
        facts, outputs, rows, physical, tuple(names), results.values, tuple(results.status)
    )


def joined_runs(runs: StudyRuns, rendered: StudyRuns) -> StudyRuns:
    """The runs of both tiers; the blocks of those that were rendered say so.

    Parameters
    ----------
    runs, rendered : StudyRuns, of the same study
    """
    return replace(
        runs,
        rows=np.concatenate([runs.rows, rendered.rows]),
        physical=np.concatenate([runs.physical, rendered.physical]),
        blocks=(*runs.blocks, *(f"rendered, {block}" for block in rendered.blocks)),
        values=np.concatenate([runs.values, rendered.values]),
        statuses=runs.statuses + rendered.statuses,
    )


def _facts(name: str, cause: Cause) -> CauseFacts:
    has_number = cause.when in ("as-built", "drift")
    field = next((part for part in reversed(cause.key.split(".")) if not part.isdigit()), "")
    unit = next((unit for end, unit in UNITS.items() if field.endswith(end)), "1")
    return CauseFacts(
        name=name,
        when=cause.when,
        keys=(cause.key, *cause.together),
        distribution=cause.in_words,
        unit=unit if has_number else None,
        group=cause.group or "",
    )
