"""A track moved by hand: the operator is asked to crank it and confirms.

[track]
driver = "manual"
options = { min_mm = 0, max_mm = 300 }
"""

import math
from collections.abc import Callable
from typing import Annotated

from pydantic import Field

from lscan.config.rig import RigFile
from lscan.devices.api import Fact, PassiveTrack, TravelDriver, TravelOptions
from lscan.errors import DeviceError

Ask = Callable[[str], str]


class ManualOptions(TravelOptions):
    """Options.  min_mm, max_mm: the track's scale; tolerance_mm: how far a reading may be off."""

    tolerance_mm: Annotated[float, Field(gt=0, le=100)] = 0.5


class ManualTrack(PassiveTrack):
    """A hand crank with a scale; ``ask`` shows a text and returns what the operator types.

    It stands where the operator last said.
    """

    name = "manual track"

    def __init__(self, options: ManualOptions, ask: Ask = input) -> None:
        """Ask where the head stands now."""
        self._ask = ask
        stands_mm = self._read("manual track: where on its scale is the head now, in mm? ")
        super().__init__(stands_mm, (options.min_mm, options.max_mm), options.tolerance_mm)

    def move_to(self, position_mm: float) -> float:
        """The position the operator reads after cranking there; Enter: exactly as asked.

        A reading that is no number within the tolerance is asked for again.  Raises DeviceError
        outside the scale, after closing, and where the operator types q or the terminal ends.
        """
        self._require_free_way(position_mm)
        if position_mm == self.position_mm:
            return self.position_mm
        asked = text = (
            f"manual track: crank to {position_mm:.9g} mm, always from below; "
            "then Enter, or the scale's reading in mm, or q to stop: "
        )
        while abs((reading_mm := self._read(asked, position_mm)) - position_mm) > self.tolerance_mm:
            asked = f"{reading_mm:g} mm is more than {self.tolerance_mm:g} mm off; {text}"
        self.position_mm = reading_mm
        return reading_mm

    def _read(self, text: str, default_mm: float | None = None) -> float:
        """The number typed; asked for again until it is one."""
        while True:
            try:
                answer = self._ask(text).strip()
            except EOFError:
                raise DeviceError(
                    "manual track: the terminal gives no answer; run the scan where someone can "
                    "type, or set another track.driver"
                ) from None
            if answer.lower() == "q":
                raise DeviceError("manual track: stopped by the operator; --resume goes on")
            if not answer and default_mm is not None:
                return float(default_mm)
            try:
                reading_mm = float(answer)
            except ValueError:
                continue
            if math.isfinite(reading_mm):
                return reading_mm


class ManualTrackDriver(TravelDriver[ManualOptions]):
    """Registered as "manual" under ``lscan.tracks``."""

    model = ManualOptions

    def capabilities(self, rig_file: RigFile) -> dict[str, Fact]:
        """Its scale."""
        return dict(self.options(rig_file))

    def open(self, rig_file: RigFile) -> ManualTrack:
        """The track, its head where the operator says."""
        return ManualTrack(self.options(rig_file))


track_driver = ManualTrackDriver()
