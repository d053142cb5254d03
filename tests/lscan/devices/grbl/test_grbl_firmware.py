"""The serial track on firmware that answers as Grbl does, and where real Grbl surprises."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import serial
from grbl_line import FLUIDNC, GRBL_ESP32, GRBLHAL, GRBLHAL_AS_GRBL, DirectLine, SimulatedTime
from track_plant import START_MM, UNHOMED, Plant, spacing_is_true

from lscan.devices.grbl import SerialTrack, SerialTrackOptions, open_track
from lscan.errors import DeviceError
from sim.emulators.grbl import GRBL, Faults, Firmware, GrblEmulator, MarlinEmulator, PseudoTerminal

FIRMWARE = {
    "Grbl 1.1h": GRBL,
    "GrblHAL 1.1f": GRBLHAL,
    "Grbl 1.1f": GRBLHAL_AS_GRBL,
    "Grbl 1.3a": GRBL_ESP32,
    "Grbl 3.7": FLUIDNC,
}
each_firmware = pytest.mark.parametrize("name", FIRMWARE)


@dataclass
class Desk:
    """A controller, the time it lives in, and its line."""

    time: SimulatedTime
    emulator: GrblEmulator
    line: DirectLine

    def open(self, **values: Any) -> SerialTrack:
        plain = {"port": "here", "min_mm": 0, "max_mm": 40, "homing": False, "settle_s": 0}
        options = SerialTrackOptions(**{**plain, **values})
        return open_track(options, self.line, self.time, self.time.sleep)


def desk(
    machine: dict[int, float] | None = None, firmware: Firmware = GRBL, said: bool = False
) -> Desk:
    """said: the banner was read by another program before."""
    time = SimulatedTime()
    emulator = GrblEmulator({**UNHOMED, **(machine or {})}, clock=time, firmware=firmware)
    if said:
        emulator.transmit()
    return Desk(time, emulator, DirectLine(emulator, time))


@each_firmware
def test_frames_in_pairs_are_taken_where_they_are_due(name: str) -> None:
    d = desk(firmware=FIRMWARE[name])
    track = d.open()
    assert track.describe()["firmware"] == name
    for stop_mm in (0.0, 0.5, 1.0, 1.5):
        assert track.move_to(stop_mm) == pytest.approx(stop_mm, abs=0.02)
        assert d.emulator.head_mm[0] - START_MM == pytest.approx(stop_mm, abs=0.02)
        track.laser_on()
        assert d.emulator.laser_power == 1000
        track.laser_off()
        assert d.emulator.laser_power == 0
    assert track.describe()["noise_bytes"] == 0


@each_firmware
@pytest.mark.parametrize("moving", [True, False])
def test_a_position_lost_between_two_sessions_is_never_gone_on_from(
    name: str, moving: bool, tmp_path: Path
) -> None:
    """A reset, in motion with a lost position, and then unlocked by another program."""
    plant = Plant(boot_s=0.1)
    plant.emulator = GrblEmulator(UNHOMED, (START_MM,) * 3, plant.time, firmware=FIRMWARE[name])
    plant.scan(tmp_path / "a", 2)
    if moving:
        plant.emulator.receive(b"$J=G91X5F500\n")
        plant.time.sleep(0.1)
    plant.emulator.receive(b"\x18")
    plant.emulator.receive(b"$X\n")
    plant.emulator.transmit()
    with pytest.raises(DeviceError, match=r"restarted, reset or in alarm.*--position-restored"):
        plant.scan(tmp_path / "a")
    assert len(plant.seen_mm) == 2


@each_firmware
def test_a_position_kept_between_two_sessions_is_gone_on_from(name: str, tmp_path: Path) -> None:
    """Opening resets the controller at rest; its mark from before is found, also in inches."""
    plant = Plant(boot_s=0.1)
    inches = {13: 1} if name.endswith(("1.1h", "1.1f")) else {}
    plant.emulator = GrblEmulator(
        UNHOMED | inches, (START_MM,) * 3, plant.time, firmware=FIRMWARE[name]
    )
    plant.scan(tmp_path / "a", 2)
    assert plant.scan(tmp_path / "a") is not None
    assert spacing_is_true(plant)


@pytest.mark.parametrize("left", [b"F10000\n", b"G20F300\n", b"G93\n", b"T105\n"])
def test_what_another_program_left_is_no_mark(left: bytes) -> None:
    d = desk(said=True)
    d.emulator.receive(left)
    zero = d.open(boot_s=0.1).zero
    assert zero is not None
    feed, token = zero.split()
    assert 200_000 <= float(feed.removeprefix("F")) < 1_000_000
    assert token


# ---- the laser --------------------------------------------------------------------------


def test_a_laser_held_lit_is_put_out_by_a_reset() -> None:
    """In a hold Grbl leaves M5 waiting; the reset loses the mark, which the next move says."""
    d = desk()
    track = d.open()
    track.laser_on()
    d.emulator.receive(b"!")
    track.laser_off()
    assert d.emulator.laser_power == 0
    assert track.zero == "lost"
    with pytest.raises(DeviceError, match="the controller has restarted"):
        track.move_to(1.0)


def test_an_alarm_with_the_laser_lit_leaves_it_dark_and_reset() -> None:
    d = desk()
    track = d.open()
    track.laser_on()
    d.emulator.inject(Faults(alarm=True))
    with pytest.raises(DeviceError, match=r"ALARM:1, a limit switch"):
        track.move_to(30.0)
    assert d.emulator.laser_power == 0
    track.close()
    assert d.emulator.laser_power == 0
    assert d.emulator.state == "Alarm"


def test_a_lost_ok_of_m5_does_not_end_a_scan() -> None:
    d = desk()
    track = d.open()
    track.laser_on()
    d.emulator.inject(Faults(lose_oks=1))
    track.laser_off()
    assert track.move_to(1.0) == 1.0


def test_an_unplugged_laser_is_not_said_to_be_off() -> None:
    d = desk()
    track = d.open()
    track.laser_on()
    d.emulator.inject(Faults(silent=True))
    with pytest.raises(DeviceError, match="silent"):
        track.laser_off()


def marlin(time: SimulatedTime, emulator: MarlinEmulator, line: DirectLine | None = None) -> None:
    options = SerialTrackOptions(port="here", dialect="marlin", min_mm=0, max_mm=40, boot_s=0.1)
    open_track(options, line or DirectLine(emulator, time), time, time.sleep)


def test_marlin_is_made_dark_when_it_is_opened() -> None:
    """A program that was killed left it lit, and Marlin does not restart."""
    time = SimulatedTime()
    emulator = MarlinEmulator(clock=time)
    emulator.receive(b"M3 S100\n")
    assert emulator.laser_power == 100
    marlin(time, emulator)
    assert emulator.laser_power == 0


def test_a_marlin_built_without_a_laser_opens(monkeypatch: pytest.MonkeyPatch) -> None:
    """It answers echo:Unknown command and an ok, which no later line may be taken to have."""
    time = SimulatedTime()
    emulator = MarlinEmulator(clock=time)
    execute = emulator._execute
    monkeypatch.setattr(emulator, "_execute", lambda text: execute("?" if text == "M5" else text))
    marlin(time, emulator)


def test_a_long_m115_that_arrives_in_pieces_is_read() -> None:
    """Of 289 characters, with the longest machine type that a hundred characters can be."""

    class Trickling(DirectLine):
        def read(self, size: int) -> bytes:
            return super().read(min(size, 48))

    time = SimulatedTime()
    emulator = MarlinEmulator(clock=time)
    emulator.machine_type = "T" * 100
    marlin(time, emulator, Trickling(emulator, time))


# ---- opening ----------------------------------------------------------------------------


@pytest.mark.parametrize("again_s", [0.05, 0.3, 0.45])
def test_a_board_that_starts_twice_is_opened(again_s: float) -> None:
    d = desk()
    d.emulator.inject(Faults(begin_s=again_s, restart=True))
    track = d.open()
    assert d.time() >= again_s
    assert track.move_to(2.0) == 2.0


@pytest.mark.parametrize("starts", [1, 2])
def test_a_board_that_starts_again_when_it_is_asked_is_opened_once_more(starts: int) -> None:
    d = desk()

    class StartingAgain(DirectLine):
        left = starts

        def write(self, data: bytes) -> int:
            if data == b"$$\n" and self.left:
                self.left -= 1
                d.emulator.inject(Faults(restart=True))
            return super().write(data)

    d.line = StartingAgain(d.emulator, d.time)
    if starts == 1:
        assert d.open().move_to(2.0) == 2.0
    else:
        with pytest.raises(DeviceError, match="the controller has restarted"):
            d.open()


def test_a_second_start_drops_the_mark_that_was_found() -> None:
    d = desk(said=True)
    first = d.open(boot_s=0.1)
    zero = first.zero
    d.emulator.inject(Faults(begin_s=d.time() + 0.15, restart=True))
    again = d.open(boot_s=0.1)
    assert d.emulator._faults.restart is False, "the second start came while it was opened"
    assert zero is not None
    assert again.zero is not None
    assert again.zero.split()[0] != zero.split()[0]


def test_a_travel_that_only_the_firmware_knows_is_left_to_it() -> None:
    """FluidNC counts from mpos_mm, which no answer states; Grbl from 0 down to -$130."""
    rig = {"min_mm": 5.0, "max_mm": 40.0, "zero_mm": 100.0}
    desk({20: 1}, FLUIDNC).open(**rig)
    with pytest.raises(DeviceError, match="soft limits allow"):
        desk({20: 1}, GRBL).open(**rig)


@pytest.mark.parametrize("hold_ms", [25, 255])
def test_motors_that_let_go_are_named(hold_ms: int, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        desk({1: hold_ms}).open()
    assert ("let go 25 ms after each move ($1=25)" in caplog.text) == (hold_ms == 25)
    assert ("$1=255" in caplog.text) == (hold_ms == 25)


@pytest.fixture
def terminal() -> Iterator[PseudoTerminal]:
    with PseudoTerminal(GrblEmulator(UNHOMED)) as terminal:
        yield terminal


@pytest.mark.parametrize("dtr", [True, False])
def test_dtr_and_rts_are_set_before_the_port_opens(
    dtr: bool, terminal: PseudoTerminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Raised even for a moment, they would hold or start some boards."""
    lines: list[tuple[bool, bool]] = []
    opened = serial.Serial.open

    def spied(port: serial.Serial) -> None:
        lines.append((port.dtr, port.rts))
        opened(port)

    monkeypatch.setattr(serial.Serial, "open", spied)
    options = SerialTrackOptions(
        port=terminal.port, min_mm=0, max_mm=9, homing=False, dtr=dtr, boot_s=0.1, answer_s=60
    )
    open_track(options).close()
    assert lines == [(dtr, dtr)]


@pytest.mark.parametrize("dialect", ["grbl", "marlin"])
def test_a_board_that_says_nothing_may_be_held_in_reset(dialect: str) -> None:
    d = desk()
    d.emulator.inject(Faults(silent=True))
    with pytest.raises(DeviceError, match=r"track\.options\.dtr = false"):
        d.open(dialect=dialect)


# ---- motion -----------------------------------------------------------------------------


def test_idle_before_the_motion_begins_is_not_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    d = desk()
    track = d.open()
    state, begun_s = d.emulator._state, [-1.0]

    def late() -> str:
        now = state()
        if now != "Jog":
            begun_s[0] = -1.0
            return now
        begun_s[0] = d.time() if begun_s[0] < 0 else begun_s[0]
        return "Idle" if d.time() - begun_s[0] < 0.03 else now

    monkeypatch.setattr(d.emulator, "_state", late)
    for stop_mm in (5.0, 5.5, 6.0):
        assert track.move_to(stop_mm) == stop_mm


def test_a_jog_cancelled_as_it_ends_leaves_a_track_that_answers() -> None:
    """Grbl reports Idle but takes no line until it is told to go on."""
    d = desk()
    track = d.open()
    d.emulator.receive(b"$J=G53X5F500\n")
    d.emulator.inject(Faults(late_cancel=True))
    track._machine.stop()
    assert d.emulator.state == "Idle"
    d.emulator.inject(Faults())
    assert track._machine.position_mm() == 5.0


def test_one_left_suspended_by_a_killed_program_is_opened_with_its_zero() -> None:
    d = desk(said=True)
    zero = d.open(boot_s=0.1).zero
    d.emulator.inject(Faults(late_cancel=True))
    d.emulator.receive(b"$J=G53X5F500\n")
    d.emulator.receive(b"\x85")
    d.time.sleep(5)
    d.emulator.inject(Faults())
    track = d.open(boot_s=0.1)
    assert track.position_mm == 5.0
    assert zero is not None
    assert track.zero == zero.split()[0]


def test_a_jog_is_cancelled_once_while_it_brakes() -> None:
    d = desk({120: 50})

    class Recording(DirectLine):
        sent = bytearray()

        def write(self, data: bytes) -> int:
            self.sent += data
            return super().write(data)

    line = d.line = Recording(d.emulator, d.time)
    track = d.open()
    d.emulator.receive(b"$J=G53X30F500\n")
    d.time.sleep(1.0)
    track._machine.stop()  # 500 mm/min at 50 mm/s² brake within 0.17 s
    assert bytes(line.sent).count(b"\x85") == 1
    assert d.emulator.state == "Idle"
