"""Whether the rigs that a design search finds err, when rendered, as it predicts."""

from pathlib import Path

from lscan.errors import MeasurementError
from sim.studies.design.run import RIGS
from sim.studies.run.running import StudyOptions
from sim.studies.study import run_study
from sim.validation.rows import Row, row


def design_rows(scenes: Path, folder: Path, options: StudyOptions | None = None) -> list[Row]:
    """How far the rendered error of each rendered design is off the predicted one, percent.

    Parameters
    ----------
    scenes : Path, folder of the scenes that come with lscan; ``studies/first-rig.toml``
    folder : Path, of the study's runs
    options : StudyOptions, optional

    Raises
    ------
    MeasurementError
        No design was rendered.
    """
    results = run_study(scenes / "studies" / "first-rig.toml", folder, options)
    rows = [
        row(
            "design-error",
            100 * abs(trial.rendered_mm.value / trial.predicted_mm - 1),
            seed=results.seed,
            trials=len(results.trials),
            predicted=trial.predicted_mm,
            value=trial.rendered_mm.value,
            low=trial.rendered_mm.low,
            high=trial.rendered_mm.high,
            rigs=RIGS,
            design=number,
        )
        for number, trial in enumerate(results.trials, start=1)
        if trial.rendered_mm is not None and trial.predicted_mm
    ]
    if not rows:
        raise MeasurementError("no design was rendered")
    return rows
