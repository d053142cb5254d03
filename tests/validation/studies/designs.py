"""Whether the rigs that a design search finds err, when rendered, as it predicts."""

from pathlib import Path

from lscan.errors import MeasurementError
from sim.studies.design.run import RIGS as DESIGN_RIGS
from sim.studies.running import StudyOptions
from sim.studies.study import run_study
from sim.studies.tiers import RIGS
from tests.validation.exposures import band_miss_percent
from tests.validation.rows import Row, row


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
            rigs=DESIGN_RIGS,
            design=number,
        )
        for number, trial in enumerate(results.trials, start=1)
        if trial.rendered_mm is not None and trial.predicted_mm
    ]
    if not rows:
        raise MeasurementError("no design was rendered")
    return rows


# Whether rigs within the tolerances that a study finds keep their bound.


def tolerance_rows(scenes: Path, folder: Path, options: StudyOptions | None = None) -> list[Row]:
    """How far the share of fresh rigs within 0.1 mm is off the yield asked for, 95 %.

    Parameters
    ----------
    scenes : Path, folder of the scenes that come with lscan; ``studies/tolerances.toml``
    folder : Path, of the study's runs
    options : StudyOptions, optional

    Raises
    ------
    MeasurementError
        The study found no tolerances.
    """
    results = run_study(scenes / "studies" / "tolerances.toml", folder, options)
    found = results.tolerances
    if found is None or found.found is None:
        raise MeasurementError(found.note if found else "no tolerances were asked for")
    kept = found.found
    factors = {cause.factor for cause in found.causes if cause.factor is not None}
    return [
        row(
            "tolerance-yield",
            band_miss_percent(kept.value),
            seed=results.seed,
            rigs=RIGS,
            fresh=found.fresh,
            percent=100 * kept.value,
            low=100 * kept.low,
            high=100 * kept.high,
            factor=max(factors),
        )
    ]
