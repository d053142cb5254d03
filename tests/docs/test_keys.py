"""The reference describes every key of every file, every status and every method, and no other."""

import os
import re
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from places import ROOT, SCENES, tracked
from typer.core import TyperGroup
from typer.main import get_command

sys.path.append(str(ROOT / "docs" / "_ext"))

import commandline
import drawing
import lists
import lscan_docs
import workspace

from lscan.cli.app import app as instrument
from lscan.config.userfiles import Section, as_markdown, descriptions, find_file, models_in, rows
from lscan.records import Status
from sim.cli.app import app as tank
from tests.validation.light.gallery import scene_files

PAGES = [*lscan_docs.KINDS, "scene camera.options", "scene track.options"]
ALL = {page: lscan_docs.sections_on(page) for page in PAGES}
SECTIONS = [
    pytest.param(section, id=f"{page}-{section.label or 'file'}")
    for page, found in ALL.items()
    for section in found
]
NOT_KEYS = {"status", *lists.GROUPS}
"""Tables of the descriptions that are of no file."""


@pytest.mark.parametrize("section", SECTIONS)
def test_every_key_is_described(section: Section) -> None:
    """Each key is a row with a type and a default, or a table whose keys are described."""
    text = as_markdown(section)
    described = {part.model for found in ALL.values() for part in found}
    for key, info in section.model.model_fields.items():
        models = models_in(info.annotation)
        assert f"| `{info.alias or key}` |" in text or (models and set(models) <= described), key
    for _, kind, _, _, default, _ in rows(section):
        assert kind not in ("", "anything")
        assert default


def test_no_key_is_described_that_there_is_not() -> None:
    keys: dict[str, set[str]] = {}
    for found in ALL.values():
        for section in found:
            keys.setdefault(section.label or "file", set()).update(section.model.model_fields)
    for label, texts in descriptions().items():
        if label not in NOT_KEYS:
            assert label in keys, label
            assert set(texts) - {"_"} <= keys[label], label


def test_bounds_unit_and_default_are_those_of_the_model() -> None:
    plan = next(part for part in find_file("rig").sections if part.name == "plan")
    by_key = {row[0]: row for row in rows(plan)}
    assert by_key["frames"][:5] == ("frames", "whole number", "≥ 1, ≤ 1e+06", "", "`1`")
    assert by_key["step_mm"][:5] == ("step_mm", "number", "", "mm", "`0.5`")
    assert by_key["laser"][1] == '`"untouched"`, `"on"`, `"pairs"`'


def test_every_status_and_method_is_described() -> None:
    assert set(descriptions()["status"]) == {status.name for status in Status}
    for table in lists.TABLES.values():
        assert table().count("\n") >= 2
    for group in lists.GROUPS:
        names = {entry.name for entry in entry_points(group=group) if lists._ours(entry.value)}
        for text in descriptions()[group]:
            # Of plane maps a name goes on after its method's: "graticule-1".
            method = text.split("-")[0] if group == "lscan.planemaps" else text
            assert method in names, f"[{group}] {text}"


@pytest.mark.parametrize("program", commandline.APPS)
def test_every_command_is_listed_with_what_it_does(program: str) -> None:
    text = commandline.as_markdown(program)
    for name, command in commandline.commands(program).items():
        assert f"### {program} {name}\n\n{command.help.split()[0]}" in text
    assert ("| `SCENE` |" in text) or ("| `RIG` |" in text)


@pytest.mark.parametrize("package", ["lscan", "sim"])
def test_the_drawing_shows_every_room(package: str) -> None:
    picture = drawing.svg(package)
    rooms = {
        path.name
        for path in (ROOT / package).iterdir()
        if path.is_dir() and (path / "__init__.py").exists()
    }
    assert all(f">{room}</text>" in picture for room in rooms)


@pytest.mark.parametrize("package", ["lscan", "sim"])
def test_the_tables_of_the_architecture_name_every_room(package: str) -> None:
    page = (ROOT / "docs" / "explanation" / "architecture.md").read_text(encoding="utf-8")
    table = page.split(f"\n## {package}\n")[1].split("\n## ")[0]
    named = set(
        re.findall("`([a-z]+)`", " ".join(re.findall(r"^\| (.+?) \|", table, re.MULTILINE)))
    )
    paths = [path.relative_to(ROOT / package) for path in tracked(ROOT / package, "*.py")]
    modules = {path.stem for path in paths if len(path.parts) == 1} - {"__init__"}
    rooms = {path.parts[0] for path in paths if len(path.parts) > 1}
    assert rooms | modules == named


def test_a_build_keeps_everything_in_the_folder_that_it_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("IPYTHONDIR", "PYTHONPATH"):
        monkeypatch.setenv(name, "")
    monkeypatch.chdir(tmp_path)
    workspace.prepare(tmp_path / "work")
    [startup] = Path(os.environ["IPYTHONDIR"]).rglob("*.py")
    exec(startup.read_text(encoding="utf-8"), {})  # as a kernel does before the page's code
    assert Path.cwd().parent == tmp_path / "work"
    assert Path(workspace.cache(tmp_path / "work")).parent == tmp_path / "work"
    monkeypatch.setattr(drawing, "svg", lambda package: f"<svg>{package}</svg>")
    where = drawing.write("sim", ROOT / "docs", tmp_path / "pictures")
    shown = ROOT / "docs" / "explanation" / where
    assert shown.resolve() == tmp_path / "pictures" / "rooms-sim.svg"


def test_implied_arrows_are_left_out() -> None:
    pairs = {("a", "b"), ("b", "c"), ("a", "c"), ("a", "d")}
    assert drawing.reduced(pairs) == {("a", "b"), ("b", "c"), ("a", "d")}


def test_every_scene_is_listed() -> None:
    listed = (SCENES / "README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([a-z0-9/-]+\.toml)` \|", listed, re.MULTILINE)
    kept = set(scene_files(SCENES)) & set(tracked(SCENES))
    files = {path.relative_to(SCENES).as_posix() for path in kept}
    assert sorted(rows) == sorted(files)


def test_the_readme_is_short_and_its_pictures_are_small() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(readme.splitlines()) <= 150
    pictures = [ROOT / path for path in re.findall(r"!\[[^]]*\]\(([^)]+)\)", readme)]
    assert len(pictures) == 2
    assert all(path.stat().st_size <= 150_000 for path in pictures)


def test_the_readme_names_every_command() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for app in (instrument, tank):
        group = get_command(app)
        assert isinstance(group, TyperGroup)
        for name in group.commands:
            assert f"`{name}`" in readme, name


def test_links_of_pages_outside_the_docs_lead_somewhere() -> None:
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md"):
        for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
            assert Path(ROOT / target).exists(), target
