"""``lscan calibrate --map auto`` and ``lscan check``, as a user at sea calls them."""

import json
from dataclasses import replace
from pathlib import Path

import boards
import pytest
from command_line import call, refused
from planeviews import PAPER_BOARD, paper_board

from lscan.calibration.calibrationfile import load_calibration
from lscan.calibration.maps import auto
from lscan.config.documents import read_document, write_toml
from lscan.files.pictures import write_picture

pytestmark = pytest.mark.xdist_group("cli_check")  # one worker: they share a fixture

VIEW = boards.View()


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The board three times: for calibration, again as it was, and after a change of focus."""
    folder = tmp_path_factory.mktemp("pictures")
    refocused = replace(VIEW, focal_px=1.005 * VIEW.focal_px)
    for name, view, seed in (("first", VIEW, 1), ("again", VIEW, 2), ("refocused", refocused, 3)):
        write_picture(folder / f"{name}.png", boards.render(paper_board(), view, seed=seed))
    (folder / "optics.toml").write_text("[optics]\nfocal_px = [850.0, 30.0]\n")
    return folder


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """``auto`` with three quick candidates and one that does not exist; pictures are read once."""
    monkeypatch.setattr(auto, "CANDIDATES", ("spline", "polynomial-4", "projective", "nothing"))
    monkeypatch.setattr("lscan.cli.inputs.read_board", boards.read_once)


@pytest.fixture
def calibration(pictures: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    path = pictures / "c.json"
    if not path.exists():
        code, _, err = call(capsys, "calibrate", pictures / "first.png", "--board", PAPER_BOARD,
                            "-o", path, "--map", "spline")  # fmt: skip
        assert code == 0, err
    return path


def test_auto_prints_its_table(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ("calibrate", pictures / "first.png", "--board", PAPER_BOARD, "--map", "auto",
              "--optics", pictures / "optics.toml", "-o", tmp_path / "c.json")  # fmt: skip
    code, out, err = call(capsys, *common)
    assert code == 0 and "board file" not in err
    for word in ("spline", "polynomial-4", "nothing: refused", "without", "rms mm"):
        assert word in out
    code, out, err = call(capsys, *common, "--json")
    assert code == 0, err
    summary = json.loads(out)
    assert summary["map"] == "auto"
    assert summary["chosen"] == summary["scores"][0]["name"]
    assert [score["name"] for score in summary["scores"]][-1] == "nothing"
    assert load_calibration(tmp_path / "c.json").optics.focal_px == (850.0, 30.0)


def test_marks_that_the_board_file_has_elsewhere_are_named(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """20 mm off, one of sixteen dots, one of three rings: the control points do without them."""
    document = read_document(PAPER_BOARD)
    for mark in (document["dot"][7], document["ring"][0]):
        mark["x_mm"] += 20.0
    write_toml(tmp_path / "board.toml", document)
    code, out, err = call(capsys, "calibrate", pictures / "first.png", "--board",
                          tmp_path / "board.toml", "-o", tmp_path / "c.json", "--map",
                          "projective", "--json")  # fmt: skip
    assert code == 0, err
    assert json.loads(out)["control_points"]["found"] == 100
    assert "not found where the board file has them: B4, E; " in err


def test_check_agrees_with_the_same_board(
    pictures: Path, calibration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """At a level of one false alarm in a thousand: the pictures are noisy, but fixed."""
    common = ("check", calibration, pictures / "again.png", "--board", PAPER_BOARD,
              "--level", 0.001)  # fmt: skip
    code, out, err = call(capsys, *common)
    assert (code, err) == (0, "")
    assert "the calibration agrees" in out
    code, out, _ = call(capsys, *common, "--placed", 1.0, "--json")
    assert code == 0
    found = json.loads(out)
    assert found["agrees"] is True
    assert found["reasons"] == []
    assert found["rms_mm"] < 0.2
    assert len(found["worst"]) == 5


def test_check_disagrees_after_a_change_of_focus(
    pictures: Path, calibration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ("check", calibration, pictures / "refocused.png", "--board", PAPER_BOARD)
    code, out, err = call(capsys, *common)
    assert (code, err) == (1, "")
    assert "the calibration disagrees: scale" in out
    code, out, _ = call(capsys, *common, "--json")
    assert code == 1
    assert json.loads(out)["agrees"] is False


def test_bad_input(
    pictures: Path, calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = pictures / "again.png"
    refused(call(capsys, "check", calibration, picture), "--board")
    refused(call(capsys, "check", tmp_path / "no.json", picture, "--board", PAPER_BOARD), "no.json")
    refused(
        call(capsys, "check", calibration, picture, "--board", PAPER_BOARD, "--level", 2), "level"
    )
    empty = tmp_path / "empty.toml"
    empty.write_text("")
    refused(
        call(capsys, "calibrate", picture, "--board", PAPER_BOARD, "--optics", empty,
             "-o", tmp_path / "c.json"), "empty.toml", "[optics]",
    )  # fmt: skip
    empty.write_text("[optics]\ngap_mm = [10.0, -1.0]\n")
    refused(
        call(capsys, "calibrate", picture, "--board", PAPER_BOARD, "--optics", empty,
             "-o", tmp_path / "c.json"), "empty.toml", "optics.gap_mm",
    )  # fmt: skip
    assert not (tmp_path / "c.json").exists()


def test_check_says_how_to_correct_and_does(
    pictures: Path, calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ("check", calibration, pictures / "refocused.png", "--board", PAPER_BOARD)
    code, out, _ = call(capsys, *common)
    assert code == 1
    assert "--update FILE --correct scale" in out
    assert ("a new calibration is better" in out) == ("scale, shape" in out)
    better = tmp_path / "better.json"
    code, out, err = call(capsys, *common, "--update", better)
    assert code == 0, err
    assert "corrected (scale)" in out
    # What a change of focus leaves of the shape is in the lack of fit, so that it agrees.
    code, out, err = call(capsys, "check", better, *common[2:])
    assert code == 0, err
    code, out, _ = call(capsys, "check", better, *common[2:], "--update", tmp_path / "none.json")
    assert code == 0 and "nothing to correct" in out
    assert not (tmp_path / "none.json").exists()


@pytest.mark.slow  # test_carry.py refuses it by the map
def test_check_takes_a_picture_to_the_water_that_a_file_states(
    pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A map that knows of no water is refused in another one, so the file was read."""
    for name, celsius in (("bucket", 20.0), ("sea", 5.0)):
        (tmp_path / f"{name}.toml").write_text(f"[optics]\ntemperature_c = [{celsius}, 0.5]\n")
    of_picture = (pictures / "again.png", "--board", PAPER_BOARD)
    bucket, sea = (("--optics", tmp_path / f"{name}.toml") for name in ("bucket", "sea"))
    saved = tmp_path / "c.json"
    call(capsys, "calibrate", *of_picture, *bucket, "--map", "polynomial-4", "-o", saved)
    assert call(capsys, "check", saved, *of_picture, *bucket)[0] == 0
    refused(call(capsys, "check", saved, *of_picture, *sea), "cannot be carried to other water")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (
            ("--correct", "focus", "--update", "x.json"),
            ("--correct", "focus", "scale, index, shift"),
        ),
        (("--correct", "index", "--update", "x.json"), ("no index of the water",)),
        (("--correct", "shift", "--update", "x.json"), ("placed_mm", "a shift cannot be told")),
        (("--optics", "no.toml"), ("no.toml",)),
    ],
)
def test_corrections_that_there_are_not_are_refused(
    pictures: Path,
    calibration: Path,
    options: tuple[str, ...],
    says: tuple[str, ...],
    capsys: pytest.CaptureFixture[str],
) -> None:
    common = ("check", calibration, pictures / "refocused.png", "--board", PAPER_BOARD)
    refused(call(capsys, *common, *options), *says)
