"""A track moved by hand: the operator is told where to crank it and confirms.

[track]
driver = "manual"
options = { min_mm = 0, max_mm = 300 }
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Self

from pydantic import Field, model_validator

from lscan.config.documents import Strict, check
from lscan.config.rig import RigFile
from lscan.devices.api import Fact
from lscan.devices.travel import check_plan
from lscan.errors import DeviceError

Ask = Callable[[str], str]


class ManualOptions(Strict):
    """Options.  min_mm, max_mm: the track's scale; tolerance_mm: how far a reading may be off."""

    min_mm: float
    max_mm: float
    tolerance_mm: Annotated[float, Field(gt=0, le=100)] = 0.5

    @model_validator(mode="after")
    def _not_empty(self) -> Self:
        if self.min_mm >= self.max_mm:
            raise ValueError("min_mm must be below max_mm")
        return self


class ManualTrack:
    """A hand crank with a scale; ``ask`` shows a text and returns what the operator types."""

    def __init__(self, options: ManualOptions, ask: Ask = input) -> None:
        """Ask where the head stands now."""
        self._options, self._ask, self._closed = options, ask, False
        self._position_mm = self._read("manual track: where on its scale is the head now, in mm? ")

    @property
    def limits_mm(self) -> tuple[float, float]:
        """The ends of its scale."""
        return self._options.min_mm, self._options.max_mm

    @property
    def tolerance_mm(self) -> float:
        """How far a reading may be off what was asked."""
        return self._options.tolerance_mm

    @property
    def position_mm(self) -> float:
        """Where the operator last said the head stands."""
        return self._position_mm

    def move_to(self, position_mm: float) -> float:
        """The position the operator reads after cranking there; Enter: exactly as asked.

        A reading that is no number within the tolerance is asked for again.  Raises DeviceError
        outside the scale, after closing, and where the operator types q or the terminal ends.
        """
        if self._closed:
            raise DeviceError("manual track: is closed")
        low, high = self.limits_mm
        if not low <= position_mm <= high:  # also refuses NaN
            raise DeviceError(
                f"manual track: cannot move to {position_mm:.9g} mm; "
                f"allowed: {low:.9g} mm to {high:.9g} mm"
            )
        if position_mm == self._position_mm:
            return self._position_mm
        text = (
            f"manual track: crank to {position_mm:.9g} mm, always from below; "
            "then Enter, or the scale's reading in mm, or q to stop: "
        )
        reading_mm = self._read(text, float(position_mm))
        while not abs(reading_mm - position_mm) <= self.tolerance_mm:
            again = f"{reading_mm:g} mm is more than {self.tolerance_mm:g} mm off; {text}"
            reading_mm = self._read(again, float(position_mm))
        self._position_mm = reading_mm
        return reading_mm

    def close(self) -> None:
        """Nothing is held open; the track can no longer be moved."""
        self._closed = True

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
                return default_mm
            try:
                reading_mm = float(answer)
            except ValueError:
                continue
            if math.isfinite(reading_mm):
                return reading_mm


class _TrackDriver:
    sections: frozenset[str] = frozenset()

    def validate(self, rig_file: RigFile) -> None:
        options = self._options(rig_file)
        check_plan(rig_file, options.min_mm, options.max_mm)

    def abilities(self, rig_file: RigFile) -> dict[str, Fact]:
        return dict(self._options(rig_file))

    def open(self, rig_file: RigFile) -> ManualTrack:
        return ManualTrack(self._options(rig_file))

    def _options(self, rig_file: RigFile) -> ManualOptions:
        section = rig_file.rig.track.options
        return check(ManualOptions, section, where=rig_file.source, prefix="track.options")


track_driver = _TrackDriver()
