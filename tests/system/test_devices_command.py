"""``lscan devices RIG --test`` on the tank served as hardware, as a user runs it."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
from served import hurry, small_scene
from typer.testing import CliRunner

from lscan.cli import devices as devices_cli
from lscan.config.documents import merge, write_toml
from sim.emulators import EmulatedHardware


@pytest.fixture(scope="module")
def hardware() -> Iterator[EmulatedHardware]:
    with EmulatedHardware(small_scene()) as hardware:
        hurry(hardware)
        yield hardware


@pytest.fixture
def rig(hardware: EmulatedHardware, tmp_path: Path) -> Path:
    quick = {"track": {"options": {"feed_mm_min": 60_000.0, "boot_s": 0.0, "settle_s": 0.0}}}
    path = tmp_path / "rig.toml"
    write_toml(path, merge(hardware.rig_document(), quick))
    return path


def run(*arguments: str) -> str:
    app = typer.Typer()
    app.command()(devices_cli.devices)
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def test_a_trial_of_served_hardware(hardware: EmulatedHardware, rig: Path) -> None:
    """A head that always arrives from below, on whole steps, repeats to its report's last digit."""
    trial = json.loads(run(str(rig), "--test", "--pictures", "4", "--approaches", "2", "--json"))
    facts, found = trial["track"]["facts"], trial["track"]["repeatability"]
    options = hardware.rig_document()["track"]["options"]
    assert facts["firmware"] == "Grbl 1.1h"
    assert (
        facts["travel_low_mm"] <= options["min_mm"] < options["max_mm"] <= facts["travel_high_mm"]
    )
    assert facts["step_mm"] == pytest.approx(1 / hardware.controller.settings[100])
    # Positions are reported with three decimals, motors rest on whole steps.
    assert abs(found["deviation_mm"]) <= facts["step_mm"] / 2 + 0.001
    assert max(found["upward_sigma_mm"], found["downward_sigma_mm"]) <= 0.001
    assert abs(found["reversal_mm"]) <= 0.001
    assert trial["track"]["moves"][-1]["commanded_mm"] == options["max_mm"]  # homed beyond it
    assert trial["camera"]["timing"]["rate_hz"] > 0
    assert trial["camera"]["settings"] == []  # a stream has none


def test_a_trial_in_words_and_what_the_rig_can_do(hardware: EmulatedHardware, rig: Path) -> None:
    text = run(str(rig), "--test", "--pictures", "4", "--approaches", "2")
    for words in ("Grbl 1.1h", "noise_bytes", "2 approaches from either side", "pictures/s"):
        assert words in text, words
    listed = run(str(rig))
    assert hardware.port in listed
    assert hardware.url in listed
