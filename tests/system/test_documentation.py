"""Every command in README, CONTRIBUTING and docs: its arguments are parsed, and it is run.

Commands stand in blocks of ``sh``.  They are run page by page, each once, in a folder with small
versions of the scenes; those for hardware on what the tank emulates.  ``ELSEWHERE`` names the test
that runs a command which takes long, or serves until it is stopped.
"""

import re
import shlex
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import typer
from places import PAPER_BOARD, ROOT, SCENES, tracked
from served import hurry, quick_rig, small_scene

import lscan.cli.app
import lscan.config.scenes
import sim.cli.app
from lscan.config.documents import toml_text
from sim.emulators import EmulatedHardware

APPS = {"lscan": lscan.cli.app.app, "lscan-sim": sim.cli.app.app}
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *tracked(ROOT / "docs", "*.md")]
BLOCK = re.compile(r"^```sh\n(.*?)^```", re.MULTILINE | re.DOTALL)
ELSEWHERE = {
    "lscan live": "tests/system/test_live_interrupt.py",
    "lscan report": "tests/lscan/cli/test_commands.py",
    "lscan bench": "tests/lscan/benchmark/test_benchmark.py",
    "lscan calibrate-shaft": "tests/system/test_shaft_tank.py",
    "lscan scan shaft/": "tests/system/test_shaft_tank.py",
    "lscan measure runs/nod": "tests/system/test_shaft_tank.py",
    "lscan-sim views metric/water --board": "tests/sim/datasets/test_views.py",
    "lscan-sim serve": "tests/system/test_serve_command.py",
    "lscan grid": "tests/lscan/surface/test_grid_files.py",
    "lscan init": "tests/lscan/cli/test_init_command.py",
    "lscan export": "tests/lscan/surface/test_recording.py",
    "lscan roughness": "tests/lscan/cli/test_roughness_command.py",
    "lscan-sim dataset": "tests/sim/datasets/test_dataset.py",
    "lscan leaderboard": "tests/lscan/benchmark/test_leaderboard.py",
    "lscan suite": "tests/lscan/suites/test_suites.py",
    "lscan-sim suite make": "tests/sim/datasets/test_suite.py",
    "lscan-sim study": "tests/sim/cli/test_study.py",
    "lscan-sim concavity": "tests/sim/cli/test_study.py",
    "make ": "Makefile",
    "pytest ": "conftest.py",
    "python -m tests.mutants": "tests/test_mutants.py",
    "pip install": "tests/system/test_package.py",
}
pytestmark = pytest.mark.xdist_group("documentation")


def commands(page: Path) -> list[str]:
    """The command lines of a page, continued lines joined, comments left out."""
    blocks = BLOCK.findall(page.read_text(encoding="utf-8"))
    text = "\n".join(blocks).replace("\\\n", " ")
    return [line for raw in text.splitlines() if (line := raw.split(" #")[0].strip())]


WITH_COMMANDS = [
    pytest.param(page, id=page.relative_to(ROOT).as_posix()) for page in PAGES if commands(page)
]


def test_no_command_stands_outside_a_block_of_sh() -> None:
    """Other fences and indented lines would hide it from these tests."""
    for page in PAGES:
        rest = BLOCK.sub("", page.read_text(encoding="utf-8"))
        assert not re.search(r"^\s*\$? ?(lscan|lscan-sim|make) [a-z-]+ .*-", rest, re.M), page
        assert not re.search(r"^```(console|bash|shell)", rest, re.M), page


@pytest.mark.parametrize("page", WITH_COMMANDS)
def test_the_arguments_are_known(page: Path) -> None:
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
    for line in commands(page):
        program, *arguments = shlex.split(line)
        if program == "make":
            assert arguments[0] in targets, line
        elif program in APPS:
            parsed(program, arguments)
        else:
            assert program in ("mkdir", "pip", "pytest", "python"), line


@cache
def built(program: str) -> Any:
    """The program's commands: typer takes 0.1 s to read what each of them is given."""
    return typer.main.get_command(APPS[program])


def parsed(program: str, arguments: list[str]) -> None:
    """Parse the arguments as the program does; its own error where it refuses them."""
    group = built(program)
    while hasattr(group, "commands"):
        name, *arguments = arguments
        group = group.commands[name]
    group.make_context(name, arguments)


def test_every_command_that_is_run_elsewhere_is() -> None:
    lines = [line for page in PAGES for line in commands(page)]
    for prefix, file in ELSEWHERE.items():
        assert any(line.startswith(prefix.strip()) for line in lines), prefix
        word = prefix.split()[1] if prefix.startswith("lscan") else ""
        assert word in (ROOT / file).read_text(encoding="utf-8"), prefix


@dataclass
class Workspace:
    """A folder in which commands run, and those that have run."""

    folder: Path
    done: set[str] = field(default_factory=set)

    def run(self, line: str) -> None:
        """Run a command in this process, once; AssertionError where it fails."""
        if line in self.done:
            return
        program, *arguments = shlex.split(line)
        if program == "mkdir":
            Path(arguments[-1]).mkdir(parents=True, exist_ok=True)
        else:
            if arguments[0] == "views":
                arguments += ["--poses", "5"]  # half as many as a rig needs
            if arguments[0] == "scan" and "--resume" not in arguments:  # of another page
                shutil.rmtree(arguments[arguments.index("-o") + 1], ignore_errors=True)
            code = built(program).main(arguments, prog_name=program, standalone_mode=False)
            assert code in (None, 0), line
        self.done.add(line)


@pytest.fixture(scope="module")
def tank(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """Scenes of few samples and few pictures, and the files that pages take for granted."""
    folder = tmp_path_factory.mktemp("documentation")
    shutil.copytree(SCENES, folder / "scenes")
    for file in (folder / "scenes").rglob("*.toml"):
        file.write_text(smaller(file.read_text(encoding="utf-8")), encoding="utf-8")
    rig = folder / "scenes" / "paper" / "rig.toml"
    rig.write_text(f"{rig.read_text()}\n[render]\nsamples = 1\nscatter_samples = 0\n")
    (folder / "scenes").rename(folder / "small")
    (folder / "out").mkdir()
    shutil.copy(PAPER_BOARD, folder / "my-board.toml")
    return Workspace(folder)


def smaller(text: str) -> str:
    """A scene file with fewer samples and, where there are hundreds, a hundred pictures."""
    fine = re.search(r"^fineness = ([23])", text, re.M)
    least = int(fine.group(1)) ** 2 if fine else 4 if 'shape = "board"' in text else 1
    text = re.sub(r"^samples = \d+", f"samples = {least}", text, flags=re.M)
    text = re.sub(r"^scatter_samples = \d+", "scatter_samples = 0", text, flags=re.M)
    text = text.replace("frames = 10", "frames = 2")
    # 2 mm apart: ten profiles across each wedge, as few as the alignment takes.
    return text.replace("frames = 400\nstep_mm = 0.5", "frames = 100\nstep_mm = 2.0")


@pytest.fixture(scope="module")
def hardware(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workspace]:
    """An emulated webcam and track with the rig file that ``lscan-sim serve`` writes for them."""
    folder = tmp_path_factory.mktemp("hardware")
    plan = {"start_mm": 20.0, "step_mm": 1.0, "frames": 3}
    with EmulatedHardware(small_scene(plan=plan)) as served:
        hurry(served)
        text = toml_text(quick_rig(served).document)
        (folder / "rig.toml").write_text(text, encoding="utf-8")
        (folder / "board.toml").write_text('include = "rig.toml"\n[plan]\nframes = 1\n')
        yield Workspace(folder)


def for_hardware(line: str) -> bool:
    """Whether a command opens the devices of a rig file of the reader's."""
    return re.search(r"^lscan (scan|devices)( (rig|board)\.toml|$)", line) is not None


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_COMMANDS)
def test_the_commands_run(
    page: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    for program in APPS:  # each module of commands, before scenes_folder is another
        assert all(built(program).commands.values())
    monkeypatch.setattr(typer, "prompt", lambda *_, **__: "")  # to put the cap on the lens
    for line in commands(page):
        if line.startswith(tuple(ELSEWHERE)):
            continue
        name = "hardware" if for_hardware(line) else "tank"
        workspace: Workspace = request.getfixturevalue(name)
        monkeypatch.chdir(workspace.folder)
        if name == "tank":
            # A name such as paper/board means a small scene.
            monkeypatch.setattr(lscan.config.scenes, "scenes_folder", lambda: Path("small"))
            _provide(line, workspace)
        workspace.run(line)


def _provide(line: str, tank: Workspace) -> None:
    """Make what a page takes for granted: pictures of one's own, and a scan with one's own rig."""
    needs: dict[str, Callable[[], None]] = {
        "photograph.jpg": lambda: _picture(tank, "board", "photograph.jpg"),
        "laser-on.png": lambda: _laser_pictures(tank),
        "mask.png": _mask,
        "two-lines.png": lambda: _picture(tank, "groove", "two-lines.png"),
        "upper.json": lambda: _calibration(tank, "upper.json"),
        "lower.json": lambda: _calibration(tank, "lower.json"),
        "runs/first": lambda: _scan(tank, "groove", "first"),
    }
    for file, make in needs.items():
        if file in line and not Path(file).exists():
            make()
    if line.startswith("lscan reconstruct runs/first") or "runs/board" in line:
        _scan(tank, "board", "board")
    if " -c calibration.json" in line and not Path("calibration.json").exists():
        tank.run("lscan calibrate runs/board -o calibration.json")


def _scan(tank: Workspace, scene: str, name: str) -> None:
    line = f"lscan scan paper/{scene} -o runs/{name}"
    if not Path("runs", name).exists():
        tank.run(line)


def _picture(tank: Workspace, scene: str, file: str) -> None:
    _scan(tank, scene, scene)
    picture = cv2.imread(f"runs/{scene}/frames/000000.png")
    cv2.imwrite(file, picture)


def _calibration(tank: Workspace, file: str) -> None:
    _scan(tank, "board", "board")
    tank.run(f"lscan calibrate runs/board -o {file}")


def _mask() -> None:
    """A mask that hides nothing of the picture whose line runs down."""
    cv2.imwrite("mask.png", np.full(cv2.imread("laser-on.png").shape[:2], 255, np.uint8))


def _laser_pictures(tank: Workspace) -> None:
    """A picture whose line runs down, and a black one for its background."""
    _scan(tank, "groove", "groove")
    picture = cv2.imread("runs/groove/frames/000000.png")
    cv2.imwrite("laser-on.png", cv2.rotate(picture, cv2.ROTATE_90_CLOCKWISE))
    cv2.imwrite("laser-off.png", cv2.rotate(0 * picture, cv2.ROTATE_90_CLOCKWISE))
