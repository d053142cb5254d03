"""A machine that runs Klipper, behind the part of Moonraker's HTTP interface that a track uses.

Sources: those of ``lscan.devices.klipper``; texts of errors are Klipper's.  Left out: extruders,
heaters, macros, acceleration (a move lasts as long as at its feed), and G92; homing goes to the
end of the axis at once.
"""

import json
import math
import re
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final, Self

AXES: Final = "XYZ"
POLL_S: Final = 0.001

READY = "Printer is ready"
SHUT_DOWN = (
    "Shutdown due to webhooks request\nOnce the underlying issue is corrected, use the\n"
    '"FIRMWARE_RESTART" command to reset the firmware, reload the\n'
    "config, and restart the host software.\nPrinter is shutdown\n"
)


class KlipperError(Exception):
    """A request that is refused.  status: of the HTTP answer."""

    def __init__(self, text: str, status: int = 400) -> None:
        super().__init__(text)
        self.status = status


class KlipperEmulator:
    """Klipper with three axes and an output pin "laser".

    Parameters
    ----------
    clock : callable
        Seconds.
    pace : float
        How many times faster than its feed the head moves.

    Attributes
    ----------
    head_mm : list of float, where the head truly is, mm from the ends at which it homes
    pin : float, value of the output pin
    lose_answers : int, of how many of the next requests, which are carried out, none arrives
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, pace: float = 1.0) -> None:
        self._clock, self._pace = clock, pace
        self.travel_mm, self.lose_answers, self.pin = (-10.0, 200.0), 0, 0.0
        self.settings: dict[str, Any] = {"output_pin laser": {"value": 0.0, "shutdown_value": 0.0}}
        self._gcode = threading.Lock()  # one script after the other
        self._sent_mm, self._offset_mm = [0.0] * 3, [50.0, 60.0, 70.0]  # from coordinates to truth
        self._halt()
        self.restart()

    def restart(self) -> None:
        """FIRMWARE_RESTART: nothing is homed, the motors are free, the pin is at its value."""
        self.state, self.message, self.homed = "ready", READY, set[str]()
        self._relative, self._feed_mm_s = False, 25.0
        self._offset_mm, self._sent_mm = self.head_mm, [0.0] * 3
        self._halt()
        self.pin = self.settings["output_pin laser"]["value"]

    def shut_down(self, message: str = SHUT_DOWN) -> None:
        """As by an emergency stop; the head stays where it is."""
        self._sent_mm = self._live_mm()
        self._halt()
        self.state, self.message = "shutdown", message
        self.pin = self.settings["output_pin laser"]["shutdown_value"]

    def motors_off(self) -> None:
        """M84, as [idle_timeout] does by itself: no axis counts as homed."""
        self.homed.clear()

    def _halt(self) -> None:
        self._begun = (self._clock(), self._sent_mm, 0.0)  # when, from where, how long

    @property
    def head_mm(self) -> list[float]:
        """Where the head truly is."""
        return [one + off for one, off in zip(self._live_mm(), self._offset_mm, strict=True)]

    def _live_mm(self) -> list[float]:
        began_s, start_mm, lasts_s = self._begun
        done = min(1.0, (self._clock() - began_s) / lasts_s) if lasts_s > 0 else 1.0
        return [a + done * (b - a) for a, b in zip(start_mm, self._sent_mm, strict=True)]

    # ---- what Moonraker is asked ----------------------------------------------------------

    def answer(self, method: str, path: str, body: Any) -> Any:
        """The result of a request; KlipperError where it is refused."""
        if (method, path) == ("GET", "/server/info"):
            return {"klippy_connected": True, "klippy_state": self.state,
                    "moonraker_version": "v0.10.0-31-gd5ee171"}  # fmt: skip
        if (method, path) == ("GET", "/printer/info"):
            return {"state": self.state, "state_message": self.message,
                    "software_version": "v0.13.0-730-g84104bbb"}  # fmt: skip
        if (method, path) == ("POST", "/printer/objects/query"):
            return {
                "eventtime": self._clock(),
                "status": self._status(self._given(body, "objects")),
            }
        if (method, path) == ("POST", "/printer/emergency_stop"):
            self.shut_down()
            return "ok"
        if (method, path) == ("POST", "/printer/gcode/script"):
            script = self._given(body, "script")
            with self._gcode:
                for line in script.splitlines():
                    self._run(line.partition(";")[0].strip())
            return "ok"
        known = ("/server/info", "/printer/info", "/printer/objects/query",
                 "/printer/emergency_stop", "/printer/gcode/script")  # fmt: skip
        raise KlipperError(*("Method Not Allowed", 405) if path in known else ("Not Found", 404))

    def _given(self, body: Any, name: str) -> Any:
        if not isinstance(body, dict) or name not in body:
            raise KlipperError(f"No data for argument: {name}")
        return body[name]

    def _status(self, objects: dict[str, list[str] | None]) -> dict[str, Any]:
        """What was asked for; an object or an attribute that is not there is left out."""
        low_mm, high_mm = self.travel_mm
        known: dict[str, dict[str, Any]] = {
            "webhooks": {"state": self.state, "state_message": self.message},
            "toolhead": {
                "position": [*self._sent_mm, 0.0],
                "homed_axes": "".join(sorted(self.homed)),
                "axis_minimum": [low_mm] * 3 + [0.0],
                "axis_maximum": [high_mm] * 3 + [0.0],
                "max_velocity": 1000.0,
                "max_accel": 20_000.0,
            },
            "motion_report": {"live_position": [*self._live_mm(), 0.0]},
            "output_pin laser": {"value": self.pin},
            "configfile": {"settings": self.settings},
        }
        return {
            name: {key: known[name][key] for key in keys or known[name] if key in known[name]}
            for name, keys in objects.items()
            if name in known
        }

    # ---- G-code ---------------------------------------------------------------------------

    def _run(self, line: str) -> None:
        if self.state != "ready":
            raise KlipperError(self.message)
        name, *words = line.split() or [""]
        name = name.upper()
        if name in ("G0", "G1"):
            self._move(line, dict(re.findall(r"([A-Z])(-?[0-9.]+)", " ".join(words).upper())))
        elif name in ("G90", "G91"):
            self._relative = name == "G91"
        elif name == "G28":
            for axis in [word[0].upper() for word in words] or AXES:
                self._home(axis)
        elif name == "M400":
            self._wait()
        elif name in ("M84", "M18"):
            self.motors_off()
        elif name == "SET_PIN":
            pairs = (word.partition("=") for word in words)
            self._set_pin(line, {key.upper(): value for key, _, value in pairs})
        elif name == "FIRMWARE_RESTART":
            self.restart()
        # Klipper notes any other command as unknown, and answers ok.

    def _move(self, line: str, words: dict[str, str]) -> None:
        if "F" in words:
            if float(words["F"]) <= 0:
                raise KlipperError(f"Invalid speed in '{line}'")
            self._feed_mm_s = float(words["F"]) / 60
        target_mm = list(self._sent_mm)
        for index, axis in enumerate(AXES):
            if axis in words:
                target_mm[index] = float(words[axis]) + self._relative * target_mm[index]
        place = f"{target_mm[0]:.3f} {target_mm[1]:.3f} {target_mm[2]:.3f} [0.000]"
        for axis, now_mm, then_mm in zip(AXES.lower(), self._sent_mm, target_mm, strict=True):
            if now_mm != then_mm and axis not in self.homed:
                raise KlipperError(f"Must home axis first: {place}")
            if now_mm != then_mm and not self.travel_mm[0] <= then_mm <= self.travel_mm[1]:
                raise KlipperError(f"Move out of range: {place}")
        self._wait()
        way_mm = math.dist(target_mm, self._sent_mm)
        self._begun = (self._clock(), self._sent_mm, way_mm / self._feed_mm_s / self._pace)
        self._sent_mm = target_mm

    def _home(self, axis: str) -> None:
        """Find the end at which the true place is 0."""
        self._wait()
        index, place_mm = AXES.index(axis), self._live_mm()
        place_mm[index] = self._offset_mm[index] = 0.0
        self.homed.add(axis.lower())
        self._sent_mm = place_mm
        self._halt()

    def _wait(self) -> None:
        while self.state == "ready" and self._clock() - self._begun[0] < self._begun[2]:
            time.sleep(POLL_S)
        if self.state != "ready":
            raise KlipperError(self.message)

    def _set_pin(self, line: str, words: dict[str, str]) -> None:
        if (pin := words.get("PIN")) is None:
            raise KlipperError(f"Error on '{line}': missing PIN")
        if pin != "laser":
            raise KlipperError(f"The value '{pin}' is not valid for PIN. Options: laser")
        value = float(words.get("VALUE", "nan"))
        if math.isnan(value):
            raise KlipperError("SET_PIN command must specify VALUE or TEMPLATE")
        if not 0 <= value <= 1:
            bound = "maximum of 1.0" if value > 1 else "minimum of 0.0"
            raise KlipperError(f"Error on '{line}': VALUE must have {bound}")
        if value not in (0.0, 1.0):
            raise KlipperError("Invalid pin value")
        self._wait()
        self.pin = value


class EmulatedMoonraker:
    """The machine behind HTTP on a free port of the loopback address.

    with EmulatedMoonraker(KlipperEmulator()) as moonraker:
        ...  # track.options.url = moonraker.url
    """

    def __init__(self, printer: KlipperEmulator, api_key: str | None = None) -> None:
        """Listen.  api_key: what each request must then bring in X-Api-Key."""

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.reply("GET")

            def do_POST(self) -> None:
                self.reply("POST")

            def reply(self, method: str) -> None:
                data = self.rfile.read(int(self.headers.get("Content-Length", 0)))
                status, content = 200, {}
                try:
                    if api_key is not None and self.headers.get("X-Api-Key") != api_key:
                        raise KlipperError("Unauthorized", 401)
                    is_json = self.headers.get("Content-Type", "").startswith("application/json")
                    body = json.loads(data) if data and is_json else None
                    content = {"result": printer.answer(method, self.path, body)}
                except KlipperError as error:
                    status = error.status
                    content = {"error": {"code": status, "message": str(error)}}
                if printer.lose_answers > 0:
                    printer.lose_answers -= 1
                    return
                text = json.dumps(content).encode()
                self.send_response(status)
                self.send_header("Content-Type", "application/json; charset=UTF-8")
                self.send_header("Content-Length", str(len(text)))
                self.end_headers()
                self.wfile.write(text)

            def log_message(self, *_: object) -> None: ...

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}"
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.01,), daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Listen no longer."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
