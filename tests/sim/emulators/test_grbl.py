"""The emulated controller against Grbl 1.1's documentation, and its motion in closed form."""

import socket
from pathlib import Path

import pytest
from drawn_examples import examples
from grbl_line import SimulatedTime
from hypothesis import given, strategies as st

from lscan.config.rig import Plan
from lscan.devices.grbl.dialogue import StatusReport, parse_line
from lscan.errors import InputError
from sim.emulators.grbl import GrblEmulator
from sim.emulators.grbl.motion import Ramp
from sim.emulators.track import EmulatedTrack

FREE = {20: 0, 22: 0}  # no homing, no soft limits: nothing is locked


class Desk:
    """An emulator, its clock, and someone who types."""

    def __init__(self, machine: dict[int, float] | None = None) -> None:
        self.time = SimulatedTime()
        self.grbl = GrblEmulator(FREE if machine is None else machine, clock=self.time)
        self.greeting = self.heard()

    def heard(self) -> list[str]:
        return self.grbl.transmit().decode("ascii").split("\r\n")[:-1]

    def say(self, text: str, wait_s: float = 0.0) -> list[str]:
        self.grbl.receive(text.encode("latin-1"))
        self.time.sleep(wait_s)
        return self.heard()

    def line(self, text: str, wait_s: float = 0.0) -> list[str]:
        return self.say(text + "\n", wait_s)


def test_the_greeting_with_and_without_a_lock() -> None:
    assert Desk().greeting == ["", "Grbl 1.1h ['$' for help]"]
    assert Desk({}).greeting[-1] == "[MSG:'$H'|'$X' to unlock]"


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("10", 1),
        ("GX", 2),
        ("$10=nan", 2),
        ("$Q", 3),
        ("G1X1F-5", 4),
        ("$H", 5),
        ("$20=1", 10),
        ("G1 X" + "1" * 90, 11),
        ("$J", 16),
        ("G5", 20),
        ("G20G21", 21),
        ("G1X1", 22),
        ("X1X2", 25),
        ("G92", 26),
        ("G4", 28),
        ("G80X1", 31),
    ],
)
def test_a_bad_line_gets_its_documented_error_and_moves_nothing(text: str, code: int) -> None:
    desk = Desk()
    assert desk.line(text, 1.0) == [f"error:{code}"]
    assert desk.grbl.state == "Idle"
    assert desk.grbl.head_mm == (-50.0, -50.0, -50.0)


def test_the_documented_listings_end_in_ok() -> None:
    desk = Desk()
    settings_list = desk.line("$$")
    assert settings_list[0] == "$0=10"
    assert "$100=250.000" in settings_list
    assert desk.line("$G") == ["[GC:G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0]", "ok"]
    assert desk.line("$#")[-2:] == ["[PRB:0.000,0.000,0.000:0]", "ok"]
    for text in ("$$", "$#", "$I", "$G", "$", ""):
        lines = desk.line(text)
        assert lines[-1] == "ok"
        assert all(parse_line(line) is not None for line in lines), lines


def test_locked_it_takes_only_what_unlocks() -> None:
    desk = Desk({})
    assert desk.line("G1X1F10") == ["error:9"]
    assert desk.line("$J=X1F10") == ["error:8"]
    assert desk.line("$X") == ["[MSG:Caution: Unlocked]", "ok"]
    assert desk.line("G1X-1F100") == ["ok"]


def test_homing_finds_the_switches() -> None:
    desk = Desk({})
    assert desk.line("$H", 1.0) == []
    assert desk.say("?") == []  # documented: no report while homing
    desk.time.sleep(60.0)
    assert desk.heard() == ["ok"]
    assert desk.grbl.head_mm == (-1.0, -1.0, -1.0)
    assert desk.say("?")[0].startswith("<Idle|MPos:-1.000,-1.000,-1.000|")


def test_soft_limits_refuse_a_jog_and_lock_for_a_feed() -> None:
    desk = Desk({})
    desk.line("$H", 60.0)
    assert desk.line("$J=G53X1F100") == ["error:15"]
    assert desk.line("G1X1F100") == ["ALARM:2", "[MSG:Reset to continue]"]
    assert desk.say("?") == []
    assert desk.say("\x18")[-1] == "[MSG:'$H'|'$X' to unlock]"


def test_a_reset_in_motion_is_alarm_3_and_at_rest_is_none() -> None:
    desk = Desk()
    assert desk.say("\x18") == ["", "Grbl 1.1h ['$' for help]"]
    desk.line("G1X10F600", 0.5)
    assert desk.say("\x18")[0] == "ALARM:3"
    assert desk.grbl.state == "Alarm"


def test_feed_hold_keeps_a_feed_and_ends_a_jog() -> None:
    desk = Desk()
    desk.line("G1X10F600", 0.5)
    desk.say("!", 1.0)
    held_mm = desk.grbl.head_mm[0]
    assert desk.grbl.state == "Hold:0"
    assert -50.0 < held_mm < -40.0
    desk.say("~", 5.0)
    assert desk.grbl.head_mm[0] == -40.0
    desk.line("$J=G91X10F600", 0.5)
    desk.say("!", 1.0)
    assert desk.grbl.state == "Idle"
    desk.say("~", 5.0)
    assert desk.grbl.head_mm[0] < -30.0


def test_a_reset_after_the_brake_keeps_the_position_and_during_it_does_not() -> None:
    """Grbl 1.1 motion_control.c, mc_reset: ALARM:3 in a cycle, a jog, or an unfinished hold.

    600 mm/min at 200 mm/s² brake within 0.05 s and 0.25 mm.
    """
    for line, byte, state in (("$J=X10F600", "\x85", "Idle"), ("G1X10F600", "!", "Hold:0")):
        desk = Desk()
        desk.line(line, 0.5)
        desk.say(byte, 0.01)
        assert desk.say("?")[0].startswith(("<Jog|", "<Hold:1|"))
        desk.time.sleep(0.05)
        assert desk.grbl.state == state
        there_mm = desk.grbl.head_mm[0]
        assert desk.say("\x18") == ["", "Grbl 1.1h ['$' for help]"]
        assert desk.grbl.state == "Idle"
        reported = parse_line(desk.say("?")[0])
        assert isinstance(reported, StatusReport)
        assert reported.machine is not None
        assert reported.machine[0] == pytest.approx(there_mm + 50.0, abs=0.0025)  # half a step
        desk = Desk()
        desk.line(line, 0.5)
        desk.say(byte, 0.01)
        assert desk.say("\x18")[0] == "ALARM:3"


def test_a_hold_at_rest_lets_lines_wait() -> None:
    desk = Desk()
    desk.say("!")
    assert desk.grbl.state == "Hold:0"
    assert desk.line("$G") == []
    assert desk.say("~")[-1] == "ok"
    assert desk.grbl.state == "Idle"


def test_inches_and_increments() -> None:
    desk = Desk()
    desk.line("G20G91G1X0.5F100", 20.0)
    assert desk.grbl.head_mm[0] == pytest.approx(-50 + 12.7, abs=0.002)
    assert desk.line("$G")[0].startswith("[GC:G1 G54 G17 G20 G91")


def test_the_laser_waits_for_the_motion_before_it() -> None:
    desk = Desk()
    desk.line("G1X10F600")
    assert desk.line("M3S500") == []
    assert desk.grbl.laser_power == 0
    desk.time.sleep(3.0)
    assert desk.heard() == ["ok"]
    assert desk.grbl.laser_power == 500
    assert desk.line("M5") == ["ok"]
    assert desk.grbl.laser_power == 0


def test_every_report_can_be_read_and_states_the_offset_first() -> None:
    desk = Desk({**FREE, 10: 3})
    desk.line("G92X5")
    report = desk.say("?")[0]
    first = parse_line(report)
    assert isinstance(first, StatusReport)
    assert first.offset == (-5.0, 0.0, 0.0)
    assert "|Bf:15,128|" in report
    for _ in range(25):
        assert isinstance(parse_line(desk.say("?")[0]), StatusReport)


def test_a_move_takes_the_time_of_its_ramps() -> None:
    """100 mm at 50 mm/s and 200 mm/s²: s/v + v/a = 2.25 s; 1 mm: 2 √(s/a) = 0.1414 s."""
    assert Ramp.from_rest_to_rest(100.0, 50.0, 200.0).duration_s == pytest.approx(2.25)
    assert Ramp.from_rest_to_rest(1.0, 50.0, 200.0).duration_s == pytest.approx(0.141421, abs=1e-6)
    assert Ramp.to_rest(50.0, 200.0).at(1.0)[0] == pytest.approx(6.25)  # v²/2a


@examples(100)
@given(
    length=st.floats(0.01, 1000),
    top=st.floats(0.1, 1000),
    accel=st.floats(1, 10_000),
    part=st.floats(0, 1),
)
def test_a_ramp_is_symmetric_and_keeps_its_limits(
    length: float, top: float, accel: float, part: float
) -> None:
    ramp = Ramp.from_rest_to_rest(length, top, accel)
    time_s = part * ramp.duration_s
    way, speed = ramp.at(time_s)
    mirrored = length - ramp.at(ramp.duration_s - time_s)[0]
    assert way == pytest.approx(mirrored, abs=1e-9 * length)
    assert 0 <= speed <= top * (1 + 2**-51)  # a quotient and a product, each rounded once
    assert -1e-9 * length <= way <= length * (1 + 1e-9)


# ---- over TCP ---------------------------------------------------------------------------


def test_unplugged_and_plugged_in_again_it_has_the_same_address() -> None:
    track = EmulatedTrack(Plan(), tcp=True)
    try:
        address = track.port
        track.unplug()
        assert track.port == address
        with pytest.raises(OSError, match="refused"):
            _reach(address)
        track.plug_in()
        assert track.port == address
        _reach(address)
    finally:
        track.unplug()


def _reach(address: str) -> None:
    host, number = address.removeprefix("socket://").split(":")
    socket.create_connection((host, int(number)), timeout=60).close()


def test_a_link_names_no_tcp_port(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--link: names no TCP port .*without --tcp"):
        EmulatedTrack(Plan(), link=tmp_path / "port", tcp=True)
