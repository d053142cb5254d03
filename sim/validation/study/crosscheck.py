"""Single errors of the paper's rig: against a trial by another program, and tier against tier."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from lscan.records import Floats
from sim.studies.geometric import GeometricRig
from sim.studies.prepared import prepare
from sim.studies.problem import AFTER, NOMINAL, columns
from sim.studies.rendered import RenderedRig
from sim.studies.studyfile import Looked, Study, load_study
from sim.validation.rows import Row, row

HEIGHT = "height"
NOISES = ("noise", "speckle")
SEEDS = 32  # of what is drawn: its mean square scatters by a few per cent
TRIAL_MM = {
    "": 0.074,
    "board-off": 0.73,
    "board-lean": 2.09,
    "port-after": 5.8,
    "port-before": 0.074,
    "salinity": 0.65,
    "sheet": 0.73,
    "focal": 0.155,
    "camera": 1.15,
    "shake": 0.34,
    "pointing": 0.215,
    "screw": 0.076,
}
"""Rms of the height, noise and speckle at work beside each, as a trial of 101 lines found it on
rendered pictures of this rig before there were studies."""
RECALIBRATED = ("water", "sheet", "window")


def cross_check_rows(scenes: Path, places: Looked, seeds: int = SEEDS) -> list[Row]:
    """Of each error of ``studies/cross-check.toml``: how far its rms is off the trial's.

    Parameters
    ----------
    scenes : Path, folder of the scenes that come with lscan
    places : Looked, of the scan
    seeds : int, rigs of each
    """
    study = looked_at(load_study(scenes / "studies" / "cross-check.toml"), places)
    rig = GeometricRig(study, prepare(study))
    return [
        row(
            "study-cross-check",
            100 * abs(found / trial - 1),
            what=cause or "noise and speckle alone",
            trial=trial,
            found=found,
            seed=0,
        )
        for cause, trial in TRIAL_MM.items()
        for found in [rms_with(rig, [*NOISES, *([cause] if cause else [])], HEIGHT, seeds)]
    ]


def recalibration_rows(scenes: Path, places: Looked) -> list[Row]:
    """What calibrating anew takes away, by both tiers, without noise.

    Of ``studies/recalibration.toml``: the water 5 degrees warmer, the sheet shifted by 1 mm, the
    window tilted by half a degree, each beside a board that leans and stays.

    Parameters
    ----------
    scenes : Path, folder of the scenes that come with lscan
    places : Looked, of the scan
    """
    study = looked_at(load_study(scenes / "studies" / "recalibration.toml"), places)
    known = prepare(study)
    tiers = GeometricRig(study, known), RenderedRig(study, known)
    stays = rms_with(tiers[0], ["board"], HEIGHT, 1)
    rows = []
    for cause in RECALIBRATED:
        geometric, rendered = (_before_and_after(rig, ["board", cause]) for rig in tiers)
        words = {"cause": cause, "before": rendered[0], "after": rendered[1], "stays": stays}
        off = 100 * np.abs(rendered / geometric - 1).max()
        rows.append(row("study-recalibration-tiers", float(off), **words))
        rows.append(row("study-recalibration", float(100 * abs(rendered[1] / stays - 1)), **words))
    return rows


def looked_at(study: Study, places: Looked) -> Study:
    """The study with other places of its scan looked at.

    Parameters
    ----------
    study : Study
    places : Looked
    """
    return replace(study, file=study.file.model_copy(update={"places": places}))


def rms_with(rig: GeometricRig, at_work: list[str], output: str, seeds: int) -> float:
    """Rms of an output over rigs with some of the causes at work, mm.

    Parameters
    ----------
    rig : GeometricRig
    at_work : list of str, causes
    output : str
    seeds : int, rigs
    """
    part = columns(rig.outputs)[output]
    columns_of = [rig.causes.index(cause) for cause in at_work]
    numbers = np.random.default_rng(0).random((seeds, len(rig.causes)))
    rows = np.full(numbers.shape, NOMINAL)
    rows[:, columns_of] = numbers[:, columns_of]
    return float(np.sqrt(np.mean([rig.evaluate(one)[part] ** 2 for one in rows])))


def _before_and_after(rig: GeometricRig, at_work: list[str]) -> Floats:
    """(2,) rms of the height before and after recalibration, mm."""
    one = np.full(len(rig.causes), NOMINAL)
    one[[rig.causes.index(cause) for cause in at_work]] = 0.5
    errors, parts = rig.evaluate(one), columns(rig.outputs)
    found = (errors[parts[name]] for name in (HEIGHT, HEIGHT + AFTER))
    return np.array([np.sqrt(np.mean(values**2)) for values in found])
