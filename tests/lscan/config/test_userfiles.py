"""The schemas and the texts of the files that users write, held to the loaders of these files."""

import json
import random
import subprocess
import sys
import tomllib
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from jsonschema import Draft202012Validator
from places import SCENES, tracked
from typer.testing import CliRunner

from lscan.cli.app import app
from lscan.config.board import load_board
from lscan.config.documents import check, read_document
from lscan.config.rig import Rig
from lscan.config.userfiles import as_text, find_file, json_schema, kind_of, kinds
from lscan.errors import InputError
from sim.datasets.datasetspec import load_dataset_spec
from sim.datasets.suite import load_suite_spec
from sim.scene import load_scene
from sim.studies.design.catalogue import load_catalogue
from sim.studies.studyfile import load_study

TAPLO = Path(sys.executable).with_name("taplo")
FILES = sorted(file.relative_to(SCENES).as_posix() for file in tracked(SCENES, "*.toml"))
KINDS = {"studies": "study", "datasets": "dataset", "suites": "suite"}
OTHERS = {
    "studies/catalogue.toml": "catalogue",
    "paper/calibration-board.toml": "board",
    "metric/dots.toml": "board",
}
SCHEMAS = {kind: Draft202012Validator(json_schema(kind)) for kind in kinds()}
HARDWARE = """
[camera]
driver = "opencv"
[camera.options]
device = 0
[track]
driver = "grbl"
[track.options]
port = "/dev/ttyUSB0"
min_mm = 0.0
max_mm = 200.0
"""


WHOLE: list[tuple[str, str, Callable[[Path], object]]] = [
    ("scene", "paper/groove.toml", load_scene),
    ("scene", "best/sandwave.toml", load_scene),
    ("scene", "shaft/sandwave.toml", load_scene),
    ("board", "paper/calibration-board.toml", load_board),
    ("study", "studies/paper-budget.toml", load_study),
    ("suite", "suites/quick.toml", load_suite_spec),
    ("dataset", "datasets/stripes.toml", load_dataset_spec),
    ("catalogue", "studies/catalogue.toml", load_catalogue),
]


def read(text: str) -> dict[str, Any]:
    return tomllib.loads(text)


def faults(kind: str, document: dict[str, Any]) -> list[str]:
    return [error.message for error in SCHEMAS[kind].iter_errors(document)]


@pytest.mark.parametrize("kind", kinds())
def test_schemas_are_schemas(kind: str) -> None:
    Draft202012Validator.check_schema(SCHEMAS[kind].schema)


@pytest.mark.parametrize("name", FILES)
def test_every_file_that_comes_with_lscan_is_valid(name: str) -> None:
    document = read((SCENES / name).read_text(encoding="utf-8"))
    kind = OTHERS.get(name, KINDS.get(name.split("/")[0], "scene"))
    assert kind_of(document) == kind
    assert faults(kind, document) == []


def places_in(value: Any, place: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Of all keys and items of a document."""
    items = value.items() if isinstance(value, dict) else enumerate(value)
    found = []
    for key, inner in items:
        found.append((*place, key))
        if isinstance(inner, dict | list):
            found += places_in(inner, (*place, key))
    return found


def with_a_fault(document: dict[str, Any], rng: random.Random) -> dict[str, Any]:
    """What somebody may have typed wrong: a key, a type, a sign, a power of ten, a choice."""
    wrong = deepcopy(document)
    *table, key = rng.choice(places_in(wrong))
    holder: Any = wrong
    for part in table:
        holder = holder[part]
    value = holder[key]
    if isinstance(key, str) and rng.random() < 0.3:
        letter = rng.randrange(len(key))
        holder[key[:letter] + key[letter + 1 :] + rng.choice("aeiou")] = holder.pop(key)
    elif isinstance(value, bool):
        holder[key] = str(value)
    elif isinstance(value, int | float):
        holder[key] = rng.choice([str(value), -value - 1, 1e12 * (value + 1), [value]])
    elif isinstance(value, str):
        holder[key] = rng.choice([7, value + "s", ""])
    elif isinstance(value, list):
        holder[key] = rng.choice([value[:-1], [*value, "more"], "none"])
    else:
        holder[key] = rng.choice([[], 1.5, "none"])
    return wrong


@pytest.mark.parametrize("count", [50, pytest.param(500, marks=pytest.mark.slow)])
def test_most_wrong_files_are_found_by_the_schema_and_no_right_one(
    tmp_path: Path, count: int
) -> None:
    """Of those that the loader refuses, in one line, at least nine in ten are found without it."""
    rng = random.Random(60)
    whole = [(kind, read_document(SCENES / name), load) for kind, name, load in WHOLE]
    found = refused = 0
    while refused < count:
        kind, document, load = rng.choice(whole)
        wrong = with_a_fault(document, rng)
        told, file = faults(kind, wrong), tmp_path / "wrong.toml"
        file.write_text(tomli_w.dumps(wrong), encoding="utf-8")
        try:
            load(file)
        except InputError:
            refused, found = refused + 1, found + bool(told)
        else:
            assert told == []
    assert found >= 0.9 * count, f"{found} of {count}"


def test_a_file_that_includes_others_may_leave_out_anything() -> None:
    assert faults("scene", read('include = "paper/rig"\n[laser]\npower_mw = 5.0\n')) == []
    assert (
        faults(
            "scene", read('include = ["a", "b"]\nexclude = "workpiece"\n[port]\ntilt_x_deg = 1\n')
        )
        == []
    )
    assert faults("scene", read('include = "paper/rig"\n[laser]\npower = 5.0\n'))
    assert faults("study", read('include = "paper-budget"\nseed = 3\n')) == []
    assert faults("study", read("seed = 3\n")) != []


@pytest.mark.parametrize(
    ("wrong", "right"),
    [("device = 0", "devise = 0"), ('port = "/dev/ttyUSB0"', "port = 3"), ("grbl", "replay")],
)
def test_options_are_those_of_the_driver(wrong: str, right: str) -> None:
    check(Rig, read(HARDWARE), "")
    assert faults("rig", read(HARDWARE)) == []
    assert faults("rig", read(HARDWARE.replace(wrong, right)))


def test_a_rig_names_its_boards_file_or_holds_its_tables() -> None:
    board = (SCENES / "metric/dots.toml").read_text(encoding="utf-8")
    inner = "\n".join(
        line.replace("[", "[board.", 1) if line.startswith("[") else line
        for line in board.splitlines()
    )
    assert faults("rig", read(HARDWARE + '[board]\nfile = "dots.toml"\n')) == []
    assert faults("rig", read(f"{HARDWARE}[board]\n{inner}")) == []
    assert faults("rig", read(HARDWARE + "[board]\nfile = 3\n"))


def test_keys_are_explained_where_the_editor_shows_them() -> None:
    tables = json_schema("scene")["$defs"]
    assert tables["Plan"]["properties"]["step_mm"]["description"] == (
        "distance from one position to the next"
    )
    assert "{doc}" not in json.dumps(tables)


@pytest.mark.parametrize("kind", kinds())
def test_text_names_every_key_with_its_default(kind: str) -> None:
    text = "\n".join(as_text(section) for section in find_file(kind).sections)
    assert "`" not in text and "{doc}" not in text
    assert max(map(len, text.splitlines())) <= 100
    if kind == "scene":
        assert "  step_mm: number, mm; default 0.5\n      distance from one position" in text


def test_the_command_prints_writes_and_refuses(tmp_path: Path) -> None:
    invoke = CliRunner().invoke
    listed = invoke(app, ["schema"])
    assert [line.split()[0] for line in listed.output.splitlines()] == sorted(kinds())
    assert json.loads(invoke(app, ["schema", "board"]).output) == json_schema("board")
    assert invoke(app, ["schema", "rig", "--text"]).output.startswith("At the top of the file\n")
    file = tmp_path / "rig.json"
    assert "#:schema rig.json" in invoke(app, ["schema", "rig", "-o", str(file)]).output
    assert json.loads(file.read_text()) == json_schema("rig")
    refused = invoke(app, ["schema", "rigs"])
    assert isinstance(refused.exception, InputError)
    assert "got 'rigs'; allowed: board, catalogue, dataset" in str(refused.exception)


def test_copied_scenes_name_their_schemas(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    assert CliRunner().invoke(app, ["scenes", "--copy", str(folder)]).exit_code == 0
    files = sorted(folder.rglob("*.toml"))
    assert len(files) == len(FILES)
    schemas = {kind: json_schema(kind) for kind in kinds()}
    for file in files:
        first, rest = file.read_text(encoding="utf-8").split("\n", 1)
        assert rest == (SCENES / file.relative_to(folder)).read_text(encoding="utf-8")
        schema = (file.parent / first.removeprefix("#:schema ")).resolve()
        assert schema.parent == folder / "schemas"
        assert json.loads(schema.read_text()) == schemas[schema.stem]
    assert load_scene(folder / "paper/groove.toml").rig.name == "paper: grooved block"


@pytest.mark.slow
@pytest.mark.skipif(not TAPLO.exists(), reason="it has no wheel for this machine")
def test_an_outside_reader_agrees(tmp_path: Path) -> None:
    """Taplo, which editors read TOML by."""
    folder = tmp_path / "mine"
    CliRunner().invoke(app, ["scenes", "--copy", str(folder)])

    def code(*files: Path) -> int:
        command = [TAPLO, "check", *files]
        return subprocess.run(command, capture_output=True, check=False).returncode

    assert code(*folder.rglob("*.toml")) == 0
    wrong = folder / "paper" / "wrong.toml"
    for text in ("[plan]\nstep = 1.0", "[plan]\nframes = 0", 'include = "rig"\n[lens]\nf = 2.8'):
        wrong.write_text(f"#:schema ../schemas/scene.json\n{text}\n")
        assert code(wrong) != 0
