"""The runs of a study with their causes' numbers, as files and budgets have them."""

from dataclasses import replace

import numpy as np

from sim.studies.problem import Output
from sim.studies.records import CauseFacts, StudyRuns
from sim.studies.sampling import AGAIN, ALL, Design
from sim.studies.states import correlated, share_of
from sim.studies.store import Results
from sim.studies.studyfile import Cause, Study

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
    shares = np.stack([correlated(row, root) for row in rows])
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


def joined(runs: StudyRuns, rendered: StudyRuns) -> StudyRuns:
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
