"""The list of mutants is sound, and its runner tells what escapes from what is caught."""

import re
import shutil
import subprocess
from collections import Counter
from pathlib import Path

import pytest
from places import ROOT, tracked

from tests.mutants import __main__ as mutants
from tests.mutants.__main__ import Mutant

LISTED = mutants.listed()
TEXTS = {str(path.relative_to(ROOT)): path for path in tracked(ROOT, "*.py")}


def test_each_mutant_changes_one_place_and_names_tests_that_there_are() -> None:
    for mutant in LISTED:
        assert mutant.text(TEXTS[mutant.file].read_text(encoding="utf-8"))
        assert mutant.tests, mutant.what
        for file, name, *_ in (f"{test}::".split("::") for test in mutant.tests):
            named = rf"^(def|class) {re.escape(name.partition('[')[0])}\b"
            assert re.search(named, TEXTS[file].read_text(encoding="utf-8"), re.MULTILINE), name


def test_every_room_has_two_mutants_and_none_is_listed_twice() -> None:
    folders = {"/".join(Path(file).parts[:2]) for file in TEXTS if file.count("/") > 1}
    count = Counter(mutant.room for mutant in LISTED)
    assert {
        room for room in folders if room.startswith(("lscan/", "sim/")) and count[room] < 2
    } == set()
    assert len({mutant.what for mutant in LISTED}) == len(LISTED) >= 80


SUM = "def total(a, b):\n    return a + b\n"
PROJECT = {
    "pyproject.toml": '[tool.pytest.ini_options]\naddopts = "-ra --import-mode=importlib"\n',
    "room/sum.py": SUM,
    "tests/__init__.py": "",
    "tests/test_sum.py": "from room.sum import total\n\ndef test_sum(): assert total(2, 3) == 5\n",
}


def test_what_escapes_and_what_breaks_the_tests_is_told_from_what_is_caught(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, text in PROJECT.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    (tmp_path / "tests" / "mutants").mkdir()
    shutil.copy(Path(mutants.__file__).with_name("__init__.py"), tmp_path / "tests" / "mutants")
    for command in (["init", "-q"], ["add", "."]):
        subprocess.run(["git", *command], cwd=tmp_path, check=True)
    monkeypatch.setattr(mutants, "ROOT", tmp_path)
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # which takes longer than all else
    changes = {
        "wrong sign": ("a + b", "a - b"),
        "harmless": ("a + b", "b + a"),
        "another name": ("total", "sum_of"),
        "none of the file's": ("c + d", "c - d"),
    }
    *there, missing = (
        Mutant(what, "room/sum.py", old, new, ("tests/test_sum.py::test_sum",))
        for what, (old, new) in changes.items()
    )
    assert not mutants.try_all(there, 1)
    said = capsys.readouterr().out
    assert "1 of 3 mutants caught" in said
    assert "harmless: escaped" in said and "another name: not collected" in said
    with pytest.raises(ValueError, match="occurs 0 times"):
        missing.text(SUM)
    assert (tmp_path / "room" / "sum.py").read_text(encoding="utf-8") == SUM
