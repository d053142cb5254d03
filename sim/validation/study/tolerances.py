"""Whether rigs within the tolerances that a study finds keep their bound."""

from pathlib import Path

from lscan.errors import MeasurementError
from sim.studies.run.running import StudyOptions
from sim.studies.study import run_study
from sim.studies.tiers import RIGS
from sim.validation.accuracy.intervals import band_miss_percent
from sim.validation.rows import Row, row


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
