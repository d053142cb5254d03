"""``lscan-sim serve`` as a process: what it says, and that nothing stays when it is stopped."""

import json
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from served import small_scene

from lscan.cli.console import run_command_line
from lscan.config.documents import write_toml
from lscan.config.rig import load_rig
from sim.cli.app import app
from sim.emulators.hardware import EmulatedHardware

PATIENCE_S = 120.0


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    file = tmp_path / "scene.toml"
    write_toml(file, small_scene().document)
    return file


def start(scene_file: Path, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "sim.cli.app", "serve", str(scene_file), *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def stop(process: subprocess.Popen[str], number: int) -> tuple[str, str]:
    process.send_signal(number)
    return process.communicate(timeout=PATIENCE_S)


def read_json(process: subprocess.Popen[str]) -> Any:
    """The first JSON object of its output."""
    assert process.stdout is not None
    text = ""
    while line := process.stdout.readline():
        text += line
        if line == "}\n":
            break
    return json.loads(text)


def test_it_runs_until_sigterm_and_leaves_nothing(scene_file: Path, tmp_path: Path) -> None:
    link, rig = tmp_path / "track", tmp_path / "rig.toml"
    process = start(scene_file, "--json", "--link", str(link), "--write-rig", str(rig))
    try:
        where = read_json(process)
        with urllib.request.urlopen(where["snapshot"], timeout=PATIENCE_S) as answer:
            assert answer.read(2) == b"\xff\xd8"  # how a JPEG begins
        assert where["port"] == str(link) and link.readlink().exists()
        options = load_rig(Path(where["rig"])).rig
        assert options.camera.options["url"] == where["url"]
        assert options.track.options["port"] == str(link)
        _, errors = stop(process, signal.SIGTERM)
    finally:
        process.kill()
    assert (process.returncode, errors) == (0, "")
    left = sorted(path.name for path in tmp_path.iterdir())
    assert left == ["rig.toml", "scene.toml"]


@pytest.mark.slow  # what is served, tests/sim/emulators/test_serve.py reads in process
def test_it_says_in_lines_where_everything_is_and_stops_at_ctrl_c(scene_file: Path) -> None:
    process = start(scene_file)
    try:
        assert process.stdout is not None
        lines = [process.stdout.readline() for _ in range(4)]
        said, errors = stop(process, signal.SIGINT)
    finally:
        process.kill()
    assert [line.split(": ")[0] for line in lines] == ["scene", "url", "snapshot", "port"]
    assert (process.returncode, said, errors) == (0, "", "")


@pytest.mark.slow  # what is served, tests/sim/emulators/test_serve.py reads in process
def test_board_and_scan_are_served_in_one_go(scene_file: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.toml"
    other.write_bytes(scene_file.read_bytes())
    process = start(scene_file, str(other), "--json", "--write-rig", str(tmp_path / "rigs"))
    try:
        served = read_json(process)["scenes"]
        _, errors = stop(process, signal.SIGTERM)
    finally:
        process.kill()
    assert (process.returncode, errors) == (0, "")
    assert len({place["url"] for place in served} | {place["port"] for place in served}) == 4
    for place, name in zip(served, ("scene", "other"), strict=True):
        assert place["scene"] == str(tmp_path / f"{name}.toml")
        assert place["rig"] == str(tmp_path / "rigs" / f"{name}.toml")
        assert load_rig(Path(place["rig"])).rig.camera.options["url"] == place["url"]


def test_what_cannot_be_served_is_refused_before_it_is_rendered(
    scene_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["lscan-sim", "serve", str(scene_file), str(scene_file), "--link", "track"]
    other = scene_file.with_name("other.toml")
    other.write_bytes(scene_file.read_bytes())
    no_folder = f"{other}: cannot be made a folder"
    monkeypatch.setattr(EmulatedHardware, "__init__", lambda *_: pytest.fail("is rendered"))
    for arguments, what in (
        (words, "--link: goes with one scene"),
        ([*words[:3], "--write-rig", str(scene_file)], f"{scene_file}: is another file"),
        ([*words[:4], "--write-rig", "rigs"], "scenes: would have rig files of one name"),
        ([*words[:3], str(other), "--write-rig", str(other)], no_folder),
        ([*words[:3], "--write-rig", str(other / "rig.toml")], no_folder),
    ):
        monkeypatch.setattr(sys, "argv", arguments)
        with pytest.raises(SystemExit) as end:
            run_command_line(app, "lscan-sim")
        assert end.value.code == 2
        assert capsys.readouterr().err.startswith(f"lscan-sim: {what}")


@pytest.mark.parametrize(
    ("option", "value", "what"),
    [
        ("--quality", "101", "must be a whole number of 1 to 100 (got 101)"),
        ("--http-port", "-1", "must be a whole number of 0 to 65535 (got -1)"),
        ("--dialect", "fanuc", "must be 'grbl' or 'marlin' (got 'fanuc')"),
    ],
)
def test_a_bad_option_is_one_clear_line(
    scene_file: Path,
    option: str,
    value: str,
    what: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["lscan-sim", "serve", str(scene_file), option, value])
    with pytest.raises(SystemExit) as end:
        run_command_line(app, "lscan-sim")
    assert end.value.code == 2
    assert tuple(capsys.readouterr()) == ("", f"lscan-sim: {option}: {what}\n")
