"""The rules of the house, kept by tests: floors, versions, entry points, clean files."""

import ast
import importlib.metadata
import itertools
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import documented
import house
import oldest
import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.version import Version
from places import ROOT, tracked

import lscan

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
MODULES = [
    path.relative_to(ROOT) for name in ("lscan", "sim") for path in tracked(ROOT / name, "*.py")
]
MODULE_NAMES = [".".join(path.with_suffix("").parts).removesuffix(".__init__") for path in MODULES]


# ---- import contracts -------------------------------------------------------------------


def _lint_imports(root: Path) -> subprocess.CompletedProcess[str]:
    program = Path(sys.executable).with_name("lint-imports")
    return subprocess.run(
        [program, "--no-cache", "--config", "pyproject.toml"],
        cwd=root,
        capture_output=True,
        text=True,
    )


def test_the_import_contracts_are_kept() -> None:
    done = _lint_imports(ROOT)
    assert done.returncode == 0, done.stdout + done.stderr


BREACHES = {
    "the instrument does not know the tank": [
        ("lscan/board/reader.py", "import sim.scene", "lscan.board.reader -> sim.scene"),
        ("lscan/paper/report.py", "import mitsuba", "lscan.paper.report -> mitsuba"),
    ],
    "the floors of lscan": [
        ("lscan/board/search.py", "import lscan.cli.app", "lscan.board.search -> lscan.cli.app"),
        ("lscan/attic.py", "", "lscan.attic"),
    ],
    "the floors of sim": [
        ("sim/scene/file.py", "import sim.render.tank", "sim.scene.file -> sim.render.tank"),
    ],
    "the truth judges code it does not use": [
        ("sim/truth/board.py", "import lscan.stripe", "sim.truth.board -> lscan.stripe"),
    ],
}


@pytest.fixture(scope="module")
def broken_contracts(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What lint-imports says of each contract where all of BREACHES are in one checkout."""
    folder = tmp_path_factory.mktemp("breached")
    shutil.copy(ROOT / "pyproject.toml", folder)
    for package in ("lscan", "sim"):
        shutil.copytree(ROOT / package, folder / package)
    for module, line, _ in itertools.chain(*BREACHES.values()):
        with (folder / module).open("a", encoding="utf-8") as file:
            file.write(f"\n{line}\n")
    done = _lint_imports(folder)
    assert done.returncode != 0
    parts = re.split(r"^(.+)\n-+$", done.stdout.partition("Broken contracts")[2], flags=re.M)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


@pytest.mark.xdist_group("house")
@pytest.mark.parametrize(
    ("contract", "said"),
    [(contract, said) for contract, breaches in BREACHES.items() for _, _, said in breaches],
)
def test_the_contracts_notice(broken_contracts: dict[str, str], contract: str, said: str) -> None:
    assert said in broken_contracts[contract]


@pytest.mark.slow  # the import contracts above say the same of what is written
def test_no_lscan_module_loads_the_tank() -> None:
    names = [name for name in MODULE_NAMES if name.split(".")[0] == "lscan"]
    assert "lscan.cli.app" in names
    code = (
        "import importlib, sys\n"
        "for name in sys.argv[1:]: importlib.import_module(name)\n"
        "print(sorted({'sim', 'mitsuba', 'drjit'} & set(sys.modules)))"
    )
    command = [sys.executable, "-c", code, *names]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr


# ---- clean files ------------------------------------------------------------------------


# The words stand apart here so that this file keeps the rule it checks.
FOREIGN = re.compile(
    r"(?<![\w.*)}\]/-])/(?:" + "|".join(("work", "root", "tmp", "farm", "home")) + r")\b"
    r"|" + "|".join(("index" + "-url", "find" + "-links", r"/sim" + r"ple\b", "pypi" + r"\.org")),
    re.IGNORECASE,
)


def test_what_git_does_not_track_is_not_judged(tmp_path: Path) -> None:
    for name in ("kept.py", "folder/kept.md", "folder/scratch.py", "run.log"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    everything = tracked(tmp_path)
    assert [path.name for path in everything] == ["kept.md", "scratch.py", "kept.py", "run.log"]
    for command in (["init", "-q"], ["add", "kept.py", "folder/kept.md"]):
        subprocess.run(["git", "-C", tmp_path, *command], check=True)
    assert tracked(tmp_path) == [tmp_path / "folder/kept.md", tmp_path / "kept.py"]
    assert tracked(tmp_path / "folder", "*.py") == []
    (tmp_path / "kept.py").unlink()
    assert tracked(tmp_path, "*.py") == []


def test_no_file_names_a_place_on_one_machine_or_a_package_index() -> None:
    if not (ROOT / ".git").exists() or not shutil.which("git"):
        pytest.skip("not a git checkout")
    found = []
    for path in tracked(ROOT):
        lines = path.read_text(encoding="utf-8", errors="ignore").splitlines()
        for number, line in enumerate(lines, start=1):
            if FOREIGN.search(line):
                found.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()[:80]}")
    assert found == []


@pytest.mark.parametrize("folder", ["work", "root", "tmp", "farm", "home"])
@pytest.mark.parametrize("pattern", ["/{}/a", "'/{}'", "see /{}.", "x=/{}/a", "a:/{}/b", "(/{}/x)"])
def test_a_place_on_one_machine_is_noticed(folder: str, pattern: str) -> None:
    assert FOREIGN.search(pattern.format(folder))


@pytest.mark.parametrize(
    "line", ["--{}-url=x", "--{}-url x", "PIP_{}_URL=https://host/sim" + "ple/", "https://{}.org/x"]
)
def test_a_package_index_is_noticed(line: str) -> None:
    name = "pypi" if ".org" in line else "index"
    assert FOREIGN.search(line.format(name))


@pytest.mark.parametrize(
    "line", ["runs/tmp/a", "a/work", "/workshop", "../root/a", "mm/root", "1/simpler", "findlinks"]
)
def test_other_text_is_left_alone(line: str) -> None:
    assert not FOREIGN.search(line)


def test_every_module_says_what_it_is() -> None:
    texts = {path: (ROOT / path).read_text(encoding="utf-8") for path in MODULES}
    assert [path for path, text in texts.items() if not ast.get_docstring(ast.parse(text))] == []


# ---- docstrings -------------------------------------------------------------------------


NAMED_FILE = re.compile(r"(?<![\w/{*.\"'])[a-z_]+(?:/[a-z_]+)*\.py\b")


def test_every_file_that_code_names_is_there() -> None:
    """Beside the file that names it, or at a path from lscan or sim."""
    lost = [
        f"{path.relative_to(ROOT)}: {name}"
        for package in ("lscan", "sim")
        for path in tracked(ROOT / package, "*.py")
        for name in NAMED_FILE.findall(path.read_text(encoding="utf-8"))
        if not any(
            (at / name).exists() for at in (path.parent, ROOT, ROOT / package, ROOT / "lscan")
        )
    ]
    assert lost == []


@pytest.mark.slow
def test_every_parameter_of_a_public_function_is_documented() -> None:
    functions = documented.Sources().public()
    assert len(functions) > 500
    assert {str(f): missing for f in functions if (missing := f.undocumented())} == {}


LATHE = '''
def turned(a, b, *c, d=1, **e):
    """A rod.

    Parameters
    ----------
    a, b : float, mm, its ends
        Of the left: one.
    **e : keywords

    Raises
    ------
    d : no parameter
    """


def bored(f): ...


def of_its_own_room(g): ...


class Lathe:
    """A lathe.

    Parameters
    ----------
    h : float, mm
    """

    def __init__(self, h, i): ...

    def turn(self, j): ...

    def _hold(self, k): ...
'''


def test_an_undocumented_parameter_is_noticed(tmp_path: Path) -> None:
    for name, text in {
        "lscan/__init__.pyi": "from lscan.lathe.api import Lathe as Lathe",
        "lscan/lathe/api.py": LATHE,
        "lscan/lathe/run.py": "from lscan.lathe.api import of_its_own_room",
        "lscan/bench/run.py": "from lscan.lathe.api import turned",
        "sim/bench/run.py": "from lscan.lathe import api\n\napi.bored(1)",
    }.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    found = documented.Sources(tmp_path).public()
    assert {function.name: function.undocumented() for function in found} == {
        "turned": ["c", "d"],
        "bored": ["f"],
        "Lathe.__init__": ["i"],
        "Lathe.turn": ["j"],
    }


# ---- sizes and names --------------------------------------------------------------------


def test_every_measure_of_the_house_is_within_its_bar() -> None:
    assert [row for row in house.house_rows() if not row.passed] == []


def test_a_way_that_skips_a_file_is_noticed(tmp_path: Path) -> None:
    """Its files are there, and each is imported by one before it, or is a plug-in."""
    (tmp_path / "docs/explanation").mkdir(parents=True)
    (tmp_path / "lscan").mkdir()
    (tmp_path / "pyproject.toml").write_text('[project.entry-points.g]\nd = "lscan.d:f"\n')
    (tmp_path / "lscan/a.py").write_text("from lscan.b import c\n")
    for name in "bcd":
        (tmp_path / f"lscan/{name}.py").touch()
    page = tmp_path / "docs/explanation/architecture.md"
    row = "## Five ways through it\n\n| a way | `lscan/a.py`, `lscan/b.py`, `lscan/d.py`{} |\n"
    page.write_text(row.format(""))
    assert [path.name for path in house.ways(tmp_path)["a way"]] == ["a.py", "b.py", "d.py"]
    for wrong in ("c", "e"):
        page.write_text(row.format(f", `lscan/{wrong}.py`"))
        with pytest.raises(ValueError, match=f"{wrong}.py"):
            house.ways(tmp_path)


def test_code_is_counted_without_docstrings_comments_and_blank_lines(tmp_path: Path) -> None:
    path = tmp_path / "module.py"
    docstring = ['"""Not code.', "", 'Nor this."""', "", "# nor this"]
    code = ["x = (", "    1,  # code", ")", "def f():", '    """No code."""', "    return 1"]
    path.write_text("\n".join([*docstring, *code]), encoding="utf-8")
    assert house.code_lines(path) == len(code) - 1


def test_a_class_name_used_twice_is_noticed(tmp_path: Path) -> None:
    for folder, name in {"lscan": "Tank", "sim": "_Tank"}.items():
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.py").write_text(f"class {name}: ...\nclass {folder}Own: ...\n")
    assert house.repeated_classes(tmp_path) == {"Tank": ["lscan/a.py:1", "sim/a.py:1"]}


# ---- findings ---------------------------------------------------------------------------


FINDINGS = tracked(ROOT / "findings", "*.sh")


def test_the_table_of_findings_lists_every_script() -> None:
    readme = (ROOT / "findings" / "README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `([\w-]+\.sh)` \|", readme, flags=re.MULTILINE)
    assert sorted(rows) == [path.name for path in FINDINGS]


@pytest.mark.parametrize("path", FINDINGS, ids=lambda path: path.name)
def test_a_finding_stands_alone(path: Path) -> None:
    """It says what is seen, works in a folder that goes with it, pins, and needs no lscan."""
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines()
    assert lines[0] == "#!/usr/bin/env bash" and lines[1].startswith("# ")
    assert path.stat().st_mode & 0o111, "is not executable"
    assert all(part in text for part in ("set -euo pipefail", "mktemp -d", "trap "))
    code = "\n".join(line for line in lines if not line.lstrip().startswith("#"))
    assert not re.search(r"\b(import|from) (lscan|sim)\b|\blscan(-sim)? ", code)
    assert len(lines) <= 110


# ---- versions and packages --------------------------------------------------------------


def _changelog_agrees(headings: list[str], version: str) -> bool:
    """Whether the newest heading is the version, or is Unreleased above none newer."""
    if not headings or headings[0] != "Unreleased":
        return headings[:1] == [version]
    return len(headings) == 1 or Version(headings[1]) <= Version(version)


def test_the_changelog_knows_this_version() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    headings = re.findall(r"^## \[([^\]]+)\]", text, flags=re.MULTILINE)
    assert _changelog_agrees(headings, lscan.__version__)


def test_a_changelog_that_lags_or_leads_is_noticed() -> None:
    assert _changelog_agrees(["Unreleased"], "0.1.0")
    assert _changelog_agrees(["0.1.0"], "0.1.0")
    assert _changelog_agrees(["Unreleased", "0.1.0"], "0.2.0")
    assert not _changelog_agrees([], "0.1.0")
    assert not _changelog_agrees(["0.1.0"], "0.2.0")
    assert not _changelog_agrees(["Unreleased", "0.10.0"], "0.9.0")


@pytest.mark.parametrize(("name", "module"), PROJECT["project"]["scripts"].items())
def test_a_program_says_its_version(
    name: str, module: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    main = importlib.metadata.EntryPoint(name, module, "console_scripts").load()
    monkeypatch.setattr(sys, "argv", [name, "--version"])
    monkeypatch.setattr("lscan.cli.console.ignore_stop_signals", lambda: None)  # the tests go on
    with pytest.raises(SystemExit) as left:
        main()
    assert (left.value.code, capsys.readouterr().out) == (0, f"{name} {lscan.__version__}\n")


ENTRY_POINTS = [
    importlib.metadata.EntryPoint(name, value, group)
    for group, entries in {
        "console_scripts": PROJECT["project"]["scripts"],
        **PROJECT["project"]["entry-points"],
    }.items()
    for name, value in entries.items()
]


# What lscan calls on an object of each group, as the group's api module says.
DUTIES = {
    "console_scripts": {"__call__"},
    "lscan.cameras": {"sections", "validate", "open"},
    "lscan.tracks": {"sections", "validate", "open"},
    "lscan.extractors": {"__call__"},
    "lscan.planemaps": {"solve", "restore"},
    "lscan.boardreaders": {"__call__"},
    "lscan.userfiles": {"__call__"},
    "pytest11:lscan": {"pytest_addoption", "stripe_case", "board_case", "assert_no_worse"},
    "pytest11:lscan-tank": {"tank"},
}


@pytest.mark.parametrize("entry", ENTRY_POINTS, ids=lambda entry: f"{entry.group}:{entry.name}")
def test_every_entry_point_loads(entry: importlib.metadata.EntryPoint) -> None:
    duties = DUTIES.get(f"{entry.group}:{entry.name}") or DUTIES[entry.group]
    assert duties <= set(dir(entry.load()))


def _locked() -> dict[str, tuple[str, int]]:
    """Version and number of hashes of each package of the lock file, by canonical name."""
    text = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    blocks = re.split(r"^(?=\w)", re.sub(r"^ *#.*\n", "", text, flags=re.MULTILINE), flags=re.M)
    pins = [re.match(r"([\w.-]+)==(\S+)", block) for block in blocks]
    return {
        _canonical(pin[1]): (pin[2], block.count("--hash=sha256:"))
        for pin, block in zip(pins, blocks, strict=True)
        if pin
    }


def _canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_the_lock_pins_all_that_the_project_asks_for() -> None:
    project, locked = PROJECT["project"], _locked()
    extras = [line for lines in project["optional-dependencies"].values() for line in lines]
    asked = [*project["dependencies"], *extras, *PROJECT["build-system"]["requires"]]
    for requirement in map(Requirement, asked):
        version, hashes = locked[_canonical(requirement.name)]
        assert version in requirement.specifier, requirement
        assert hashes > 0, requirement


def _claimed_pythons() -> list[str]:
    """The first patch of each version of Python that the lock file says it is for."""
    text = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    minors = re.search(r"\b3\.(\d+) to 3\.(\d+)\b", text)
    assert minors
    return [f"3.{minor}.0" for minor in range(int(minors[1]), int(minors[2]) + 1)]


def test_the_lock_serves_every_python_that_it_claims() -> None:
    """Debian 12 has 3.11.2: a package that needs a later patch leaves it without any."""
    claimed = _claimed_pythons()
    assert SpecifierSet(PROJECT["project"]["requires-python"]) == SpecifierSet(
        f">={claimed[0][:-2]}"
    )
    refused = {}
    for name, (version, _) in _locked().items():
        package = importlib.metadata.metadata(name)
        assert package["Version"] == version, f"{name} is not the lock's: make setup"
        allowed = SpecifierSet(package.get("Requires-Python", ""))
        refused[name] = [python for python in claimed if python not in allowed]
    assert {name: pythons for name, pythons in refused.items() if pythons} == {}


@pytest.mark.skipif(not shutil.which("make"), reason="there is no make here")
def test_make_knows_the_newest_python_of_the_lock() -> None:
    command = ["make", "-s", "--eval", "newest: ; @echo 3.$(NEWEST).0", "newest"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.strip() == _claimed_pythons()[-1], done.stderr


def test_the_oldest_packages_are_the_lower_bounds() -> None:
    """Each requirement of the project, in whatever spelling; all others at most as locked."""
    project = PROJECT["project"]
    asked = itertools.chain(project["dependencies"], *project["optional-dependencies"].values())
    bounds = {f"{_canonical(r.name)}=={oldest.lower_bound(r)}" for r in map(Requirement, asked)}
    rest = set(oldest.constraints()) - bounds
    assert bounds <= set(oldest.constraints())
    assert all(line.count("<=") == 1 and "==" not in line for line in rest)
    assert len(bounds) + len(rest) == len(_locked())
    with pytest.raises(ValueError, match="numpy: has no lower bound"):
        oldest.lower_bound(Requirement("numpy"))


@pytest.mark.xdist_group("house")
def test_groups_of_tests_stay_on_one_worker(request: pytest.FixtureRequest) -> None:
    """pytest-xdist says so by the group's name in the test's own; without it, fixtures that tests
    of a group share, a whole demo among them, are made once by each worker."""
    if not request.config.getoption("loadgroup", False):
        pytest.skip("not run in groups: --dist loadgroup")
    assert request.node.nodeid.endswith("@house")
