"""What a report says of where its pictures come from, and of the two chains that read them."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import report_examples as examples

from lscan.acquisition.run import Run
from lscan.cli.console import show
from lscan.cli.report import chain_lines
from lscan.config.rig import parse_rig
from lscan.paper import published as paper
from lscan.paper.experiment import (
    Experiment,
    PictureSource,
    chain_names,
    describe_chains,
    note,
    picture_source,
)
from lscan.paper.report import results_json
from lscan.paper.tables import paper_tables

pytestmark = pytest.mark.xdist_group("report")
PARTS = ("board", "groove", "sandwave")
WEBCAM = PictureSource("opencv", simulated=False)


@pytest.fixture(scope="module")
def both() -> Experiment:
    """An experiment of runs in the tank, evaluated by both chains."""
    return examples.both_chains()


@pytest.fixture(scope="module")
def page() -> str:
    return examples.undrawn(examples.both_chains())


def captions(text: str) -> list[str]:
    """Every caption of a figure and every paragraph over a table."""
    under = re.findall(r"<figcaption>(.*?)</figcaption>", text, re.DOTALL)
    return under + re.findall(r"</h2>\n<p>(.*?)</p>", text, re.DOTALL)


def test_title_first_sentence_and_every_caption_say_that_the_tank_was_simulated(page: str) -> None:
    assert re.search(r"<title>[^<]*simulated tank[^<]*</title>", page)
    assert re.search(r"<h1>[^<]*simulated tank[^<]*</h1>", page)
    first = re.search(r'<p class="lead">([^.]*)\.', page)
    assert first and "simulated tank" in first[1] and "noise seed 7" in first[1]
    found = captions(page)
    assert len(found) >= 18 + 4  # figures, and Tables I to III and the slices
    assert [c for c in found if "Simulated tank, noise seed 7." not in c] == []


def test_a_report_of_real_hardware_says_nothing_of_a_simulation(both: Experiment) -> None:
    text = examples.undrawn(replace(both, sources=dict.fromkeys(PARTS, WEBCAM)))
    read = re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
    assert "imulated" not in read and "noise seed" not in read
    assert "opencv (board, groove, sandwave)" in read


def test_only_the_captions_of_the_simulated_part_say_so(both: Experiment) -> None:
    sources = {**both.sources, "board": WEBCAM}
    assert note(sources, ["board"]) == ""
    assert note(sources, ["groove"]) == "Simulated tank, noise seed 7."
    assert note(sources, ["board", "groove"]) == "Groove: simulated tank, noise seed 7."
    alone = replace(examples.board_alone(), sources=sources)
    assert "(simulated tank: groove, sandwave)" in examples.undrawn(alone)


def _run(document: dict[str, Any]) -> Run:
    plain = {"camera": {"driver": "sim"}, "track": {"driver": "sim"}}
    rig_file = parse_rig({**plain, **document}, source="run.json", trusted=True)
    return Run(Path("run"), rig_file, "complete", (), ())


@pytest.mark.parametrize(
    ("document", "source", "words"),
    [
        ({"sensor": {"seed": 3}}, PictureSource("sim", True, True, 3), "noise seed 3"),
        ({"sensor": {}}, PictureSource("sim", True), "noise seed not stated"),
        (
            {"sensor": {"noise": False, "seed": 3}},
            PictureSource("sim", True, False, 3),
            "without noise",
        ),
        ({"sensor": {"seed": [{}]}}, PictureSource("sim", True), "noise seed not stated"),
        ({"sensor": "none"}, PictureSource("sim", True), "noise seed not stated"),
        # A replayed run, or a stream of the tank served as a webcam, cannot know.
        (
            {"camera": {"driver": "replay"}, "sensor": {"seed": 3}},
            PictureSource("replay", False),
            "",
        ),
        ({"camera": {"driver": "opencv"}}, PictureSource("opencv", False), ""),
    ],
)
def test_a_run_states_how_its_pictures_were_made(document, source, words) -> None:
    found = picture_source(_run(document))
    assert found == source
    caption = note({"board": found})
    assert words in caption and bool(words) == bool(caption)


def _texts(cells: Any) -> list[str]:
    return [cell.text for cell in cells]


def test_the_tables_hold_the_papers_number_the_papers_chain_and_the_best(
    both: Experiment,
) -> None:
    tables = {table.key: table for table in paper_tables(both, paper.Bars())}
    assert list(tables) == ["table-1", "table-2", "table-3", "slices"]
    board, better = both.board.measures[paper.CHOSEN_MAP], both.best.board.measures["refractive"]
    for key, ours, best in (
        ("table-1", board.distances, better.distances),
        ("table-2", board.diameters, better.diameters),
        ("table-3", both.groove.dimensions, both.best.groove.dimensions),
    ):
        block = tables[key].chains
        assert [row.code for row in block.rows] == list(ours)
        for row in block.rows:
            printed = (
                paper.TABLE_3.get(row.code)
                or (paper.TABLE_1.get(row.code) or paper.TABLE_2[row.code])["Second rms"]
            )
            assert _texts(row.paper)[0] == f"{printed.measured_mm:.2f}"
            for cells, length in ((row.ours, ours[row.code]), (row.best, best[row.code])):
                expected = [f"{length.measured_mm:.3f}", f"{length.sigma_mm:.3f}"]
                assert _texts(cells)[:2] == expected
    for row in tables["slices"].chains.rows:
        assert _texts(row.paper) == ["−1.0", "+1.5"]
        for cells, chain in ((row.ours, both), (row.best, both.best)):
            errors = chain.sandwave.errors[row.code]
            assert cells[0].text == f"{errors.rmse_mm:.3f}"
            least = float(cells[1].text.replace("−", "-"))
            assert least == pytest.approx(errors.min_mm, abs=6e-4)  # three decimals


def test_the_page_has_both_chains_side_by_side(page: str) -> None:
    assert page.count("Ours, paper’s chain</th>") == page.count("Ours, best chain</th>") + 1 == 5
    row = page[page.index('data-row="H2"') :]
    row = row[: row.index("</tr>")]
    assert [row.count(f'<td class="{name}') for name in ("ours", "best")] == [4, 4]
    assert "plane map refractive, line by ml, corrected for blur." in page


def test_without_a_best_chain_the_page_says_why(both: Experiment) -> None:
    why = "run: the rig file has no section [optics]"
    alone = replace(both, best=None, best_refused=why)
    text = examples.undrawn(replace(alone, sandwave=None, shown={}))
    assert "Ours, best chain" not in text
    assert f"No best chain: {why}." in text
    tables = paper_tables(alone, paper.Bars())
    assert [table.chains is None for table in tables] == [True, True, False, False]


def test_a_line_not_found_by_the_papers_rules_is_not_called_its_chain(both: Experiment) -> None:
    assert chain_names(both.chain)[0] == "Ours, paper’s chain"
    for key, value in (("extractors", ("ml",)), ("corrected_for", ("blur",))):
        assert chain_names(replace(both.chain, **{key: value}))[0] == "Ours, paper’s map"
    words = describe_chains(both)
    assert words.startswith("Two chains read the same pictures. The paper’s chain:")


def test_the_summary_prints_both_chains(both: Experiment, capsys) -> None:
    show(None, *chain_lines(both), json=False)
    printed = capsys.readouterr().out
    assert printed.startswith("Simulated tank, noise seed 7.\n")
    (line,) = (line for line in printed.splitlines() if line.startswith("│ H₂"))
    cells = [cell.strip() for cell in line.strip("│").split("│")]
    assert cells[1:] == ["−0.66"] + [
        text
        for length in (both.groove.dimensions["H2"], both.best.groove.dimensions["H2"])
        for text in (f"{length.sigma_mm:.3f}", f"{length.error_mm:+.3f}".replace("-", "−"))
    ]
    for name in ("S1", "SD"):
        assert f"│ {name}" in printed
    show(None, *chain_lines(replace(both, best=None)), json=False)
    assert "best" not in capsys.readouterr().out


def test_results_json_holds_the_numbers_of_both_chains(both: Experiment) -> None:
    """The keys that a reader of results.json relies on, and plain JSON types alone."""
    content = results_json(both)
    json.dumps(content, allow_nan=False)
    assert list(content) == [
        "scene", "versions", "seconds", "pictures", "control_points", "chain", "distances",
        "diameters", "groove", "sandwave", "best", "render_check",
    ]  # fmt: skip
    assert list(content["best"]) == ["chain", "distances", "diameters", "groove", "sandwave"]
    a1a2 = both.board.measures["projective"].distances["A1A2"]
    assert content["distances"]["projective"]["A1A2"] == {
        "nominal_mm": a1a2.nominal_mm,
        "measured_mm": a1a2.measured_mm,
        "error_mm": a1a2.error_mm,
        "sigma_mm": a1a2.sigma_mm,
    }
    for chain in (content, content["best"]):
        assert chain["sandwave"]["yaw_deg"] == pytest.approx({"estimated": 2.2, "true": 2.2})
    assert content["pictures"]["board"] == {
        "camera": "sim", "simulated": True, "noise": True, "noise_seed": 7,
    }  # fmt: skip
    real = results_json(replace(both, truth=None, best=None, best_refused="why"))
    assert real["best"] == {"refused": "why"}
    assert set(real["control_points"]) == {"expected", "found"} and "render_check" not in real
