"""`lscan leaderboard`: every saved run once, ranked within its suite, and nothing is markup."""

import json
import re
from dataclasses import replace

import pytest
import suite_cases
from command_line import call, refused

from lscan.benchmark.run import standings, write_leaderboard
from lscan.benchmark.suiterun import run_suite, suite_rows, write_suite_run
from lscan.errors import InputError


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two runs of one suite, one of another, and what the first said of all cases."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "drawn").mkdir()
    suite_cases.drawn_suite(folder / "drawn")
    first = run_suite(str(folder / "drawn"), {"extractor": ["max", "gaussian", "centroid"]})
    write_suite_run(folder / "first", first, ["target"])
    hostile = replace(first, sums={"<script>alert(1)</script>": first.sums["max"]}, worst={})
    write_suite_run(folder / "second", hostile, [])
    other = replace(first, identity="another seed 7", sums={"max": first.sums["max"]})
    write_suite_run(folder / "third", other, [])
    return folder, suite_rows(first, ())


def _files(folder):
    return [folder / name / "bench.json" for name in ("first", "second", "third")]


def test_every_method_is_ranked_once_within_its_suite(runs):
    """By its rms, with the figures of the run itself; the time is that of the table's groups."""
    folder, rows = runs
    found = standings(_files(folder))
    assert [len(ranked) for ranked in found.values()] == [1, 4]
    ranked = found["drawn seed 7 lscan test"]
    assert [one.rms for one in ranked] == sorted(one.rms for one in ranked)
    for row in rows:
        (one,) = [of.row for of in ranked if (of.run, of.row.extractor) == ("first", row.extractor)]
        assert replace(one, time=0.0) == replace(row, time=0.0)
        assert one.time == pytest.approx(row.time)


def test_the_page_holds_all_and_no_markup_of_a_name(runs, tmp_path):
    folder, _ = runs
    page = write_leaderboard(_files(folder), tmp_path / "new" / "page.html").read_text()
    assert page.count("<tr>") == 2 + 5  # two headings
    assert page.count("<script>") == 1
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert "http" not in re.sub(r"http-equiv", "", page)  # nothing is fetched
    assert page.index("another seed 7") < page.index("drawn seed 7")


def test_the_command_writes_the_page_and_refuses_other_files(runs, tmp_path, capsys):
    folder, _ = runs
    page = tmp_path / "page.html"
    code, out, _ = call(capsys, "leaderboard", *_files(folder), "-o", page, "--json")
    assert code == 0
    assert json.loads(out) == {"page": str(page)}
    assert page.is_file()
    wrong = tmp_path / "bench.json"
    content = json.loads(_files(folder)[0].read_text())
    for change in ({"version": 2}, {"rows": [{}]}, {"extractors": {"x": {"c": ["much"]}}}):
        wrong.write_text(json.dumps({**content, **change}))
        refused(call(capsys, "leaderboard", wrong, "-o", page), "is no saved run")
    with pytest.raises(InputError, match="nothing to rank"):
        standings([])
