"""The public names of ``lscan`` and ``sim``: all there, typed, and loaded only when asked for."""

import ast
import importlib
import pickle
import subprocess
import sys
from inspect import isfunction
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from places import ROOT

import lscan
import sim
from lscan.records import Floats, PlanePoints

PACKAGES = pytest.mark.parametrize("package", [lscan, sim], ids=lambda package: package.__name__)


@PACKAGES
def test_the_names_are_those_that_type_checkers_see(package: ModuleType) -> None:
    """Of a stub, checkers re-export what is imported under its own name alone (PEP 484)."""
    assert package.__file__ is not None
    stub = Path(package.__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    aliases = [
        alias
        for node in ast.parse(stub).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    ]
    assert all(alias.asname == alias.name for alias in aliases)
    assert [alias.name for alias in aliases] != []
    assert sorted(alias.name for alias in aliases) == package.__all__ == dir(package)


@PACKAGES
def test_every_name_is_there(package: ModuleType) -> None:
    for name in package.__all__:
        assert getattr(package, name).__doc__ or name == "__version__", name


@PACKAGES
def test_no_name_is_a_room(package: ModuleType) -> None:
    """A room of the same name would hide it as soon as a module of the room is imported."""
    assert package.__file__ is not None
    rooms = {path.stem for path in Path(package.__file__).parent.iterdir()}
    assert not rooms & set(package.__all__)


@PACKAGES
def test_another_name_is_refused(package: ModuleType) -> None:
    with pytest.raises(AttributeError, match="no attribute 'attic'"):
        _ = package.attic
    with pytest.raises(ImportError):
        importlib.import_module(f"{package.__name__}.attic")


def test_an_argument_of_another_kind_is_refused_by_name() -> None:
    nothing: Any = None
    run = lscan.Run(Path("r"), nothing, "complete", (), ())
    rest = [nothing] * 5
    calibration = lscan.Calibration("any", AnyMap(), *rest)
    called: Any = lscan.measure_groove
    with pytest.raises(TypeError) as refused:
        called(run, calibration)
    assert str(refused.value) == (
        "measure_groove: plane_map: must be a PlaneMap, not a Calibration; its .plane_map is one"
    )
    with pytest.raises(TypeError, match=r"run: must be a Run, not a str$"):
        called("runs/groove", AnyMap())
    with pytest.raises(TypeError, match=r"run: must be a Run, not a type$"):
        called(lscan.Run, AnyMap())  # the class: of its fields there is no value
    with pytest.raises(TypeError, match=r"measure_groove\(\) missing 1 required"):
        called(run)


@PACKAGES
def test_its_functions_can_be_pickled(package: ModuleType) -> None:
    """As multiprocessing does with what it is to call."""
    functions = [found for name in package.__all__ if isfunction(found := getattr(package, name))]
    assert functions != []
    for function in functions:
        assert pickle.loads(pickle.dumps(function)) is function


class AnyMap:
    """A plane map by its methods alone."""

    name = "any"

    def to_plane(self, image_px: Floats, sigma_px: Floats | None = None) -> PlanePoints:
        raise NotImplementedError

    def parameters(self) -> dict[str, Any]:
        return {}


@PACKAGES
def test_types_are_published(package: ModuleType) -> None:
    assert package.__file__ is not None
    assert Path(package.__file__).with_name("py.typed").is_file()


PLOTTING = {"xarray", "pandas", "scipy.stats", "matplotlib", "plotly", "jinja2"}
NOT_LOADED = {
    "lscan": {"numpy", "pydantic"},
    "sim": {"numpy", "mitsuba"},
    "lscan.records": {"scipy", "cv2", "pydantic"},
    "lscan.pipeline": PLOTTING,
    "lscan.paper.report": {"matplotlib", "plotly", "jinja2"},
    "sim.demo": {"xarray", "pandas", "scipy.stats", "matplotlib"},
}
"""What has not been loaded after each of these modules, imported one after the other."""


def test_nothing_is_loaded_before_it_is_asked_for() -> None:
    code = "import importlib, sys\n"
    for module, names in NOT_LOADED.items():
        code += f"importlib.import_module({module!r}); print({module!r}, *sys.modules & {names})\n"
    code = code.replace("sys.modules &", "sys.modules.keys() &")
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == list(NOT_LOADED)
