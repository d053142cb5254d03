"""Whatever goes wrong on the serial line ends in one clear error, never in a wrong position."""

import os
import tty
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from grbl_line import DirectLine, SimulatedTime

from lscan.devices.grbl import SerialTrack, SerialTrackOptions, open_track
from lscan.devices.grbl.machine import ASKINGS, Link, open_serial
from lscan.errors import DeviceError
from sim.emulators.grbl import Faults, GrblEmulator, PseudoTerminal

ZERO_MM = -190.0
TOLERANCE_MM = 0.02
UNHOMED = {20: 0, 22: 0}


def opened(time: SimulatedTime, emulator: GrblEmulator, homing: bool) -> SerialTrack:
    zero_mm = ZERO_MM if homing else 0.0
    options = SerialTrackOptions(
        port="here",
        min_mm=-5.0 if homing else -40.0,
        max_mm=40.0,
        zero_mm=zero_mm,
        homing=homing,
        tolerance_mm=TOLERANCE_MM,
        settle_s=0.05,
    )
    return open_track(options, DirectLine(emulator, time), time, time.sleep)


def test_a_restart_on_the_way_to_where_it_began_is_noticed() -> None:
    """Quietly: the head rests there, and the controller says zero, which is where it is to be."""
    time = SimulatedTime()
    emulator = GrblEmulator(UNHOMED, clock=time)
    track, began_mm = opened(time, emulator, homing=False), emulator.head_mm[0]
    track.move_to(-20.0)
    emulator.inject(Faults(restart=True, quietly=True, begin_s=time() + 1.0))
    with pytest.raises(DeviceError, match=r"the controller has restarted"):
        track.move_to(0.0)
    assert began_mm - emulator.head_mm[0] > 5.0


LATE_OK = ("lost ok", 1.0)
FAULTS = {
    "silent": (Faults(silent=True), r"silent: .*check cable and power"),
    "lost ok": (Faults(lose_oks=ASKINGS), r"silent: an answer to .* did not come.*check cable"),
    "alarm": (Faults(alarm=True), r"ALARM:1, a limit switch was hit.*home"),
    "stuck": (Faults(stuck=True), r"still in state Jog .*check for a jam"),
    "slow": (Faults(slow=20.0), r"still in state Jog .*check for a jam, the feed rate"),
    "restart": (Faults(restart=True), r"the controller has restarted.*home"),
    "quiet restart": (Faults(restart=True, quietly=True), r"home"),
    "unplugged": (Faults(unplug=True), r"the connection broke .*check the cable"),
    "garbled": (Faults(garble=0.5), r"(silent|readings in a row|refuses).*"),
}


@pytest.mark.parametrize(
    ("kind", "after_s"),
    # No ok is sent while the head moves, so none can be lost.
    [(kind, after_s) for kind in FAULTS for after_s in (0.0, 1.0) if (kind, after_s) != LATE_OK],
)
def test_each_fault_is_one_clear_error(kind: str, after_s: float) -> None:
    """The line names the device, what happened and what to do; afterwards the track refuses."""
    fault, pattern = FAULTS[kind]
    time = SimulatedTime()
    emulator = GrblEmulator(clock=time)
    track = opened(time, emulator, homing=True)
    track.move_to(0.0)
    emulator.inject(replace(fault, begin_s=time() + after_s))
    with pytest.raises(DeviceError, match=pattern) as caught:
        track.move_to(40.0)
    assert str(caught.value).startswith("grbl track on here: ")
    assert "\n" not in str(caught.value)
    for again in (lambda: track.move_to(1.0), lambda: track.position_mm):
        with pytest.raises(DeviceError, match="failed before and must be opened again"):
            again()
    track.close()
    track.close()


@pytest.mark.parametrize("lost", range(1, ASKINGS))
def test_a_question_whose_ok_was_lost_is_asked_again(lost: int) -> None:
    """``$G`` changes nothing, so it can be; before a move it is the first line sent."""
    time = SimulatedTime()
    emulator = GrblEmulator(clock=time)
    track = opened(time, emulator, homing=True)
    emulator.inject(Faults(lose_oks=lost))
    assert track.move_to(10.0) == pytest.approx(10.0, abs=TOLERANCE_MM)


def test_a_question_that_arrived_garbled_is_asked_again() -> None:
    """Grbl answers error:3 to a $ command it does not know."""

    class Garbling(DirectLine):
        left = 1

        def write(self, data: bytes) -> int:
            if data == b"$G\n" and self.left:
                self.left -= 1
                data = b"$g7\n"
            return super().write(data)

    time = SimulatedTime()
    emulator = GrblEmulator(UNHOMED, clock=time)
    options = SerialTrackOptions(port="here", min_mm=0, max_mm=40, homing=False)
    line = Garbling(emulator, time)
    track = open_track(options, line, time, time.sleep)
    assert track.move_to(10.0) == pytest.approx(10.0, abs=TOLERANCE_MM)
    assert line.left == 0


def random_fault(generator: np.random.Generator) -> tuple[str, Faults]:
    kind = str(generator.choice([*FAULTS, "light noise"]))
    if kind == "light noise":
        fault = Faults(garble=float(10 ** generator.uniform(-4, -1)))
    else:
        fault = FAULTS[kind][0]
    if kind == "lost ok":
        fault = Faults(lose_oks=int(generator.integers(1, 4)))
    return kind, replace(fault, seed=int(generator.integers(2**31)))


def campaign(seeds: range) -> Counter[str]:
    """How often a fault ended in an error or was borne; fails at the first wrong position."""
    outcomes: Counter[str] = Counter()
    for seed in seeds:
        generator = np.random.default_rng([20, seed])
        time = SimulatedTime()
        homing = bool(generator.integers(2))
        emulator = GrblEmulator(None if homing else UNHOMED, clock=time)
        track = opened(time, emulator, homing)
        origin_mm = ZERO_MM if homing else emulator.head_mm[0]
        kind, fault = random_fault(generator)
        emulator.inject(replace(fault, begin_s=time() + generator.uniform(0, 12)))
        try:
            for stop_mm in generator.choice([0.0, 0.5, 1.0, 5.0, 20.0, 40.0], 10):
                reported_mm = track.move_to(float(stop_mm))
                true_mm = emulator.head_mm[0] - origin_mm if kind != "unplugged" else reported_mm
                assert abs(reported_mm - true_mm) <= TOLERANCE_MM, (seed, kind)
                assert abs(true_mm - stop_mm) <= TOLERANCE_MM, (seed, kind)
            outcomes["borne"] += 1
        except DeviceError as error:
            assert str(error).startswith("grbl track on here: "), error
            assert "\n" not in str(error)
            outcomes[kind] += 1
        track.close()
    return outcomes


def test_random_faults_never_give_a_wrong_position() -> None:
    assert sum(campaign(range(1000, 1010)).values()) == 10


@pytest.mark.slow
def test_many_random_faults_of_every_kind_never_give_a_wrong_position() -> None:
    outcomes = campaign(range(100))
    assert sum(outcomes.values()) == 100
    assert outcomes.keys() >= FAULTS.keys(), outcomes


# ---- over the system's own serial port --------------------------------------------------


QUICK = dict.fromkeys((25, 110, 111, 112), 50_000) | dict.fromkeys((120, 121, 122), 20_000)


def on_terminal(terminal: PseudoTerminal) -> SerialTrackOptions:
    return SerialTrackOptions(
        port=terminal.port,
        min_mm=0,
        max_mm=40,
        zero_mm=ZERO_MM,
        feed_mm_min=50_000,
        settle_s=0,
        boot_s=0.2,
        answer_s=60,
    )


def test_a_cable_pulled_from_a_real_port() -> None:
    terminal = PseudoTerminal(GrblEmulator(QUICK))
    options = on_terminal(terminal)
    track = open_track(options)
    track.move_to(1.0)
    terminal.close()
    with pytest.raises(DeviceError, match=r"the connection broke .*check the cable"):
        track.move_to(2.0)
    track.close()
    terminal.close()
    with pytest.raises(DeviceError, match="cannot be opened"):
        open_track(options)


def test_a_second_program_does_not_get_the_port() -> None:
    with PseudoTerminal(GrblEmulator(QUICK)) as terminal:
        options = on_terminal(terminal)
        track = open_track(options)
        with pytest.raises(DeviceError, match=r"cannot be opened.*no other program holds it"):
            open_track(options)
        track.close()


def test_a_port_that_accepts_nothing_is_distinguished_from_a_broken_one() -> None:
    """Nobody reads at the other end, as behind an adapter that hangs: its buffer fills up."""
    ours, theirs = os.openpty()
    try:
        tty.setraw(theirs)
        port = open_serial(os.ttyname(theirs), 115_200, "grbl track on here", write_s=0.05)
        link = Link(port, "grbl track on here", write_s=0.05)
        with pytest.raises(DeviceError, match=r"nothing for 0\.05 s; .*track\.options\.write_s"):
            link.send_bytes(b"?" * 1_000_000)
        link.close()
    finally:
        os.close(ours)
        os.close(theirs)
