"""Whole scans rendered for a suite, and chains judged by them: what is known of a chain is said."""

import json
from dataclasses import replace

import numpy as np
import pytest
from command_line import call, refused

from lscan.benchmark.judging import judge_chain, load_chain
from lscan.benchmark.suiterun import run_suite, suite_rows
from lscan.errors import InputError
from lscan.records import Status
from lscan.stripe import find_extractor
from lscan.suites import open_suite, verify_suite
from sim.datasets.suite import load_suite_spec, make_suite

pytestmark = pytest.mark.xdist_group("scans")  # one worker: they share a fixture

SCANS = """
name = "scans"

[scans]
scene = "paper/groove"
board = "paper/board"
pictures = 2

[scans.base.plan]
frames = 2

[scans.base.render]
scatter_samples = 0

[scans.render.port.flat]

[scans.expose.speckle.usual]
[scans.expose.speckle.none.sensor]
speckle = "none"
"""
OFF_PX = 2.0


def off_by_two(image, settings, clipped):
    """The paper's extractor, two pixels too low."""
    stripe = find_extractor("centroid-relative")(image, settings, clipped)
    return replace(stripe, centre_px=stripe.centre_px + OFF_PX)


def broken(image, settings, clipped):
    """Raises what no extractor should."""
    raise ZeroDivisionError("by zero")


@pytest.fixture(scope="module")
def spec_file(tmp_path_factory):
    file = tmp_path_factory.mktemp("scans") / "scans.toml"
    file.write_text(SCANS)
    return file


@pytest.fixture(scope="module")
def suite(spec_file):
    return make_suite(load_suite_spec(spec_file), spec_file.parent / "scans.zip", workers="none")


@pytest.fixture
def chain_file(tmp_path):
    """A function that writes a chain of one section."""

    def written(stripe):
        file = tmp_path / "chain.toml"
        lines = "\n".join(f"{key} = {value}" for key, value in stripe.items())
        file.write_text(f"[stripe]\n{lines}\n")
        return str(file)

    return written


def test_a_scan_holds_what_its_rig_saw(suite):
    """Two exposures of one render: the truth is the same but for the light's noise; the block's
    truth lies on its two levels and the floor, whose heights its nominal shape says."""
    cases = list(verify_suite(suite).scans())
    assert {case.axes["speckle"] for case in cases} == {"usual", "none"}
    one, other = cases
    assert len(one.frames) == one.rig.plan.frames == 2
    assert np.array_equal(one.line_mm, other.line_mm, equal_nan=True)
    assert not np.array_equal(one.frames[0], other.frames[0])
    assert not np.array_equal(one.board.picture, other.board.picture)
    shown = one.status == Status.OK
    assert shown.mean() > 0.9
    heights = np.round(one.line_mm[shown][:, 1] - one.line_mm[shown][:, 1].min(), 1)
    values, counts = np.unique(heights, return_counts=True)
    levels = values[counts > 20]
    assert len(levels) >= 5  # the floor, three bottoms, the tops
    assert len(one.slices_mm) == 0
    assert one.rig.optics.water_index is not None


def test_an_exact_chain_is_exact_and_a_wrong_one_is_not(suite, chain_file):
    """The best chain is within 0.1 mm rms; the paper's moved by two pixels is off by twice what a
    pixel is on the sheet there, about 1.1 mm along z at this angle, and says so of every point."""
    moved = chain_file({"extractor": f'"{__name__}:off_by_two"'})
    run = run_suite(str(suite), {"chain": ["best/groove", moved]})
    rows = {row.extractor: row for row in suite_rows(run, ())}
    best, wrong = (rows[f"{name}: points"] for name in ("best/groove", moved))
    assert best.found > 0.99
    assert np.hypot(best.bias_px, best.scatter_px) < 0.1
    assert wrong.wrong > 0.9
    grooves = rows["best/groove: grooves"]
    assert (grooves.found, grooves.cases) == (1, 2)
    assert np.hypot(grooves.bias_px, grooves.scatter_px) < 0.2
    # Lengths of the block do not know where it is.
    assert abs(rows[f"{moved}: grooves"].bias_px) < 0.2
    assert not any("slices" in name for name in rows)


def test_the_error_of_a_point_is_that_of_the_chain(suite, chain_file):
    """Of a chain that is off by two pixels every point is moved by two pixels of its own column."""
    case = next(open_suite(suite).scans())
    moved = load_chain(chain_file({"extractor": f'"{__name__}:off_by_two"'}))
    sums = judge_chain("moved", moved, case)["points"]
    usual = judge_chain("paper", load_chain("paper/rig"), case)["points"]
    assert usual.valued == pytest.approx(sums.valued, rel=0.01)
    lattice = case.board.map_px, case.board.map_mm
    apart = np.hypot(*np.diff(lattice[1], axis=0).T) / np.hypot(*np.diff(lattice[0], axis=0).T)
    assert np.median(apart) * OFF_PX > 1.0  # so that two pixels are wrong by more than the limit
    assert sums.outlying > 0.9 * sums.valued


def test_what_a_chain_cannot_do_is_missed(suite, chain_file):
    """A threshold above all light: the board is read, no point is found, no groove is measured."""
    case = next(open_suite(suite).scans())
    sums = judge_chain("dark", load_chain(chain_file({"threshold_dn": 254.0})), case)
    assert sums["board"].missed == 0
    assert sums["points"].valued == 0
    assert sums["grooves"].missed == sums["grooves"].clear == 9


def test_a_chain_that_is_none_is_refused(suite, chain_file, tmp_path):
    (tmp_path / "none.toml").write_text("[plan]\nframes = 2\n")
    with pytest.raises(InputError, match=r"none\.toml: has no section of a chain"):
        run_suite(str(suite), {"chain": [str(tmp_path / "none.toml")]})
    with pytest.raises(InputError, match="no such stripe extractor"):
        run_suite(str(suite), {"chain": [chain_file({"extractor": '"nobodys"'})]})
    with pytest.raises(InputError, match=r"chain\.toml.*threshold_dn"):
        run_suite(str(suite), {"chain": [chain_file({"threshold_dn": '"high"'})]})
    with pytest.raises(InputError, match=r"broken.*ZeroDivisionError"):
        run_suite(str(suite), {"chain": [chain_file({"extractor": f'"{__name__}:broken"'})]})


@pytest.mark.slow
def test_the_command_judges_chains_and_notices_a_change(suite, chain_file, tmp_path, capsys):
    options = ["bench", "--suite", suite, "-o", tmp_path / "one", "--only"]
    code, out, _ = call(capsys, *options, "--chain", "paper/rig", "--json")
    assert code == 0
    content = json.loads(out)
    assert {row["extractor"] for row in content["rows"]} == {
        f"paper/rig: {part}" for part in ("board", "points", "grooves")
    }
    options[4] = tmp_path / "two"
    saved = tmp_path / "one" / "bench.json"
    code, out, _ = call(capsys, *options, "--chain", "paper/rig", "--against", saved)
    assert code == 0 and "nothing differs" in out
    assert "scatter" in out and "bias mm" in out
    refused(call(capsys, "bench", "--chain", "paper/rig"), "--suite")
    refused(call(capsys, "bench", "max", "--suite", suite, "--chain", "paper/rig"), "--chain")
    refused(call(capsys, "bench", "--suite", suite), "no pictures of a line")


def test_a_scans_board_lies_in_the_sheet(tmp_path):
    file = tmp_path / "wrong.toml"
    leaning = tmp_path / "leaning.toml"
    leaning.write_text('include = "paper/board"\n[target]\ntilt_x_deg = 1.0\n')
    for wrong in ("paper/groove", str(leaning)):
        file.write_text(SCANS.replace("paper/board", wrong))
        with pytest.raises(InputError, match=r"scans\.board"):
            make_suite(load_suite_spec(file), tmp_path / f"{len(wrong)}.zip", workers="none")
    file.write_text(
        SCANS.replace("[scans.render.port.flat]", "[scans.render.port.flat.laser]\non=false")
    )
    with pytest.raises(InputError, match="one line, that is on"):
        make_suite(load_suite_spec(file), tmp_path / "wrong.zip", workers="none")


@pytest.mark.parametrize("place", ["base.plan", "render.port.flat", "expose.speckle.usual"])
def test_a_section_of_a_case_is_a_table(tmp_path, place):
    file, table = tmp_path / "wrong.toml", f"[scans.{place}]"
    file.write_text(SCANS.replace(table, f"[scans.{place.removesuffix('.plan')}]\nsensor = 1.0"))
    with pytest.raises(InputError, match=r"scans\.\w.*sensor: must be a table"):
        load_suite_spec(file)
