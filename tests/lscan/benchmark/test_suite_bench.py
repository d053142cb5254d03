"""Judging on a suite: rows attribute a known error, and a paired test finds what changed."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import suite_cases
from command_line import call, refused
from drawn_examples import examples
from hypothesis import given, strategies as st
from hypothesis.extra import numpy as hnp
from scipy.special import ndtr
from scipy.stats import wilcoxon

from lscan.benchmark import suiterun
from lscan.benchmark.judging import coordinate_sums, judge_case, normal_score
from lscan.benchmark.suiterun import (
    FALSE_ALARMS,
    Difference,
    before_and_after,
    between,
    compare_saved,
    differences,
    pseudo_median,
    run_suite,
    saved_run,
    suite_rows,
    write_suite_run,
)
from lscan.errors import InputError
from lscan.files.disk import write_json
from lscan.records import Status, has_value
from lscan.stripe import find_extractor
from tests.validation.regression.mutations import drawn_sums

pytestmark = pytest.mark.xdist_group("suite_bench")  # one worker: they share a fixture

BASE = "gaussian"
CASES = 12  # of fewer than eleven not even a change of all is significant: 2 / 2^10


def _own(change):
    """An extractor that differs from BASE by a change of its stripe."""

    def extractor(image, settings, clipped):
        return change(find_extractor(BASE)(image, settings, clipped), image)

    return extractor


same = _own(lambda stripe, _: stripe)
half_off = _own(lambda stripe, _: replace(stripe, centre_px=stripe.centre_px + 0.5))
sigma_halved = _own(lambda stripe, _: replace(stripe, sigma_px=stripe.sigma_px / 2))
sigma_doubled = _own(lambda stripe, _: replace(stripe, sigma_px=stripe.sigma_px * 2))
scaled = _own(
    lambda stripe, image: replace(
        stripe, centre_px=stripe.centre_px + 0.03 * np.sin(1e3 * stripe.peak)
    )
)
mirrored = _own(lambda stripe, image: replace(stripe, centre_px=len(image) - 1 - stripe.centre_px))


@_own
def every_tenth_lost(stripe, _):
    """A column in ten gets no value."""
    lost = np.arange(len(stripe.status)) % 10 == 0
    status = np.where(lost, int(Status.NO_PEAK), stripe.status)
    return replace(
        stripe,
        status=status,
        **{
            name: np.where(lost, np.nan, getattr(stripe, name))
            for name in ("centre_px", "sigma_px", "peak")
        },
    )


@_own
def sees_ghosts(stripe, image):
    """A value in every column."""
    none = ~has_value(stripe.status)
    return replace(
        stripe,
        status=np.where(none, int(Status.OK), stripe.status),
        centre_px=np.where(none, 50.0, stripe.centre_px),
        sigma_px=np.where(none, 0.1, stripe.sigma_px),
        peak=np.where(none, 100.0, stripe.peak),
    )


off_the_picture = _own(lambda stripe, _: replace(stripe, centre_px=stripe.centre_px - 1000.0))


def _named(name):
    return f"{__name__}:{name}"


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    folder = tmp_path_factory.mktemp("judged") / "drawn"
    folder.mkdir()
    suite_cases.drawn_suite(folder, CASES)
    return folder


@pytest.fixture(scope="module")
def saved(suite, tmp_path_factory):
    """A run of BASE under every mutant's name, as if each had been so."""
    run = run_suite(str(suite), {"extractor": [BASE]})
    mutants = {_named(name): run.sums[BASE] for name in (*MUTANTS, "same")}
    folder = tmp_path_factory.mktemp("saved")
    # Without the pictures of the worst columns, each of which takes a second to draw.
    content = saved_run(replace(run, sums={**run.sums, **mutants}))
    write_json(folder / "bench.json", content)
    return folder / "bench.json"


MUTANTS = {
    "half_off": "rms error",
    "sigma_halved": "error in stated sigmas",
    "scaled": "rms error",
    "mirrored": "wrong columns",
    "every_tenth_lost": "missed columns",
    "sees_ghosts": "columns without a line",
}


def test_a_row_says_what_is_known_of_the_case():
    """The lines scatter as the bound says, or a little more; dark columns have no value.

    The rms of 310 columns, good to sqrt(1 / 620) of itself, 4 of which are allowed for: not below
    the bound of the reading noise, and not above that of the line's crest, whose light of 150 DN
    has a variance of 150 x 255 / 15,000 DN² in shot noise.
    """
    sums, worst = judge_case(BASE, suite_cases.drawn_case(1))
    assert (sums.clear, sums.missed, sums.valued, sums.sure) == (310, 0, 310, 0)
    assert (sums.dark, sums.ghosts) == (4, 0)  # of ten, those not beside the line
    assert (sums.square / sums.bound) ** 0.5 > 1 - 4 / 620**0.5
    assert worst[0].true[1] == pytest.approx(worst[0].found[1] - worst[0].error_px)


def test_an_error_of_three_stated_sigmas_is_the_most_that_is_honest():
    error, every = np.array([[-2.9], [3.1], [2.9], [10.0]]), np.ones(4, dtype=bool)
    sums = coordinate_sums(every, every, error, np.ones((4, 1)), np.inf, 0.0)
    assert (sums.valued, sums.honest, sums.outlying) == (4, 2, 0)


def test_an_extractor_that_leaves_the_picture_is_refused_with_the_case():
    with pytest.raises(InputError, match=r"off_the_picture.*centre_px in column 10.*, in case-001"):
        judge_case(_named("off_the_picture"), suite_cases.drawn_case(1))


def test_a_bias_of_half_a_pixel_is_said(suite):
    run = run_suite(str(suite), {"extractor": [BASE, _named("half_off")]})
    right, wrong = suite_rows(run, ())
    assert wrong.bias_px - right.bias_px == pytest.approx(0.5, abs=1e-6)
    assert wrong.scatter_px == pytest.approx(right.scatter_px, rel=1e-6)
    by_target = suite_rows(run, ["target"])
    assert {row.group["target"] for row in by_target} == {"peak 150", "peak 30"}
    assert sum(row.cases for row in by_target) == 2 * CASES
    with pytest.raises(InputError, match="no such axis"):
        suite_rows(run, ["colour"])


QUICK = ("half_off", "sigma_halved")


@pytest.mark.parametrize(
    "mutant",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in MUTANTS],
)
def test_a_mutation_is_noticed(suite, saved, mutant):
    worse = compare_saved(run_suite(str(suite), {"extractor": [_named(mutant)]}), saved)
    assert MUTANTS[mutant] in {one.figure for one in worse if one.worse}, worse


def test_what_has_not_changed_differs_in_nothing(suite, saved):
    assert compare_saved(run_suite(str(suite), {"extractor": [_named("same")]}), saved) == []


@pytest.mark.slow
def test_the_paired_test_finds_three_percent_and_nothing_where_nothing_is():
    """500 cases of 300 columns, as quick has; both runs with noise of their own, 200 repeats each.

    The bars: power 95 %, false alarms 1 %.  Of 200 repeats of a true rate of 1 % up to 6 are within
    the binomial's 99.5 %; the noise of an rms is sqrt(1 / 600) in a case, of the mean of 500
    differences 0.26 %, so that 3 % is 11 of its standard deviations.
    """
    found = alarms = 0
    for seed in range(200):
        rng = np.random.default_rng([16, seed])
        before, same_again = drawn_sums(rng, 500, 300), drawn_sums(rng, 500, 300)
        alarms += bool(differences("x", same_again, before))
        now = differences("x", drawn_sums(rng, 500, 300, factor=1.03), before)
        found += any(one.worse and one.figure == "rms error" for one in now)
    assert found >= 190
    assert alarms <= 6
    assert FALSE_ALARMS == 0.01


@given(st.floats(-30.0, 30.0))
def test_the_score_is_the_area_between_two_distributions_squared(z):
    """Its definition, by the midpoint rule, whose error at the step is below the cell's width."""
    width = 1e-3
    places = np.arange(-40.0, 40.0, width) + width / 2
    area = ((ndtr(places) - (places >= z)) ** 2).sum() * width
    assert normal_score(np.array(z)) == pytest.approx(area, abs=width)


def test_a_sigma_that_does_not_follow_the_errors_is_noticed():
    """Columns of two scatters, stated as they are and as one that leaves mean ln |z| as it was.

    The score of the right sigmas is 0.55 / sqrt(pi) on average, and by quadrature 20 % more of
    sqrt(0.1) for both; the noise of a mean of 300 columns is less, and there are 60 cases.
    """
    rng = np.random.default_rng(5)
    every = np.ones(300, bool)
    right, wrong = {}, {}
    for case in map(str, range(60)):
        sigma = np.where(every.cumsum() % 2, 1.0, 0.1)[:, np.newaxis]
        error = sigma * rng.standard_normal((300, 1))
        for sums, stated in ((right, sigma), (wrong, np.full_like(sigma, 0.1**0.5))):
            sums[case] = coordinate_sums(every, every, error, stated, 9.0, 0.0)
    assert [(one.figure, one.worse) for one in differences("x", wrong, right)] == [
        ("score of stated sigmas", True)
    ]


@given(hnp.arrays(float, st.integers(1, 40), elements=st.integers(-1000, 1000).map(float)))
def test_the_pseudo_median_belongs_to_the_signed_ranks(values):
    """It moves and turns with the values, and lies where SciPy's rank sums balance.

    Half of the rank sum of all lies on either side of it but for ties, which share a pair's mean.
    """
    low, middle, high = pseudo_median(values)
    assert pseudo_median(-values) == (-high, -middle, -low)
    assert pseudo_median(values + 7.0) == pytest.approx((low + 7.0, middle + 7.0, high + 7.0))
    assert low <= middle <= high
    assert values.min() <= middle <= values.max()
    one, other = np.triu_indices(len(values))
    means = (values[one] + values[other]) / 2
    assert (means < middle).sum() <= len(means) / 2 >= (means > middle).sum()


@given(st.integers(0, 10**6), st.integers(30, 80))
@examples(20)
def test_the_interval_is_what_the_signed_rank_test_does_not_reject(seed, count):
    """Shifted by its ends, the values have a p of 5 %: a rank more or less moves it by a tenth."""
    values = np.random.default_rng(seed).normal(0.3, 1.0, count)
    low, _, high = pseudo_median(values)
    for end in (low, high):
        p = wilcoxon(values - end, method="asymptotic").pvalue
        assert p == pytest.approx(0.05, rel=0.15)


def test_two_methods_and_two_runs_are_told_apart_in_words():
    rng = np.random.default_rng(3)
    one, other = drawn_sums(rng, 60, 300), drawn_sums(rng, 60, 300, factor=1.5)
    (rms, *_) = between({"ml": one, "max": other})
    assert (rms.extractor, rms.figure, rms.worse) == ("max beside ml", "rms error", True)
    # A logarithm of an rms scatters by sqrt(1 / 600): 2 x 1.96 sqrt(2 / 600 / 60) x 1.5 = 0.044.
    low, high = rms.interval
    assert low < 0.5 < high and high - low == pytest.approx(0.044, rel=0.3)
    assert "% larger (4" in rms.in_words or "% larger (5" in rms.in_words
    off = {case: replace(sums, error=sums.error + 0.1 * sums.core) for case, sums in one.items()}
    off["7"] = replace(off["7"], square=100 * one["7"].square)
    said = before_and_after(off, one)
    before, after = map(float, re.search(r"bias (\S+) to (\S+) px", said).groups())
    assert after - before == pytest.approx(0.1, abs=2e-4)
    assert "of 18000 columns in 60 cases; changed most: 7 (" in said


@pytest.mark.parametrize(
    ("figure", "change", "words"),
    [
        ("rms error", 1.2, "rms error worse: 2.2 times as large"),
        ("rms error", 0.995, "rms error worse: 100 % larger"),
        ("rms error", -0.034, "rms error worse: 3.4 % smaller"),
        ("wrong columns", 2.5, "wrong columns worse: 2.5 columns more"),
    ],
)
def test_a_difference_says_which_way(figure, change, words):
    assert words in Difference("ml", figure, True, change, 0.001, 40, (change, change)).in_words


@examples(15)
@given(seed=st.integers(0, 10**6), cases=st.integers(0, 12))
def test_the_paired_test_is_antisymmetric(seed, cases):
    """What is worse one way is better the other way, whatever the numbers; few cases say little."""
    rng = np.random.default_rng(seed)
    one, other = drawn_sums(rng, cases, 50), drawn_sums(rng, cases, 50, factor=3.0)
    ways = differences("x", other, one), differences("x", one, other)
    assert [(a.figure, a.worse) for a in ways[0]] == [(b.figure, not b.worse) for b in ways[1]]
    assert differences("x", one, one) == []
    if cases < 9:  # 2 / 2^8 is above 1 % / 7
        assert ways == ([], [])


def test_the_command_judges_writes_and_compares(suite, tmp_path, capsys):
    mine = _named("half_off")
    options = ["--only", "--suite", suite, "-o", tmp_path / "first"]
    code, out, _ = call(capsys, "bench", BASE, *options)
    assert code == 0
    assert "by fault" in out
    saved_file = tmp_path / "first" / "bench.json"
    assert (tmp_path / "first" / f"worst-{BASE}.png").read_bytes().startswith(b"\x89PNG")
    content = json.loads(saved_file.read_text())
    content["extractors"][mine] = content["extractors"][BASE]
    saved_file.write_text(json.dumps(content))
    options[-1] = tmp_path / "second"
    code, out, err = call(capsys, "bench", mine, *options, "--against", saved_file)
    assert code == 1
    assert f"{mine}: rms error worse" in out
    assert "figures are worse" in err
    code, out, _ = call(capsys, "bench", BASE, *options, "--against", saved_file, "--json")
    assert code == 0
    assert json.loads(out)["differences"] == []


def test_the_command_refuses_what_does_not_fit(suite, tmp_path, capsys):
    other = tmp_path / "bench.json"
    other.write_text('{"version": 1}')
    options = ["bench", BASE, "--only", "-o", tmp_path]
    refused(call(capsys, *options, "--suite", suite, "--against", other), "is no saved run")
    refused(call(capsys, *options, "--suite", "nobodys"), "no such suite")
    refused(call(capsys, *options, "--against", other), "needs --suite")
    refused(call(capsys, *options, "--suite", suite, "--by", "colour"), "no such axis")


@pytest.mark.parametrize("pool", [suite_cases.Threads, pytest.param(None, marks=pytest.mark.slow)])
def test_several_processes_judge_as_one_does(suite, monkeypatch, pool):
    """All but the seconds."""
    if pool is not None:
        monkeypatch.setattr(suiterun, "ProcessPoolExecutor", pool)
    names = [BASE, "max"]
    alone = run_suite(str(suite), {"extractor": names})
    monkeypatch.setattr(suiterun, "LEAST_SHARED", 1)
    monkeypatch.setattr("lscan.benchmark.suiterun.AT_ONCE", 10)
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    shown = []
    methods = {"extractor": names}
    shared = run_suite(str(suite), methods, progress=lambda *done: shown.append(done))
    assert [*alone.sums] == [*shared.sums] == names
    for name in names:
        one, other = alone.sums[name], shared.sums[name]
        assert one.keys() == other.keys()
        for case, sums in one.items():
            assert replace(sums, seconds=0.0) == replace(other[case], seconds=0.0)
        of_both = zip(alone.worst[name], shared.worst[name], strict=True)
        assert all(worst.case == again.case for worst, again in of_both)
    assert shown == [(done, CASES) for done in range(1, CASES + 1)]


def test_drawn_lines_are_a_suite(tmp_path):
    run = run_suite("drawn", {"extractor": ["centroid-relative"]})
    content = write_suite_run(tmp_path, run, ["water"])
    assert {row["group"]["water"] for row in content["rows"]} == {
        "tap",
        "clear",
        "coastal",
        "harbor",
    }
    assert compare_saved(run, tmp_path / "bench.json") == []
    content["sums"].pop()  # as runs were saved before there were scores
    content["extractors"] = {
        name: {case: sums[:-1] for case, sums in of.items()}
        for name, of in content["extractors"].items()
    }
    write_json(tmp_path / "before.json", content)
    assert compare_saved(run, tmp_path / "before.json") == []
    again = run_suite("drawn", {"extractor": ["centroid-relative"]}, seed=2)
    with pytest.raises(InputError, match="is of another suite"):
        compare_saved(again, tmp_path / "bench.json")
