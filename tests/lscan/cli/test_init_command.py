"""``lscan init``: what it writes loads as it was answered, and replaces nothing unasked."""

import json
from pathlib import Path

import pytest
from command_line import call, refused
from jsonschema import Draft202012Validator
from places import PAPER_BOARD
from typer.testing import CliRunner

from lscan.cli import devices
from lscan.cli.app import app
from lscan.config.documents import read_document
from lscan.config.rig import RigFile, load_rig
from lscan.devices.listing import SerialPort, VideoDevice

BY_ID = "/dev/v4l/by-id/usb-A_webcam-index0"


@pytest.fixture(autouse=True)
def _found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A camera in use, one that is ready, a port of the machine's own and one of a cable."""
    cameras = [
        VideoDevice("/dev/video0", "is in use"),
        VideoDevice("/dev/video2", "ready", size_px=(1280, 720), by_id=(BY_ID,)),
    ]
    ports = [SerialPort("/dev/ttyS0", "n/a"), SerialPort("/dev/ttyUSB0", "USB Serial")]
    monkeypatch.setattr(devices, "video_devices", lambda: cameras)
    monkeypatch.setattr(devices, "serial_ports", lambda: ports)
    monkeypatch.chdir(tmp_path)


def written(capsys: pytest.CaptureFixture[str], *options: str) -> RigFile:
    """The rig that ``lscan init --yes OPTIONS`` writes."""
    code, _, err = call(capsys, "init", "--yes", *options)
    assert (code, err) == (0, "")
    return load_rig("rig.toml")


def test_what_is_found_is_proposed(capsys: pytest.CaptureFixture[str]) -> None:
    rig = written(capsys).rig
    assert rig.camera.options == {"device": BY_ID} and rig.camera.size_px == (1280, 720)
    assert rig.track.driver == "grbl"
    assert rig.track.options == {
        "port": "/dev/ttyUSB0", "min_mm": 0, "max_mm": 150, "zero_mm": -160
    }  # fmt: skip
    positions = rig.plan.positions_mm()
    assert (positions[0], positions[1], positions[-1]) == (0.0, 0.5, 150.0)
    assert rig.board == load_rig("paper/board").rig.board
    assert rig.optics.temperature_c is not None


def test_the_files_name_their_schemas_and_keep_them(capsys: pytest.CaptureFixture[str]) -> None:
    document = written(capsys).document
    for name, kind in {"rig.toml": "rig", "my-board.toml": "board"}.items():
        line = Path(name).read_text().partition("\n")[0]
        assert line == f"#:schema ./schemas/{kind}.json"
        schema = json.loads(Path(f"schemas/{kind}.json").read_text())
        Draft202012Validator(schema).validate(read_document(name))
    assert "board" in document


def test_answers_are_asked_for_in_turn(tmp_path: Path) -> None:
    (tmp_path / "plates").mkdir()
    plate = Path("plates/mine.toml")
    plate.write_text(PAPER_BOARD.read_text())
    (tmp_path / "rigs").mkdir()
    answers = ["http://10.0.0.7/stream", "manual", "2,7", str(plate), "sea"]
    result = CliRunner().invoke(app, ["init", "rigs/one.toml"], input="\n".join(answers))
    assert result.exit_code == 0, result.output
    assert BY_ID in result.output and "/dev/ttyUSB0" in result.output  # listed before
    assert "lscan live rigs/one.toml" in result.output
    rig = load_rig("rigs/one.toml").rig
    assert rig.camera.options == {"url": answers[0]}
    assert rig.track.driver == "manual"
    assert rig.plan.positions_mm() == [0.0, 2.0, 4.0, 6.0]
    assert rig.board == load_rig("paper/board").rig.board
    assert rig.optics.salinity_psu is not None and rig.optics.port == "flat"
    assert not Path("rigs/my-board.toml").exists()


def test_options_answer_as_well(capsys: pytest.CaptureFixture[str]) -> None:
    odd = '/dev/a "b" \\c'
    options = "--camera", "3", "--track", odd, "--scan", "0.1,0.3"
    rig = written(capsys, *options, "--board", "none", "--water", "air").rig
    assert rig.camera.options == {"device": 3} and rig.camera.size_px == (640, 480)
    assert rig.track.options["port"] == odd
    assert (rig.plan.frames, rig.board, rig.optics.port) == (4, None, "none")


def test_no_file_is_replaced_unless_told(capsys: pytest.CaptureFixture[str]) -> None:
    Path("rig.toml").write_text("mine")
    refused(call(capsys, "init", "--yes"), "rig.toml", "--force")
    Path("rig.toml").unlink()
    Path("my-board.toml").write_text("mine")
    words = "--board", "paper/calibration-board"
    refused(call(capsys, "init", "--yes", *words), "my-board.toml", "--force")
    assert [path.name for path in Path().iterdir()] == ["my-board.toml"]
    assert Path("my-board.toml").read_text() == "mine"
    assert call(capsys, "init", "--yes", "--force", *words)[0] == 0
    # A board that is there is the one that is proposed.
    assert written(capsys, "--force").rig.board == load_rig("paper/board").rig.board


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--scan", "150", "STEP,LENGTH"),
        ("--scan", "0,150", "STEP,LENGTH"),
        ("--scan", "1e-6,150", "plan.frames"),
        ("--water", "mud", "fresh, sea, air"),
        ("--board", "nobody", "no such file"),
        ("--board", "paper/rig", "board"),
    ],
)
def test_what_makes_no_rig_is_refused_before_anything_is_written(
    capsys: pytest.CaptureFixture[str], option: str, value: str, words: str
) -> None:
    refused(call(capsys, "init", "--yes", option, value), words)
    assert not [*Path().iterdir()]
