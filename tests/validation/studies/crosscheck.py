"""Single errors of the paper's rig: against a trial by another program, and tier against tier."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from lscan.records import Floats
from sim.studies.problem import AFTER, NOMINAL, columns
from sim.studies.rig.evaluation import GeometricRig, RenderedRig
from sim.studies.rig.prepared import prepare
from sim.studies.studyfile import Looked, Study, load_study
from tests.validation.rows import Row, row

HEIGHT = "height"
NOISE, SPECKLE = "noise", "speckle"
SEEDS = 32  # of what is drawn: its mean square scatters by a few per cent
TRIAL_MM = {
    NOISE: 0.037,
    SPECKLE: 0.074,
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
"""Rms of the height with noise, then speckle, then one error beside both, as a trial of 101 lines
found it on rendered pictures of this rig before there were studies."""
STAYS = {"shake": "camera", "pointing": "sheet"}
"""Of what is new in each picture: the same number off in all of them alike."""
DRAWN = 0.3  # quantile of the rig whose pictures are rendered: it chooses their draws
RECALIBRATED = ("water", "sheet", "window")


def cross_check_rows(scenes: Path, places: Looked, seeds: int = SEEDS) -> list[Row]:
    """Of each error of ``studies/cross-check.toml``: how far its rms is off the trial's.

    What is new in each picture is also held against what the trial's own figure of the same number
    off in all pictures alike asks for, and against rendered pictures with the same draws.

    Parameters
    ----------
    scenes : Path, folder of the scenes that come with lscan
    places : Looked, of the scan
    seeds : int, rigs of each
    """
    study = as_in_the_trial(looked_at(load_study(scenes / "studies" / "cross-check.toml"), places))
    known = prepare(study)
    rig, rendered = GeometricRig(study, known), RenderedRig(study, known)
    found = {cause: rms_with(rig, at_work_with(cause), HEIGHT, seeds) for cause in TRIAL_MM}
    rows = [_single_row(study, cause, mm) for cause, mm in found.items()]
    for cause in STAYS:
        rows += [_implied_row(study, cause, found[cause]), _each_frame_row(rig, rendered, cause)]
    return rows


def at_work_with(cause: str) -> list[str]:
    """The causes at work where the trial looked at one of them.

    Parameters
    ----------
    cause : str

    Examples
    --------
    >>> at_work_with("noise"), at_work_with("shake")
    (['noise'], ['noise', 'speckle', 'shake'])
    """
    return [NOISE] if cause == NOISE else list(dict.fromkeys([NOISE, SPECKLE, cause]))


def as_in_the_trial(study: Study) -> Study:
    """The study with the light that scans had at the trial's time, and read from single pictures.

    Sandwaves were scanned in light of the first order then.  What the sheet's thickness moves the
    line by is corrected for in whole surfaces only, so that it stays in pictures looked at singly;
    that the trial's were is what its figures with and without speckle say: explanation/budget.

    Parameters
    ----------
    study : Study
    """
    scan = study.scan.with_tank(render={"scatter_samples": 0})
    bare = replace(scan, rig=scan.rig.model_copy(update={"sheet": None}))
    return replace(study, scan=bare)


def implied_mm(study: Study, cause: str) -> float:
    """Rms of the height, mm, that the trial's other figures ask for.

    What is new in each picture moves the heights of this picture as the same number does where it
    is off in all pictures alike: so its mean square is that of the other times the ratio of the
    variance to the other's square, and noise adds its own.

    Parameters
    ----------
    study : Study
    cause : str, new in each picture
    """
    drawn, still = (study.file.cause[name] for name in (cause, STAYS[cause]))
    assert drawn.normal is not None
    assert still.fixed is not None
    base, other = TRIAL_MM[SPECKLE], TRIAL_MM[STAYS[cause]]
    alone = np.sqrt(other**2 - base**2) * drawn.normal[1] / still.fixed
    return float(np.hypot(base, alone))


def _single_row(study: Study, cause: str, found: float) -> Row:
    """How far the error is off the trial's, and what its others say of it."""
    trial, why = TRIAL_MM[cause], ""
    if cause in STAYS:
        expected, base = implied_mm(study, cause), TRIAL_MM[SPECKLE]
        times = np.sqrt((trial**2 - base**2) / (expected**2 - base**2))
        why = (
            f"; its noise and its figure of {STAYS[cause]}, the same number off in all pictures, "
            f"ask for {expected:.3f} mm: what it drew was {times:.2f} times as large as stated"
        )
    what = ", ".join(at_work_with(cause))
    off = 100 * abs(found / trial - 1)
    return row("study-cross-check", off, seed=0, what=what, trial=trial, found=found, why=why)


def _implied_row(study: Study, cause: str, found: float) -> Row:
    """How far what is new in each picture is off what the trial's other figures ask for."""
    expected, key = implied_mm(study, cause), "study-cross-check-implied"
    off = 100 * abs(found / expected - 1)
    still = STAYS[cause]
    return row(key, off, seed=0, what=cause, still=still, expected=expected, found=found)


def _each_frame_row(rig: GeometricRig, rendered: RenderedRig, cause: str) -> Row:
    """One rig with what is new in each picture alone, by both tiers with the same draws."""
    one = np.full(len(rig.causes), NOMINAL)
    one[rig.causes.index(cause)] = DRAWN
    part = columns(rig.outputs)[HEIGHT]
    true, found = (float(np.sqrt(np.mean(r.evaluate(one)[part] ** 2))) for r in (rig, rendered))
    off = 100 * abs(found / true - 1)
    return row("study-cross-check-tiers", off, what=cause, geometric=true, rendered=found)


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
