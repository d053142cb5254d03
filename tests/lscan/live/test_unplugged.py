"""The live page on an emulated Grbl whose cable is pulled and put back."""

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from fake_devices import FakeCamera, fake_rig
from live_rig import LONG_S, wait_for

import lscan.config.rig
from lscan.acquisition.run import open_run
from lscan.config.plugins import find_plugin
from lscan.config.rig import RigFile, parse_rig
from lscan.devices.api import Grab, Track
from lscan.errors import DeviceError
from lscan.live.devices import LiveDevices
from lscan.live.session import Session
from sim.emulators.grbl import GrblEmulator, PseudoTerminal

QUICK = dict.fromkeys((25, 110, 111, 112), 50_000) | dict.fromkeys((120, 121, 122), 20_000)
ZERO_MM = -190.0
FRAMES = 6
FOREVER_S = 1e6  # no question to the track by itself: the command is what notices


class Cable:
    """A port whose name stays, whichever controller is behind it; none: unplugged."""

    def __init__(self, port: Path) -> None:
        self.port = port
        self.plug()

    def plug(self) -> None:
        """A controller that has just started."""
        self._terminal = PseudoTerminal(GrblEmulator(QUICK))
        self.port.unlink(missing_ok=True)
        self.port.symlink_to(self._terminal.port)

    def pull(self) -> None:
        """The line breaks, and the port is gone."""
        self._terminal.close()
        self.port.unlink(missing_ok=True)


class WaitingCamera(FakeCamera):
    """Lets the scan's grabs through one by one, once it is released."""

    gate: threading.Semaphore | None = None

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        if frame is not None and self.gate is not None:
            assert self.gate.acquire(timeout=LONG_S)
        return super().grab(frame, dark)


class CameraDriver:
    """Opens such a camera over whatever track there is."""

    def open(self, rig_file: RigFile, track: Track) -> WaitingCamera:
        return WaitingCamera(track)


@pytest.fixture
def cable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Cable]:
    def find(group: str, name: str, where: object = None) -> Any:
        return find_plugin(group, name, where=where) if name == "grbl" else CameraDriver()

    monkeypatch.setattr(lscan.config.rig, "find_plugin", find)
    monkeypatch.setattr("lscan.live.session.CHECK_S", FOREVER_S)
    plugged = Cable(tmp_path / "port")
    yield plugged
    plugged.pull()


def grbl_rig(cable: Cable) -> RigFile:
    options = {
        "port": str(cable.port),
        "min_mm": 0,
        "max_mm": 40,
        "zero_mm": ZERO_MM,
        "feed_mm_min": 50_000,
        "settle_s": 0,
        "boot_s": 0.2,
        "reconnects": 0,
    }
    document = {**fake_rig(FRAMES).document, "track": {"driver": "grbl", "options": options}}
    return parse_rig(document, source="rig.toml", trusted=True)


def reaches(session: Session, state: str) -> dict[str, Any]:
    scan: dict[str, Any] = wait_for(
        lambda: (s := session.state()["scan"])["state"] not in ("scanning", "stopping") and s
    )
    assert scan["state"] == state, scan["message"]
    return scan


def test_the_first_go_after_an_idle_break_moves(cable: Cable) -> None:
    devices = LiveDevices(grbl_rig(cable), lambda grab: None)
    try:
        devices.move_to(3.0)
        cable.pull()
        cable.plug()
        devices.move_to(5.0)
        assert devices.position_mm == pytest.approx(5.0, abs=0.02)  # the rig's tolerance_mm
    finally:
        devices.close()


def test_a_go_while_it_is_gone_fails_and_the_first_one_after_it_moves(cable: Cable) -> None:
    devices = LiveDevices(grbl_rig(cable), lambda grab: None)
    try:
        cable.pull()
        for _ in range(2):
            with pytest.raises(DeviceError, match="cannot be opened"):
                devices.move_to(5.0)
            assert devices.track_error
        cable.plug()
        devices.move_to(5.0)
        assert devices.track_error == ""
    finally:
        devices.close()


def test_a_move_that_is_refused_opens_nothing_anew(cable: Cable) -> None:
    devices = LiveDevices(grbl_rig(cable), lambda grab: None)
    try:
        track = devices.track
        with pytest.raises(DeviceError, match="cannot move to 41 mm"):
            devices.move_to(41.0)
        devices.move_to(5.0)
        assert devices.track is track
    finally:
        devices.close()


def test_a_resting_track_that_is_gone_is_reported(
    cable: Cable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lscan.live.session.CHECK_S", 0.02)
    session = Session(grbl_rig(cable), tmp_path / "runs")
    try:
        assert session.state()["track"]["error"] == ""
        cable.pull()
        state = wait_for(lambda: (track := session.state()["track"])["error"] and track)
        assert "opened again" in state["error"]
        assert state["position_mm"] is None
    finally:
        session.close()


def test_the_first_resume_after_a_pulled_cable_goes_on(
    cable: Cable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate = threading.Semaphore(2)
    monkeypatch.setattr(WaitingCamera, "gate", gate)
    session = Session(grbl_rig(cable), tmp_path / "runs")
    try:
        session.start_scan("a")
        wait_for(lambda: session.state()["scan"]["done"] == 2)
        cable.pull()
        gate.release(100)
        failed = reaches(session, "failed")
        kept = failed["done"]
        assert failed["message"].endswith(f"{kept} of {FRAMES} frames are kept; Resume goes on")
        cable.plug()
        session.resume_scan()
        reaches(session, "done")
    finally:
        gate.release(100)
        session.close()
    run = open_run(tmp_path / "runs" / "a")
    assert (run.state, len(run)) == ("complete", FRAMES)
    run.verify()
