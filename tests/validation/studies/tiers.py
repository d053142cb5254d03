"""Causes alone in both tiers, of the same rigs: how far the geometric figures are off."""

from pathlib import Path

from lscan.records import Floats
from sim.studies.problem import BASE, SETS, alone, columns, make_design
from sim.studies.results import evaluate_rows, identity_of
from sim.studies.rig.prepared import Prepared, prepare
from sim.studies.running import RigSource
from sim.studies.studyfile import Study, Tier, load_study
from sim.studies.tiers import alone_squares, beginnings, large_causes, pad_rows, paired_bounds
from tests.validation.rows import Row, row

RIGS = 4  # of a cause alone, rendered: some 20 s each
OUTPUT = "height"


def tier_rows(file: Path, rigs: int = RIGS, prepared: Prepared | None = None) -> list[Row]:
    """Of each cause that makes 2 % of the mean square or more: its rms alone, tier against tier.

    Parameters
    ----------
    file : Path, of a study
    rigs : int, of each cause alone, that are rendered, SETS at most
    prepared : Prepared, optional, of this study, where it is known already
    """
    study = load_study(file)
    packed = (prepared or prepare(study)).packed()
    design = make_design(study.causes, 0, SETS, study.file.seed, study.groups)
    geometric = _errors(study, "geometric", packed, design.rows)
    large = large_causes(alone_squares(design, geometric))
    part = beginnings(design, {BASE: 1} | {alone(group): rigs for group in large})
    rendered = pad_rows(design, part, _errors(study, "rendered", packed, part.rows))
    cheap, dear = design.split(geometric), design.split(rendered)
    rows, beyond = [], 0
    for group in large:
        of_one, of_other, off = paired_bounds(cheap[alone(group)], dear[alone(group)])
        beyond += not off.low <= 0 <= off.high
        words = {"geometric": of_one.value, "rendered": of_other.value, "rigs": rigs}
        words |= {"low": off.low, "high": off.high}
        figure = 100 * abs(off.value) / of_one.value
        rows.append(row("tier-contribution", figure, seed=study.file.seed, what=group, **words))
    words = {"beyond": beyond, "causes": len(large), "rigs": rigs}
    return [*rows, row("tier-beyond", beyond, seed=study.file.seed, **words)]


def _errors(study: Study, tier: Tier, packed: bytes, rows: Floats) -> Floats:
    """(N, P) errors of the height in a tier; NaN where a run failed."""
    documents = study.document, study.calibrate.document, study.scan.document
    source = RigSource(tier, *documents, packed, study.source)
    identity = identity_of(source)
    values = evaluate_rows(source, identity.sha256, rows).results.values
    return values[:, columns(identity.outputs)[OUTPUT]]
