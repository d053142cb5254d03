"""The emulated track: a controller behind a serial port, its travel made for a scan's plan."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from lscan.config.documents import Strict
from lscan.config.rig import Plan
from lscan.errors import InputError
from sim.emulators.grbl import Faults, GrblEmulator, MarlinEmulator, PseudoTerminal, TcpPort

Dialect = Literal["grbl", "marlin"]

SPARE_MM = 5.0  # of way at either end of the plan
APPROACH_MM, OFF_SWITCH_MM = 1.0, 1.0
FEED_MM_MIN = 6000.0
# Homing is as quick as moving; steps of 4 µm; 1000 mm/s2 is a tenth of g.
MACHINE = {25: FEED_MM_MIN, 27: OFF_SWITCH_MM, 100: 250.0, 110: FEED_MM_MIN, 120: 1000.0}


@dataclass(frozen=True)
class TrackTravel:
    """Where the head may go.  min_mm, max_mm: positions.  zero_mm: machine coordinate of 0.

    travel_mm: of the machine, from ``-travel_mm`` to its switch at 0.
    """

    min_mm: float
    max_mm: float
    zero_mm: float
    travel_mm: float

    def standing_mm(self, position_mm: float) -> float:
        """The position at which the head comes to rest when sent to ``position_mm``.

        Commands go over the line with three decimals, motors stand on whole steps.
        """
        steps = round(round(position_mm + self.zero_mm, 3) * MACHINE[100])
        return steps / MACHINE[100] - self.zero_mm


def travel_for(plan: Plan) -> TrackTravel:
    """The travel in which all of the plan lies, with some way to spare at either end."""
    positions_mm = plan.positions_mm()
    low_mm = math.floor(min(positions_mm) - SPARE_MM)
    high_mm = math.ceil(max(positions_mm) + SPARE_MM)
    zero_mm = -(high_mm + 2 * OFF_SWITCH_MM)
    lowest_mm = low_mm - APPROACH_MM - OFF_SWITCH_MM
    return TrackTravel(float(low_mm), float(high_mm), zero_mm, -(lowest_mm + zero_mm))


class EmulatedTrack:
    """A controller on a pseudo-terminal or TCP, the head at the plan's start, the laser off."""

    def __init__(
        self, plan: Plan, dialect: Dialect = "grbl", link: Path | None = None, tcp: bool = False
    ) -> None:
        """Plug it in.

        link: a name for the port that stays the same; InputError where something has it.
        tcp: behind a TCP port of the loopback address in place of a pseudo-terminal.
        """
        self.travel = travel = travel_for(plan)
        settings = {**MACHINE, 130: travel.travel_mm}
        head_mm = (plan.start_mm + travel.zero_mm, -OFF_SWITCH_MM, -OFF_SWITCH_MM)
        kind: type[GrblEmulator | MarlinEmulator]
        kind = GrblEmulator if dialect == "grbl" else MarlinEmulator
        self.controller: GrblEmulator | MarlinEmulator = kind(settings, head_mm)
        self.dialect, self._link, self._tcp = dialect, link, tcp
        self._address = ""
        if link is not None:
            if tcp:
                allowed = "a serial port, without --tcp"
                raise InputError("names no TCP port", where="--link", allowed=allowed)
            if link.is_symlink() and not link.exists():
                link.unlink()  # left by one that was killed
            if link.exists():
                raise InputError("is taken", where="--link", value=str(link), allowed="a new name")
        self._terminal: PseudoTerminal | TcpPort | None = None
        self.plug_in()

    @property
    def port(self) -> str:
        """What to open as a port; "" while a pseudo-terminal without a link is unplugged."""
        if self._link is not None:
            return str(self._link.absolute())
        return self._address if self._terminal is None else self._terminal.port

    @property
    def position_mm(self) -> float | None:
        """Track position where the head truly rests; None while it moves."""
        head_mm = self.controller.standing_mm
        return None if head_mm is None else head_mm[0] - self.travel.zero_mm

    @property
    def now_mm(self) -> float:
        """Track position where the head truly is at this moment."""
        return self.controller.head_mm[0] - self.travel.zero_mm

    @property
    def lit(self) -> bool:
        """Whether the controller has switched the laser on: M3 and S above 0."""
        return self.controller.laser_power > 0

    def inject(self, faults: Faults) -> None:
        """Let faults act on the line and the machine; InputError where the dialect has none."""
        self.require_faults().inject(faults)

    def require_faults(self) -> GrblEmulator:
        """The controller, to be given faults; InputError where the dialect has none."""
        if not isinstance(self.controller, GrblEmulator):
            raise InputError(f"{self.dialect} has no such faults", where="--fault", allowed="grbl")
        return self.controller

    def unplug(self) -> None:
        """Pull the cable, and remove its link; the controller stays under power.

        Twice is harmless.
        """
        if self._terminal is not None:
            if self._link is not None:
                self._link.unlink(missing_ok=True)
            self._terminal.close()
            self._terminal = None

    def plug_in(self) -> None:
        """Plug the cable in; nothing where it is."""
        if self._terminal is not None:
            return
        if self._tcp:
            number = int(self._address.rpartition(":")[2] or 0)  # the same after a break
            self._terminal = TcpPort(self.controller, number)
            self._address = self._terminal.port
        else:
            self._terminal = PseudoTerminal(self.controller)
        if self._link is not None:
            try:
                self._link.symlink_to(self._terminal.port)
            except OSError as error:
                self._terminal.close()
                what = f"cannot be made a link: {error.strerror}"
                raise InputError(what, where="--link", value=str(self._link)) from error

    def rig_options(self) -> dict[str, Any]:
        """``[track.options]`` of a rig file for this track.

        Nothing shakes when it stops; settle_s covers a picture that is on its way.  A pseudo-
        terminal does not restart the controller when it is opened, so boot_s need not wait.
        """
        return {
            "port": self.port,
            "dialect": self.dialect,
            "min_mm": self.travel.min_mm,
            "max_mm": self.travel.max_mm,
            "zero_mm": self.travel.zero_mm,
            "feed_mm_min": FEED_MM_MIN,
            "approach_mm": APPROACH_MM,
            "settle_s": 0.05,
            "boot_s": 0.2,
        }


# How the tank is served as hardware.


class ServeOptions(Strict):
    """How the tank is served.

    Attributes
    ----------
    http_port : int, port of the webcam; 0 for any free one
    fps : float, pictures per second
    quality : int, of the JPEGs, 1 to 100
    subsampling : str, of the JPEGs' chroma, "4:4:4", "4:2:2" or "4:2:0"
    places : int, how many rendered places are kept, 5 MB each at 640 by 480 px
    switched_laser : bool, the laser is lit only by M3, else always
    prepare : bool, render all of the plan first, and keep it
    dialect : Dialect, of the controller, "grbl" or "marlin"
    link : Path or None, a lasting name for the controller's serial port
    tcp : bool, the controller is behind a TCP port in place of a serial one

    Examples
    --------
    >>> import sim
    >>> sim.ServeOptions(fps=15.0, subsampling="4:2:2").dialect
    'grbl'
    """

    http_port: Annotated[int, Field(ge=0, le=65535)] = 0
    fps: Annotated[float, Field(ge=0.1, le=240)] = 30.0
    quality: Annotated[int, Field(ge=1, le=100)] = 95
    subsampling: Literal["4:4:4", "4:2:2", "4:2:0"] = "4:4:4"
    places: Annotated[int, Field(ge=1, le=100_000)] = 64
    switched_laser: bool = False
    prepare: bool = False
    dialect: Dialect = "grbl"
    link: Path | None = None
    tcp: bool = False
