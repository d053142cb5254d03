"""A linear track behind a controller that speaks Grbl, Marlin or Klipper."""

import contextlib
import logging
import math
from collections.abc import Iterator

from lscan.devices.api import LASER_MAY_BE_LIT, ConnectionLost, Fact, require_reachable
from lscan.devices.grbl.machine import ROUNDING_MM, AxisMachine, AxisOptions, Connection
from lscan.errors import DeviceError

_CLOSED = "is closed"
_log = logging.getLogger(__name__)


class SerialTrack:
    """A track that moves only upwards into every position, and believes only what it reads.

    After a failed motion nothing is known of where the head stands or what still lies in the
    controller: the track then refuses, with the reason, until it is opened again.  Steps that
    a stalled motor loses are not known to the controller and can be seen only by homing.
    """

    def __init__(self, machine: AxisMachine, options: AxisOptions, link: Connection) -> None:
        """Wake the machine and home it where the options say so.

        Parameters
        ----------
        machine : AxisMachine, speaks the controller's language
        options : AxisOptions, travel and motion
        link : Connection, to the controller

        Raises
        ------
        DeviceError
            The controller does not wake or home, or cannot do what the options ask for.
        """
        self._machine, self._options, self._link, self._name = machine, options, link, link.name
        self._refusal: str | None = None
        self._lost: ConnectionLost | None = None  # what the refusal is about
        self._engaged = self._moved = self._lit = False
        try:
            self._travel = machine.wake()
            self._check_travel()
            self._check_feed()
            if options.homing:
                # A warning, so that it is seen without logging set up: the head moves by itself.
                _log.warning("%s: homing, within %g s", link.name, options.homing_s)
                machine.home()
            self._position_mm = self._sent_mm = options.position_mm(machine.position_mm())
        except BaseException:
            link.close()
            raise

    @property
    def limits_mm(self) -> tuple[float, float]:
        """Lowest and highest position that can be commanded."""
        return self._options.min_mm, self._options.max_mm

    @property
    def tolerance_mm(self) -> float:
        """How far from its target the head may report to stand.

        Never below half a motor step and the rounding of both the command and the report.
        """
        return max(self._options.tolerance_mm, self._travel.step_mm / 2 + 2 * ROUNDING_MM)

    @property
    def position_mm(self) -> float:
        """Where the head stands, as the controller last reported it at rest.

        Raises DeviceError where a failed motion left that unknown.
        """
        self._ready()
        return self._position_mm

    def move_to(self, position_mm: float) -> float:
        """The position reported after moving there upwards and coming to rest, mm.

        Parameters
        ----------
        position_mm : float, mm, along the track

        Raises
        ------
        DeviceError
            Names the limit where the position lies outside the travel (the head stays), and says
            what to do where the controller is silent, in alarm, restarted, or stops anywhere else.
        """
        self._ready()
        require_reachable(self._name, position_mm, self.limits_mm, ROUNDING_MM)
        with self._latch_failure():
            self._check_undisturbed()
            self._moved, self._sent_mm = True, float(position_mm)
            return self._approach(float(position_mm))

    def describe(self) -> dict[str, Fact]:
        """What the controller says of itself, and of its axis in the track's positions.

        firmware; state, the inputs that are active; noise_bytes skipped on the line so far;
        the travel the controller guards; its motor step, fastest feed and acceleration.
        None: it does not say.  Raises DeviceError.
        """
        self._ready()
        travel = self._travel
        low_mm, high_mm = self._travel_ends_mm()
        numbers = {
            "travel_low_mm": low_mm,
            "travel_high_mm": high_mm,
            "step_mm": travel.step_mm,
            "max_mm_min": travel.max_mm_min,
            "accel_mm_s2": travel.accel_mm_s2,
        }
        with self._latch_failure():
            facts = self._machine.describe()
        finite = {name: mm if math.isfinite(mm) else None for name, mm in numbers.items()}
        return facts | finite

    @property
    def zero(self) -> str | None:
        """Name of the zero that positions count from; None where homing finds it each time."""
        return None if self._options.homing else self._machine.zero

    def check_place(self, last_mm: float, next_mm: float, zero: str | None) -> None:
        """Refuse to go on with a scan whose frames could be shifted.

        Homing finds the same zero each time.  Without it the controller must have counted its steps
        ever since; and unless the track was moved since it was opened, and so watched, the head
        must stand where it can have been left: between the two places, or as far below as the
        approach goes.

        Parameters
        ----------
        last_mm : float, mm, where the scan's last frame was recorded
        next_mm : float, mm, where the next is due
        zero : str or None, what ``zero`` was when the last frame was recorded

        Raises
        ------
        DeviceError
            Says what to do.
        """
        self._ready()
        if self._options.homing:
            return
        stands_mm = self._position_mm
        reports = (
            f"{self._name}: reports {stands_mm:g} mm, the last frame was recorded at "
            f"{last_mm:g} mm; the scan might go on at shifted places, since"
        )
        if zero is None or not self._machine.has_kept(zero):
            raise DeviceError(f"{reports} {self._lost_zero()}")
        low_mm, high_mm = self._way_mm(last_mm, next_mm)
        if not self._moved and not low_mm <= stands_mm <= high_mm:
            raise DeviceError(
                f"{reports} the head was moved, or homed by hand, in between: jog to "
                f"{last_mm:g} mm and resume, or, where it was homed as it was before the scan "
                "began, resume with --position-restored"
            )

    def _way_mm(self, start_mm: float, end_mm: float) -> tuple[float, float]:
        """Lowest and highest place at which a head may be left that goes from one to the other."""
        low_mm, high_mm = sorted((start_mm, end_mm))
        return low_mm - self._options.approach_mm - self.tolerance_mm, high_mm + self.tolerance_mm

    def _lost_zero(self) -> str:
        """Why the zero may have moved, and how it is put back."""
        start_mm = self._options.position_mm(0.0)
        why = (
            "Marlin does not report whether it restarted in between"
            if not self._machine.notices_restart
            else "the controller was restarted, reset or in alarm in between, or used otherwise"
        )
        return (
            f"{why}. Without homing {start_mm:g} mm is where the head stands when the controller "
            f"starts: switch it off, push the head by hand to where {start_mm:g} mm was, switch "
            "it on, and resume with --position-restored; or, where it was homed by hand before "
            "the scan began, do so again and resume with --position-restored"
        )

    def reconnect(self) -> None:
        """Reach a controller again whose connection broke, where it has kept its zero.

        What it was still doing is stopped, a laser that was lit is put out, and the head must
        stand on the way that it was sent.  The next move approaches from below again.

        Raises
        ------
        ConnectionLost
            ``reconnects`` attempts did not reach it.
        DeviceError
            It restarted or is in alarm, the head was moved, or it runs Marlin, which does not
            report a restart.
        """
        if (lost := self._lost) is None:
            self._ready()
            return
        for _ in range(self._options.reconnects if self._link.can_reopen else 0):
            self._link.sleep(self._options.reconnect_wait_s)
            try:
                self._link.reopen()
                self._position_mm = self._recovered_mm()
                self._refusal = self._lost = None
                return
            except ConnectionLost as error:
                lost = error
        raise lost

    def _recovered_mm(self) -> float:
        """Where the head rests after the connection came back; DeviceError where that is unsure."""
        self._machine.stop()
        if self._lit:
            self._machine.laser(0.0)
            self._lit = False
        if not self._machine.notices_restart:
            raise DeviceError(
                f"{self._name}: the connection broke, and Marlin does not report whether it "
                "restarted meanwhile; open the track again"
            )
        stands_mm = self._options.position_mm(self._machine.position_mm())
        low_mm, high_mm = self._way_mm(self._position_mm, self._sent_mm)
        if not low_mm <= stands_mm <= high_mm:
            raise DeviceError(
                f"{self._name}: stands at {stands_mm:g} mm since the connection broke, allowed on "
                f"its way: {low_mm:g} to {high_mm:g} mm; something else moved it: home and open "
                "the track again"
            )
        return stands_mm

    def laser_on(self) -> None:
        """Switch the laser on with the rig's ``laser_power``."""
        self._ready()
        with self._latch_failure():
            self._lit = True
            self._machine.laser(self._options.laser_power)

    def laser_off(self) -> None:
        """Switch the laser off; after a failed motion too, for the sake of eyes."""
        if self._refusal == _CLOSED:
            self._ready()
        with self._latch_failure():
            self._machine.laser(0.0)
            self._lit = False

    def close(self) -> None:
        """Stop any motion, switch off a laser that is on, release the port."""
        if self._refusal == _CLOSED:
            return
        with contextlib.suppress(DeviceError):
            self._machine.stop()
        if self._lit:
            try:
                self._machine.laser(0.0)
            except DeviceError:
                _log.warning("%s: %s", self._name, LASER_MAY_BE_LIT)
        self._link.close()
        self._refusal, self._lost = _CLOSED, None

    def _approach(self, target_mm: float) -> float:
        """Go there from below; where the head already came from below, straight on."""
        way_mm = self._options.approach_mm
        rise_mm = target_mm - self._position_mm
        if way_mm > 0 and not (rise_mm >= way_mm or (self._engaged and rise_mm >= 0)):
            self._engaged = False
            self._go(target_mm - way_mm)
        self._go(target_mm)
        self._engaged = True
        return self._position_mm

    def _go(self, target_mm: float) -> None:
        """Move, rest, and see that the head stands where it was sent."""
        options, travel = self._options, self._travel
        way_mm = abs(target_mm - self._position_mm)
        speed_mm_s = min(options.feed_mm_min, travel.max_mm_min) / 60.0
        expected_s = way_mm / speed_mm_s + speed_mm_s / travel.accel_mm_s2
        self._machine.move(
            options.machine_mm(target_mm), options.feed_mm_min, 1.5 * expected_s + options.answer_s
        )
        self._link.sleep(options.settle_s)
        stands_mm = options.position_mm(self._machine.position_mm())
        if not abs(stands_mm - target_mm) <= self.tolerance_mm:
            raise DeviceError(
                f"{self._name}: stands at {stands_mm:g} mm instead of {target_mm:g} mm, allowed: "
                f"{self.tolerance_mm:g} mm; something stopped it or the line garbled the command: "
                "check the way and the cable, then open the track again"
            )
        self._position_mm = stands_mm

    def _check_undisturbed(self) -> None:
        """A head that is elsewhere than it was left was moved, or its controller restarted."""
        stands_mm = self._options.position_mm(self._machine.position_mm())
        if not abs(stands_mm - self._position_mm) <= self.tolerance_mm:
            raise DeviceError(
                f"{self._name}: reports {stands_mm:g} mm but was left at {self._position_mm:g} mm; "
                "the controller restarted or something else moved it: home and open the track again"
            )

    def _check_travel(self) -> None:
        """Refuse a rig whose positions, with their approach, leave the controller's travel."""
        options, travel = self._options, self._travel
        lowest_mm = options.min_mm - options.approach_mm
        for position_mm in (lowest_mm, options.max_mm):
            machine_mm = options.machine_mm(position_mm)
            if not travel.low_mm <= machine_mm <= travel.high_mm:
                low_mm, high_mm = self._travel_ends_mm()
                raise DeviceError(
                    f"{self._name}: track.options ask for {lowest_mm:g} to {options.max_mm:g} mm "
                    f"(approach_mm below min_mm included), the controller's soft limits allow "
                    f"{low_mm:g} to {high_mm:g} mm; change min_mm, max_mm, approach_mm, zero_mm "
                    "or invert, or the travel (Grbl: $130 to $132)"
                )

    def _travel_ends_mm(self) -> list[float]:
        """The controller's travel as positions of the track, infinite where it guards none."""
        return sorted(map(self._options.position_mm, (self._travel.low_mm, self._travel.high_mm)))

    def _check_feed(self) -> None:
        """Refuse a feed that the controller would cut to its own without a word."""
        feed_mm_min, max_mm_min = self._options.feed_mm_min, self._travel.max_mm_min
        if feed_mm_min > max_mm_min:
            raise DeviceError(
                f"{self._name}: track.options.feed_mm_min is {feed_mm_min:g}, the axis's fastest "
                f"in the controller is {max_mm_min:g} mm/min; lower it, or raise the controller's "
                "(Grbl: $110 to $112) where the motor can do it"
            )

    def _ready(self) -> None:
        if self._refusal is not None:
            kind = DeviceError if self._lost is None else ConnectionLost
            raise kind(f"{self._name}: {self._refusal}")

    @contextlib.contextmanager
    def _latch_failure(self) -> Iterator[None]:
        """Remember that what runs within failed, and stop what may still move."""
        try:
            yield
        except BaseException as error:
            if self._refusal is None:
                self._refusal = f"failed before and must be opened again ({error})"
                self._lost = error if isinstance(error, ConnectionLost) else None
            self._engaged = False
            with contextlib.suppress(DeviceError):
                self._machine.stop()
            raise
