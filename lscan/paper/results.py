"""What an experiment leaves on disk: results.json, the report, the calibrations, the surface."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

from lscan.calibration.calibrationfile import save_calibration
from lscan.files.disk import make_folder, write_json
from lscan.measurement import lengths_json
from lscan.paper.experiment import Experiment
from lscan.paper.provenance import chain_versions
from lscan.paper.report import write_report
from lscan.surface import save_points, save_surface


def results_json(experiment: Experiment) -> dict[str, Any]:
    """What results.json holds.

    ``pictures``: each run's camera driver, and of the tank's the noise seed.  ``chain``: what
    turned them into the lengths that follow.  ``best``: the same of the best chain, with its own
    ``chain``, ``distances``, ``diameters``, ``groove`` and ``sandwave``, or, where it could not
    be followed, the reason as ``refused``.  ``render_check`` and the true yaw: where a tank
    knows the truth.

    Parameters
    ----------
    experiment : Experiment, lengths in mm
    """
    best, truth = experiment.best, experiment.truth
    points = asdict(experiment.control_points)
    true_yaw_deg = truth.yaw_deg if truth else None
    return {
        **({} if experiment.quick is None else {"quick": experiment.quick}),
        "scene": experiment.scene,
        "versions": chain_versions(experiment),
        "seconds": {name: round(value, 2) for name, value in experiment.seconds.items()},
        "pictures": {part: source.as_json() for part, source in experiment.sources.items()},
        "control_points": {name: value for name, value in points.items() if value is not None},
        **_chain_json(experiment, true_yaw_deg),
        "best": _chain_json(best, true_yaw_deg) if best else {"refused": experiment.best_refused},
        **({"render_check": asdict(truth.render_check)} if truth else {}),
    }


def _chain_json(experiment: Experiment, true_yaw_deg: float | None) -> dict[str, Any]:
    """What one chain measured."""
    boards = experiment.board.measures
    content: dict[str, Any] = {
        "chain": asdict(experiment.chain),
        "distances": {name: lengths_json(board.distances) for name, board in boards.items()},
        "diameters": {name: lengths_json(board.diameters) for name, board in boards.items()},
    }
    if experiment.groove:
        content |= experiment.groove.as_json()
    if experiment.sandwave:
        content |= experiment.sandwave.as_json()
        if true_yaw_deg is not None:
            content["sandwave"]["yaw_deg"]["true"] = true_yaw_deg
    return content


def write_experiment(folder: Path, experiment: Experiment) -> None:
    """Write results.json, report.html, the calibrations and the surface.

    Parameters
    ----------
    folder : Path, made where it is missing; files of an earlier report in it are replaced
    experiment : Experiment, lengths in mm

    Raises
    ------
    InputError
        Where the disk refuses.
    """
    make_folder(folder)
    best = experiment.best.board.calibrations if experiment.best else {}
    for name, calibration in {**experiment.board.calibrations, **best}.items():
        save_calibration(folder / f"calibration-{name}.json", calibration)
    if experiment.sandwave:
        save_surface(folder / "sandwave.nc", experiment.sandwave.aligned)
        save_points(folder / "sandwave.ply", experiment.sandwave.aligned)
    write_json(folder / "results.json", results_json(experiment))
    write_report(folder / "report.html", experiment)
