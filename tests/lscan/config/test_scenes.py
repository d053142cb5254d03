"""The scenes that come with lscan: found by name wherever a file of theirs is taken."""

import json
from pathlib import Path
from typing import get_args

import pytest
from places import SCENES
from typer.testing import CliRunner

from lscan.cli.app import app
from lscan.config.board import load_board
from lscan.config.documents import read_document
from lscan.config.rig import load_rig
from lscan.config.scenes import (
    SpecKind,
    copy_scenes,
    scene_file,
    scene_names,
    scenes_folder,
    spec_file,
    spec_names,
)
from lscan.errors import InputError


def test_every_file_has_its_name() -> None:
    """Those of scenes, and those of studies but their catalogue of parts, each in its own list."""
    assert scenes_folder() == SCENES
    names, studies = scene_names(), spec_names("study")
    others = sum(len(spec_names(kind)) for kind in get_args(SpecKind)) + 1  # the catalogue
    assert len(names) + others == len(list(SCENES.rglob("*.toml")))
    assert all(scene_file(name) == SCENES / f"{name}.toml" for name in names)
    assert all(spec_file(name, "study") == SCENES / "studies" / f"{name}.toml" for name in studies)
    assert {"paper-budget", "seasons", "first-rig"} <= set(studies)


@pytest.mark.parametrize("path", ["paper-budgt", "studies/paper-budget", "mine.toml"])
def test_neither_file_nor_name_of_a_study_is_refused(path: str) -> None:
    with pytest.raises(InputError, match="no such file, and no study of that name") as refused:
        spec_file(path, "study")
    assert "first-rig, paper-budget, " in str(refused.value.allowed)
    assert ("did you mean paper-budget?" in str(refused.value)) == ("budg" in path)


def test_a_study_of_that_path_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "seasons").write_text("own = 1", encoding="utf-8")
    assert spec_file("seasons", "study") == Path("seasons")


@pytest.mark.parametrize("name", ["paper/sandwave", Path("paper/sandwave")])
def test_a_name_stands_for_the_file(name: Path | str) -> None:
    assert load_rig(name).document == load_rig(SCENES / "paper" / "sandwave.toml").document


def test_a_board_has_a_name_too() -> None:
    board = load_board(Path("paper/calibration-board"))
    assert board == load_board(SCENES / "paper" / "calibration-board.toml")


def test_a_file_of_that_path_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "paper" / "rig").mkdir(parents=True)  # a folder is no such file
    (tmp_path / "paper" / "board").write_text("own = 1", encoding="utf-8")
    assert read_document("paper/board") == {"own": 1}
    assert "camera" in read_document("paper/rig")


def test_a_file_includes_a_scene_by_its_name(tmp_path: Path) -> None:
    """Unless there is a file of that path beside it."""
    own = tmp_path / "own.toml"
    own.write_text('include = "paper/board"\nname = "own"', encoding="utf-8")
    assert load_rig(own).document == {**load_rig("paper/board").document, "name": "own"}
    (tmp_path / "paper").mkdir()
    (tmp_path / "paper" / "board").write_text("mine = 1", encoding="utf-8")
    assert read_document(own) == {"mine": 1, "name": "own"}


@pytest.mark.parametrize("path", ["paper/sandwav", "../scenes/paper/sandwav", "rig.toml", "a\0b"])
def test_neither_file_nor_name_is_refused_by_both(path: str) -> None:
    with pytest.raises(InputError, match="no such file, and no scene of that name") as refused:
        read_document(path)
    assert "lscan scenes" in str(refused.value)


@pytest.mark.parametrize("path", ["paper/sandwav", "paper/sandwave.tml", "nothing"])
def test_a_name_with_a_typing_error_brings_the_nearest(path: str) -> None:
    with pytest.raises(InputError) as refused:
        read_document(path)
    meant = "; did you mean paper/sandwave? (" in str(refused.value)
    assert meant == (path != "nothing")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("paper/rig", "target: field required: this is a rig in the tank with nothing to scan"),
        ("paper/calibration-board", "is no rig: it has neither [camera] nor [track]"),
    ],
)
def test_what_cannot_be_scanned_says_what_it_is(name: str, words: str) -> None:
    with pytest.raises(InputError) as refused:
        load_rig(name)
    assert words in str(refused.value)
    assert "scene" in str(refused.value.allowed)


def test_a_path_from_the_root_is_no_name(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="gone: cannot be read: No such file"):
        read_document(tmp_path / "gone")


def test_copies_are_whole_and_never_overwrite(tmp_path: Path) -> None:
    copy_scenes(tmp_path / "mine")
    copied = {path.relative_to(tmp_path / "mine") for path in (tmp_path / "mine").rglob("*.*")}
    assert copied == {path.relative_to(SCENES) for path in SCENES.rglob("*.*")}
    assert load_rig(tmp_path / "mine" / "targets" / "coloured-mesh.toml")
    with pytest.raises(InputError, match="mine: is there already"):
        copy_scenes(tmp_path / "mine")


def test_the_command_lists_names_and_copies(tmp_path: Path) -> None:
    listed = CliRunner().invoke(app, ["scenes"]).output.splitlines()
    assert [line.split()[0] for line in listed] == scene_names()
    about = next(line for line in listed if line.startswith("paper/sandwave"))
    assert "The sandwave (Sec. IV.C, Figs. 22 to 32): 400 pictures" in about
    assert about.endswith(", as a block in a tank does.")
    copied = CliRunner().invoke(app, ["scenes", "--copy", str(tmp_path / "mine"), "--json"])
    answer = json.loads(copied.output)
    assert answer == {"scenes": scene_names(), "copied_to": str(tmp_path / "mine")}
    assert (tmp_path / "mine" / "paper" / "rig.toml").is_file()
