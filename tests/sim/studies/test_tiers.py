"""Two tiers: few runs of a dear problem and many of a cheap one, against closed forms."""

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from study_cases import known_of

import sim.studies.running as running_module
from lscan.errors import InputError, MeasurementError
from lscan.records import Floats
from sim.scene import load_scene
from sim.studies.problem import (
    AGAIN,
    ALL,
    BASE,
    NOMINAL,
    SETS,
    Design,
    Indices,
    Output,
    TermMeans,
    alone,
    columns,
    make_design,
    mixed_block,
    moments,
    set_sums,
    sobol_indices,
    term_means,
)
from sim.studies.results import load_results
from sim.studies.rig.evaluation import GeometricRig, RenderedRig
from sim.studies.rig.prepared import Prepared, prepare
from sim.studies.running import StudyOptions
from sim.studies.study import RENDERED_RUNS, run_study
from sim.studies.studyfile import Study, study_of
from sim.studies.tiers import large_causes, pad_rows, paired_bounds, rendered_design, tier_rows
from tests.validation.light.gallery import shrunk
from tests.validation.studies.coverage import (
    SLOPES,
    ClosedForm,
    ishigami,
    nearly_linear,
    two_tier_pairs,
)

PAIRS = dict(zip(("ishigami", "linear"), two_tier_pairs(), strict=True))


def both(
    cheap: ClosedForm, dear: ClosedForm, base: int = 256, most: int = 256, seed: int = 1
) -> tuple[Design, Floats, Floats]:
    """A design with its results in the cheap problem, and a part of them in the dear one."""
    design = make_design(cheap.causes, base, SETS, seed)
    part = rendered_design(design, dict.fromkeys(cheap.causes, 1.0), most)
    return design, cheap.evaluate(design.rows), pad_rows(design, part, dear.evaluate(part.rows))


def of(design: Design, values: Floats, rendered: Floats | None = None) -> Indices:
    (found,) = sobol_indices(design, values, (Output("error", "mm"),), rendered).values()
    return found


def test_a_dear_mean_is_that_of_the_cheap_tier_corrected_by_their_line() -> None:
    """Where the dear tier is a + b x exactly, the mean over all N is a + b mean(x), and nothing is
    left to scatter but x itself."""
    x = np.random.default_rng(1).standard_normal((64, 3))
    y = np.where(np.arange(64)[:, None] < SETS, 2 + 1.5 * x, np.nan)
    means = term_means(x, y)
    found = means.pseudo_values(lambda of: of[..., 0])
    assert found == pytest.approx(2 + 1.5 * x[:, 0].reshape(-1, SETS).mean(axis=0), abs=1e-12)
    assert means.used == SETS


def test_a_cheap_term_that_does_not_vary_is_corrected_by_the_difference() -> None:
    """There is no line then; the dear mean is that of its own samples."""
    y = np.random.default_rng(2).standard_normal((SETS, 1))
    means = term_means(np.full((SETS, 1), 3.0), y)
    assert means.pseudo_values(lambda of: of[..., 0]).mean() == pytest.approx(y.mean(), abs=1e-12)
    assert TermMeans(set_sums(np.ones((SETS, 2))), 1).used == SETS


def test_two_tiers_that_agree_are_one() -> None:
    problem = ishigami()
    design, values, rendered = both(problem, problem)
    one, two = of(design, values), of(design, values, rendered)
    for cause in problem.causes:
        for kind in ("first", "total"):
            single, double = (getattr(found.groups[cause], kind) for found in (one, two))
            assert vars(double) == pytest.approx(vars(single), abs=1e-9)
    assert two.moments.variance.value == pytest.approx(one.moments.variance.value, rel=1e-9)
    assert all(group.used == 3 * SETS for group in two.groups.values())


def test_control_variates_make_few_dear_runs_do() -> None:
    """Twelve causes, 256 dear runs at most, of tiers whose slopes differ by up to 5 %, and that
    differ by a curvature of 0.05 of 4.3 in all: nearly all studies know the three largest indices
    to 0.05, as is required.  Without the cheap tier none does."""
    cheap = nearly_linear(SLOPES)
    off = np.linspace(0.95, 1.05, len(SLOPES))
    dear = nearly_linear(tuple(np.multiply(SLOPES, off)), curvature=0.05, at=0.3)

    def widest(found: Indices) -> float:
        three = [found.groups[cause] for cause in ("x1", "x2", "x3")]
        return max(max(one.first.half_width, one.total.half_width) for one in three)

    widths = []
    for seed in range(10):
        design, values, rendered = both(cheap, dear, base=1024, seed=seed)
        assert np.isfinite(rendered).sum() <= 256
        widths.append((widest(of(design, values, rendered)), widest(of(design, rendered))))
    two, one = np.sort(widths, axis=0).T
    assert two[6] < 0.05 < one[0]


def test_a_field_has_the_moments_of_the_dear_tier() -> None:
    """Errors 0.5 + 1.2 z at every place, known as z in the cheap tier: exact but for z's mean."""
    z = np.random.default_rng(4).standard_normal((64 * SETS, 1)) @ np.ones((1, 5))
    dear = np.where(np.arange(len(z))[:, None] < 2 * SETS, 0.5 + 1.2 * z, np.nan)
    found = moments(z, dear)
    for bounded, truth in ((found.mean, 0.5), (found.systematic, 0.25), (found.variance, 1.44)):
        # As in test_indices: beyond 2.2 half-widths once in 3,500 times.
        assert abs(bounded.value - truth) < 2.2 * bounded.half_width
        assert bounded.half_width < 0.15


def test_what_is_rendered_is_the_beginning_of_each_block() -> None:
    design = make_design(tuple("abc"), 64, 32, seed=1)
    part = rendered_design(design, {"a": 1.0, "b": 0.01, "c": 0.5}, 1 + 2 * 16 * 5 + 9)
    lengths = {name: len(rows) for name, rows in part.blocks.items()}
    assert lengths == {
        BASE: 1, ALL: 32, AGAIN: 32, **{mixed_block(c): 32 for c in "abc"},
        alone("a"): 4, alone("b"): 0, alone("c"): 4,
    }  # fmt: skip
    values = pad_rows(design, part, part.rows)
    told = np.array([n < lengths[name] for name, n in design.labels])
    np.testing.assert_array_equal(values[told], design.rows[told])
    assert np.isnan(values[~told]).all()
    assert large_causes({"a": 1.0, "b": 0.01, "c": 0.5}) == ["a", "c"]
    with pytest.raises(InputError, match="81 or more"):
        rendered_design(design, {}, 80)


def test_a_cause_alone_is_compared_by_its_ratio() -> None:
    """In proportion in both tiers, four rigs tell it exactly; one tells nothing of an interval."""
    errors = np.random.default_rng(3).standard_normal((64, 1)) * np.ones((1, 7))
    few = np.where(np.arange(64)[:, None] < 4, 1.1 * errors, np.nan)
    cheap, dear, off = paired_bounds(errors, few)
    assert cheap.low < 1 < cheap.high
    assert off.value == pytest.approx(0.1 * cheap.value) and off.half_width < 1e-12
    assert dear.half_width == pytest.approx(cheap.half_width)
    assert np.isnan(paired_bounds(errors, np.where(few == few[0], few, np.nan))[2].half_width)


def test_rows_of_both_tiers_tell_base_all_and_each_large_cause() -> None:
    cheap, dear = PAIRS["linear"]
    design, values, rendered = both(cheap, dear)
    rows = tier_rows(design, values, rendered, (Output("error", "mm"),))
    # 14 * 16 rows leave 31: of seven causes four rigs each, but those below 2 % are not large.
    what = {"all causes", "no cause", "x1 alone", "x2 alone"}
    assert what < {row.what.removeprefix("rms of error, ") for row in rows}
    truth = np.sqrt(dear.variance + dear.mean**2)
    assert abs(rows[0].rendered.value - truth) < 2.2 * rows[0].rendered.half_width
    assert rows[1].difference.half_width == 0
    for row in rows:
        assert row.difference.value == pytest.approx(row.rendered.value - row.geometric.value)


class CheapRig:
    """Errors in proportion to two causes at the places of a study; a few rigs fail."""

    causes = ("board", "sheet")
    factor = 1.0

    def __init__(self, _: Study, prepared: Prepared) -> None:
        self.profile = np.linspace(-1, 1, len(prepared.places.frame))

    @property
    def outputs(self) -> tuple[Output, ...]:
        return (Output("height", "mm", len(self.profile)), Output("turn", "deg"))

    def evaluate(self, row: Floats) -> Floats:
        z = np.where(np.isnan(row), 0.0, 2 * row - 1)
        if z[0] > 0.98:
            raise MeasurementError("the line leaves the picture")
        return np.append(self.factor * z[0] + z[1] * self.profile, z[1])


class DearRig(CheapRig):
    factor = 1.2
    rows: ClassVar[list[bytes]] = []

    def evaluate(self, row: Floats) -> Floats:
        self.rows.append(row.tobytes())
        return super().evaluate(row)


STUDY = """
calibrate = "best/board"
scan = "best/sandwave"
tier = "both"
places = { pictures = 4, columns = 80 }
precision = { base = 64, most = 64, alone = 16, rendered = 80 }
[cause.board]
key = "calibrate.target.position_mm.1"
when = "as-built"
normal = [0, 0.1]
[cause.sheet]
key = "laser.tilt_deg"
when = "drift"
normal = [0, 0.01]
"""


def test_a_study_in_both_tiers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The height is 1.2 z + z' x in the dear tier, z and z' uniform and x evenly spread in (-1, 1):
    z makes 1.44 / (1.44 + m) of the variance, with m the mean of x²."""
    monkeypatch.setattr(running_module, "GeometricRig", CheapRig)
    monkeypatch.setattr(running_module, "RenderedRig", DearRig)
    monkeypatch.setattr(running_module, "prepare", lambda _: known_of())
    file, out = tmp_path / "study.toml", tmp_path / "out"
    file.write_text(STUDY)
    found = run_study(file, out, StudyOptions(workers="none"))
    m = float(np.mean(np.linspace(-1, 1, len(known_of().places.frame)) ** 2))
    height = found.outputs[0]
    assert found.tier == "both" and "rendered rigs" in found.notes[-1]
    assert len(DearRig.rows) == len(set(DearRig.rows)) <= 80
    first = height.causes[0].first
    assert first is not None and abs(first.value - 1.44 / (1.44 + m)) < 2.2 * first.half_width
    rms, alone_rms = height.rms, height.causes[0].alone_rms
    assert rms is not None and alone_rms is not None
    # A rig in a hundred fails, all at one end of the first cause: that is 3 % of its variance.
    assert rms.value == pytest.approx(np.sqrt((1.44 + m) / 3), rel=0.05)
    row = next(row for row in found.tiers if row.what == "rms of height, board alone")
    assert row.rendered == alone_rms
    assert row.difference.value == pytest.approx(0.2 * row.geometric.value)
    assert load_results(out) == found
    # Gone on with, nothing is evaluated again, and the same is found.
    again = run_study(file, out, StudyOptions(workers="none", resume=True))
    assert len(DearRig.rows) == len(set(DearRig.rows)) and (out / RENDERED_RUNS).exists()
    assert replace(again, seconds=found.seconds) == found


@pytest.mark.slow
def test_both_tiers_of_a_small_picture_without_noise_agree() -> None:
    """With nothing at work the rendered rig is the one that the geometric tier was prepared on:
    what is left is that places are moved into the middles of columns, of a surface that is smooth
    over half a column, and the 0.3 um of tests of the geometric tier.  With the sheet off, the line
    falls elsewhere on the pixels: the bias found there is as large as the one corrected for, and
    independent of it; that, times sqrt(2) and what a pixel is worth, is the rms between the tiers.
    """
    document = {
        "calibrate": "best/board", "scan": "best/sandwave",
        "places": {"pictures": 2, "columns": 64},
        "cause": {"sheet": {"key": "laser.tilt_deg", "when": "drift", "fixed": 0.1}},
    }  # fmt: skip
    scenes = (shrunk(load_scene(name), 2) for name in ("best/board", "best/sandwave"))
    study = study_of(document, "small.toml", tuple(scenes))  # type: ignore[arg-type]
    prepared = prepare(study)
    geometric, rendered = GeometricRig(study, prepared), RenderedRig(study, prepared)
    where = columns(geometric.outputs)["height"]
    row = np.full(len(geometric.causes), NOMINAL)
    off = (rendered.evaluate(row) - geometric.evaluate(row))[where]
    assert np.abs(off).max() < 1e-3

    bias_px = np.sqrt(np.mean(prepared.corrected_px**2))
    lifted = GeometricRig(study, replace(prepared, line_bias_px=prepared.line_bias_px + 0.1))
    mm_per_px = np.abs(lifted.evaluate(row) - geometric.evaluate(row))[where].max() / 0.1
    off = (rendered.evaluate(np.array([0.5])) - geometric.evaluate(np.array([0.5])))[where]
    assert np.sqrt(np.mean(off**2)) < np.sqrt(2) * bias_px * mm_per_px
