"""The same rig with other numbers, and how the errors of both compare on the same draws."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lscan.config.documents import Document, check, merge
from lscan.config.rig import parse_rig
from lscan.errors import InputError
from lscan.records import Floats
from sim.scene import SECTIONS, Scene, scene_of
from sim.scene.file import TankSections
from sim.scene.varying import CAMERA, number_at
from sim.studies.budget import OutputComparison, PartChange, RigComparison
from sim.studies.design.rig import stated_of_light, true_optics
from sim.studies.design.search import changed_keys
from sim.studies.page import figure, share
from sim.studies.problem import (
    Bounded,
    Design,
    Output,
    both_draws,
    columns,
    index_pseudo_values,
    interval,
    moment_pseudo_values,
)
from sim.studies.rig.states import CALIBRATE, SCAN, apply_numbers
from sim.studies.studyfile import Study, study_of

# The other rig: the study's own with other numbers, its instrument told of them.


AGAINST = "--against"
STATED = ("optics", "stripe", "sheet")
"""Sections of a rig's file that state what the rig is made of."""


def other_rig(study: Study, numbers: Mapping[str, float]) -> Study:
    """The study of a rig some of whose numbers are others.

    What the rig file states of them in [optics], [stripe] and [sheet] follows: whoever builds that
    rig knows what it is made of.

    Parameters
    ----------
    study : Study
    numbers : mapping, from dotted keys of the scenes to numbers in the keys' units; with
        ``calibrate.`` or ``scan.`` before it a key is changed in that scene alone, else in both

    Raises
    ------
    InputError
        No number has that key, one is out of its range, a cause sets it, or nothing changes.

    Examples
    --------
    >>> from sim.studies.studyfile import load_study
    >>> other = other_rig(load_study("seasons"), {"port.gap_mm": 15.0})
    >>> other.scan.tank.port.gap_mm, other.scan.rig.optics.gap_mm  # of 10 mm, by ruler 11
    (15.0, (16.0, 3.0))
    """
    for key in numbers:
        _require_free(study, key)
    board = _with_numbers(study.calibrate, numbers, CALIBRATE)
    scan = _with_numbers(study.scan, numbers, SCAN)
    old, new = (
        [(scene.tank, scene.rig.camera) for scene in scenes]
        for scenes in ((study.calibrate, study.scan), (board, scan))
    )
    if new == old:
        what, allowed = "changes nothing", "a number that the rig does not have already"
        raise InputError(what, where=AGAINST, value=dict(numbers), allowed=allowed)
    return study_of(study.document, study.source, (board, scan))


def changes_of(study: Study, other: Study, keys: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Of each key the number of a study's rig and of the other one; where two scenes, the scan's.

    Parameters
    ----------
    study, other : Study, this one and that of ``other_rig``
    keys : sequence of str, that were changed
    """

    def number(of: Study, key: str) -> float:
        scope, bare = _scope(key)
        return number_at(of.calibrate if scope == CALIBRATE else of.scan, bare)

    return {key: (number(study, key), number(other, key)) for key in keys}


def restated_of(study: Study, other: Study) -> tuple[str, ...]:
    """What the other rig's file of the scan states otherwise, as ``optics.gap_mm = 16, 3``.

    Parameters
    ----------
    study, other : Study, this one and that of ``other_rig``
    """
    changed = changed_keys(other.scan.document, study.scan.document)
    return tuple(_assignments({key: changed[key] for key in STATED if key in changed}))


def _assignments(table: Document, within: str = "") -> Iterator[str]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _assignments(value, f"{within}{key}.")
        else:
            numbers = value if isinstance(value, list) else [value]
            yield f"{within}{key} = {', '.join(f'{number:.6g}' for number in numbers)}"


def _require_free(study: Study, key: str) -> None:
    """InputError where a cause sets the number whole, whatever the scene says it is.

    What a cause adds to the scene's number, or takes a share of, is about the new number then.
    """
    scope, bare = _scope(key)
    for name, cause in study.file.cause.items():
        if cause.when in ("each-frame", "noise"):
            continue
        for own in (*cause.together, *([] if cause.off or cause.relative else [cause.key])):
            other_scope, other = _scope(own)
            if other == bare and (scope == other_scope or "" in (scope, other_scope)):
                raise InputError(
                    f"is set by [cause.{name}], whatever it is in the scene",
                    where=AGAINST,
                    value=key,
                    allowed="a key that no cause sets, or one of a cause with off or relative",
                )


def _scope(key: str) -> tuple[str, str]:
    """The scene that a key is meant for, "" where both, and the key itself."""
    scope = next((one for one in (CALIBRATE, SCAN) if key.startswith(one)), "")
    return scope, key.removeprefix(scope)


def _with_numbers(scene: Scene, numbers: Mapping[str, float], own: str) -> Scene:
    """The scene with the numbers that are meant for it, in its document too."""
    changed = apply_numbers(scene, numbers, own, AGAINST)
    document = scene.document
    for key in numbers:
        scope, bare = _scope(key)
        if scope in ("", own):
            section, field = bare.split(".")[:2]
            model = changed.rig.camera if section == CAMERA else getattr(changed.tank, section)
            value = getattr(model, field)
            value = list(value) if isinstance(value, tuple) else value
            document = merge(document, {section: {field: value}})
    document = merge(document, _restated(scene.document, document))
    return scene_of(parse_rig(document, source=scene.source, trusted=True))


def _restated(before: Document, after: Document) -> Document:
    """What a rig's file states of its parts, where these have changed: [optics] by as much."""
    stated = before.get("optics", {})
    was, now = (
        true_optics(check(TankSections, {k: one[k] for k in one if k in SECTIONS}, AGAINST))
        for one in (before, after)
    )
    steps = {key: now[key] - was[key] for key in stated if key in now and now[key] != was[key]}
    optics = {
        key: [stated[key][0] + step, stated[key][1]] if isinstance(stated[key], list)
        else stated[key] + step
        for key, step in steps.items()
    }  # fmt: skip
    light = changed_keys(stated_of_light(after), stated_of_light(before))
    return {**light, "optics": optics} if optics else light


# Two rigs on the same draws.
#
# The rows of a study's design stand for the same draws of its causes, and the same seeds of noise,
# whatever the rig: what the draws do to both goes out of ratios and differences (common random
# numbers).  Their intervals are those of a study's indices, the jackknife over the design's
# independent sets of points, applied to the ratio or difference itself.  A pair in which either rig
# failed is left out.
#
# References
# ----------
# Glasserman & Yao 1992, Management Science 38, 884: common random numbers.


SAME, INTERACTION = "the mean error", "interaction"
"""Parts of a mean square that are no cause's own: of the mean error, and of what is left."""
ROUNDING = 1e-9  # of a spread: a smaller one is of numbers that are the same


@dataclass(frozen=True)
class RigRuns:
    """Results of the R rows of a design by one rig.

    Attributes
    ----------
    outputs : tuple of Output, whose sizes sum up to K
    values : (R, K) array, NaN where a run failed
    rendered : (R, K) array, in the tier that counts, NaN where there are none; None of one tier
    """

    outputs: tuple[Output, ...]
    values: Floats
    rendered: Floats | None = None


def compare_rigs(
    design: Design,
    this: RigRuns,
    other: RigRuns,
    changes: Mapping[str, tuple[float, float]],
    told: Sequence[str] = (),
    folder: str = "",
) -> RigComparison:
    """Two rigs compared, output by output.

    Parameters
    ----------
    design : Design
    this, other : RigRuns, of its rows; a field's places may be others, and as many or not
    changes, told, folder : as in ``RigComparison``
    """
    draws = (both_draws([design.split(runs.values)])[0] for runs in (this, other))
    first, second = (np.isfinite(values).all(axis=1) for values in draws)
    return RigComparison(
        changes=changes,
        told=tuple(told),
        folder=folder,
        rigs=int(np.sum(first & second)),
        failed=(int(np.sum(~first)), int(np.sum(~second))),
        outputs=tuple(
            _compare(design, output, *_pairs(design, this, other, output.name))
            for output in this.outputs
        ),
    )


Tiers = list[dict[str, Floats]]
"""Of each tier an output's results block by block."""


def _pairs(design: Design, this: RigRuns, other: RigRuns, name: str) -> tuple[Tiers, Tiers]:
    """An output of both rigs, NaN in both where either has none."""
    mine: Tiers = []
    theirs: Tiers = []
    for a, b in ((this.values, other.values), (this.rendered, other.rendered)):
        if a is not None and b is not None:
            pair = a[:, columns(this.outputs)[name]], b[:, columns(other.outputs)[name]]
            both = np.isfinite(np.hstack(pair)).all(axis=1, keepdims=True)
            kept = (np.where(both, one, np.nan) for one in pair)
            for tiers, values in zip((mine, theirs), kept, strict=True):
                tiers.append(design.split(values))
    return mine, theirs


def _compare(design: Design, output: Output, mine: Tiers, theirs: Tiers) -> OutputComparison:
    this, other = (moment_pseudo_values(*both_draws(tiers)) for tiers in (mine, theirs))
    off = other["log_rms"] - this["log_rms"]
    paired, apart = (
        np.nanstd(off),
        np.hypot(np.nanstd(this["log_rms"]), np.nanstd(other["log_rms"])),
    )
    log = interval(off)
    ratio = Bounded(*(float(np.exp(end)) for end in (log.value, log.low, log.high))).known
    difference = interval(other["rms"] - this["rms"]).known
    parts = _part_changes(design, mine, theirs)
    return OutputComparison(
        name=output.name,
        unit=output.unit,
        places=output.size,
        this=interval(this["rms"], True).known,
        other=interval(other["rms"], True).known,
        ratio=ratio,
        difference=difference,
        narrower=float(apart / paired) if paired > ROUNDING * apart else None,
        verdict=verdict(ratio, difference, parts),
        parts=parts,
    )


def _part_changes(design: Design, mine: Tiers, theirs: Tiers) -> tuple[PartChange, ...]:
    this, other = (mean_square_parts(design, tiers) for tiers in (mine, theirs))
    changes = [
        PartChange(
            part,
            interval(this[part]).known,
            interval(other[part]).known,
            interval(other[part] - this[part]).known,
        )
        for part in this
    ]
    return tuple(
        sorted(changes, key=lambda one: -abs(one.difference.value) if one.difference else 0)
    )


def mean_square_parts(design: Design, tiers: Sequence[Mapping[str, Floats]]) -> dict[str, Floats]:
    """(SETS,) pseudo-values of what an output's mean square is the sum of, by name.

    Those of each group: its first-order index times the variance; of the mean error, ``SAME``; and
    of what is left, ``INTERACTION``.

    Parameters
    ----------
    design : Design
    tiers : sequence of mapping, of each tier the output's (N, P) results block by block, the tier
        that counts last
    """
    moments = moment_pseudo_values(*both_draws(tiers))
    variance = moments["variance"]

    def of(index: Floats) -> Floats:
        """Pseudo-values of a product: to first order, as the jackknife is."""
        if not np.nanmax(variance) > 0:  # nothing varies, and indices there are none
            return np.zeros_like(variance)
        middle = np.nanmean(index)
        return np.asarray(middle * variance + (index - middle) * np.nanmean(variance))

    firsts = {group: first for group, (first, *_) in index_pseudo_values(design, tiers).items()}
    return {
        SAME: moments["systematic"],
        **{group: of(first) for group, first in firsts.items()},
        INTERACTION: of(1 - np.sum(list(firsts.values()), axis=0)),
    }


def verdict(
    ratio: Bounded | None, difference: Bounded | None, parts: Sequence[PartChange] = ()
) -> str:
    """Which of two rigs is better, by how much and through what, in words.

    Parameters
    ----------
    ratio, difference : Bounded, of the other rig's rms error to this one's; ratio None where this
        one has no error
    parts : sequence of PartChange, the largest change first

    Examples
    --------
    >>> verdict(Bounded(0.41, 0.39, 0.43), Bounded(-0.3, -0.32, -0.28))
    'the other rig is better: its rms error is 0.41 ± 0.02 of this one’s'
    >>> verdict(Bounded(1.004, 0.98, 1.03), Bounded(0.002, -0.01, 0.014))
    'no difference seen: less than 3.0\\xa0%'
    """
    if difference is None:
        return "not compared: too few rigs were measured with both"
    if ratio is None:
        return "no difference" if difference.value == 0 else "compared with a rig that has no error"
    if ratio.low == ratio.high == 1:
        return "no difference at all"
    if ratio.low <= 1 <= ratio.high:
        return f"no difference seen: less than {share(max(ratio.high - 1, 1 - ratio.low))}"
    times = f"{figure(ratio.value)} ± {ratio.half_width:.1g}"
    better = ratio.high < 1
    words = f"the other rig is {'better' if better else 'worse'}: its rms error is {times} "
    words += "of this one’s" if better else "times this one’s"
    seen = [
        one
        for one in parts
        if one.difference and (one.difference.high < 0 if better else one.difference.low > 0)
    ]
    return f"{words}; through {seen[0].part} above all" if seen else words
