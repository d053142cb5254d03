"""A Grbl track in simulated time, whose controller or line fails on command."""

from collections.abc import Callable
from dataclasses import replace

from lscan.devices.grbl import SerialTrack, SerialTrackOptions, open_track
from lscan.files.disk import packaged_table
from sim.emulators.grbl import DirectLine, Faults, GrblEmulator, SimulatedTime

ZERO_MM: float = packaged_table("sim.testing", "bench.toml")["track"]["options"]["zero_mm"]
"""Where, counted from the switch, the track's position is 0."""

FAULTS = {
    kind: Faults(**fields)
    for kind, fields in packaged_table("sim.testing", "faults.toml")["track"].items()
}


class TimeWithBell(SimulatedTime):
    """Simulated time in which something can be made to happen at a set moment."""

    def __init__(self) -> None:
        super().__init__()
        self._when_s, self._action = float("inf"), lambda: None

    def at(self, when_s: float, action: Callable[[], None]) -> None:
        """Let ``action`` happen once, when the time comes to ``when_s``."""
        self._when_s, self._action = when_s, action

    def sleep(self, seconds: float) -> None:
        """Let ``seconds`` pass at once, and what is due in them happen in its moment."""
        end_s = self.now_s + seconds
        if self._when_s <= end_s:
            self.now_s, self._when_s = max(self.now_s, self._when_s), float("inf")
            self._action()
        self.now_s = end_s


class FaultyTrack:
    """The machine and its line, which outlive the tracks opened on them."""

    def __init__(self) -> None:
        self.time = TimeWithBell()
        self._emulator = GrblEmulator({25: 5000}, clock=self.time)
        self._kind = ""

    def open(self, options: SerialTrackOptions) -> SerialTrack:
        """The track as lscan's own driver opens it."""
        line = DirectLine(self._emulator, self.time)
        return open_track(options, line, self.time, self.time.sleep)

    def look(self) -> tuple[float, bool]:
        """The head's true position on the track, mm, and whether it moves."""
        before_mm = self._emulator.head_mm[0]
        return before_mm - ZERO_MM, self._emulator.state not in ("Idle", "Alarm")

    def inject(self, kind: str, strength: float) -> None:
        """Let a fault begin now; strength: of the noise, or how many ok are lost."""
        self._kind, fault = kind, FAULTS[kind]
        if fault.garble:
            fault = replace(fault, garble=strength, seed=int(1e9 * strength))
        if fault.lose_oks:
            fault = replace(fault, lose_oks=int(strength))
        self._emulator.inject(replace(fault, begin_s=self.time()))

    def clear(self) -> None:
        """End the fault; a controller whose cable was pulled has lost its power too."""
        self._emulator.inject(Faults())
        if self._kind == "serial unplugged":
            self._emulator.power_cycle()
