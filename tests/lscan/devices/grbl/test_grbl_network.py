"""The serial track over a network: raw TCP and RFC 2217, and a connection that breaks."""

import logging
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import serial
from device_contract import TrackContract
from grbl_line import FLUIDNC, GRBL_ESP32, GRBLHAL, GRBLHAL_AS_GRBL
from network_bench import QUICK, STEP_MM, NetworkBench, no_pause_on_closing
from serial.rfc2217 import PortManager
from track_plant import UNHOMED

from lscan.acquisition.run import MANIFEST, Manifest, open_run
from lscan.config.rig import parse_rig
from lscan.devices.api import LASER_MAY_BE_LIT, ConnectionLost, Track
from lscan.devices.grbl import SerialTrackOptions, open_track, track_driver
from lscan.devices.grbl.machine import Link, open_serial
from lscan.errors import DeviceError, InputError
from sim.emulators.grbl import GRBL, Faults, GrblEmulator, MarlinEmulator, PseudoTerminal, TcpPort

__all__ = ["no_pause_on_closing"]
pytestmark = pytest.mark.usefixtures("no_pause_on_closing")

FIRMWARE = {
    "Grbl 1.1h": GRBL,
    "grblHAL": GRBLHAL,
    "grblHAL as Grbl": GRBLHAL_AS_GRBL,
    "Grbl_ESP32": GRBL_ESP32,
    "FluidNC": FLUIDNC,
    "Marlin": None,
}
LINES = {"pty": PseudoTerminal, "TCP": TcpPort}
FRAMES = 6


def controller(name: str = "Grbl 1.1h") -> GrblEmulator | MarlinEmulator:
    firmware = FIRMWARE[name]
    if firmware is None:
        return MarlinEmulator(QUICK)
    return GrblEmulator({**QUICK, **UNHOMED}, firmware=firmware)


@pytest.fixture
def bench() -> Iterator[NetworkBench]:
    grbl = controller()
    with TcpPort(grbl) as line:
        yield NetworkBench(grbl, line, FRAMES)


# ---- what may stand in a rig file -------------------------------------------------------


def check_port(port: str) -> None:
    options = {"port": port, "min_mm": 0, "max_mm": 9}
    document = {"camera": {"driver": "x"}, "track": {"driver": "grbl", "options": options}}
    track_driver.validate(parse_rig(document, source="rig.toml", trusted=True))


@pytest.mark.parametrize(
    "port",
    [
        *("/dev/ttyUSB0", "COM3", r"\\.\COM10"),
        "/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0-port0",
        *("socket://fluidnc.local:23", "socket://[fe80::1]:23", "rfc2217://10.0.0.7:2217"),
    ],
)
def test_a_port_is_a_name_or_one_of_two_addresses(port: str) -> None:
    check_port(port)


@pytest.mark.parametrize(
    "port",
    [
        *("alt:///dev/ttyUSB0?class=PosixPollSerial", "spy:///dev/ttyUSB0?file=log"),
        *("loop://", "hwgrep://USB", "cp2110://x", "http://host:80", "SOCKET://host:23"),
        *("socket://host", "socket://host:23?logging=debug", "socket://me:word@host:23"),
        "rfc2217://host:2217?timeout=1e9",
    ],
)
def test_other_addresses_are_refused_by_name(port: str) -> None:
    """pyserial's ``alt`` would load any class, its ``spy`` write any file."""
    with pytest.raises(InputError, match=r"track\.options\.port: .*socket://HOST:PORT") as caught:
        check_port(port)
    assert repr(port) in str(caught.value)


@pytest.mark.parametrize("number", [0, 65536])
def test_a_number_that_no_port_has_is_refused(number: int) -> None:
    with pytest.raises(InputError, match=rf"track\.options\.port: .*65535.*:{number}"):
        check_port(f"socket://host:{number}")


# ---- reaching a controller --------------------------------------------------------------


class TestTrackOverTcp(TrackContract):
    limits_mm = (-5.0, 45.0)
    tolerance_mm = 0.02
    name = "grbl track on socket://127.0.0.1"
    firmware = "Grbl 1.1h"

    @pytest.fixture
    def track(self) -> Iterator[Track]:
        self.emulator = controller(self.firmware)
        with TcpPort(self.emulator) as line:
            track = NetworkBench(self.emulator, line, FRAMES).open()
            yield track
            track.close()

    def is_lit(self) -> bool:
        return self.emulator.laser_power > 0


class TestMarlinOverTcp(TestTrackOverTcp):
    name = "marlin track on socket://127.0.0.1"
    firmware = "Marlin"


@pytest.mark.parametrize(
    ("host", "reason"),
    [("127.0.0.1", "Connection refused"), ("no-such-host.invalid", "[Nn]ame")],
)
def test_what_cannot_be_reached_is_one_line(host: str, reason: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        number = free.getsockname()[1]
    port = f"socket://{host}:{number}"
    with pytest.raises(ConnectionLost, match=rf"cannot be reached: .*{reason}.*check the") as lost:
        open_track(SerialTrackOptions(port=port, min_mm=0, max_mm=9))
    assert str(lost.value).startswith(f"grbl track on {port}: ")
    assert "\n" not in str(lost.value)


def test_a_connection_that_is_closed_at_once_is_one_line(bench: NetworkBench) -> None:
    """As by a bridge that serves somebody else already."""
    with socket.create_server(("127.0.0.1", 0)) as busy:
        options = bench.options().model_copy(
            update={"port": f"socket://127.0.0.1:{busy.getsockname()[1]}"}
        )
        threading.Thread(target=lambda: busy.accept()[0].close(), daemon=True).start()
        with pytest.raises(ConnectionLost, match=r"the connection broke .*the network.*"):
            open_track(options)


def test_a_line_that_comes_late_and_in_pieces_is_read_whole() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = f"socket://127.0.0.1:{server.getsockname()[1]}"
        link = Link(open_serial(port, 115_200, "here", write_s=5.0), "here")
        with server.accept()[0] as peer:
            peer.sendall(b"o")
            assert link.line(link.clock() + 0.05) is None
            peer.sendall(b"k\r\nerr")
            assert link.line(link.clock() + 60) == "ok"
            peer.sendall(b"or:9\n")
            assert link.line(link.clock() + 60) == "error:9"
            assert link.noise_bytes == 0
        link.close()


def test_a_peer_that_takes_nothing_is_distinguished_from_one_that_is_gone() -> None:
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        port = f"socket://127.0.0.1:{deaf.getsockname()[1]}"
        line = open_serial(port, 115_200, "here", write_s=0.05)
        with deaf.accept()[0], pytest.raises(serial.SerialTimeoutException):
            line.write(b"?" * 10_000_000)
        line.close()


class RemoteDevice(serial.Serial):
    """A pseudo-terminal, which has no modem lines, as a bridge's serial port."""

    cts = dsr = ri = cd = False

    def _update_dtr_state(self) -> None: ...

    def _update_rts_state(self) -> None: ...


def test_a_serial_port_by_rfc_2217_is_scanned_with(tmp_path: Path) -> None:
    """The other side is pyserial's own, before the emulator's pseudo-terminal; it hangs up once."""
    grbl, served = controller(), list[socket.socket]()
    with PseudoTerminal(grbl) as terminal, socket.create_server(("127.0.0.1", 0)) as server:
        device = RemoteDevice(terminal.port, timeout=0.002)
        threading.Thread(target=serve_rfc2217, args=(server, device, served), daemon=True).start()
        terminal.port = f"rfc2217://127.0.0.1:{server.getsockname()[1]}"
        bench = NetworkBench(grbl, terminal, FRAMES, dtr=False)
        bench.before_grab = {5: lambda: served[0].shutdown(socket.SHUT_RDWR)}
        bench.require_true(bench.scan(tmp_path / "a"))
    assert (device.dtr, device.rts, device.baudrate) == (False, False, 115_200)
    assert len(served) == 2


def serve_rfc2217(server: socket.socket, device: RemoteDevice, served: list[socket.socket]) -> None:
    """Two connections: what comes and goes is filtered and escaped by pyserial's PortManager."""
    while len(served) < 2:
        served.append(server.accept()[0])
        with suppress(OSError), served[-1] as client:
            manager = PortManager(device, SimpleNamespace(write=client.sendall))
            client.settimeout(0.002)
            while True:
                with suppress(TimeoutError):
                    if not (came := client.recv(1024)):
                        break
                    device.write(b"".join(manager.filter(came)))
                if data := device.read(device.in_waiting or 1):
                    client.sendall(b"".join(manager.escape(data)))


# ---- scans ------------------------------------------------------------------------------


def stop() -> None:
    raise KeyboardInterrupt


def reset(emulator: GrblEmulator) -> None:
    emulator.receive(b"\x18")


def alarm(emulator: GrblEmulator) -> None:
    emulator.inject(Faults(alarm=True))  # in the next motion


def scan_stopped_and_resumed(name: str, kind: str, frames: int, path: Path) -> None:
    emulator = controller(name)
    with LINES[kind](emulator) as line:
        bench = NetworkBench(emulator, line, frames, before_grab={frames // 2: stop})
        with pytest.raises(KeyboardInterrupt):
            bench.scan(path / "a")
        assert emulator.laser_power == 0
        bench.require_true(bench.scan(path / "a"))


def scan_with_a_lost_zero(name: str, kind: str, what: str, frames: int, path: Path) -> None:
    """After a reset or an alarm it ends dark, is not gone on with, and then is where it was put."""
    emulator = controller(name)
    assert isinstance(emulator, GrblEmulator)
    with LINES[kind](emulator) as line:
        bench = NetworkBench(emulator, line, frames, answer_s=1.0 if what == "alarm" else 60.0)
        bench.before_grab = {frames: partial({"reset": reset, "alarm": alarm}[what], emulator)}
        with pytest.raises(DeviceError, match=r"has restarted|ALARM:1"):
            bench.scan(path / "a")
        assert emulator.laser_power == 0
        emulator.receive(b"\x18")  # by hand: out of the alarm, and unlocked
        emulator.receive(b"$X\n")
        taken, kept = len(bench.seen), len(open_run(path / "a"))
        with pytest.raises(DeviceError, match=r"--position-restored"):
            bench.scan(path / "a")
        assert (len(bench.seen), kept) == (taken, frames // 2)
        resumed = bench.scan(path / "a", position_restored=True)
        assert (resumed.state, len(resumed)) == ("complete", frames)


GRBLS = [name for name, firmware in FIRMWARE.items() if firmware is not None]


@pytest.mark.parametrize("name", FIRMWARE)
def test_every_firmware_scans_over_tcp(name: str, tmp_path: Path) -> None:
    scan_stopped_and_resumed(name, "TCP", FRAMES, tmp_path)


@pytest.mark.parametrize(("name", "what"), [(n, "reset") for n in GRBLS] + [(GRBLS[0], "alarm")])
def test_a_zero_lost_over_tcp_is_not_gone_on_from(name: str, what: str, tmp_path: Path) -> None:
    scan_with_a_lost_zero(name, "TCP", what, FRAMES, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", LINES)
@pytest.mark.parametrize("name", FIRMWARE)
def test_every_firmware_takes_400_frames_in_pairs(name: str, kind: str, tmp_path: Path) -> None:
    scan_stopped_and_resumed(name, kind, 400, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["reset", "alarm"])
@pytest.mark.parametrize("kind", LINES)
@pytest.mark.parametrize("name", GRBLS)
def test_every_zero_lost_is_not_gone_on_from(
    name: str, kind: str, what: str, tmp_path: Path
) -> None:
    scan_with_a_lost_zero(name, kind, what, 400, tmp_path)


# ---- a connection that breaks -----------------------------------------------------------


def may_be_lit(path: Path) -> bool:
    return Manifest.from_file(path / MANIFEST).laser_may_be_lit


@pytest.mark.parametrize("pictures", [1, 4, 5, 11])
@pytest.mark.parametrize("laser", ["pairs", "on"])
def test_no_frame_is_lost_or_repeated_where_the_connection_comes_back(
    bench: NetworkBench, laser: str, pictures: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It breaks while a picture is taken, with the laser lit or dark; the controller goes on."""
    bench.laser = laser
    assert isinstance(bench.line, TcpPort)
    bench.before_grab = {pictures: bench.line.drop}
    with caplog.at_level(logging.WARNING):
        run = bench.scan(tmp_path / "a")
    if laser == "pairs":
        bench.require_true(run)
        assert "the connection broke" in caplog.text
        assert (LASER_MAY_BE_LIT in caplog.text) == (pictures % 2 == 1)
    run.verify()
    assert [row.index for row in run.rows] == [*range(FRAMES)]
    for row in run.rows:
        assert row.position_mm == pytest.approx(row.index * STEP_MM, abs=0.004)
    assert bench.controller.laser_power == 0
    assert not may_be_lit(tmp_path / "a")


def test_a_cable_that_is_put_back_loses_and_repeats_no_frame(tmp_path: Path) -> None:
    """Its name stays, as in /dev/serial/by-id; the controller has its own supply."""
    grbl, name = controller(), tmp_path / "port"
    with PseudoTerminal(grbl) as before, PseudoTerminal(grbl) as after:
        name.symlink_to(before.port)

        def put_back() -> None:
            before.close()
            name.unlink()
            name.symlink_to(after.port)

        bench = NetworkBench(grbl, SimpleNamespace(port=str(name)), FRAMES)
        bench.before_grab = {5: put_back}
        bench.require_true(bench.scan(tmp_path / "a"))


def test_what_was_on_its_way_is_stopped_and_judged_by_where_it_stands(
    bench: NetworkBench,
) -> None:
    """On the way down to the beginning of an approach."""
    line = bench.line
    assert isinstance(line, TcpPort)
    bench.feed_mm_min = 600
    track = bench.open()
    track.move_to(2.0)
    zero = track.zero
    track.laser_on()
    bench.asleep = lambda: None if bench.controller.standing_mm else line.drop()
    with pytest.raises(ConnectionLost, match="the connection broke"):
        track.move_to(0.0)
    with pytest.raises(ConnectionLost, match="failed before"):
        track.move_to(0.0)
    bench.asleep = lambda: None
    track.reconnect()
    stands_mm = track.position_mm
    assert bench.controller.standing_mm is not None
    assert -1.0 < stands_mm < 2.0
    assert bench.controller.laser_power == 0
    assert bench.controller.head_mm[0] + 50.0 == pytest.approx(stands_mm, abs=0.004)
    assert track.zero == zero
    assert track.move_to(0.0) == pytest.approx(0.0, abs=0.004)
    track.close()


@pytest.mark.parametrize("what", ["restarted", "moved", "alarm", "Marlin"])
def test_a_zero_that_may_be_lost_meanwhile_ends_the_scan_in_words(
    what: str, tmp_path: Path
) -> None:
    emulator = controller("Marlin" if what == "Marlin" else "Grbl 1.1h")
    says = {
        "restarted": "has restarted, so its position is lost",
        "moved": r"stands at 9 mm since the connection broke, allowed on its way",
        "alarm": "ALARM:1|silent: ",  # the line itself may be lost with the connection
        "Marlin": "Marlin does not report whether it restarted meanwhile",
    }
    with TcpPort(emulator) as line:
        bench = NetworkBench(emulator, line, FRAMES, answer_s=1.0 if what == "alarm" else 60.0)

        def drop() -> None:
            line.drop()
            if isinstance(emulator, MarlinEmulator):
                return
            if what == "restarted":
                emulator.power_cycle()
            if what == "moved":
                emulator.receive(b"$J=G53X9F50000\n")
                while emulator.standing_mm is None:
                    pass
            if what == "alarm":
                emulator.inject(Faults(alarm=True))
                emulator.receive(b"$J=G53X9F50000\n")

        bench.before_grab = {5: drop}
        with pytest.raises(DeviceError, match=says[what]) as caught:
            bench.scan(tmp_path / "a")
    assert not isinstance(caught.value, ConnectionLost)
    assert "\n" not in str(caught.value)
    assert emulator.laser_power == 0
    assert len(open_run(tmp_path / "a")) == 2
    assert not may_be_lit(tmp_path / "a")


def test_a_controller_that_stays_away_ends_the_scan_and_the_laser_may_be_lit(
    bench: NetworkBench, tmp_path: Path
) -> None:
    """What it says first is that the laser may be lit; the run keeps that, and goes on later."""
    line = bench.line
    assert isinstance(line, TcpPort)
    bench.reconnects = 2
    bench.before_grab = {5: line.close}
    with pytest.raises(ConnectionLost, match="cannot be reached") as caught:
        bench.scan(tmp_path / "a")
    assert LASER_MAY_BE_LIT in caught.value.__notes__
    assert bench.controller.laser_power > 0
    assert may_be_lit(tmp_path / "a")
    with TcpPort(bench.controller) as back:
        bench.line, bench.before_grab = back, {}
        bench.require_true(bench.scan(tmp_path / "a"))
    assert not may_be_lit(tmp_path / "a")


def test_a_line_that_breaks_again_and_again_ends_the_scan(
    bench: NetworkBench, tmp_path: Path
) -> None:
    line = bench.line
    assert isinstance(line, TcpPort)
    bench.before_grab = dict.fromkeys(range(3, 30), line.drop)
    with pytest.raises(ConnectionLost, match="the connection broke"):
        bench.scan(tmp_path / "a")
    assert len(open_run(tmp_path / "a")) == 1
