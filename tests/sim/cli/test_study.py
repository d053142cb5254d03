"""``lscan-sim study`` and ``concavity``: what they print, write and refuse."""

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import xarray as xr
from places import SCENES
from study_cases import known_of
from study_examples import study_results
from typer.testing import CliRunner

import sim.studies.running
from lscan.cli.console import BAD_INPUT, STOPPED, run_command_line
from lscan.config.scenes import spec_names
from lscan.errors import InputError
from lscan.records import Floats
from sim.cli.app import app
from sim.studies import concavity
from sim.studies.concavity import ConcavityCase, ConcavityErrors
from sim.studies.design.catalogue import load_catalogue
from sim.studies.page import comparison_text
from sim.studies.results import load_results
from sim.studies.rig.evaluation import GeometricRig
from sim.studies.rig.states import check_keys
from sim.studies.studyfile import Study, load_study

pytestmark = pytest.mark.xdist_group("study")  # one worker: they share a fixture

STUDY = """
name = "small"
calibrate = "paper/board"
scan = "paper/sandwave"
[precision]
base = 16
most = 16
alone = 16
[cause.focal]
key = "lens.focal_px"
when = "drift"
normal = [850, 1]
[cause.power]                 # no cause of the geometric tier
key = "laser.power_mw"
when = "as-built"
uniform = [9, 10]
"""
WRITTEN = ("results.json", "runs.nc", "report.html")


@pytest.fixture(scope="module", autouse=True)
def not_rendered() -> Iterator[None]:
    """What is known of pictures is made up, for studies of the paper's rig."""

    def known(study: Study) -> object:
        return known_of(study.file.calibrate, study.file.scan)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sim.studies.running, "prepare", known)
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a study that has been run: small.toml, out, and what was printed."""
    folder = tmp_path_factory.mktemp("study")
    (folder / "small.toml").write_text(STUDY, encoding="utf-8")
    arguments = ["study", str(folder / "small.toml"), "-o", str(folder / "out")]
    found = CliRunner().invoke(app, [*arguments, "--processes", "none"])
    assert found.exit_code == 0, found.output
    (folder / "printed").write_text(found.output, encoding="utf-8")
    return folder


def refused(
    arguments: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> str:
    """The one line with which the command leaves."""
    monkeypatch.setattr("sys.argv", ["lscan-sim", "study", *arguments])
    with pytest.raises(SystemExit) as left:
        run_command_line(app, "lscan-sim")
    assert left.value.code == BAD_INPUT
    line = capsys.readouterr().err.strip()
    assert line.startswith("lscan-sim: ") and "\n" not in line
    return line


def test_stopped_it_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ctrl-C comes while the fourth rig is evaluated."""
    whole, seen = GeometricRig.evaluate, []

    def evaluate(rig: GeometricRig, row: Floats) -> Floats:
        seen.append(row)
        if len(seen) == 4:
            raise KeyboardInterrupt
        return whole(rig, row)

    monkeypatch.setattr(GeometricRig, "evaluate", evaluate)
    (tmp_path / "small.toml").write_text(STUDY, encoding="utf-8")
    arguments = ["small.toml", "--processes", "none"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["lscan-sim", "study", *arguments])
    with pytest.raises(SystemExit) as left:
        run_command_line(app, "lscan-sim")
    assert left.value.code == STOPPED
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("lscan-sim: stopped; ") and last.endswith("go on with --resume")


@pytest.mark.parametrize("name", spec_names("study"))
def test_a_study_that_ships_is_one(name: str) -> None:
    """Its keys can vary, its usual numbers are in range, and parts of its design there are."""
    study = load_study(name)
    check_keys(study)
    if study.file.design:
        space = study.file.design.space(load_catalogue())
        assert len(space["sight"]) >= 20 and len(space["laser"]) > 1  # type: ignore[arg-type]


@pytest.mark.parametrize("drifts", [True, False])
def test_results_with_and_without_recalibration_are_printed(
    monkeypatch: pytest.MonkeyPatch, drifts: bool
) -> None:
    """The table of every cause; the laser's class by its name; a cost of four digits in full."""
    results = study_results()[0]
    if not drifts:
        outputs = tuple(replace(budget, after=None) for budget in results.outputs)
        results = replace(results, outputs=outputs)
    objectives = {"error / mm": 0.1, "cost / €": 1234.0, "laser class": "3R"}
    trial = replace(results.trials[0], objectives=objectives, on_front=True)
    results = replace(results, trials=(trial,))
    asked: list[object] = []

    def run_study(*_: object, against: object, **__: object) -> object:
        asked.append(against)
        return results

    monkeypatch.setattr("sim.studies.study.run_study", run_study)
    monkeypatch.setenv("COLUMNS", "300")
    against = ["--against", "lens.f_number=8", "--against", "port.gap_mm=1.5e1"]
    found = CliRunner().invoke(app, ["study", "any.toml", *against])
    assert found.exit_code == 0, found.exception
    assert asked == [{"lens.f_number": 8, "port.gap_mm": 15.0}]
    assert results.against and comparison_text(results.against) in found.stdout
    for cause in ("tilt", "salinity", "speckle"):
        assert cause in found.stdout
    assert ("alone, recalibrated" in found.stdout) == drifts
    row = next(line for line in found.stdout.splitlines() if "1234" in line)
    assert " 3R " in row and " 0.1 " in row


@pytest.mark.slow
def test_a_study_gives_its_three_files(finished: Path) -> None:
    """One cause drifts, and recalibrating takes all of it; the other has no effect and is named."""
    found = load_results(finished / "out")
    height = next(budget for budget in found.outputs if budget.name == "height")
    focal, power = height.causes
    assert focal.first and focal.total and height.after and height.after.rms
    assert height.base_rms is not None and focal.alone_rms and power.alone_rms
    assert focal.total.low <= 1.0 <= focal.total.high
    assert focal.alone_rms.value > 2 * height.base_rms
    assert height.after.rms.value == pytest.approx(height.base_rms, rel=0.01)
    assert power.alone_rms.value == pytest.approx(height.base_rms, rel=1e-12)
    note = "power: without any effect alone in the geometric tier"
    printed = (finished / "printed").read_text(encoding="utf-8")
    assert any(line.startswith(note) for line in found.notes) and note in printed
    assert all((finished / "out" / file).stat().st_size > 0 for file in WRITTEN)
    with xr.open_dataset(finished / "out" / "runs.nc") as runs:
        assert found.runs == 1 + 2 * 16 + 4 * 16 == len(runs["status"])
    for word in ("height: rms ", "levelled: rms ", "tilt-along", "report.html"):
        assert word in printed


@pytest.mark.slow
def test_going_on_with_a_study_that_is_done_gives_the_same_bytes(
    finished: Path, tmp_path: Path
) -> None:
    """But for the seconds that it took, which results.json and the page tell."""
    again = tmp_path / "out"
    shutil.copytree(finished / "out", again)
    arguments = ["study", str(finished / "small.toml"), "-o", str(again), "--processes", "none"]
    found = CliRunner().invoke(app, [*arguments, "--resume", "--json"])
    assert found.exit_code == 0, found.output
    before, after = (
        json.loads((folder / "results.json").read_text(encoding="utf-8"))
        for folder in (finished / "out", again)
    )
    assert before.pop("seconds") > 0 and after.pop("seconds") > 0
    assert after == before
    for file in ("runs.nc", "prepared.npz"):
        assert (again / file).read_bytes() == (finished / "out" / file).read_bytes()


@pytest.mark.slow
def test_a_study_that_is_done_is_compared_with_another_rig(finished: Path, tmp_path: Path) -> None:
    """Its camera stands farther off; what was drawn for the first rig is not drawn again."""
    shutil.copytree(finished / "out", tmp_path / "out")
    arguments = ["study", str(finished / "small.toml"), "-o", str(tmp_path / "out"), "--resume"]
    other = ["--against", "head.camera_mm.1=-900", "--processes", "none"]
    found = CliRunner().invoke(app, [*arguments, *other])
    assert found.exit_code == 0, found.output
    text = (tmp_path / "out" / "against.txt").read_text(encoding="utf-8")
    assert (
        text.startswith("The other rig: head.camera_mm.1 -866.025 to -900.")
        and text in found.output
    )
    compared = load_results(tmp_path / "out").against
    assert compared and compared.rigs == 32 and compared.failed == (0, 0)
    beside = load_results(tmp_path / "out" / compared.folder)
    assert beside.runs == load_results(finished / "out").runs
    height = compared.outputs[0]
    assert height.narrower and height.narrower > 1 and height.parts[0].part != "power"


@pytest.mark.slow
def test_growing_ends_where_more_runs_were_not_agreed_to(finished: Path, tmp_path: Path) -> None:
    """What is known by then is written, and a note says that it was to be known better."""
    study = tmp_path / "small.toml"
    wanted = STUDY.replace("most = 16", "most = 64\nhalf_width = 1e-12")
    study.write_text(wanted, encoding="utf-8")
    shutil.copytree(finished / "out", tmp_path / "out")
    arguments = ["study", str(study), "-o", str(tmp_path / "out"), "--processes", "none"]
    found = CliRunner().invoke(app, [*arguments, "--resume", "--at-most", "100"])
    assert found.exit_code == 0, found.output
    assert "more than the 100 runs agreed to" in found.output
    assert any(
        "known less well than ± 1e-12" in line for line in load_results(tmp_path / "out").notes
    )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("lens.focal_px", "lens.focal"), "small.toml, [cause.focal]: is the key of no number"),
        (("normal =", "norml ="), "norml"),
        (("paper/board", "paper/bord"), "did you mean paper/board?"),
    ],
)
def test_a_study_that_is_none_is_refused(
    change: tuple[str, str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    study = tmp_path / "small.toml"
    study.write_text(STUDY.replace(*change), encoding="utf-8")
    line = refused([str(study), "-o", str(tmp_path / "out")], monkeypatch, capsys)
    assert words in line
    assert not (tmp_path / "out").exists()


def test_two_scenes_of_two_rigs_are_refused(tmp_path: Path) -> None:
    board = SCENES / "paper" / "board.toml"
    scene = f'include = "{board.as_posix()}"\n[port]\ntilt_x_deg = 1.0\n'
    (tmp_path / "board.toml").write_text(scene, encoding="utf-8")
    study = tmp_path / "small.toml"
    study.write_text(STUDY.replace("paper/board", "board.toml"), encoding="utf-8")
    with pytest.raises(InputError, match="calibrate and scan are not of one rig: port differ"):
        load_study(study)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nothing.toml"], "nothing.toml: cannot be read: there is no such file, and no study"),
        (["paper-budget", "--at-most", "10"], "--at-most: too many runs ("),
        (["paper-budget", "--workers", "0"], "--workers: out of range (got 0; "),
        (["seasons", "--against", "lens.f_number"], "--against: no number (got 'lens.f_number';"),
        (["seasons", "--against", "lens.f_number=8mm"], "--against: no number (got 'lens.f_nu"),
        (["seasons", *2 * ["--against", "lens.k1=0"]], "--against: is given twice (got 'lens.k1'"),
        (["seasons", "--against", "lens.focal=9"], "board.toml: is the key of no number that can"),
        (["seasons", "--against", "lens.f_number=nan"], "--against: lens.f_number: must be a num"),
    ],
)
def test_a_wrong_argument_is_refused(
    arguments: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert words in refused(arguments, monkeypatch, capsys)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_folder_with_runs_is_gone_on_with_only_where_asked_and_by_the_same_study(
    finished: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    kept = (finished / "out" / "results.json").read_bytes()
    output = ["-o", str(finished / "out"), "--processes", "none"]
    line = refused([str(finished / "small.toml"), *output], monkeypatch, capsys)
    assert "holds runs of a study (allowed: --resume, or another folder)" in line
    other = tmp_path / "small.toml"
    other.write_text(STUDY.replace("[850, 1]", "[850, 2]"), encoding="utf-8")
    line = refused([str(other), *output, "--resume"], monkeypatch, capsys)
    assert "holds the results of another study" in line
    assert (finished / "out" / "results.json").read_bytes() == kept


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The targets that are measured, in place of rendering them."""
    names: list[str] = []

    def errors(case: ConcavityCase) -> ConcavityErrors:
        names.append(case.name)
        return ConcavityErrors(case.name, case.derived, 7, (0.03, 0.02, 0.01), (0.09, 0.06, 0.03))

    monkeypatch.setattr(concavity, "concavity_errors", errors)
    return names


def test_the_table_of_concavity_is_printed_and_written(tmp_path: Path, measured: list[str]) -> None:
    chosen = ["concavity", "--only", "sphere", "-o", str(tmp_path)]
    found = CliRunner().invoke(app, chosen)
    assert found.exit_code == 0, found.output
    assert measured and all("sphere" in name for name in measured)
    for name in measured:
        assert name in found.stdout
    written = json.loads((tmp_path / "concavity.json").read_text(encoding="utf-8"))
    assert [row["name"] for row in written] == measured
    assert written[0]["rms_mm"] == [0.03, 0.02, 0.01]
    assert json.loads(CliRunner().invoke(app, [*chosen, "--json"]).stdout) == written


def test_every_target_is_measured_unless_some_are_named(
    tmp_path: Path, measured: list[str]
) -> None:
    assert CliRunner().invoke(app, ["concavity", "-o", str(tmp_path)]).exit_code == 0
    assert len(measured) == len(set(measured)) == 9


def test_a_target_that_is_none_is_refused(tmp_path: Path, measured: list[str]) -> None:
    found = CliRunner().invoke(app, ["concavity", "--only", "cube", "-o", str(tmp_path)])
    assert isinstance(found.exception, InputError)
    assert "no such target" in str(found.exception) and "sphere of 60 mm" in str(found.exception)
    assert not measured
