"""``[track.options]`` of the serial track, checked before any device is touched."""

from typing import Annotated, Final, Literal

from pydantic import Field

from lscan.devices.travel import TravelOptions

Place = Annotated[float, Field(ge=-100_000, le=100_000)]
ROUNDING_MM: Final = 0.0005
"""Half of the last of three decimals, with which coordinates go over the line."""


class SerialTrackOptions(TravelOptions):
    """The track's port, its frame and how it moves.

    port: the serial port, as ``/dev/ttyUSB0`` or ``COM3``.  dtr: whether its lines DTR and RTS
    are raised while it is open, which holds some boards in reset.  min_mm, max_mm: positions the
    head may be sent to; the approach needs ``approach_mm`` of free way below min_mm.
    zero_mm: the machine coordinate where the position is 0; invert: positions grow where
    machine coordinates fall.  approach_mm: every position is reached upwards, over at least
    this way, so that backlash is taken up; 0: from wherever the head stands.
    tolerance_mm: how far from its target the head may report to have stopped.
    settle_s: rest before a picture.  homing: search the switches on opening; without it the
    machine's zero is where the head stood when the controller started, and any restart moves it.
    boot_s, answer_s, homing_s: how long a start, an answer, a homing may take.  write_s: how
    long the port may take to accept a line; longer where a busy computer or an adapter holds it up.
    laser_power: S word of M3.
    """

    port: Annotated[str, Field(min_length=1)]
    baud: Annotated[int, Field(ge=1200, le=4_000_000)] = 115_200
    dtr: bool = True
    dialect: Literal["grbl", "marlin"] = "grbl"
    axis: Literal["X", "Y", "Z"] = "X"
    min_mm: Place
    max_mm: Place
    zero_mm: Place = 0.0
    invert: bool = False
    feed_mm_min: Annotated[float, Field(gt=0, le=60_000)] = 500.0
    approach_mm: Annotated[float, Field(ge=0, le=100)] = 1.0
    tolerance_mm: Annotated[float, Field(gt=0, le=1)] = 0.02
    settle_s: Annotated[float, Field(ge=0, le=60)] = 0.2
    homing: bool = True
    boot_s: Annotated[float, Field(ge=0, le=30)] = 3.0
    answer_s: Annotated[float, Field(gt=0, le=60)] = 2.0
    homing_s: Annotated[float, Field(gt=0, le=600)] = 60.0
    write_s: Annotated[float, Field(gt=0, le=60)] = 5.0
    laser_power: Annotated[float, Field(ge=0, le=100_000)] = 1000.0

    def machine_mm(self, position_mm: float) -> float:
        """Machine coordinate, mm.

        Parameters
        ----------
        position_mm : float, mm, of the track
        """
        return self.zero_mm + (-position_mm if self.invert else position_mm)

    def position_mm(self, machine_mm: float) -> float:
        """Position of the track, mm.

        Parameters
        ----------
        machine_mm : float, mm, machine coordinate
        """
        offset_mm = machine_mm - self.zero_mm
        return -offset_mm if self.invert else offset_mm
