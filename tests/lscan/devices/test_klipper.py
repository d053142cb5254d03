"""The track of a machine with Klipper, over HTTP to an emulated Moonraker."""

import json
import logging
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from device_contract import TrackContract
from loopback import listening

from lscan.acquisition.run import open_run
from lscan.acquisition.scan import acquire_into
from lscan.acquisition.writer import resume_run
from lscan.config.rig import RigFile, parse_rig
from lscan.devices.api import LASER_MAY_BE_LIT, ConnectionLost, Grab, Track
from lscan.devices.grbl import SerialTrack
from lscan.devices.klipper import KlipperOptions, open_track, track_driver
from lscan.errors import DeviceError, InputError
from sim.emulators.klipper import EmulatedMoonraker, KlipperEmulator

FRAMES = 5
STEP_MM = 0.5


@dataclass
class Desk:
    """A machine, where it is reached, and a camera that sees its laser."""

    printer: KlipperEmulator
    url: str
    values: dict[str, Any] = field(default_factory=dict)
    at_grab: dict[int, Any] = field(default_factory=dict)
    seen: list[tuple[int | None, float, float]] = field(default_factory=list)
    size_px = (20, 16)

    def document(self) -> dict[str, Any]:
        options = {
            "url": self.url, "laser_pin": "laser", "min_mm": 0.0, "max_mm": 180.0, "zero_mm": 5.0,
            "feed_mm_min": 60_000, "settle_s": 0, "reconnect_wait_s": 0, **self.values,
        }  # fmt: skip
        return {
            "camera": {"driver": "fake", "width_px": 20, "height_px": 16},
            "track": {"driver": "klipper", "options": options},
            "plan": {"step_mm": STEP_MM, "frames": FRAMES, "laser": "pairs"},
        }

    @property
    def rig_file(self) -> RigFile:
        return parse_rig(self.document(), source="rig.toml", trusted=True)

    def open(self) -> SerialTrack:
        return open_track(track_driver.options(self.rig_file), sleep=lambda seconds: None)

    def scan(self, path: Path) -> Any:
        track = self.open()
        try:
            with resume_run(path, self.rig_file) as writer:
                return acquire_into(writer, self, track)
        finally:
            track.close()

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        self.seen.append((frame, self.printer.head_mm[0], self.printer.pin))
        self.at_grab.get(len(self.seen), lambda: None)()
        picture = np.full((16, 20), 200 if self.printer.pin else 3, np.uint8)
        return Grab(picture, time.monotonic(), 20.0)

    def close(self) -> None: ...


@pytest.fixture
def desk() -> Iterator[Desk]:
    printer = KlipperEmulator(pace=100.0)
    with EmulatedMoonraker(printer) as moonraker:
        yield Desk(printer, moonraker.url)


class TestKlipperTrack(TrackContract):
    limits_mm = (0.0, 180.0)
    tolerance_mm = 0.02
    name = "klipper track on http://127.0.0.1"

    @pytest.fixture
    def track(self, desk: Desk) -> Iterator[Track]:
        self.printer = desk.printer
        track = desk.open()
        yield track
        track.close()

    def is_lit(self) -> bool:
        return self.printer.pin > 0


# ---- motion and scans -------------------------------------------------------------------


def test_it_stands_where_it_says_and_came_from_below(desk: Desk) -> None:
    track, stops = desk.open(), []
    run = desk.printer._run
    desk.printer._run = lambda line: (stops.append(line), run(line))  # type: ignore[assignment]
    for stop_mm in (20.0, 7.125, 7.625):
        assert track.move_to(stop_mm) == pytest.approx(stop_mm, abs=0.0005)
        assert desk.printer.head_mm[0] == pytest.approx(stop_mm + 5.0, abs=0.0005)
    moves = [line for line in stops if line.startswith("G1")]
    assert moves == [
        "G1 X25.000 F60000.0",
        "G1 X11.125 F60000.0",
        "G1 X12.125 F60000.0",
        "G1 X12.625 F60000.0",
    ]


def test_frames_in_pairs_are_taken_where_they_are_due(desk: Desk, tmp_path: Path) -> None:
    run = desk.scan(tmp_path / "a")
    run.verify()
    assert len(run) == FRAMES
    expected = [
        (index, pytest.approx(5.0 + STEP_MM * index, abs=0.0005), lit)
        for index in range(FRAMES)
        for lit in (1.0, 0.0)
    ]
    assert desk.seen == expected
    assert desk.printer.pin == 0.0


def test_what_it_says_of_itself(desk: Desk) -> None:
    facts = desk.open().describe()
    assert facts["firmware"] == "Klipper v0.13.0-730-g84104bbb"
    assert (facts["state"], facts["homed_axes"]) == ("ready", "x")
    assert (facts["travel_low_mm"], facts["travel_high_mm"]) == (-15.0, 195.0)


# ---- a position that is lost ------------------------------------------------------------


@pytest.mark.parametrize("how", ["restart", "motors_off"])
def test_a_lost_position_ends_the_scan_in_words_and_homing_resumes_it(
    desk: Desk, how: str, tmp_path: Path
) -> None:
    desk.at_grab = {4: getattr(desk.printer, how)}
    with pytest.raises(DeviceError, match="axis X is not homed, so its position is lost"):
        desk.scan(tmp_path / "a")
    assert len(open_run(tmp_path / "a")) == 2
    desk.at_grab.clear()
    desk.scan(tmp_path / "a").verify()
    taken = [frame for frame, _, lit in desk.seen if lit]
    assert taken == [*range(FRAMES)]
    true_mm = [place for _, place, lit in desk.seen if lit]
    np.testing.assert_allclose(true_mm, 5.0 + STEP_MM * np.arange(FRAMES), atol=0.0005)


def test_a_shutdown_is_named_and_the_laser_dark(desk: Desk, tmp_path: Path) -> None:
    desk.at_grab = {3: lambda: desk.printer.shut_down("MCU 'mcu' shutdown: Timer too close\nmore")}
    with pytest.raises(DeviceError, match=r"Timer too close|is in state 'shutdown'") as caught:
        desk.scan(tmp_path / "a")
    assert "\n" not in str(caught.value)
    assert desk.printer.pin == 0.0


def test_an_axis_that_is_not_homed_is_not_homed_unasked(desk: Desk) -> None:
    desk.values = {"homing": False}
    with pytest.raises(DeviceError, match=r"axis X is not homed.*track\.options\.homing"):
        desk.open()
    desk.printer.answer("POST", "/printer/gcode/script", {"script": "G28 X"})
    assert desk.open().move_to(3.0) == 3.0


def test_coordinates_that_were_shifted_are_noticed(desk: Desk) -> None:
    """As by G92 or SET_GCODE_OFFSET: the toolhead goes elsewhere than it was told."""
    track, move = desk.open(), desk.printer._move
    desk.printer._move = lambda line, words: move(line, {**words, "X": "9"})  # type: ignore
    with pytest.raises(DeviceError, match=r"stands at 4 mm instead of"):
        track.move_to(20.0)


# ---- the laser --------------------------------------------------------------------------


def test_a_laser_that_was_left_lit_is_put_out_on_opening(desk: Desk) -> None:
    desk.printer.pin = 1.0
    desk.open()
    assert desk.printer.pin == 0.0


def test_a_pin_that_stays_lit_is_put_out_by_an_emergency_stop(
    desk: Desk, caplog: pytest.LogCaptureFixture
) -> None:
    track = desk.open()
    track.laser_on()
    desk.printer._set_pin = lambda line, words: None  # type: ignore[method-assign]
    track.laser_off()
    assert (desk.printer.pin, desk.printer.state) == (0.0, "shutdown")
    assert "emergency stop has put the laser out" in caplog.text
    with pytest.raises(DeviceError, match="is in state 'shutdown', so the position is lost"):
        track.move_to(1.0)


def test_a_board_that_no_stop_reaches_is_not_said_to_be_dark(desk: Desk) -> None:
    track = desk.open()
    track.laser_on()
    printer = desk.printer
    printer.shut_down("Lost communication with MCU 'mcu'")
    printer.shut_down = lambda *text: None  # type: ignore[method-assign]
    with pytest.raises(DeviceError, match="Lost communication"):
        track.laser_off()


@pytest.mark.parametrize(("key", "value"), [("shutdown_value", 1.0), ("value", 1.0)])
def test_a_pin_that_a_shutdown_lights_is_refused(desk: Desk, key: str, value: float) -> None:
    desk.printer.settings["output_pin laser"][key] = value
    with pytest.raises(DeviceError, match=rf"\[output_pin laser\] has {key}: 1.0; it must be 0"):
        desk.open()


def test_a_pin_that_is_not_configured_is_named(desk: Desk) -> None:
    desk.values = {"laser_pin": "beam"}
    with pytest.raises(DeviceError, match=r"no \[output_pin beam\]"):
        desk.open()


def test_a_plan_that_switches_a_laser_needs_its_pin(desk: Desk) -> None:
    desk.values = {"laser_pin": None}
    document = desk.document()
    del document["track"]["options"]["laser_pin"]
    with pytest.raises(InputError, match=r"plan\.laser: needs track\.options\.laser_pin"):
        track_driver.validate(parse_rig(document, source="rig.toml", trusted=True))


# ---- the network ------------------------------------------------------------------------


@pytest.mark.parametrize("pictures", [3, 4])
def test_a_broken_connection_loses_and_repeats_no_frame(
    desk: Desk, pictures: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Three requests are carried out whose answers are lost."""
    desk.at_grab = {pictures: lambda: setattr(desk.printer, "lose_answers", 3)}
    with caplog.at_level(logging.WARNING):
        run = desk.scan(tmp_path / "a")
    run.verify()
    assert "cannot be reached" in caplog.text
    assert (LASER_MAY_BE_LIT in caplog.text) == (pictures == 3)
    lit = {frame: place for frame, place, power in desk.seen if power}
    np.testing.assert_allclose([*lit.values()], 5.0 + STEP_MM * np.arange(FRAMES), atol=0.0005)
    assert [row.index for row in run.rows] == [*range(FRAMES)]


def test_what_cannot_be_reached_is_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        url = f"http://127.0.0.1:{free.getsockname()[1]}"
    with pytest.raises(ConnectionLost, match=r"cannot be reached: .*refused.*Moonraker runs"):
        open_track(KlipperOptions(url=url, min_mm=0, max_mm=9))


def test_an_api_key_is_looked_up_for_its_host_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the user's own file: a rig file is kept in every run folder, and may be a stranger's."""
    monkeypatch.setenv("HOME", str(tmp_path))
    keys = tmp_path / ".netrc"
    with EmulatedMoonraker(KlipperEmulator(), api_key="a-key") as moonraker:
        options = KlipperOptions(url=moonraker.url, min_mm=0, max_mm=9, feed_mm_min=60_000)
        for others in ("", "machine other.host password a-key\n", "default password a-key\n"):
            keys.write_text(others)
            keys.chmod(0o600)
            with pytest.raises(DeviceError, match=r"answers 401: .*machine 127\.0\.0\.1 password"):
                open_track(options)
        keys.write_text("machine 127.0.0.1 password a-key\n")
        open_track(options).close()
        keys.write_text("machine\n")
        with pytest.raises(DeviceError, match=r"~/\.netrc cannot be read"):
            open_track(options)


@pytest.mark.parametrize(
    "said",
    [b"no JSON", b"[1, 2]", b"null", b'{"result": {"klippy_state": "ready"}}', b"9" * 5_000_000],
    ids=["text", "list", "null", "of another", "too long"],
)
def test_what_is_no_moonraker_is_one_line(said: bytes) -> None:
    class Other(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Length", str(len(said)))
            self.end_headers()
            self.wfile.write(said)

        do_POST = do_GET  # noqa: N815

        def log_message(self, *_: object) -> None: ...

    with listening(Other) as url, pytest.raises(DeviceError, match=r"klipper track on") as caught:
        open_track(KlipperOptions(url=url, min_mm=0, max_mm=9))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    "url", ["klipper.local", "ftp://host", "http://host/path", "http://me:word@host", "http://"]
)
def test_other_addresses_are_refused(desk: Desk, url: str) -> None:
    desk.values = {"url": url}
    with pytest.raises(InputError, match=r"track\.options\.url: must be Moonraker's address"):
        track_driver.validate(desk.rig_file)


def test_options_of_the_connection_are_options() -> None:
    assert track_driver.connection_options <= set(KlipperOptions.model_fields)
    json.dumps(KlipperOptions.model_json_schema())
