"""A track of a machine that runs Klipper, reached through Moonraker's HTTP interface.

[track]
driver = "klipper"
options = { url = "http://klipper.local:7125", laser_pin = "laser", min_mm = 0, max_mm = 180 }

Sources: Moonraker's documentation (docs/external_api: introduction, printer, server,
authorization) of commit d5ee171, 2026-06-29; Klipper's (docs/G-Codes.md, Status_Reference.md,
Config_Reference.md, and the texts of its errors in klippy) of commit 84104bb, 2026-08-07, after
v0.13.0.
"""

import logging
import math
import netrc
import time
from collections.abc import Callable
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from typing import Annotated, Any, Final
from urllib.parse import urlsplit

from pydantic import Field

from lscan.config.rig import RigFile
from lscan.devices.api import ConnectionLost, Fact, TravelDriver
from lscan.devices.grbl.machine import ROUNDING_MM, AxisOptions, AxisTravel, PortNumber
from lscan.devices.grbl.track import SerialTrack
from lscan.errors import DeviceError, InputError
from lscan.files.disk import json_text, parse_json

_log = logging.getLogger(__name__)

MOST_BYTES: Final = 4 * 2**20
"""Of an answer; Klipper's whole configuration takes some 100 kB."""


class KlipperOptions(AxisOptions):
    """Where Moonraker is, and the laser's pin, besides what is said of the axis.

    url: Moonraker's address.  laser_pin: NAME of the ``[output_pin NAME]`` that switches the laser;
    laser_power: VALUE of its SET_PIN.
    """

    url: Annotated[
        str,
        PortNumber,
        Field(
            pattern=r"^https?://([^\[\]\s:/?#@]+|\[[0-9a-fA-F:.]+\])(:[0-9]{1,5})?/?$",
            description="Moonraker's address, such as http://HOST:7125",
        ),
    ]
    laser_pin: Annotated[str, Field(pattern=r"^[A-Za-z0-9_]+$")] | None = None
    laser_power: Annotated[float, Field(gt=0, le=1000)] = 1.0


class Moonraker:
    """Requests to one Moonraker, each on a connection of its own.

    name: how messages call the device.  sleep: what lets a track rest.
    """

    can_reopen = True

    def __init__(self, options: KlipperOptions, sleep: Callable[[float], None]) -> None:
        self.name, self.sleep = f"klipper track on {options.url}", sleep
        self._where, self._answer_s = urlsplit(options.url), options.answer_s
        self._headers = {"Content-Type": "application/json", "Connection": "close"}
        if (key := self._key()) is not None:
            self._headers["X-Api-Key"] = key

    def ask(self, path: str, body: Any = None, within_s: float | None = None) -> Any:
        """The result of a GET, or of a POST of ``body``.

        within_s: how long it may take, if not ``answer_s``.

        Raises
        ------
        ConnectionLost
            Moonraker is not reached, or the connection broke before the answer.
        DeviceError
            It refuses, is silent, or answers what is not its own.
        """
        kind = HTTPSConnection if self._where.scheme == "https" else HTTPConnection
        line = kind(str(self._where.hostname), self._where.port, timeout=self._answer_s)
        sent = None if body is None else json_text(body).encode()
        try:
            line.connect()
            line.sock.settimeout(within_s or self._answer_s)
            try:
                line.request("GET" if body is None else "POST", path, sent, self._headers)
                answer = line.getresponse()
                data = answer.read(MOST_BYTES + 1)
            except TimeoutError:
                raise DeviceError(
                    f"{self.name}: silent: {path} was not answered within "
                    f"{within_s or self._answer_s:g} s; check for a jam, the feed rate, the "
                    "network and the machine's power, then open the track again"
                ) from None
        except (OSError, HTTPException, ValueError) as error:
            raise ConnectionLost(
                f"{self.name}: cannot be reached: {str(error) or type(error).__name__}; check the "
                "address, the network, and that Moonraker runs"
            ) from error
        finally:
            line.close()
        return self._result(answer.status, data, path)

    def reopen(self) -> None:
        """Ask for a sign of life; ConnectionLost where none comes."""
        self.ask("/server/info")

    def close(self) -> None:
        """Nothing is held open."""

    def _key(self) -> str | None:
        """The API key that ~/.netrc has for this host alone, None where it has none.

        It stands in no rig file: that is kept in every run folder, and may be a stranger's.
        """
        try:
            entry = netrc.netrc().hosts.get(str(self._where.hostname))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, netrc.NetrcParseError) as error:
            raise DeviceError(
                f"{self.name}: ~/.netrc cannot be read: {_line(str(error))}"
            ) from error
        return entry[2] if entry is not None and entry[2] else None

    def _result(self, status: int, data: bytes, path: str) -> Any:
        try:
            if len(data) > MOST_BYTES:
                raise InputError("is too long")
            said = parse_json(data, path)
            if status == 200:
                return said["result"]
            reason = str(said["error"]["message"])
        except (InputError, KeyError, TypeError):
            reason = "no answer of Moonraker's; check the address"
        hint = f"; put its API key into ~/.netrc: machine {self._where.hostname} password KEY"
        raise DeviceError(
            f"{self.name}: {path} answers {status}: {_line(reason)}{hint if status == 401 else ''}"
        )


class KlipperMachine:
    """One axis of a machine that runs Klipper.

    Klipper knows where an axis stands from its homing until a restart, an emergency stop, an error
    in homing, or until the motors go off, as by themselves after [idle_timeout]; ``homed_axes``
    then names it no longer.  So every position is asked for with ``homed_axes``.
    """

    notices_restart = True
    zero = "homed"

    def __init__(self, link: Moonraker, options: KlipperOptions) -> None:
        self._link, self._options = link, options
        self._axis = "XYZ".index(options.axis)
        self._version = ""

    def has_kept(self, zero: str) -> bool:
        """Whether it was homed: each homing finds the same switch."""
        return self.zero == zero

    def wake(self) -> AxisTravel:
        """Put out a laser left lit by a killed program, wait for its moves, ask for the travel."""
        info = _table(self._link.ask("/server/info"))
        self._version = _line(f"{info.get('moonraker_version')}")
        self._require_ready()
        if self._options.laser_pin is not None:
            self._require_pin(self._options.laser_pin)
            self.laser(0.0)
        self._script("M400", self._options.homing_s)
        head = self._query("toolhead")
        low_mm, high_mm = (self._along(head.get(f"axis_{end}")) for end in ("minimum", "maximum"))
        speed_mm_s, accel_mm_s2 = (
            _number(head.get(f"max_{what}")) for what in ("velocity", "accel")
        )
        if not (speed_mm_s > 0 and accel_mm_s2 > 0 and low_mm < high_mm):  # nor NaN
            raise DeviceError(f"{self._link.name}: the toolhead reports no travel or no speed")
        return AxisTravel(low_mm, high_mm, 0.0, 60 * speed_mm_s, accel_mm_s2)

    def describe(self) -> dict[str, Fact]:
        """The versions of Klipper and Moonraker, the state, and which axes are homed."""
        info, head = _table(self._link.ask("/printer/info")), self._query("toolhead")
        return {
            "firmware": _line(f"Klipper {info.get('software_version')}"),
            "moonraker": self._version,
            "state": _line(f"{info.get('state')}"),
            "homed_axes": _line(f"{head.get('homed_axes')}") or "none",
        }

    def home(self) -> None:
        """Run ``G28`` for the axis."""
        self._script(f"G28 {self._options.axis}\nM400", self._options.homing_s)

    def move(self, target_mm: float, feed_mm_min: float, within_s: float) -> None:
        """Move and wait for the end of all motion."""
        self._script(
            f"G90\nG1 {self._options.axis}{target_mm:.3f} F{feed_mm_min:.1f}\nM400", within_s
        )

    def position_mm(self) -> float:
        """Where it stands at rest, of an axis that is homed still."""
        self._require_ready()
        asked = {"toolhead": ["homed_axes", "position"], "motion_report": ["live_position"]}
        status = self._status(asked)
        head, report = (_table(status.get(name)) for name in asked)
        if self._options.axis.lower() not in str(head.get("homed_axes")):
            raise DeviceError(
                f"{self._link.name}: axis {self._options.axis} is not homed, so its position is "
                "lost; Klipper was restarted or its motors went off (M84, [idle_timeout]): home "
                "it, or let it be homed by track.options.homing, and open the track again"
            )
        sent_mm, live_mm = map(self._along, (head.get("position"), report.get("live_position")))
        if not abs(sent_mm - live_mm) <= self._options.tolerance_mm:
            raise DeviceError(
                f"{self._link.name}: is at {live_mm:g} mm of the machine on its way to "
                f"{sent_mm:g} mm; something else moves it: wait until it is at rest"
            )
        return live_mm

    def laser(self, power: float) -> None:
        """``SET_PIN``, carried out when ``M400`` returns, and looked at.

        Where the pin cannot be set to 0, as in an error, an emergency stop puts it to its
        ``shutdown_value``, which is 0.  Klipper then is shut down, and the zero is lost.
        """
        if (pin := self._options.laser_pin) is None:
            raise DeviceError(f"{self._link.name}: track.options.laser_pin names no pin of a laser")
        try:
            self._script(f"SET_PIN PIN={pin} VALUE={power:g}\nM400")
            value = _number(self._query(f"output_pin {pin}").get("value"))
            if math.isnan(value) or (value > 0) != (power > 0):
                raise DeviceError(f"{self._link.name}: pin {pin} is at {value:g} after SET_PIN")
        except ConnectionLost:
            raise
        except DeviceError as error:
            if power > 0:
                raise
            self._link.ask("/printer/emergency_stop", {})
            hooks = self._query("webhooks")
            # It no longer reaches a board that it has lost, which goes on as it was.
            if hooks.get("state") != "shutdown" or "Lost comm" in str(hooks.get("state_message")):
                raise
            _log.warning(
                "an emergency stop has put the laser out, and shut Klipper down; restart it by "
                "FIRMWARE_RESTART and home: %s", error
            )  # fmt: skip

    def stop(self) -> None:
        """Wait until what was begun has ended: Klipper cancels no move without losing its zero."""
        self._script("M400", self._options.homing_s)

    def _require_ready(self) -> None:
        hooks = self._query("webhooks")
        if (state := hooks.get("state")) != "ready":
            raise DeviceError(
                f"{self._link.name}: Klipper is in state {_line(str(state))!r}, so the position is "
                f"lost: {_line(str(hooks.get('state_message')))}; mend it, send FIRMWARE_RESTART, "
                "home, and open the track again"
            )

    def _require_pin(self, pin: str) -> None:
        """Refuse a pin that is not configured, or that a shutdown does not put out."""
        status = self._status({f"output_pin {pin}": ["value"], "configfile": ["settings"]})
        if f"output_pin {pin}" not in status:
            raise DeviceError(
                f"{self._link.name}: Klipper's configuration has no [output_pin {pin}], which "
                "track.options.laser_pin names"
            )
        settings = _table(_table(status.get("configfile")).get("settings"))
        section = _table(settings.get(f"output_pin {pin}".lower()))
        for key in ("value", "shutdown_value"):
            if section.get(key, 0) != 0:
                raise DeviceError(
                    f"{self._link.name}: [output_pin {pin}] has {key}: {section[key]}; it must be "
                    "0, so that a start and a shutdown leave the laser dark"
                )

    def _script(self, text: str, within_s: float | None = None) -> None:
        self._link.ask("/printer/gcode/script", {"script": text}, within_s)

    def _query(self, name: str) -> dict[str, Any]:
        return _table(self._status({name: None}).get(name))

    def _status(self, objects: dict[str, Any]) -> dict[str, Any]:
        answer = self._link.ask("/printer/objects/query", {"objects": objects})
        return _table(_table(answer).get("status"))

    def _along(self, place: object) -> float:
        """The axis's number of a coordinate; NaN where there is none."""
        return _number(place[self._axis]) if isinstance(place, list) and place[3:] else math.nan


class KlipperTrackDriver(TravelDriver[KlipperOptions]):
    """Registered as "klipper" under ``lscan.tracks``."""

    model, slack_mm = KlipperOptions, ROUNDING_MM
    switches_laser = True
    connection_options = frozenset(
        {"url", "answer_s", "homing_s", "reconnects", "reconnect_wait_s"}
    )

    def options(self, rig_file: RigFile) -> KlipperOptions:
        """As of any track with a travel; a plan that switches the laser needs its pin."""
        options, plan = super().options(rig_file), rig_file.rig.plan
        if plan.laser != "untouched" and options.laser_pin is None:
            raise InputError(
                "needs track.options.laser_pin", where=f"{rig_file.source}: plan.laser",
                value=plan.laser, allowed="untouched",
            )  # fmt: skip
        return options

    def capabilities(self, rig_file: RigFile) -> dict[str, Fact]:
        """How it is reached, its travel, and whether it homes."""
        options = self.options(rig_file)
        names = {"url", "laser_pin", "min_mm", "max_mm", "tolerance_mm"}
        return {**options.model_dump(include=names), "homes_on_opening": options.homing}

    def open(self, rig_file: RigFile) -> SerialTrack:
        """The track, at rest, and homed where its options say so."""
        return open_track(self.options(rig_file))


def open_track(options: KlipperOptions, sleep: Callable[[float], None] = time.sleep) -> SerialTrack:
    """The track the options describe, at rest, and homed where they say so.

    Parameters
    ----------
    options : KlipperOptions
        ``[track.options]`` of a rig file.
    sleep : callable
        Lets it rest, for some s.

    Raises
    ------
    DeviceError
        Where Moonraker is not reached, or Klipper is not ready.
    """
    link = Moonraker(options, sleep)
    return SerialTrack(KlipperMachine(link, options), options, link)


track_driver = KlipperTrackDriver()


def _line(text: str) -> str:
    """The first line of a text that came over the network, of what can be printed."""
    first = text.strip().partition("\n")[0][:120]
    return "".join(letter for letter in first if letter.isprintable())


def _table(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _number(value: object) -> float:
    """The number; NaN, which no comparison lets pass, where it is none."""
    return float(value) if isinstance(value, int | float) else math.nan
