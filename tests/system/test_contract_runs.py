"""``pytest -m hardware --rig RIG``, as someone with hardware runs it; the hardware is emulated."""

import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from places import ROOT
from served import hurry, small_scene

from lscan.config.documents import merge, write_toml
from sim.emulators import EmulatedHardware, ServeOptions

PATIENCE_S = 300.0


@pytest.fixture(scope="module")
def hardware() -> Iterator[EmulatedHardware]:
    """Its laser shines only when it is switched, as the plan does."""
    scene = small_scene(plan={"laser": "pairs"})
    with EmulatedHardware(scene, ServeOptions(switched_laser=True)) as hardware:
        hurry(hardware)
        yield hardware


def write_rig(hardware: EmulatedHardware, path: Path, **sections: Any) -> Path:
    """The hardware's rig file without its waits, and with sections laid over it."""
    quick = {"track": {"options": {"feed_mm_min": 60_000.0, "boot_s": 0.0, "settle_s": 0.0}}}
    document = merge(merge(hardware.rig_document(), quick), sections)
    write_toml(path, document)
    return path


def run_on(rig: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """The tests of hardware, in a process of their own."""
    environment = {key: value for key, value in os.environ.items() if "PYTEST" not in key}
    command = [sys.executable, "-m", "pytest", "-m", "hardware", "--rig", str(rig), *arguments]
    return subprocess.run(
        [*command, "-p", "no:cacheprovider", "tests/hardware/test_hardware.py"],
        cwd=ROOT,
        env={**environment, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )


@pytest.mark.slow
def test_the_contracts_hold_over_the_hardware_of_a_rig(
    hardware: EmulatedHardware, tmp_path: Path
) -> None:
    """None is skipped: it states limits, switches a laser and shows previews."""
    done = run_on(write_rig(hardware, tmp_path / "rig.toml"))
    assert done.returncode == 0, done.stdout
    assert re.search(r"^=+ \d\d passed in ", done.stdout, re.MULTILINE), done.stdout
    head_mm, plan = hardware.position_mm, hardware.scene.rig.plan
    assert head_mm is not None
    assert plan.start_mm - 1.01 <= head_mm <= max(plan.positions_mm())  # 1 mm of approach
    assert hardware.controller.laser_power == 0


def test_hardware_that_is_not_as_its_rig_says_fails_by_name(
    hardware: EmulatedHardware, tmp_path: Path
) -> None:
    """Also no laser is touched where the plan leaves it."""
    wrong = {"camera": {"width_px": 320}, "plan": {"laser": "untouched"}}
    rig = write_rig(hardware, tmp_path / "rig.toml", **wrong)
    done = run_on(rig, "-k", "TestCamera and is_a_camera or laser")
    assert done.returncode == 1
    assert re.search(r"camera opencv .* pictures are 160 by 120 px; the rig says 320", done.stdout)
    assert re.search(r"2 skipped, .* 1 error", done.stdout)
    assert "set plan.laser to test it" in done.stdout


@pytest.mark.slow
def test_a_rig_file_that_is_none_is_said_in_one_line(tmp_path: Path) -> None:
    done = run_on(tmp_path / "none.toml", "-k", "is_a_track")
    assert done.returncode == 1
    assert "none.toml: " in done.stdout
    assert "Traceback" not in done.stdout


@pytest.mark.parametrize(
    ("marks", "rig", "worker", "says"),
    [
        ("", "rig.toml", None, "pytest -m hardware --rig"),
        ("not slow", "rig.toml", None, "pytest -m hardware --rig"),
        ("hardware", None, None, "pytest -m hardware --rig"),
        ("hardware", "rig.toml", "gw0", "without -n"),
        ("hardware", "rig.toml", None, None),
    ],
)
def test_nothing_moves_unless_it_is_asked_for(
    monkeypatch: pytest.MonkeyPatch,
    marks: str,
    rig: str | None,
    worker: str | None,
    says: str | None,
) -> None:
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    if worker is not None:
        monkeypatch.setenv("PYTEST_XDIST_WORKER", worker)
    config = SimpleNamespace(getoption={"-m": marks, "--rig": rig}.get)
    reason = _root_conftest()._why_not(config)
    assert reason is None if says is None else says in reason


def _root_conftest() -> Any:
    spec = importlib.util.spec_from_file_location("root_conftest", ROOT / "conftest.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
