"""What a report says of where its pictures come from, and of the two chains that read them."""

from __future__ import annotations

import copy
import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import report_examples as examples

from lscan.acquisition.provenance import PictureSource as Source
from lscan.acquisition.provenance import chain_names, chains_in_words, note, picture_source
from lscan.acquisition.run import Run
from lscan.cli.summaries import print_chains
from lscan.config.rig import parse_rig
from lscan.paper import published as paper
from lscan.paper.report import ReportInputs, render_report
from lscan.paper.tables import paper_tables

pytestmark = pytest.mark.xdist_group("report")
TANK = {"camera": "sim", "simulated": True, "noise": True, "noise_seed": 7}
PARTS = ("board", "groove", "sandwave")


def both_chains(seed: int = 4) -> dict[str, Any]:
    """A whole results.json of runs in the tank, evaluated by both chains."""
    rng = np.random.default_rng(seed)
    results, better = examples.results(rng), examples.results(rng)
    best = {key: better[key] for key in ("groove", "sandwave")}
    for section in ("distances", "diameters"):
        best[section] = {"refractive": better[section]["graticule-2"]}
    chain = {"plane_map": "graticule-2", "extractors": ["centroid-relative"], "corrected_for": []}
    best["chain"] = {"plane_map": "refractive", "extractors": ["ml"], "corrected_for": ["blur"]}
    pictures = {part: dict(TANK) for part in PARTS}
    return {**results, "pictures": pictures, "chain": chain, "best": best}


def page(results: dict[str, Any], whole: ReportInputs | None = None) -> str:
    """The page of these results, with every figure if whole is given."""
    return render_report(dataclasses.replace(whole or ReportInputs(), results=results))


def captions(text: str) -> list[str]:
    """Every caption of a figure and every paragraph over a table."""
    under = re.findall(r"<figcaption>(.*?)</figcaption>", text, re.DOTALL)
    return under + re.findall(r"</h2>\n<p>(.*?)</p>", text, re.DOTALL)


def test_title_first_sentence_and_every_caption_say_that_the_tank_was_simulated() -> None:
    text = page(both_chains(), examples.whole_experiment())
    assert re.search(r"<title>[^<]*simulated tank[^<]*</title>", text)
    assert re.search(r"<h1>[^<]*simulated tank[^<]*</h1>", text)
    first = re.search(r'<p class="lead">([^.]*)\.', text)
    assert first and "simulated tank" in first[1] and "noise seed 7" in first[1]
    found = captions(text)
    assert len(found) >= 18 + 4  # figures, and Tables I to III and the slices
    assert [c for c in found if "Simulated tank, noise seed 7." not in c] == []


def test_a_report_of_real_hardware_says_nothing_of_a_simulation() -> None:
    results = both_chains()
    results["pictures"] = {part: {"camera": "opencv"} for part in PARTS}
    text = page(results, examples.whole_experiment())
    read = re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
    assert "imulated" not in read and "noise seed" not in read
    assert "opencv (board, groove, sandwave)" in read


def test_only_the_captions_of_the_simulated_part_say_so() -> None:
    results = both_chains()
    results["pictures"]["board"] = {"camera": "opencv"}
    assert note(results, ["board"]) == ""
    assert note(results, ["groove"]) == "Simulated tank, noise seed 7."
    assert note(results, ["board", "groove"]) == "Groove: simulated tank, noise seed 7."
    assert "(simulated tank: groove, sandwave)" in page(results)


def _run(document: dict[str, Any]) -> Run:
    plain = {"camera": {"driver": "sim"}, "track": {"driver": "sim"}}
    rig_file = parse_rig({**plain, **document}, source="run.json", trusted=True)
    return Run(Path("run"), rig_file, "complete", (), ())


@pytest.mark.parametrize(
    ("document", "source", "told"),
    [
        ({"sensor": {"seed": 3}}, Source("sim", True, True, 3), "noise seed 3"),
        ({"sensor": {}}, Source("sim", True), "noise seed not stated"),
        ({"sensor": {"noise": False, "seed": 3}}, Source("sim", True, False, 3), "without noise"),
        ({"sensor": {"seed": [{}]}}, Source("sim", True), "noise seed not stated"),
        ({"sensor": "none"}, Source("sim", True), "noise seed not stated"),
        # A replayed run, or a stream of the tank served as a webcam, cannot know.
        ({"camera": {"driver": "replay"}, "sensor": {"seed": 3}}, Source("replay", False), ""),
        ({"camera": {"driver": "opencv"}}, Source("opencv", False), ""),
    ],
)
def test_a_run_says_of_itself_what_it_knows(document, source, told) -> None:
    found = picture_source(_run(document))
    assert found == source
    caption = note({"pictures": {"board": found.as_json()}}, PARTS)
    assert told in caption and bool(told) == bool(caption)


def _texts(cells: Any) -> list[str]:
    return [cell.text for cell in cells]


def test_the_tables_hold_the_papers_number_the_papers_chain_and_the_best() -> None:
    results = both_chains()
    tables = {table.key: table for table in paper_tables(results, paper.Bars())}
    assert list(tables) == ["table-1", "table-2", "table-3", "slices"]
    for key, ours, best in (
        ("table-1", results["distances"]["graticule-2"], "distances"),
        ("table-2", results["diameters"]["graticule-2"], "diameters"),
        ("table-3", results["groove"], "groove"),
    ):
        block, better = tables[key].chains, results["best"][best]
        better = better if best == "groove" else better["refractive"]
        assert [row.code for row in block.rows] == list(ours)
        for row in block.rows:
            printed = (
                paper.TABLE_3.get(row.code)
                or (paper.TABLE_1.get(row.code) or paper.TABLE_2[row.code])["Second rms"]
            )
            assert _texts(row.paper)[0] == f"{printed.measured_mm:.2f}"
            for cells, entry in ((row.ours, ours[row.code]), (row.best, better[row.code])):
                assert _texts(cells)[:2] == [f"{entry[k]:.3f}" for k in ("measured_mm", "sigma_mm")]
    for row in tables["slices"].chains.rows:
        assert _texts(row.paper) == ["−1.0", "+1.5"]
        entries = (r["sandwave"]["slices"][row.code] for r in (results, results["best"]))
        for cells, entry in zip((row.ours, row.best), entries, strict=True):
            assert cells[0].text == f"{entry['rmse_mm']:.3f}"
            assert float(cells[1].text.replace("−", "-")) == pytest.approx(
                entry["min_mm"], abs=6e-4
            )


def test_the_page_has_both_chains_side_by_side() -> None:
    text = page(both_chains())
    assert text.count("Ours, paper’s chain</th>") == text.count("Ours, best chain</th>") + 1 == 5
    row = text[text.index('data-row="H2"') :]
    row = row[: row.index("</tr>")]
    assert [row.count(f'<td class="{name}') for name in ("ours", "best")] == [4, 4]
    assert "plane map refractive, line by ml, corrected for blur." in text


def test_without_a_best_chain_the_page_says_why() -> None:
    results = both_chains()
    results["best"] = {"refused": "run: the rig file has no section [optics]"}
    text = page(results)
    assert "Ours, best chain" not in text
    assert "No best chain: run: the rig file has no section [optics]." in text
    assert [t.chains is None for t in paper_tables(results, paper.Bars())] == [
        True, True, False, False,
    ]  # fmt: skip


def test_a_line_not_found_by_the_papers_rules_is_not_called_its_chain() -> None:
    results = both_chains()
    assert chain_names(results)[0] == "Ours, paper’s chain"
    for key, value in (("extractors", ["ml"]), ("corrected_for", ["blur"])):
        other = copy.deepcopy(results)
        other["chain"][key] = value
        assert chain_names(other)[0] == "Ours, paper’s map"
    assert chains_in_words(results).startswith(
        "Two chains read the same pictures. The paper’s chain:"
    )


def test_the_summary_prints_both_chains(capsys) -> None:
    results = both_chains()
    print_chains(results)
    printed = capsys.readouterr().out
    assert printed.startswith("Simulated tank, noise seed 7.\n")
    (line,) = (line for line in printed.splitlines() if line.startswith("│ H₂"))
    cells = [cell.strip() for cell in line.strip("│").split("│")]
    ours, best = (r["groove"]["H2"] for r in (results, results["best"]))
    assert cells[1:] == ["−0.66"] + [
        text
        for entry in (ours, best)
        for text in (f"{entry['sigma_mm']:.3f}", f"{entry['error_mm']:+.3f}".replace("-", "−"))
    ]
    for name in ("S1", "SD"):
        assert f"│ {name}" in printed
    print_chains({"groove": results["groove"]})
    assert "best" not in capsys.readouterr().out
