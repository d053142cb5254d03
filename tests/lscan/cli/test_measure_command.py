"""``lscan measure`` on runs of what can, and of what cannot, be measured."""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from boards import read_once
from command_line import call, refused
from drawn_runs import board_run, flat_run
from typer.testing import CliRunner

import lscan
from lscan.cli.app import app
from lscan.cli.console import run_command_line
from lscan.config.targets import Sandwave
from lscan.errors import BoardNotFound
from lscan.records import Provenance
from lscan.surface import Alignment
from lscan.surface.alignment import save_alignment

pytestmark = pytest.mark.xdist_group("measure")  # one worker: they share a fixture

Command = Callable[..., tuple[int, str, str]]


@pytest.fixture(autouse=True)
def _read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lscan.pipeline.read_board", read_once)


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the run of one board picture, and the calibration of it."""
    folder = tmp_path_factory.mktemp("measure")
    board_run(folder / "board")
    call = ["lscan", "calibrate", str(folder / "board"), "-o", str(folder / "c.json")]
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemExit) as left:
        patch.setattr(sys, "argv", [*call, "--map", "polynomial-3"])
        run_command_line(app, "lscan")
    assert left.value.code == 0
    return folder


@pytest.fixture
def command(
    calibrated: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Command:
    """Exit code, stdout and stderr of ``lscan NAME RUN -c CALIBRATION`` with further words."""

    def call(name: str, run: Path, *more: str) -> tuple[int, str, str]:
        capsys.readouterr()
        words = ["lscan", name, str(run), "-c", str(calibrated / "c.json"), *more]
        monkeypatch.setattr(sys, "argv", words)
        with pytest.raises(SystemExit) as left:
            run_command_line(app, "lscan")
        output = capsys.readouterr()
        assert isinstance(left.value.code, int)
        return left.value.code, output.out, output.err

    return call


@pytest.mark.parametrize(
    ("sections", "words"),
    [
        ({}, "names a [board] and no [workpiece], and the pictures show no board; "),
        ({"plan": {"frames": 1}}, "the pictures show no board (no grid of dark dots"),
        ({"plan": {"frames": 1, "laser": "on"}}, "the pictures show no board; "),
        ({"board": None}, "names neither [board] nor [workpiece]"),
    ],
)
def test_of_a_scan_of_something_else_it_says_what_can_be_measured(
    sections: dict[str, Any], words: str, command: Command, tmp_path: Path
) -> None:
    frames = sections.get("plan", {"frames": 5})["frames"]
    flat_run(tmp_path / "mesh", frames, **sections)
    code, out, err = command("measure", tmp_path / "mesh", "--json")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert words in err
    assert "`lscan reconstruct` gives the surface" in err
    assert 'a picture of the [board], or [workpiece] kind = "grooved-block" or "sandwave"' in err


@pytest.mark.parametrize("plan", [{"frames": 3}, {"frames": 3, "step_mm": 0.0, "laser": "on"}])
def test_a_board_is_measured_however_its_run_was_planned(
    plan: dict[str, Any], command: Command, tmp_path: Path
) -> None:
    """A rig of real hardware may share one plan among its board and its scans."""
    board_run(tmp_path / "board", frames=plan.get("frames", 1), plan={"frames": 1, **plan})
    code, out, err = command("measure", tmp_path / "board", "--json")
    assert (code, err) == (0, "")
    assert len(json.loads(out)["distances"]) > 0


@pytest.mark.parametrize("kind", ["grooved-block", "sandwave"])
def test_a_workpiece_that_is_not_there_is_named(
    kind: str, command: Command, tmp_path: Path
) -> None:
    flat_run(tmp_path / "mesh", 5, workpiece={"kind": kind})
    code, out, err = command("measure", tmp_path / "mesh", "--json")
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert f"is a {kind}; where something else was scanned, `lscan reconstruct`" in err


def test_reconstruct_says_of_a_run_of_the_board_that_there_is_no_surface(
    calibrated: Path, command: Command, tmp_path: Path
) -> None:
    code, _, err = command("reconstruct", calibrated / "board", "-o", str(tmp_path / "s.nc"))
    assert (code, err.count("\n")) == (1, 1)
    assert "no laser line in any of its 1 pictures" in err
    assert "there is no surface to build; a run of the board is for `lscan calibrate`" in err
    assert not (tmp_path / "s.nc").exists()


def test_reconstruct_refuses_more_points_than_a_file_holds_before_it_begins(
    command: Command, calibrated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lscan.surface.files.MOST_POINTS", 600)
    code, _, err = command("reconstruct", calibrated / "board", "-o", str(tmp_path / "s.nc"))
    assert (code, err.count("\n")) == (2, 1)
    assert "too many points for a file (got '1 profiles of 640 columns'; allowed: 600" in err


def test_reconstruct_notes_that_few_columns_hold_a_line(command: Command, tmp_path: Path) -> None:
    flat_run(tmp_path / "few", 1, lit=slice(300, 308))
    code, _, err = command("reconstruct", tmp_path / "few", "-o", str(tmp_path / "s.nc"))
    assert (code, err.count("\n")) == (0, 1)
    says = r"lscan: note: only (\d+) of 640 columns hold a line; if the pictures show the board, "
    noted = re.match(says + "there is no surface to build", err)
    assert noted is not None
    surface = lscan.load_surface(tmp_path / "s.nc")
    assert int(noted[1]) == np.isfinite(surface.xyz_mm[..., 2]).sum()


@pytest.mark.parametrize(
    ("frames", "sections", "words"),
    [
        (5, {"workpiece": {"kind": "sandwave"}}, "a scan of the [workpiece] 'sandwave'; calibrate"),
        (5, {}, "a scan from several places; calibrate from a run or a picture of the board"),
        (1, {}, "light and sharpen the board"),
    ],
)
def test_calibrate_says_of_a_run_of_something_else_what_it_shows(
    frames: int, sections: dict[str, Any], words: str, tmp_path: Path
) -> None:
    flat_run(tmp_path / "mesh", frames, **sections)
    call = ["calibrate", str(tmp_path / "mesh"), "-o", str(tmp_path / "c.json")]
    with pytest.raises(BoardNotFound) as refused:
        CliRunner().invoke(app, call, catch_exceptions=False)
    assert words in str(refused.value)
    with pytest.raises(BoardNotFound, match=re.escape(words)):
        lscan.calibrate_run(lscan.open_run(tmp_path / "mesh"))


def test_reconstruct_of_dark_pictures_writes_no_file(command: Command, tmp_path: Path) -> None:
    flat_run(tmp_path / "dark", 1, stripe={"threshold_dn": 255.0})
    code, out, err = command("reconstruct", tmp_path / "dark", "-o", str(tmp_path / "s.nc"))
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "no laser line in any of its 1 pictures, so there is no surface to build" in err
    assert not (tmp_path / "s.nc").exists()


def test_a_rig_without_the_block_has_no_alignment_to_keep(
    calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is said before a picture is read: there is none that could be."""
    flat_run(tmp_path / "flat", 2)
    for picture in (tmp_path / "flat" / "frames").iterdir():
        picture.write_bytes(b"")
    out = ("-o", tmp_path / "s.nc", "--save-alignment", tmp_path / "a.json")
    arguments = ("reconstruct", tmp_path / "flat", "-c", calibrated / "c.json", *out)
    refused(call(capsys, *arguments), "another workpiece", "sandwave")


def test_an_alignment_found_with_another_calibration_is_remarked_on(
    calibrated: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    level = Alignment(
        yaw_rad=0.03, yaw_sigma_rad=0.001, rotation=np.eye(3), translation_mm=np.zeros(3),
        normal=np.array([0.0, 0.0, 1.0]), base_mm=20.0, left_corner_mm=np.zeros(2),
        right_corner_mm=np.array([200.0, 0.0]), pivot_mm=np.zeros(3), modes=np.zeros((7, 7)),
    )  # fmt: skip
    made_from = Provenance("tank", 100, "ml", "refractive", "ab" * 32)
    save_alignment(tmp_path / "a.json", level, made_from, Sandwave())
    flat_run(tmp_path / "flat", 2)
    out = ("-o", tmp_path / "s.nc", "--alignment", tmp_path / "a.json")
    code, said, err = call(
        capsys, "reconstruct", tmp_path / "flat", "-c", calibrated / "c.json", *out
    )
    assert code == 0 and "yaw 1.719 deg" in said
    assert "those of the block scanned with 'tank', with another calibration" in err


@pytest.mark.parametrize(
    ("sections", "said"),
    [
        (
            {"camera": {"driver": "fake", "width_px": 320, "height_px": 240}},
            "pictures are not of the size of the calibration",
        ),
        ({"since_calibration": {"sheet_shift_mm": 0.5}}, "plane map knows nothing of"),
    ],
)
def test_a_run_that_does_not_fit_its_calibration_is_refused(
    command: Command, tmp_path: Path, sections: dict[str, Any], said: str
) -> None:
    """Of pictures of another size, and of a rig that has changed since in what the map ignores."""
    flat_run(tmp_path / "run", 2, **sections)
    code, _, error = command("reconstruct", tmp_path / "run", "-o", str(tmp_path / "surface.nc"))
    assert (code, said in error) == (2, True), error
    assert not (tmp_path / "surface.nc").exists()
