"""Every fault of the served hardware ends in a DeviceError, and the run it spoilt goes on."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from served import hurry, quick_rig, small_scene

from lscan.acquisition.run import open_run
from lscan.acquisition.scan import scan
from lscan.errors import DeviceError, InputError
from sim.emulators import EmulatedHardware, ServeOptions, TimedFault, parse_fault
from sim.emulators.hardware import CAMERA_FAULTS, HEALED, NAMES, TRACK_FAULTS, UNPLUGGED

pytestmark = pytest.mark.xdist_group("serve_faults")  # one worker: they share a fixture

SHORT = {"timeout_s": 1.0, "retries": 2}

QUICK = ("camera-drop", "camera-black", "track-alarm", "track-unplugged")
SAID = {
    "camera-hang": "sent no new picture|cannot be opened|gave no first picture|is gone",
    "camera-drop": "is gone|cannot be opened",
    "camera-black": "a black picture",
    "camera-wrong-size": "pictures are 80 by 60 px",
    "camera-frozen": "the same picture|picture of the grab before",
    "track-silent": "grbl track",
    "track-garbled": "grbl track",
    "track-alarm": "ALARM:1",
    "track-stuck": "still in state",
    "track-unplugged": "grbl track",
}


@pytest.fixture(scope="module")
def hardware(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmulatedHardware]:
    link = tmp_path_factory.mktemp("ports") / "track"
    with EmulatedHardware(
        small_scene(), ServeOptions(prepare=True, link=link, fps=100)
    ) as hardware:
        hurry(hardware)
        yield hardware


@pytest.mark.parametrize(
    "name",
    [
        name if name in QUICK else pytest.param(name, marks=pytest.mark.slow)
        for name in NAMES
        if name != HEALED
    ],
)
def test_a_fault_in_a_scan_is_reported_and_the_scan_goes_on(
    hardware: EmulatedHardware, tmp_path: Path, name: str
) -> None:
    """After the second frame: two frames are on disk whole, and --resume takes the others."""
    rig_file = quick_rig(hardware, SHORT, answer_s=1.0, settle_s=0.02)

    def spoil(done: int, planned: int) -> None:
        if done == 2:
            hardware.inject(name)

    try:
        with pytest.raises(DeviceError, match=SAID[name]):
            scan(rig_file, tmp_path / "run", progress=spoil)
    finally:
        hardware.heal()
    spoilt = open_run(tmp_path / "run")
    kept = [frame.image.tobytes() for frame in spoilt.frames()]
    assert len(kept) == 2
    patient = quick_rig(hardware, answer_s=5.0, settle_s=0.02)
    whole = scan(patient, tmp_path / "run", resume=True)
    frames = list(whole.frames())
    assert [frame.commanded_mm for frame in frames] == rig_file.rig.plan.positions_mm()
    assert [frame.image.tobytes() for frame in frames[:2]] == kept


def test_every_fault_has_a_name_of_its_own() -> None:
    assert set(SAID) == {*CAMERA_FAULTS, *TRACK_FAULTS, UNPLUGGED} == set(NAMES) - {HEALED}


def test_faults_are_read_from_a_command_line() -> None:
    assert parse_fault("camera-hang") == TimedFault("camera-hang", 0.0)
    assert parse_fault("none@2.5") == TimedFault("none", 2.5)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("camera-sulks", "--fault: no such fault .*camera-hang"),
        ("camera-hang@", "--fault: bad time"),
        ("camera-hang@nan", "--fault: bad time"),
    ],
)
def test_bad_faults_are_refused(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_fault(text)


def test_marlin_has_no_faults_on_its_line() -> None:
    """Also of a fault that begins later: the timer's thread could only print a traceback."""
    refused = r"^--fault: marlin has no such faults \(allowed: grbl\)$"
    with EmulatedHardware(small_scene(), ServeOptions(dialect="marlin")) as hardware:
        with pytest.raises(InputError, match=refused):
            hardware.inject("track-silent")
        with pytest.raises(InputError, match=refused):
            hardware.schedule(TimedFault("track-silent", 1e6))
        with pytest.raises(InputError, match="no such fault"):
            hardware.schedule(TimedFault("track-sulks", 1e6))
        hardware.schedule(TimedFault("camera-black", 1e6))
