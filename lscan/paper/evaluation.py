"""The paper's experiment evaluated twice from the same pictures: by its chain and by the best."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from lscan.acquisition.run import Run
from lscan.config.rig import Rig
from lscan.errors import InputError, LscanError
from lscan.measurement import measure_groove, measure_sandwave
from lscan.paper.experiment import (
    METHODS,
    PICTURES_SHOWN,
    Chain,
    Experiment,
    LinePictures,
    measure_board,
)
from lscan.paper.provenance import picture_source
from lscan.paper.published import CHOSEN_MAP
from lscan.pipeline import require_size
from lscan.records import Progress
from lscan.stripe import extract_stripe

BEST_MAP, BEST_EXTRACTOR = "refractive", "ml"


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
    board, groove, sandwave : Run, scans of the three pieces; the last two may be missing
    progress : callable, optional, called with the number of the sandwave's pictures that are read,
        and of all, by both chains
    best : mapping of str to Rig, optional, "board", "groove" and "sandwave" to rigs that say how
        the best chain reads the pictures: their ``[calibration]``, ``[optics]``, ``[stripe]`` and
        ``[sheet]`` count.  By default the runs' own rigs with the map ``refractive`` and the
        extractor ``ml``; that map wants the section ``[optics]``.

    Raises
    ------
    LscanError
        What the measurements by the paper's chain raise: InputError, BoardNotFound,
        MeasurementError.  An error of the best chain is kept in ``best_refused``.

    References
    ----------
    Sec. IV of the paper.
    """
    parts = {"board": board, "groove": groove, "sandwave": sandwave}
    runs = {part: run for part, run in parts.items() if run is not None}
    experiment = replace(
        _measure(runs, METHODS, CHOSEN_MAP, _half(progress, 0)),
        sources={part: picture_source(run) for part, run in runs.items()},
        shown=_line_pictures(groove, sandwave),
    )
    try:
        better = _best_runs(runs, best)
        plane_map = better["board"].rig_file.rig.calibration.plane_map
        measured = _measure(better, (plane_map,), plane_map, _half(progress, 1))
    except LscanError as error:
        return replace(experiment, best_refused=str(error))
    return replace(experiment, best=measured)


def _measure(
    runs: Mapping[str, Run], methods: Sequence[str], chosen: str, progress: Progress | None
) -> Experiment:
    """The experiment with all ``methods`` on the board, and ``chosen`` among them for the rest."""
    board = measure_board(runs["board"], methods)
    others = {part: run for part, run in runs.items() if part != "board"}
    for run in others.values():
        size_px = board.reading.image_size
        require_size(run.rig_file.rig.camera, size_px, f"from {runs['board'].path}", run.path)
    plane_map = board.calibrations[chosen].plane_map
    groove, sandwave = others.get("groove"), others.get("sandwave")
    return Experiment(
        scene=runs[max(runs)].rig_file.rig.name,  # the sandwave's, else the groove's
        chain=_chain(chosen, [run.rig_file.rig for run in others.values()]),
        board=board,
        groove=None if groove is None else measure_groove(groove, plane_map),
        sandwave=None if sandwave is None else measure_sandwave(sandwave, plane_map, progress),
    )


def _line_pictures(groove: Run | None, sandwave: Run | None) -> dict[str, LinePictures]:
    """The first picture of the groove, and of the sandwave some from the middle of its scan."""
    shown = {}
    if groove is not None:
        shown["groove"] = _pictures(groove, range(1))
    if sandwave is not None:
        first = max(0, (len(sandwave) - PICTURES_SHOWN) // 2)
        last = min(len(sandwave), first + PICTURES_SHOWN)
        shown["sandwave"] = _pictures(sandwave, range(first, last))
    return shown


def _pictures(run: Run, indices: Sequence[int]) -> LinePictures:
    frames = [run.frame(index) for index in indices]
    stripe = extract_stripe(frames[0].image, run.rig_file.rig.stripe, frames[0].background)
    return LinePictures([frame.image for frame in frames], stripe)


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
