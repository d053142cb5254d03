"""The examples in docstrings run, in a folder of small scans (``examples_folder``)."""

import doctest
import importlib
from pathlib import Path
from types import ModuleType

import pytest
from places import ROOT, tracked

import lscan
import sim

pytestmark = pytest.mark.xdist_group("examples")  # one worker: one folder of scans

FILES = [path for name in ("lscan", "sim") for path in tracked(ROOT / name, "*.py")]
MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for path in FILES
    if ">>> " in path.read_text(encoding="utf-8")
]


@pytest.mark.parametrize("module", MODULES)
def test_the_examples_run(
    module: str, examples_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(examples_folder)
    found = doctest.testmod(importlib.import_module(module), optionflags=doctest.ELLIPSIS)
    assert found.attempted > 0 and found.failed == 0


@pytest.mark.parametrize(
    ("package", "name"),
    [
        (package, name)
        for package in (lscan, sim)
        for name in package.__all__
        if name != "__version__"
    ],
)
def test_every_public_name_has_an_example(package: ModuleType, name: str) -> None:
    _, _, examples = getattr(package, name).__doc__.partition("\n    Examples\n    --------\n")
    assert ">>> " in examples
