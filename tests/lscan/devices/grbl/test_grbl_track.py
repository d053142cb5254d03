"""The serial track over emulated controllers, in simulated time and over a pseudo-terminal."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest
from device_contract import TrackContract
from drawn_examples import examples
from grbl_line import DirectLine, SimulatedTime
from hypothesis import given, strategies as st

from lscan.config.rig import parse_rig
from lscan.devices.api import Track
from lscan.devices.grbl import SerialTrack, SerialTrackOptions, open_track, track_driver
from lscan.errors import DeviceError, InputError
from sim.emulators.grbl import GrblEmulator, MarlinEmulator, PseudoTerminal

ZERO_MM = -190.0  # machine coordinate of position 0; travel is -200 to 0
QUICK = dict.fromkeys((25, 110, 111, 112), 50_000) | dict.fromkeys((120, 121, 122), 20_000)
STEP_MM = 1 / 250  # $100


@dataclass
class Bench:
    """A track and the emulated controller at the other end of its line."""

    track: SerialTrack
    emulator: GrblEmulator | MarlinEmulator
    line: DirectLine
    time: SimulatedTime

    @property
    def head_mm(self) -> float:
        """True position of the head in the track's frame, after homing."""
        return self.emulator.head_mm[0] - ZERO_MM


class Recorder(DirectLine):
    """A line that keeps what was written to it."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.written = bytearray()

    def write(self, data: bytes) -> int:
        self.written += data
        return super().write(data)


def options(**values: Any) -> SerialTrackOptions:
    plain = {"port": "here", "min_mm": 0.0, "max_mm": 180.0, "zero_mm": ZERO_MM}
    return SerialTrackOptions(**{**plain, **values})


def bench(machine: dict[int, float] | None = None, **values: Any) -> Bench:
    time = SimulatedTime()
    chosen = options(**values)
    kind = GrblEmulator if chosen.dialect == "grbl" else MarlinEmulator
    emulator = kind(machine, clock=time)
    line = Recorder(emulator, time)
    return Bench(open_track(chosen, line, time, time.sleep), emulator, line, time)


class TestGrblTrack(TrackContract):
    limits_mm = (0.0, 180.0)
    tolerance_mm = 0.02
    name = "grbl track on"
    emulator: GrblEmulator | MarlinEmulator

    @pytest.fixture
    def track(self) -> Iterator[Track]:
        b = bench()
        self.emulator = b.emulator
        yield b.track
        b.track.close()

    def is_lit(self) -> bool:
        return self.emulator.laser_power > 0


class TestMarlinTrack(TestGrblTrack):
    name = "marlin track on"

    @pytest.fixture
    def track(self) -> Iterator[Track]:
        b = bench(dialect="marlin")
        self.emulator = b.emulator
        yield b.track
        b.track.close()


class TestTrackOnATerminal(TestGrblTrack):
    """The same code through pyserial and a pseudo-terminal, in real time."""

    kind: type[GrblEmulator] | type[MarlinEmulator] = GrblEmulator

    @pytest.fixture
    def track(self) -> Iterator[Track]:
        self.emulator = self.kind(QUICK)
        dialect = "grbl" if self.kind is GrblEmulator else "marlin"
        with PseudoTerminal(self.emulator) as terminal:
            quick = {"feed_mm_min": 50_000, "settle_s": 0, "boot_s": 0.2, "answer_s": 60}
            chosen = options(port=terminal.port, dialect=dialect, **quick)
            track = open_track(chosen)
            yield track
            track.close()


@pytest.mark.slow
class TestMarlinOnATerminal(TestTrackOnATerminal):
    name = "marlin track on"
    kind = MarlinEmulator


# ---- motion -----------------------------------------------------------------------------


@examples(15)
@given(stops=st.lists(st.floats(0, 180), min_size=1, max_size=5), dialect=st.sampled_from("gm"))
def test_it_stands_where_it_says(stops: list[float], dialect: str) -> None:
    """Half a step, and 0.5 µm of the three decimals (Marlin: 5 µm of two), from the truth."""
    b = bench(dialect="grbl" if dialect == "g" else "marlin")
    rounding_mm = 0.0005 if dialect == "g" else 0.005
    for stop_mm in stops:
        reported_mm = b.track.move_to(stop_mm)
        assert abs(reported_mm - b.head_mm) <= rounding_mm + 1e-9
        assert abs(b.head_mm - stop_mm) <= STEP_MM / 2 + 0.0005 + 1e-9


def test_a_target_that_was_misheard_is_noticed_where_the_head_stands() -> None:
    """A digit lost on the line: the controller moves there, and is at rest without complaint."""
    b = bench()
    write = b.line.write
    b.line.write = lambda data: write(data.replace(b"X-1", b"X-"))  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match=r"stands at 119 mm instead of 19 mm, allowed: 0\.02 mm"):
        b.track.move_to(20.0)


@examples(15)
@given(stops=st.lists(st.floats(0, 180), min_size=1, max_size=4), invert=st.booleans())
def test_every_stop_is_reached_from_below(stops: list[float], invert: bool) -> None:
    """With 0.8 mm of backlash the drive always pushes the carriage from the same side."""
    frame = {"invert": True, "zero_mm": -10.0} if invert else {"zero_mm": ZERO_MM}
    b, backlash_mm = bench(approach_mm=1.0, **frame), 0.8
    assert isinstance(b.line, Recorder)
    carriage_mm = b.track.position_mm
    for stop_mm in stops:
        b.line.written.clear()
        b.track.move_to(stop_mm)
        for machine_mm in re.findall(rb"G53X(-?[0-9.]+)F", bytes(b.line.written)):
            drive_mm = (float(machine_mm) - frame["zero_mm"]) * (-1 if invert else 1)
            carriage_mm = min(max(carriage_mm, drive_mm - backlash_mm), drive_mm)
        # The report is of whole steps, the command of thousandths.
        assert carriage_mm == pytest.approx(b.track.position_mm - backlash_mm, abs=STEP_MM)


def test_steps_upwards_need_no_detour_and_a_stop_again_no_motion() -> None:
    b = bench()
    b.track.move_to(10.0)
    assert isinstance(b.line, Recorder)
    b.line.written.clear()
    for stop_mm in (10.0, 10.5, 11.0):
        b.track.move_to(stop_mm)
    assert bytes(b.line.written).count(b"$J=") == 3


def test_it_rests_before_it_returns() -> None:
    quick, slow = bench(settle_s=0.0), bench(settle_s=5.0)
    spent_s = []
    for b in (quick, slow):
        b.track.move_to(10.0)
        before_s = b.time()
        b.track.move_to(20.0)
        spent_s.append(b.time() - before_s)
    assert spent_s[1] - spent_s[0] == pytest.approx(5.0, abs=0.1)


def test_lines_are_short_and_nothing_is_sent_for_a_refused_move() -> None:
    b = bench({110: 60_000}, feed_mm_min=59_999.9)
    b.track.move_to(180.0)
    assert isinstance(b.line, Recorder)
    assert max(map(len, bytes(b.line.written).split(b"\n"))) < 70
    b.line.written.clear()
    with pytest.raises(DeviceError):
        b.track.move_to(180.1)
    assert b.line.written == b""


@pytest.mark.parametrize("machine", [{13: 1}, {10: 0}, {10: 3}, {10: 2, 13: 1}])
def test_reports_in_inches_or_work_coordinates_are_understood(machine: dict[int, float]) -> None:
    """An inch report has three decimals of an inch: 0.0127 mm."""
    b = bench(machine)
    assert b.track.move_to(50.0) == pytest.approx(50.0, abs=0.0127 + 1e-9)
    assert b.head_mm == pytest.approx(50.0, abs=STEP_MM)


@pytest.mark.parametrize("dialect", ["grbl", "marlin"])
def test_the_laser_is_switched_and_left_dark(dialect: str) -> None:
    b = bench(dialect=dialect, laser_power=400)
    assert b.emulator.laser_power == 0
    b.track.laser_on()
    assert b.emulator.laser_power == 400
    b.track.laser_off()
    assert b.emulator.laser_power == 0
    b.track.laser_on()
    b.track.close()
    assert b.emulator.laser_power == 0
    assert b.line.closed


def test_without_homing_zero_is_where_the_controller_started() -> None:
    machine = {20: 0, 22: 0}
    b = bench(machine, homing=False, zero_mm=0.0, min_mm=0.0, max_mm=20.0)
    assert b.track.position_mm == 0.0
    b.track.move_to(5.0)
    assert b.emulator.head_mm[0] == pytest.approx(-45.0, abs=STEP_MM)


def test_interrupted_it_leaves_the_machine_idle() -> None:
    time, interrupt_s = SimulatedTime(), float("inf")

    def sleep(seconds: float) -> None:
        time.sleep(seconds)
        if time() > interrupt_s:
            raise KeyboardInterrupt

    emulator = GrblEmulator(clock=time)
    track = open_track(options(), DirectLine(emulator, time), time, sleep)
    interrupt_s = time() + 3.0
    with pytest.raises(KeyboardInterrupt):
        track.move_to(0.0)
    interrupt_s = float("inf")
    track.close()
    assert emulator.state == "Idle"
    assert emulator.head_mm[0] > ZERO_MM + 100  # 3 s at 10 mm/s, not the whole way


# ---- opening ----------------------------------------------------------------------------


def test_the_controllers_travel_bounds_the_rigs() -> None:
    with pytest.raises(DeviceError, match=r"approach_mm.*soft limits allow -10 to 190 mm"):
        bench(max_mm=195.0)
    with pytest.raises(DeviceError, match="soft limits"):
        bench(min_mm=-9.5, approach_mm=1.0)
    bench(min_mm=-9.0, approach_mm=1.0)


def test_homing_switched_off_in_the_controller_is_named() -> None:
    with pytest.raises(DeviceError, match=r"refuses '\$H': error:5, homing is switched off"):
        bench({20: 0, 22: 0})


def test_a_locked_controller_is_not_unlocked_unasked() -> None:
    with pytest.raises(DeviceError, match=r"state Alarm; .*home"):
        bench(homing=False)


def test_homing_that_takes_too_long() -> None:
    with pytest.raises(DeviceError, match=r"silent: an answer to '\$H'"):
        bench(homing_s=0.5)


def test_an_older_grbl_and_something_else_are_refused() -> None:
    class Other:
        def __init__(self, text: bytes) -> None:
            self.text = text

        def receive(self, data: bytes) -> None:
            pass

        def transmit(self) -> bytes:
            text, self.text = self.text, b""
            return text

    time = SimulatedTime()
    with pytest.raises(DeviceError, match=r"runs Grbl 0.9j; needed: 1.1"):
        old = DirectLine(Other(b"Grbl 0.9j ['$' for help]\r\n"), time)
        open_track(options(), old, time, time.sleep)
    line = DirectLine(Other(b"Welcome to my router\r\n"), time)
    with pytest.raises(DeviceError, match=r"no Grbl banner within 7 s.*check the port"):
        open_track(options(), line, time, time.sleep)
    assert line.closed
    with pytest.raises(DeviceError, match=r"marlin track on here: .*M115.*check"):
        open_track(options(dialect="marlin"), DirectLine(Other(b""), time), time, time.sleep)


def test_a_port_that_is_not_there() -> None:
    with pytest.raises(DeviceError, match=r"'no-such-port' cannot be opened.*check the cable"):
        open_track(options(port="no-such-port"))


# ---- the rig file -----------------------------------------------------------------------


def rig_with(plan: dict[str, Any] | None = None, **values: Any) -> Any:
    track = {"driver": "grbl", "options": {"port": "here", "min_mm": 0, "max_mm": 180, **values}}
    document = {"camera": {"driver": "x"}, "track": track, "plan": plan or {}}
    return parse_rig(document, source="rig.toml", trusted=True)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("port", ""),
        ("dialect", "tinyg"),
        ("min_mm", 180),
        ("max_mm", float("inf")),
        ("tolerance_mm", 0),
        ("laser_power", -1),
        ("speed", 1),
    ],
)
def test_a_wrong_option_is_named_before_a_device_is_touched(key: str, value: object) -> None:
    with pytest.raises(InputError, match=r"rig.toml: track.options") as caught:
        track_driver.validate(rig_with(**{key: value}))
    assert key in str(caught.value)


def test_a_missing_option_is_named() -> None:
    rig_file = parse_rig(
        {"camera": {"driver": "x"}, "track": {"driver": "grbl", "options": {"port": "p"}}},
        source="rig.toml",
        trusted=True,
    )
    with pytest.raises(InputError, match="min_mm"):
        track_driver.validate(rig_file)


@pytest.mark.parametrize("plan", [{"start_mm": -1.0}, {"step_mm": 0.1, "frames": 1802}])
def test_a_plan_beyond_the_travel_is_refused_before_a_device_is_touched(plan: Any) -> None:
    with pytest.raises(InputError, match=r"plan\.start_mm.*: leaves.* travel.*0 to 180 mm"):
        track_driver.validate(rig_with(plan))


def test_a_plan_up_to_the_limit_is_taken_in_spite_of_rounding() -> None:
    track_driver.validate(rig_with({"step_mm": 0.1, "frames": 1801}))
