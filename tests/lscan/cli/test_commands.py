"""The command line: every command as a user calls it, and every kind of bad input."""

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import call, refused
from places import ROOT

from lscan.acquisition.run import open_run
from lscan.acquisition.writer import create_run
from lscan.config.documents import merge
from lscan.config.rig import parse_rig
from lscan.surface import load_surface

pytestmark = pytest.mark.xdist_group("cli")  # one worker: they share a fixture

SCENES = ROOT / "scenes" / "paper"
QUICKLY = "[render]\nsamples = 4\nscatter_samples = 0\n"
LONG_S = 300.0  # only a command that hangs takes so long


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run folders of the board and the grooved block, and a calibration, made by the commands.

    The light of higher orders is left out: the figures' bars are the paper's errors.
    """
    folder = tmp_path_factory.mktemp("runs")
    for name in ("board", "groove"):
        scene = folder / f"{name}.toml"
        scene.write_text(f'include = "{SCENES / name}.toml"\n{QUICKLY}')
        done = subprocess.run(
            [sys.executable, "-m", "lscan.cli.app", "scan", scene, "-o", folder / name],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert done.stderr == "", "no progress bar where stderr is not a terminal"
    return folder


@pytest.fixture
def calibration(runs: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    path = runs / "calibration.json"
    if not path.exists():
        code, _, err = call(capsys, "calibrate", runs / "board", "-o", path)
        assert code == 0, err
    return path


@pytest.mark.slow
def test_a_scan_too_short_to_be_aligned_is_written_as_scanned(
    runs: Path, calibration: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Three frames of the sandwave show none of its edges; what they show is not withheld."""
    scene, run, surface = tmp_path / "scene.toml", tmp_path / "run", tmp_path / "surface.nc"
    plan = f"[plan]\nstart_mm = 60.0\nframes = 3\n{QUICKLY}"
    scene.write_text(f'include = "{SCENES / "sandwave.toml"}"\n{plan}')
    assert call(capsys, "scan", scene, "-o", run)[0] == 0
    code, out, err = call(capsys, "reconstruct", run, "-c", calibration, "-o", surface)
    assert code == 0
    assert "aligned" not in out and "not aligned" in err
    read = load_surface(surface)
    assert read.frame == "head"
    assert set(np.unique(read.position_mm)) == {60.0, 60.5, 61.0}


@pytest.mark.slow
def test_calibrate_finds_every_control_point(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = call(
        capsys, "calibrate", runs / "board", "-o", tmp_path / "c.json", "--map", "polynomial-5",
        "--overlay", tmp_path / "o.png", "--json",
    )  # fmt: skip
    assert code == 0, err
    summary = json.loads(out)
    assert summary["control_points"] == {"expected": 100, "found": 100}
    assert summary["map"] == "polynomial-5"
    assert cv2.imread(str(tmp_path / "o.png")).shape == (480, 640, 3)


@pytest.mark.slow
def test_seeds_by_hand_give_the_same_calibration(
    runs: Path, calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    marks = json.loads(calibration.read_text())["reading"]["grid"]["image_px"]
    seeds = ",".join(str(round(value)) for k in (0, 10, 1) for value in marks[k])
    code, _, err = call(
        capsys, "calibrate", runs / "board", "-o", tmp_path / "c.json", "--seeds", seeds
    )
    assert code == 0, err
    again = json.loads((tmp_path / "c.json").read_text())["reading"]["grid"]["image_px"]
    # The seeds set the first window's size only (test_controlpoints: within 0.02 px).
    np.testing.assert_allclose(again, marks, atol=0.02)


@pytest.mark.slow
def test_measure_says_the_same_where_the_scene_is_not(
    runs: Path, calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A copied run folder calibrates, reconstructs and measures to the same numbers."""
    for name in ("board", "groove"):
        shutil.copytree(runs / name, tmp_path / name)
        here = call(capsys, "measure", runs / name, "-c", calibration, "--json")
        there = call(capsys, "measure", tmp_path / name, "-c", calibration, "--json")
        assert here[0] == 0, here[2]
        assert here == there
    again = tmp_path / "c.json"
    assert call(capsys, "calibrate", tmp_path / "board", "-o", again)[0] == 0
    assert again.read_bytes() == calibration.read_bytes()
    for folder in (runs, tmp_path):
        result = call(
            capsys, "reconstruct", folder / "groove", "-c", calibration,
            "-o", tmp_path / f"{folder.name}.nc", "--points", tmp_path / f"{folder.name}.ply",
        )  # fmt: skip
        assert result[0] == 0, result[2]
    first, second = (tmp_path / f"{folder.name}.ply" for folder in (runs, tmp_path))
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.slow
def test_table_3_is_within_its_bar(
    runs: Path, calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The scattered light is left out here; tests/system/test_demo.py holds Table III with it."""
    path = tmp_path / "m.json"
    code, out, err = call(capsys, "measure", runs / "groove", "-c", calibration, "-o", path)
    assert code == 0, err
    assert "W1" in out
    groove = json.loads(path.read_text())["groove"]
    assert set(groove) == {"W1", "W2", "W3", "H1", "H2", "H3", "H4", "S1", "S2"}
    # The size of the paper's own errors in Table III.
    assert max(abs(entry["error_mm"]) for entry in groove.values()) <= 0.70


@pytest.mark.slow
def test_extract_counts_add_up(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = call(
        capsys, "extract", runs / "groove", "-o", tmp_path / "s.csv", "--overlay",
        tmp_path / "o.png", "--frame", 2, "--json",
    )  # fmt: skip
    assert code == 0, err
    counts = json.loads(out)
    assert sum(counts["status"].values()) == counts["columns"] == 640
    rows = (tmp_path / "s.csv").read_text().splitlines()
    assert len(rows) == 641
    assert sum(",OK" in row or ",SATURATED" in row for row in rows) == counts["found"]


@pytest.mark.slow
def test_a_report_of_two_runs(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, err = call(
        capsys, "report", "-o", tmp_path, "--board", runs / "board", "--groove", runs / "groove"
    )
    assert code == 0, err
    assert "Table III" in (tmp_path / "report.html").read_text()
    results = json.loads((tmp_path / "results.json").read_text())
    assert "sandwave" not in results
    assert results["pictures"]["groove"] == {
        "camera": "sim", "simulated": True, "noise": True, "noise_seed": 1,
    }  # fmt: skip
    # The rig has [optics]: its pictures are read by the best chain too, as the rig allows.
    best = results["best"]
    assert best["chain"] == {
        "plane_map": "refractive", "extractors": ["ml"], "corrected_for": [],
    }  # fmt: skip
    assert set(best["groove"]) == set(results["groove"])
    assert list(best["distances"]) == ["refractive"]


@pytest.mark.slow
def test_a_report_of_a_rig_without_optics_says_that_there_is_no_best_chain(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same picture as if a webcam had taken it: no simulated tank, and nothing of its port."""
    whole = open_run(runs / "board")
    document = merge(whole.rig_file.document, {"camera": {"driver": "opencv"}})
    del document["optics"]
    with create_run(tmp_path / "run", parse_rig(document, "rig.toml", trusted=True)) as writer:
        writer.append(whole.frame(0))
    code, out, err = call(capsys, "report", "-o", tmp_path / "out", "--board", tmp_path / "run")
    assert code == 0, err
    assert "no section [optics]" in out
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert "no section [optics]" in results["best"]["refused"]
    assert results["pictures"] == {"board": {"camera": "opencv"}}
    assert "imulated" not in out


def other_size(calibration: Path, path: Path) -> Path:
    """The calibration as if it had been solved from a picture half as large."""
    content = json.loads(calibration.read_text())
    content["reading"]["image_size"] = [320, 240]
    path.write_text(json.dumps(content))
    return path


@pytest.mark.slow
def test_a_run_that_is_not_complete_is_said_to_be_so(
    runs: Path, calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = open_run(runs / "groove")
    with create_run(tmp_path / "part", whole.rig_file) as writer:
        for index in range(3):
            writer.append(whole.frame(index))
    code, _, err = call(capsys, "measure", tmp_path / "part", "-c", calibration)
    assert code == 0, err
    assert "holds 3 of 5 frames" in err


@pytest.mark.slow
def test_bad_input_to_commands_that_need_a_run(
    runs: Path, calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    board, groove, out = runs / "board", runs / "groove", tmp_path / "x.json"
    refused(call(capsys, "calibrate", board, "-o", out, "--map", "mercator"), "mercator")
    refused(call(capsys, "calibrate", board, "-o", out, "--map", "polynomial-x"), "x")
    refused(call(capsys, "calibrate", board, "-o", out, "--channel", "pink"), "pink", "red")
    refused(call(capsys, "calibrate", board, "-o", out, "--seeds", "1,2,3"), "--seeds", "1,2,3")
    nowhere = tmp_path / "no" / "c.json"
    refused(call(capsys, "calibrate", board, "-o", nowhere), str(nowhere))
    refused(call(capsys, "extract", groove, "--frame", 9), "--frame", "0 to 4")
    refused(call(capsys, "extract", groove, "--span", 0), "span_px")
    refused(call(capsys, "extract", groove, "--extractor", "magic"), "magic", "centroid")
    refused(call(capsys, "extract", groove, "--extractor", "os:getcwd"), "os:getcwd")
    overlay = ["-o", nowhere, "--overlay", tmp_path / "o.png"]
    refused(call(capsys, "calibrate", board, *overlay), str(nowhere))
    points = ["-o", tmp_path / "s.nc", "--points", tmp_path / "no" / "p.ply"]
    refused(call(capsys, "reconstruct", groove, "-c", calibration, *points), "p.ply")
    refused(call(capsys, "report", "-o", calibration, "--board", board), str(calibration))
    small = other_size(calibration, tmp_path / "small.json")
    refused(call(capsys, "measure", groove, "-c", small), "640, 480", "320 x 240")
    small.unlink()
    refused(call(capsys, "measure", groove, "-c", board / "run.json"), "run.json")
    refused(call(capsys, "scan", SCENES / "groove.toml", "-o", groove), str(groove), "--resume")
    refused(call(capsys, "report", "-o", tmp_path, "--board", board, "--groove", board), "board")
    assert list(tmp_path.iterdir()) == [], "nothing half-done is left"
    code, _, err = call(capsys, "calibrate", groove, "-o", out)
    assert (code, err.count("\n")) == (1, 1), "a picture without a board: a result out of bounds"
    assert not out.exists()


def test_bad_input_that_needs_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "x.json"
    text, flat = tmp_path / "text.png", tmp_path / "flat.png"
    text.write_text("not a picture")
    cv2.imwrite(str(flat), np.full((40, 60), 90, np.uint8))
    deep = tmp_path / "deep.tif"
    cv2.imwrite(str(deep), np.zeros((8, 8), np.float32))
    board = SCENES / "calibration-board.toml"

    refused(call(capsys, "calibrate", text, "--board", board, "-o", out), "text.png", "picture")
    refused(call(capsys, "calibrate", deep, "--board", board, "-o", out), "deep.tif", "32 bit")
    refused(call(capsys, "calibrate", flat, "-o", out), "--board")
    pink = ["calibrate", flat, "--board", board, "-o", out, "--channel", "pink"]
    refused(call(capsys, *pink), "lscan: --channel: must be 'red'", "pink")
    refused(
        call(capsys, "calibrate", flat, "--board", SCENES / "rig.toml", "-o", out),
        "rig.toml: is a rig",
    )
    refused(call(capsys, "calibrate", tmp_path, "-o", out), "run.json")
    refused(call(capsys, "calibrate", tmp_path / "nosuch", "-o", out), "no such file or folder")
    refused(call(capsys, "extract", tmp_path / "none.png"), "none.png")
    refused(call(capsys, "extract", flat, "--background", deep), "deep.tif")
    refused(call(capsys, "extract", flat, "--axis", "diagonal"), "axis", "diagonal")
    refused(call(capsys, "scan", tmp_path / "none.toml", "-o", out), "none.toml")
    refused(call(capsys, "scan", text, "-o", out), "text.png", "TOML")
    refused(call(capsys, "scan"), "argument")
    refused(call(capsys, "extract", flat, "--span", "two"), "--span")
    refused(call(capsys, "unheard-of"), "unheard-of")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["deep.tif", "flat.png", "text.png"]


@pytest.mark.parametrize(
    "arguments",
    [
        ("extract", "LONG"),
        ("extract", "flat.png", "-o", "LONG/s.csv"),
        ("calibrate", "LONG", "-o", "c.json"),
        ("scan", SCENES / "board.toml", "-o", "LONG"),
        ("scan", SCENES / "board.toml", "-o", "LONG", "--resume"),
        ("measure", "LONG", "-c", "c.json"),
        ("reconstruct", "LONG", "-c", "c.json", "-o", "s.nc"),
        ("report", "-o", "report", "--board", "LONG"),
    ],
    ids=lambda arguments: f"{arguments[0]} {len(arguments)}",
)
def test_a_name_longer_than_any_file_may_have_is_one_line(
    arguments: tuple[object, ...],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Linux takes 255 bytes; pathlib raises for more where it is asked what there is."""
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("flat.png", np.full((40, 60), 90, np.uint8))
    long = "a" * 300
    given = [str(argument).replace("LONG", long) for argument in arguments]
    code, out, err = call(capsys, *given)
    assert (code, out) == (2, "")
    assert long in err.splitlines()[-1]
    assert [path.name for path in tmp_path.iterdir()] == ["flat.png"]


def test_a_flat_picture_holds_no_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cv2.imwrite(str(tmp_path / "flat.png"), np.full((40, 60), 90, np.uint8))
    code, out, _ = call(capsys, "extract", tmp_path / "flat.png", "--json")
    assert code == 0
    assert json.loads(out) == {"columns": 60, "found": 0, "status": {"NO_PEAK": 60}}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sent", "begun"),
    [
        (signal.SIGINT, signal.SIG_DFL),
        (signal.SIGINT, signal.SIG_IGN),
        (signal.SIGTERM, signal.SIG_DFL),
    ],
)
def test_ctrl_c_says_how_to_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], sent: int, begun: signal.Handlers
) -> None:
    """A scan stopped by SIGINT or SIGTERM leaves with 130 and a line, and --resume finishes it.

    Also one begun with SIGINT ignored, as a shell without job control begins a job with "&".
    """
    scene = tmp_path / "scene.toml"
    scene.write_text(
        f'include = "{SCENES / "groove.toml"}"\n[plan]\nframes = 12\nstep_mm = 0.1\n{QUICKLY}'
    )
    command = [
        sys.executable,
        "-m",
        "lscan.cli.app",
        "scan",
        str(scene),
        "-o",
        str(tmp_path / "run"),
    ]
    with subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, begun),
    ) as process:
        first = tmp_path / "run" / "frames" / "000001.png"
        while not first.exists() and process.poll() is None:
            time.sleep(0.05)
        process.send_signal(sent)
        _, err = process.communicate(timeout=LONG_S)
    assert process.returncode == 130
    kept = len(list((tmp_path / "run" / "frames").glob("0*.png")))
    note = f"of 12 frames are kept in {tmp_path / 'run'}; go on with --resume\n"
    assert err in [f"lscan: stopped; {count} {note}" for count in (kept, kept - 1)]
    code, out, err = call(capsys, "scan", scene, "-o", tmp_path / "run", "--resume", "--json")
    assert code == 0, err
    assert json.loads(out)["frames"] == 12
