"""The laser by every way a scan or the live page can end: off, or said that it may be lit.

The track is the driver of real ones on an emulated Grbl or Marlin in simulated time, which is
asked in the end whether its laser is on.
"""

import errno
import json
import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from command_line import call
from fake_devices import FakeCamera, fake_rig
from grbl_line import DirectLine, SimulatedTime

import lscan.config.rig
from lscan.acquisition.run import MANIFEST, frame_file
from lscan.acquisition.scan import scan
from lscan.config.rig import RigFile
from lscan.devices.api import LASER_MAY_BE_LIT, Grab
from lscan.devices.grbl import SerialTrackOptions, open_track
from lscan.devices.signals import STOPPING, interrupted_by_signals, stop_signals_held
from lscan.errors import DeviceError, DiskError, InputError, LscanError
from lscan.files.rosmessages import MessageFile, message_file
from lscan.live.server import LiveServer
from lscan.live.session import Session
from sim.emulators.grbl import Faults, GrblEmulator, MarlinEmulator

FRAMES = 3
QUICK = {20: 0, 22: 0, 110: 50_000, 120: 20_000}  # no homing, no limits; mm/min, mm/s2
DIALECTS = ("grbl", "marlin")
ENDING = [signal.Signals(number) for number in (*STOPPING, signal.SIGTSTP)]
KEPT = "1 of 3 frames are kept"


@dataclass
class Bench:
    """One controller with the laser, what opens its track, and the camera that ends the scan."""

    dialect: str
    end: Callable[["Bench"], None] = lambda _: None
    again: int | None = None
    """Signal that comes with all that is written to the controller."""
    cable_out: bool = False
    lines: list["Line"] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.time = SimulatedTime()
        kind = GrblEmulator if self.dialect == "grbl" else MarlinEmulator
        self.controller = kind(QUICK, clock=self.time)

    @property
    def lit(self) -> bool:
        return self.controller.laser_power > 0

    def find_plugin(self, group: str, name: str, where: object = None) -> Any:
        return self if group == "lscan.tracks" else CameraDriver(self)

    def open(self, rig_file: RigFile) -> Any:
        """The track, as its driver opens it."""
        if self.cable_out:
            raise DeviceError("could not open port")
        options = SerialTrackOptions.model_validate(
            {"port": "here", "dialect": self.dialect, "min_mm": 0, "max_mm": 40, "homing": False}
        )
        self.lines.append(Line(self))
        return open_track(options, self.lines[-1], self.time, self.time.sleep)

    def unplug(self) -> None:
        self.lines[-1].close()


class Line(DirectLine):
    """A line whose user is impatient."""

    def __init__(self, bench: Bench) -> None:
        super().__init__(bench.controller, bench.time)
        self._bench = bench

    def write(self, data: bytes) -> int:
        if self._bench.again is not None:
            signal.raise_signal(self._bench.again)
        return super().write(data)


@dataclass
class CameraDriver:
    """Opens the camera that ends the scan, whatever track there is."""

    bench: Bench

    def open(self, rig_file: RigFile, track: Any) -> "EndingCamera":
        return EndingCamera(track, bench=self.bench)


@dataclass
class EndingCamera(FakeCamera):
    """With the laser on at frame 1, something ends the scan."""

    bench: Any = None
    longest_grab_s = 0.05

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        if frame == 1 and not dark:
            assert self.bench.lit
            self.bench.end(self.bench)
        return super().grab(frame, dark)


# ---- ways to end ------------------------------------------------------------------------


def signalled(number: int, again: bool = False) -> Callable[[Bench], None]:
    """The signal comes, and again with every line to the controller."""

    def end(bench: Bench) -> None:
        # Where it has no handler, it would end the tests.
        assert signal.getsignal(number) not in (signal.SIG_DFL, signal.SIG_IGN)
        bench.again = number if again else None
        signal.raise_signal(number)

    return end


def raising(error: BaseException) -> Callable[[Bench], None]:
    def end(_: Bench) -> None:
        raise error

    return end


def hang(bench: Bench) -> None:
    """No picture as long as the laser is on, and none after it."""
    while bench.lit:
        time.sleep(0.001)
    raise DeviceError("the camera is gone")


def silence(bench: Bench) -> None:
    assert isinstance(bench.controller, GrblEmulator)
    bench.controller.inject(Faults(silent=True))


def alarm(bench: Bench) -> None:
    assert isinstance(bench.controller, GrblEmulator)
    bench.controller.inject(Faults(alarm=True))


@dataclass(frozen=True)
class Way:
    """How a scan ends.  off: the laser is off then; else it is said that it may be lit."""

    end: Callable[[Bench], None]
    error: type[BaseException]
    off: bool = True


WAYS = {
    **{f"{n.name}": Way(signalled(n), KeyboardInterrupt) for n in ENDING},
    **{f"{n.name} again and again": Way(signalled(n, True), KeyboardInterrupt) for n in ENDING},
    "exception": Way(raising(RuntimeError("of a driver")), RuntimeError),
    "exit": Way(raising(SystemExit(0)), SystemExit),
    "camera lost": Way(raising(DeviceError("gone")), DeviceError),
    "camera hangs": Way(hang, DeviceError),
    "track lost": Way(Bench.unplug, DeviceError, off=False),
    "track silent": Way(silence, DeviceError, off=False),
    "alarm": Way(alarm, DeviceError),
}


GRBL_ALONE = ("track silent", "alarm")  # faults that the emulated Marlin has not


@pytest.mark.parametrize("laser", ["on", "pairs"])
@pytest.mark.parametrize(
    ("name", "dialect"),
    [(way, kind) for way in WAYS for kind in DIALECTS[: 1 if way in GRBL_ALONE else 2]],
)
def test_the_laser_is_off_however_a_scan_ends_or_said_to_be_lit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, dialect: str, laser: str
) -> None:
    way = WAYS[name]
    bench = Bench(dialect, way.end)
    monkeypatch.setattr(lscan.config.rig, "find_plugin", bench.find_plugin)
    before = [signal.getsignal(number) for number in ENDING]
    with pytest.raises(way.error) as ended:
        scan(fake_rig(FRAMES, laser=laser), tmp_path / "a")
    said = LASER_MAY_BE_LIT in getattr(ended.value, "__notes__", ())
    assert said is not way.off
    assert said or not bench.lit
    assert [signal.getsignal(number) for number in ENDING] == before


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_full_disk_and_a_failing_callback_leave_it_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dialect: str
) -> None:
    bench = Bench(dialect)
    monkeypatch.setattr(lscan.config.rig, "find_plugin", bench.find_plugin)

    def failing(done: int, planned: int) -> None:
        assert done == 0 or not bench.lit, "the terminal is gone"

    with pytest.raises(AssertionError, match="the terminal is gone"):
        scan(fake_rig(FRAMES, laser="on"), tmp_path / "a", progress=failing)
    assert not bench.lit

    def full(*_: Any) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    bench.end = lambda _: monkeypatch.setattr(os, "write", full)
    with pytest.raises(DiskError):
        scan(fake_rig(FRAMES, laser="on"), tmp_path / "b")
    assert not bench.lit
    assert len(bench.lines) == 2


def test_a_late_picture_is_taken_again_with_the_laser_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A camera that was opened anew meanwhile; a second time it is given up."""
    late = [True]

    def wait_always(bench: Bench) -> None:
        begun_s = time.monotonic()
        while bench.lit:
            assert time.monotonic() < begun_s + 5, "the laser stays lit"  # a hundred times as long
            time.sleep(0.001)

    def wait(bench: Bench) -> None:
        if late:
            wait_always(bench)
        late.clear()

    bench = Bench("grbl", wait)
    monkeypatch.setattr(lscan.config.rig, "find_plugin", bench.find_plugin)
    run = scan(fake_rig(FRAMES, laser="on"), tmp_path / "a")
    assert (run.state, bench.lit) == ("complete", False)

    bench.end = wait_always
    with pytest.raises(DeviceError, match=r"frame 1 took longer than 0\.05 s 2 times"):
        scan(fake_rig(FRAMES, laser="pairs"), tmp_path / "b")


# ---- the commands -----------------------------------------------------------------------


@pytest.fixture
def commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Runs ``lscan COMMAND rig.toml -o FOLDER`` on a bench."""

    def run(bench: Bench, command: str, *options: str) -> tuple[int, str, str]:
        monkeypatch.setattr(lscan.config.rig, "find_plugin", bench.find_plugin)
        rig_file = fake_rig(FRAMES, laser="on")
        monkeypatch.setattr("lscan.cli.scan.load_rig", lambda _: rig_file)
        rest = ("--port", 0) if command == "live" else ()
        return call(capsys, command, "rig.toml", "-o", tmp_path / "a", *rest, *options)

    return run


Command = Callable[..., tuple[int, str, str]]


@pytest.mark.parametrize("number", ENDING)
def test_ctrl_c_again_and_again_keeps_the_line_about_resuming(
    commands: Command, number: signal.Signals
) -> None:
    bench = Bench("grbl", signalled(number, again=True))
    code, _, said = commands(bench, "scan")
    assert (code, bench.lit) == (130, False)
    assert said.startswith(f"lscan: stopped; {KEPT}")


def test_a_lost_track_is_said_with_the_laser_it_leaves_lit(
    commands: Command, caplog: pytest.LogCaptureFixture
) -> None:
    code, _, said = commands(Bench("grbl", Bench.unplug), "scan")
    assert code == 1
    assert f"; {LASER_MAY_BE_LIT}; 2 of 3 frames are kept" in said
    assert LASER_MAY_BE_LIT in caplog.text  # by the track itself, where no scan uses it


@pytest.mark.parametrize("lost", [False, True])
def test_a_signal_as_another_error_is_dealt_with_keeps_its_notes(
    commands: Command, lost: bool
) -> None:
    def lose(bench: Bench) -> None:
        bench.again = signal.SIGTERM
        if lost:
            bench.unplug()
        raise DeviceError("the camera is gone")

    code, _, said = commands(Bench("marlin", lose), "scan")
    assert (code, said.startswith(f"lscan: stopped; {KEPT}")) == (130, True)
    assert (LASER_MAY_BE_LIT in said) is lost


def told_again(bench: Bench, folder: Path, begin: Callable[[], Any], error: str) -> None:
    """What is begun with the cable out says, each time, that the laser may be lit."""
    bench.cable_out = True
    for _ in range(2):
        with pytest.raises(LscanError, match=error) as refused:
            begin()
        assert refused.value.__notes__.count(LASER_MAY_BE_LIT) == 1
        assert json.loads((folder / MANIFEST).read_text())["laser_may_be_lit"]
    bench.cable_out = False


@pytest.mark.parametrize(
    ("way", "laser", "dialect"),
    [
        ("lost", "on", "grbl"),
        ("lost", "pairs", "marlin"),
        ("lost at the end", "on", "marlin"),
        ("lost at the end", "pairs", "grbl"),
        ("killed", "on", "grbl"),
    ],
)
def test_whoever_resumes_is_told_again_of_a_laser_that_may_be_lit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: str, laser: str, dialect: str
) -> None:
    """By command, by the live page and beside another error, until the laser is known to be off.

    Nor does a run that has all its frames become complete without a word.
    """
    bench, rig_file, folder = Bench(dialect), fake_rig(FRAMES, laser=laser), tmp_path / "a"
    monkeypatch.setattr(lscan.config.rig, "find_plugin", bench.find_plugin)

    def lose(done: int, planned: int) -> None:
        if done == (planned if way == "lost at the end" else 1):
            if way == "killed":  # the folder is then what it is at this moment
                shutil.copytree(folder, tmp_path / "killed")
            bench.unplug()

    with pytest.raises(DeviceError):
        scan(rig_file, folder, progress=lose)
    if way == "killed":
        folder = folder.rename(tmp_path / "b").parent / "killed"
    told_again(bench, folder, lambda: scan(rig_file, folder, resume=True), "could not open")
    told_again(bench, folder, lambda: Session(rig_file, tmp_path), "could not open")
    picture = frame_file(folder, 0)
    picture.rename(tmp_path / "sound")
    told_again(bench, folder, lambda: scan(rig_file, folder, resume=True), "missing")
    (tmp_path / "sound").rename(picture)
    run = scan(rig_file, folder, resume=True, position_restored=True)
    assert (run.state, bench.lit) == ("complete", False)
    assert "laser_may_be_lit" not in json.loads((folder / MANIFEST).read_text())


LIVE = [
    *((number, False) for number in ENDING),
    (signal.SIGHUP, True),
    (signal.SIGINT, True),
]


def live_until(monkeypatch: pytest.MonkeyPatch, act: Callable[[Session], None]) -> None:
    """Let the page's server do this, and then end as a signal has told it to."""

    def run(server: LiveServer, sockets: Any) -> None:
        act(server._page._session)
        assert server.should_exit

    monkeypatch.setattr(LiveServer, "run", run)


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize(("number", "again"), LIVE)
def test_the_live_page_switches_the_laser_off_by_any_signal(
    commands: Command,
    monkeypatch: pytest.MonkeyPatch,
    dialect: str,
    number: signal.Signals,
    again: bool,
) -> None:
    bench = Bench(dialect)

    def light(session: Session) -> None:
        session.switch_laser(True)
        assert bench.lit
        signalled(number, again)(bench)

    live_until(monkeypatch, light)
    code, _, said = commands(bench, "live")
    assert (code, said, bench.lit) == (0, "", False)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_the_live_page_says_that_the_laser_may_be_lit_until_it_is_off(
    commands: Command, monkeypatch: pytest.MonkeyPatch, dialect: str
) -> None:
    """The cable is pulled, put back, and pulled again; then it ends with exit code 1."""
    bench, warnings = Bench(dialect), []

    def lose(session: Session) -> None:
        for _ in range(2):
            session.switch_laser(True)
            warnings.append(session.state()["laser_warning"])
            bench.unplug()
            session._devices.check_track()
            warnings.append(session.state()["laser_warning"])
            if len(warnings) == 2:
                session.move_to(1.0)  # opens the track again
                assert not bench.lit
        signal.raise_signal(signal.SIGTERM)

    live_until(monkeypatch, lose)
    code, _, said = commands(bench, "live")
    assert warnings == ["", LASER_MAY_BE_LIT] * 2
    assert (code, said) == (1, f"lscan: {LASER_MAY_BE_LIT}\n")


def test_a_recording_that_cannot_be_ended_hides_no_lit_laser(
    commands: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The disk is full as the recording is ended: a laser that may be lit is said all the same."""

    @contextmanager
    def full(path: Path) -> Iterator[MessageFile]:
        with message_file(path) as file:
            yield file
        raise InputError("no space left", where=path)

    monkeypatch.setattr("lscan.files.rosmessages.message_file", full)

    def lose(session: Session, *, lost: bool) -> None:
        session.switch_laser(True)
        if lost:
            bench.unplug()
            session._devices.check_track()
        signal.raise_signal(signal.SIGTERM)

    for lost, said in ((False, "no space left"), (True, LASER_MAY_BE_LIT)):
        bench = Bench("grbl")
        live_until(monkeypatch, partial(lose, lost=lost))
        code, _, words = commands(bench, "live", "--mcap", str(tmp_path / "a.mcap"))
        assert code == (1 if lost else 2)
        assert said in words
        assert bench.lit is lost


@pytest.mark.parametrize("way", ["camera lost", "camera hangs", "track lost", "SIGHUP"])
@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_scan_of_the_live_page_leaves_the_laser_off_or_says_so(
    commands: Command, monkeypatch: pytest.MonkeyPatch, dialect: str, way: str
) -> None:
    bench = Bench(dialect, (lambda _: None) if way == "SIGHUP" else WAYS[way].end)
    off = WAYS[way].off

    def scanned(session: Session) -> None:
        session.start_scan("b")
        while way != "SIGHUP" and session.scanning.active:
            time.sleep(0.002)
        assert session.state()["laser_warning"] == ("" if off else LASER_MAY_BE_LIT)
        bench.again = signal.SIGHUP if way == "SIGHUP" else None
        signal.raise_signal(signal.SIGHUP)

    live_until(monkeypatch, scanned)
    code, _, _ = commands(bench, "live")
    assert (code, bench.lit) == ((0, False) if off else (1, True))


# ---- signals ----------------------------------------------------------------------------


def test_one_interruption_at_a_time_and_another_once_it_is_gone() -> None:
    came = 0
    with interrupted_by_signals():
        for _ in range(2):
            try:
                signal.raise_signal(signal.SIGTERM)
            except KeyboardInterrupt:
                signal.raise_signal(signal.SIGHUP)  # while the first is being dealt with
                came += 1
    assert came == 2


def test_an_error_while_an_interruption_is_dealt_with_is_what_is_told() -> None:
    with pytest.raises(DeviceError, match="stays lit"), interrupted_by_signals():
        try:
            signal.raise_signal(signal.SIGTERM)
        finally:
            raise DeviceError("the laser stays lit")


def test_a_signal_that_is_held_acts_once_and_at_the_end() -> None:
    done = False
    with interrupted_by_signals(), pytest.raises(KeyboardInterrupt), stop_signals_held():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)
        done = True
    assert done


def test_a_hangup_that_nohup_ignores_stays_ignored(commands: Command) -> None:
    def hang_up(bench: Bench) -> None:
        signal.raise_signal(signal.SIGHUP)

    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert commands(Bench("grbl", hang_up), "scan")[0] == 0
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_script_keeps_its_own_handlers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    came: list[int] = []
    bench = Bench("grbl", lambda _: signal.raise_signal(signal.SIGUSR1))
    monkeypatch.setattr(lscan.config.rig, "find_plugin", bench.find_plugin)
    before = signal.signal(signal.SIGUSR1, lambda number, _: came.append(number))
    try:
        run = scan(fake_rig(FRAMES, laser="on"), tmp_path / "a")
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert (run.state, came) == ("complete", [signal.SIGUSR1])
