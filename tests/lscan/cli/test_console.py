"""What the command lines show: whole help, names of strangers as they are, words for nothing."""

import os
import re
import subprocess
import sys
from ast import literal_eval
from importlib.metadata import entry_points
from pathlib import Path
from pkgutil import resolve_name
from types import ModuleType

import pytest
import typer
from command_line import call
from places import ROOT
from typer.core import TyperGroup

import lscan.cli.app
import sim.cli.app
from lscan.calibration.planemap import find_solver
from lscan.cli import console
from lscan.cli.console import EXTRACTORS, MAP_NAMES, MAPS, note, progress_bar, show, table
from lscan.config.scenes import scene_about, scene_names, spec_names
from lscan.records import Length
from sim.cli.app import STUDIES

APPS = {"lscan": lscan.cli.app.app, "lscan-sim": sim.cli.app.app}


def said(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    code, out, err = call(capsys, *words)
    assert code == 0, err
    return " ".join((out + err).split())


def test_the_list_of_commands_is_not_cut(capsys: pytest.CaptureFixture[str]) -> None:
    text = said(capsys, "--help")
    assert "Find the board's control points in a picture and solve a plane map from them." in text
    assert "..." not in text.replace("[ARGS]...", "")


@pytest.mark.parametrize("module", [lscan.cli.app, sim.cli.app], ids=["lscan", "lscan-sim"])
def test_commands_are_declared_as_their_functions_are(module: ModuleType) -> None:
    """Their help comes from a part of their module; what is called is the whole one's function."""
    places = {**module.COMMANDS, **module.SUITE_COMMANDS}
    whole = typer.Typer(rich_markup_mode=None)
    for name, place in places.items():
        whole.command(name)(resolve_name(place))
    helps = []
    for app in (console.command_line("", places), whole):
        app.callback()(console.before_any_command)
        group = typer.main.get_command(app)
        assert isinstance(group, TyperGroup)
        helps.append([
            command.get_help(command.make_context(name, [], resilient_parsing=True))
            for name, command in sorted(group.commands.items())
        ])  # fmt: skip
    assert helps[0] == helps[1]
    assert len(helps[0]) == len(places)


def test_no_help_loads_what_is_heavy() -> None:
    code = """
import sys, typer, lscan.cli.app, sim.cli.app
for module in (lscan.cli.app, sim.cli.app):
    main = typer.main.get_command(module.app).main
    for words in [[], *zip(module.COMMANDS), *(("suite", name) for name in module.SUITE_COMMANDS)]:
        assert main([*words, "--help"], standalone_mode=False) == 0, words
heavy = "scipy cv2 matplotlib mitsuba drjit plotly trimesh h5py shapely pandas xarray PIL sqlite3"
print({name.partition(".")[0] for name in sys.modules} & {*heavy.split()})
print({name for name in sys.modules if name.startswith(("lscan.cli.", "sim.cli."))})
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    *helps, heavy, loaded = done.stdout.splitlines()
    assert sum(line.startswith("Usage: ") for line in helps) >= 32
    assert heavy == "set()"
    shared = {"lscan.cli.app", "lscan.cli.console", "sim.cli.app"}
    assert literal_eval(loaded) == shared


def test_help_names_all_extractors_maps_and_studies() -> None:
    known = {one.name for one in entry_points(group="lscan.extractors")}
    assert set(re.findall(r"[a-z-]+", EXTRACTORS.partition(";")[0])) == known
    for name in MAP_NAMES:
        find_solver(name)
    families = {one.name for one in entry_points(group="lscan.planemaps")} - {"auto", "metric"}
    assert set(re.findall(r"graticule|polynomial|projective|spline\b|refractive", MAPS)) == families
    assert STUDIES.split(", ") == spec_names("study")
    assert spec_names("data set") == ["stripes"]
    assert spec_names("suite") == ["chains", "full", "quick"]


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("lscan che", {"check"}),
        ("lscan scan paper/gr", {"paper/groove"}),
        ("lscan live my-", {"my-rig.toml"}),
        ("lscan devices ./my", {"./my-rig.toml"}),
        ("lscan extract --extractor centroid-", {"centroid-relative", "centroid-squared"}),
        ("lscan calibrate --map a", {"auto"}),
        ("lscan bench --map polynomial-", {f"polynomial-{degree}" for degree in range(1, 10)}),
        ("lscan schema s", {"scene", "shapes", "study", "suite"}),
        ("lscan extract --axis c", set()),  # the shell then offers files
        ("lscan-sim render paper/gr", {"paper/groove"}),
        ("lscan-sim serve board.toml my", {"my-rig.toml"}),
    ],
)
def test_a_shell_is_offered_names(
    words: str, offered: set[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    (tmp_path / "my-rig.toml").touch()
    monkeypatch.chdir(tmp_path)
    program, *rest = words.split()
    monkeypatch.setenv(f"_{program.upper().replace('-', '_')}_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(len(rest)))
    with pytest.raises(SystemExit) as left:
        typer.main.get_command(APPS[program]).main([], prog_name=program)
    assert left.value.code == 0
    assert set(capsys.readouterr().out.split()) == offered


def test_bash_completes_by_the_line_that_the_tutorial_gives(tmp_path: Path) -> None:
    """By bash itself, as it calls the function that the line declares, in a process of its own."""
    program = tmp_path / "lscan-sim"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m sim.cli.app "$@"\n')
    program.chmod(0o755)
    page = (ROOT / "docs/tutorials/first-scan.md").read_text(encoding="utf-8")
    line = re.search(r"`(eval .*source_bash lscan.*)` \|$", page, re.MULTILINE)
    assert line is not None
    script = f"""
{line[1].replace("_LSCAN_", "_LSCAN_SIM_").replace(" lscan)", " lscan-sim)")}
complete -p lscan-sim | grep -q -- '-F _lscan_sim_completion lscan-sim$' || exit 1
COMP_WORDS=(lscan-sim check paper/gr) COMP_CWORD=2
_lscan_sim_completion lscan-sim
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "--norc", "-c", script],
        env=environment, cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout == "paper/groove\n"
    assert done.stderr == ""


def test_every_scene_is_described(capsys: pytest.CaptureFixture[str]) -> None:
    text = said(capsys, "scenes")
    assert "targets/red A red block under the red laser: bright." in text
    for name in scene_names():
        assert re.fullmatch(r"\w[^#]{10,}[.?:]", scene_about(name), re.S), name


def test_no_suites_are_said(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lscan.suites.suites_found", dict)
    assert "lscan-sim suite make quick" in said(capsys, "suite", "list")


def test_a_table_shows_names_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    rows = [["[red]block[/red]", float("nan")], ["a[/]b", 1.0], ["\x1b[2Jclear\a", 2.0]]
    show(rows, table("[bold]shapes", ["name", "[mm]"], rows), json=False)
    text = capsys.readouterr().out
    for shown in ("[bold]shapes", "[mm]", "[red]block[/red]", "a[/]b", r"\x1b[2Jclear\x07", " – "):
        assert shown in text
    assert "\x1b" not in text and "\a" not in text and "nan" not in text
    note("run \x1b]0;title\a\u202e")
    assert capsys.readouterr().err == "lscan: note: run \\x1b]0;title\\x07\\u202e\n"


def test_long_work_is_told_of_without_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [0.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: clock[0])
    with progress_bar("cases") as progress:
        for done, clock[0] in ((1, 10.0), (2, 61.0), (3, 70.0), (4, 122.0)):
            progress(done, 500)
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["lscan: note: cases: 2 of 500", "lscan: note: cases: 4 of 500"]


def test_a_length_is_printed_in_words() -> None:
    assert str(Length(60.0, 60.012, 0.0443)) == "60.012 ± 0.044 mm, nominal 60 mm"
    assert str(Length(60.0, 60.01, 0.17)) == "60.01 ± 0.17 mm, nominal 60 mm"
    assert "± unknown" in str(Length(60.0, 60.0, float("nan")))


def test_a_length_that_is_measured_too_long_has_an_error_above_zero() -> None:
    long = Length(60.0, 60.3, 0.1)
    assert long.error_mm == pytest.approx(0.3) == long.as_json()["error_mm"]
    assert long.percent == pytest.approx(0.5)


def test_standard_output_that_takes_nothing_is_one_line() -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "lscan.cli.app", "scenes"],
            stdout=full, stderr=subprocess.PIPE, text=True, check=False,
        )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr == "lscan: standard output cannot be written: No space left on device\n"


def test_another_error_of_the_system_is_not_taken_for_one_of_standard_output(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Such as a connection's, which has no file's name either."""
    app = console.command_line("test")

    @app.command()
    def scan() -> None:
        raise ConnectionResetError(104, "Connection reset by peer")

    monkeypatch.setattr(sys, "argv", ["test"])
    with pytest.raises(ConnectionResetError):
        console.run_command_line(app, "test")


def test_signals_that_come_as_the_interpreter_ends_leave_the_exit_code() -> None:
    code = """
import atexit, os, signal
from lscan.cli.console import command_line, run_program
from lscan.devices.signals import STOPPING
app = command_line("test")
@app.command()
def stop():
    signal.raise_signal(signal.SIGTERM)
for number in STOPPING:
    atexit.register(os.kill, os.getpid(), number)
run_program(app, "test")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "test: stopped\n")
