"""The paper's experiment evaluated twice from the same pictures: by its chain and by the best."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from lscan.acquisition.provenance import PictureSource, picture_source
from lscan.acquisition.run import Run
from lscan.config.rig import Rig
from lscan.errors import InputError, LscanError
from lscan.paper.experiment import (
    METHODS,
    BoardResult,
    GrooveResult,
    SandwaveResult,
    measure_board,
    measure_groove,
    measure_sandwave,
    require_size,
)
from lscan.paper.published import CHOSEN_MAP
from lscan.records import Progress

BEST_MAP, BEST_EXTRACTOR = "refractive", "ml"


@dataclass(frozen=True)
class Chain:
    """What turned pictures into lengths.

    extractors: how the line was found, in alphabetical order; more than one where the runs
        differ.  corrected_for: "blur", "sheet thickness", or neither.
    """

    plane_map: str
    extractors: tuple[str, ...] = ()
    corrected_for: tuple[str, ...] = ()


@dataclass(frozen=True)
class Experiment:
    """What the paper's experiment gave; groove and sandwave are None where not scanned.

    chain: how it was evaluated.  sources: of each run's pictures, "board" and so on.
    best: the same pictures by the best chain, None where that was not possible, and
    best_refused then says why.  seconds: wall time spent on each part, where known.
    """

    scene: str
    chain: Chain
    board: BoardResult
    groove: GrooveResult | None = None
    sandwave: SandwaveResult | None = None
    sources: Mapping[str, PictureSource] = field(default_factory=dict)
    best: Experiment | None = None
    best_refused: str = ""
    seconds: Mapping[str, float] = field(default_factory=dict)


def evaluate(
    board: Run,
    groove: Run | None = None,
    sandwave: Run | None = None,
    progress: Progress | None = None,
    best: Mapping[str, Rig] | None = None,
) -> Experiment:
    """All measurements of the experiment, by the paper's map and by the best chain.

    The maps are solved from the board's run.  Both chains read the same pictures.

    Parameters
    ----------
    progress
        Called with the pictures of the sandwave that were read and have to be, by both chains.
    best
        "board", "groove" and "sandwave" to rigs that say how the best chain reads the pictures:
        their ``[calibration]``, ``[optics]``, ``[stripe]`` and ``[sheet]`` count.  If None, the
        runs' own rigs with the map ``refractive`` and the extractor ``ml``; that map wants the
        section ``[optics]``.

    Raises
    ------
    LscanError
        What the measurements by the paper's chain raise: InputError, BoardNotFound,
        MeasurementError.  An error of the best chain is kept in ``best_refused``.
    """
    parts = {"board": board, "groove": groove, "sandwave": sandwave}
    runs = {part: run for part, run in parts.items() if run is not None}
    experiment = _measure(runs, METHODS, CHOSEN_MAP, _half(progress, 0))
    try:
        better = _best_runs(runs, best)
        plane_map = better["board"].rig_file.rig.calibration.plane_map
        return replace(
            experiment, best=_measure(better, (plane_map,), plane_map, _half(progress, 1))
        )
    except LscanError as error:
        return replace(experiment, best_refused=str(error))


def _measure(
    runs: Mapping[str, Run], methods: Sequence[str], chosen: str, progress: Progress | None
) -> Experiment:
    """The experiment with all ``methods`` on the board, and ``chosen`` among them for the rest."""
    board = measure_board(runs["board"], methods)
    others = {part: run for part, run in runs.items() if part != "board"}
    for run in others.values():
        require_size(run, board.reading.image_size, f"from {runs['board'].path}")
    plane_map = board.calibrations[chosen].plane_map
    groove, sandwave = others.get("groove"), others.get("sandwave")
    return Experiment(
        scene=(sandwave or groove or runs["board"]).rig_file.rig.name,
        chain=_chain(chosen, [run.rig_file.rig for run in others.values()]),
        board=board,
        groove=measure_groove(groove, plane_map) if groove else None,
        sandwave=measure_sandwave(sandwave, plane_map, progress) if sandwave else None,
        sources={part: picture_source(run) for part, run in runs.items()},
    )


def _chain(plane_map: str, rigs: Sequence[Rig]) -> Chain:
    corrections = {
        "blur": any(rig.stripe.blur_px is not None for rig in rigs),
        "sheet thickness": any(rig.sheet is not None for rig in rigs),
    }
    return Chain(
        plane_map,
        extractors=tuple(sorted({rig.stripe.extractor for rig in rigs})),
        corrected_for=tuple(name for name, made in corrections.items() if made),
    )


def _best_runs(runs: Mapping[str, Run], best: Mapping[str, Rig] | None) -> dict[str, Run]:
    """The runs with rigs that have them read by the best chain."""
    if best is None and "optics" not in runs["board"].rig_file.document:
        raise InputError(
            f"the rig file has no section [optics], which the map {BEST_MAP} starts from",
            where=runs["board"].path,
        )
    return {
        part: _read_as(run, _best_rig(run.rig_file.rig) if best is None else best[part])
        for part, run in runs.items()
    }


def _best_rig(rig: Rig) -> Rig:
    stripe = rig.stripe.model_copy(update={"extractor": BEST_EXTRACTOR})
    calibration = rig.calibration.model_copy(update={"plane_map": BEST_MAP})
    return rig.model_copy(update={"stripe": stripe, "calibration": calibration})


def _read_as(run: Run, like: Rig) -> Run:
    """The run, its pictures to be read as those of the rig ``like``."""
    sections = ("calibration", "optics", "stripe", "sheet")
    rig = run.rig_file.rig.model_copy(update={name: getattr(like, name) for name in sections})
    return replace(run, rig_file=replace(run.rig_file, rig=rig))


def _half(progress: Progress | None, before: int) -> Progress | None:
    """Progress of the first (before = 0) or second (1) of two passes over the same pictures."""
    if progress is None:
        return None
    return lambda done, total: progress(done + before * total, 2 * total)
