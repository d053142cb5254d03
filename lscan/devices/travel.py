"""What tracks with a travel share: limits, as options too, and what lies outside them refused."""

from typing import Generic, Self, TypeVar

from pydantic import model_validator

from lscan.config.documents import Strict, check
from lscan.config.rig import RigFile
from lscan.errors import DeviceError, InputError


class TravelOptions(Strict):
    """``[track.options]`` of a track that goes from min_mm to max_mm."""

    min_mm: float
    max_mm: float

    @model_validator(mode="after")
    def _not_empty(self) -> Self:
        if self.min_mm >= self.max_mm:
            raise ValueError("min_mm must be below max_mm")
        return self


class PassiveTrack:
    """The part of a track without a controller: where it stands, how far it goes, being closed.

    Parameters
    ----------
    position_mm : float, mm, where the head stands
    limits_mm : (lowest, highest) position, mm, that it goes to
    tolerance_mm : float, mm, how far from where it was sent it may report to stand
    """

    name: str
    slack_mm = 0.0

    def __init__(
        self, position_mm: float, limits_mm: tuple[float, float], tolerance_mm: float
    ) -> None:
        self.position_mm, self.limits_mm = position_mm, limits_mm
        self.tolerance_mm = tolerance_mm
        self._closed = False

    def close(self) -> None:
        """Nothing is held open; the track can no longer be moved."""
        self._closed = True

    def _require_open(self) -> None:
        if self._closed:
            raise DeviceError(f"{self.name}: is closed")

    def _require_free_way(self, position_mm: float) -> None:
        """Raise DeviceError after closing, and for a position beyond the limits."""
        self._require_open()
        require_reachable(self.name, position_mm, self.limits_mm, self.slack_mm)


Options = TypeVar("Options", bound=TravelOptions)


class TravelDriver(Generic[Options]):
    """The part of a track's driver that checks its options and the plan.

    model: of ``[track.options]``.  slack_mm: how far beyond the travel the track still goes.
    """

    sections: frozenset[str] = frozenset()
    model: type[Options]
    slack_mm = 0.0

    def validate(self, rig_file: RigFile) -> None:
        """Check the options, and that the plan stays within the travel.

        Parameters
        ----------
        rig_file : RigFile, its track's options and its plan

        Raises
        ------
        InputError
            An option is wrong, or the plan leaves the travel.
        """
        self.options(rig_file)

    def options(self, rig_file: RigFile) -> Options:
        """The options of the rig's track.

        Parameters
        ----------
        rig_file : RigFile, its track's options and its plan

        Raises
        ------
        InputError
            An option is wrong, or the plan leaves the travel.
        """
        where, plan = rig_file.source, rig_file.rig.plan
        section = rig_file.rig.track.options
        options = check(self.model, section, where=where, prefix="track.options")
        low_mm, high_mm = options.min_mm, options.max_mm
        ends = {
            "plan.start_mm": plan.start_mm,
            "plan.start_mm + (plan.frames - 1) * plan.step_mm": plan.positions_mm()[-1],
        }
        for key, position_mm in ends.items():
            if not low_mm - self.slack_mm <= position_mm <= high_mm + self.slack_mm:
                raise InputError(
                    f"{key}: leaves the track's travel",
                    where=where,
                    value=position_mm,
                    allowed=f"{low_mm:.9g} to {high_mm:.9g} mm, track.options.min_mm and max_mm",
                )
        return options


def require_reachable(
    name: str, position_mm: float, limits_mm: tuple[float, float], slack_mm: float = 0.0
) -> None:
    """Refuse a position that is beyond a track's limits, or NaN.

    Parameters
    ----------
    name : str
        Of the track, for the message.
    position_mm : float
        Where it is to be sent, mm.
    limits_mm : tuple of float
        Lowest and highest position, mm.
    slack_mm : float
        How far beyond them it still goes, mm.

    Raises
    ------
    DeviceError
        It names the track and its limits.
    """
    low_mm, high_mm = limits_mm
    if not low_mm - slack_mm <= position_mm <= high_mm + slack_mm:
        raise DeviceError(
            f"{name}: cannot move to {position_mm:.9g} mm; "
            f"allowed: {low_mm:.9g} mm to {high_mm:.9g} mm"
        )
