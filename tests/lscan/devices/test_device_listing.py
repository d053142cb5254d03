"""What is connected, what it can do, and the command ``lscan devices``."""

import json
import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import typer
from fake_capture import World
from plugin_packages import install_package
from typer.testing import CliRunner

from lscan.cli import devices as devices_cli
from lscan.config.documents import check
from lscan.config.rig import NoiseSection, parse_rig
from lscan.devices import listing
from lscan.devices.api import Grab
from lscan.devices.listing import drivers, serial_ports, video_devices
from lscan.devices.opencv_camera import OpencvOptions
from lscan.devices.photontransfer import ROUNDING_DN
from lscan.devices.trials import grab_series, noise_section, try_camera
from lscan.errors import DeviceError, InputError

GAIN, READ_DN, FULL_MS = 0.1, 1.2, 20.0


class LinearCamera:
    """A sensor of known gain and noise before a gradient; its exposure can be set."""

    size_px = (64, 48)
    can_set_exposure = True

    def __init__(self, seed: int = 1) -> None:
        self._generator = np.random.default_rng(seed)
        self._time_s, self._exposure_ms = 0.0, FULL_MS
        self.exposures_ms: list[float] = []
        self.dark = False

    def set_exposure(self, exposure_ms: float) -> float:
        self._exposure_ms = exposure_ms
        self.exposures_ms.append(exposure_ms)
        return exposure_ms

    def accept_black(self) -> None:
        self.dark = True

    def grab(self, frame: int | None = None) -> Grab:
        self._time_s += 0.1
        width, height = self.size_px
        light = 0.0 if self.dark else self._exposure_ms / FULL_MS
        scene_dn = light * np.tile(np.linspace(20, 220, width), (height, 1))
        signal = GAIN * self._generator.poisson(scene_dn / GAIN)
        value = 10 + signal + self._generator.normal(0, READ_DN, signal.shape)
        image = np.clip(np.rint(value), 0, 255).astype(np.uint8)
        colour = np.stack([image, np.zeros_like(image), np.zeros_like(image)], axis=-1)
        return Grab(colour, self._time_s, self._exposure_ms)

    def close(self) -> None:
        pass


class ShortTrack:
    """A track from 0 to 10 mm that reports 0.01 mm more than it was sent to."""

    def __init__(self, position_mm: float = 0.0) -> None:
        self.position_mm = position_mm

    def move_to(self, position_mm: float) -> float:
        if not 0 <= position_mm <= 10:
            raise DeviceError(f"track: cannot move to {position_mm} mm; limits 0 and 10 mm")
        self.position_mm = position_mm + 0.01
        return self.position_mm

    def close(self) -> None:
        pass


# ---- listing ----------------------------------------------------------------------------


def test_the_drivers_say_what_they_are() -> None:
    found = {(driver.kind, driver.name): driver.does for driver in drivers()}
    assert found["camera", "replay"].startswith("A recorded run as a camera and a track")
    assert ("track", "replay") in found


def test_a_driver_that_cannot_be_loaded_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And which package it is from; the others are listed as ever."""
    entries = "[lscan.cameras]\nraspberry = picams:driver\n"
    install_package(monkeypatch, tmp_path, "picams", entries, "import libcamera_of_nobody")
    found = {driver.name: driver.does for driver in drivers() if driver.kind == "camera"}
    assert found.pop("raspberry").startswith(
        "cannot be loaded from the package picams 2.0: ModuleNotFoundError: "
        f"No module named 'libcamera_of_nobody' ({tmp_path}/picams.py line 1)"
    )
    assert not any("cannot be loaded" in does for does in found.values())


def test_without_pyserial_no_port_is_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(listing.sys.modules, "serial.tools.list_ports", None)
    assert serial_ports() is None


@pytest.mark.skipif(listing.sys.platform != "linux", reason="looks for /dev/video* on Linux only")
def test_video_devices_are_asked_what_they_can(tmp_path: Path) -> None:
    (tmp_path / "dev").mkdir()
    for name in ("video0", "video2", "video10"):
        (tmp_path / "dev" / name).touch()

    def takes_small_sizes(key: int, value: float) -> float:
        limits = {cv2.CAP_PROP_FRAME_WIDTH: 640, cv2.CAP_PROP_FRAME_HEIGHT: 480}
        return min(value, limits.get(key, value))

    def open_device(options: OpencvOptions) -> Any:
        if str(options.device).endswith("video2"):
            raise cv2.error("broken\ndriver")
        world = World(obeys=takes_small_sizes)
        world.opened, world.closes = 1, int(str(options.device).endswith("video10"))
        return world.open(options)

    first, second, last = video_devices(open_device, tmp_path)
    assert first.device == str(tmp_path / "dev/video0")
    assert (first.state, first.sizes_px) == ("ready", ((320, 240), (640, 480)))
    assert second.state == "failed: broken driver"
    assert last.state.startswith("cannot be opened")


def test_a_device_that_hangs_does_not_hang_the_list(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(listing, "PROBE_S", 0.05)
    monkeypatch.setattr(listing.sys, "platform", "linux")
    (tmp_path / "dev").mkdir()
    (tmp_path / "dev/video0").touch()
    world = World()

    def hang(options: OpencvOptions) -> Any:
        world.free.wait(300)
        return world.open(options)

    (device,) = video_devices(hang, tmp_path)
    world.free.set()
    assert device.state.startswith("hangs")


# ---- trying out -------------------------------------------------------------------------


def test_a_camera_is_measured_as_it_is() -> None:
    camera, unlit = LinearCamera(), LinearCamera(2)
    unlit.accept_black()
    dark, _ = grab_series(unlit, 8, "red")
    trial = try_camera(camera, 8, "red", dark)
    transfer, straight = trial.transfer, trial.linearity
    assert transfer is not None
    assert straight is not None
    assert abs(transfer.dn_per_electron - GAIN) < 5 * transfer.gain_sigma
    assert abs(transfer.read_dn - np.hypot(READ_DN, ROUNDING_DN)) < 5 * transfer.read_sigma_dn
    # Means over more than 1000 pixels of 8 pictures: noise below 0.1 %.
    assert straight.error_percent < 0.1
    assert trial.dark_dn == pytest.approx(10, abs=5 * 1.24 / np.sqrt(8 * 48 * 64))
    assert trial.timing.rate_hz == pytest.approx(10)
    assert trial.timing.jitter_ms == pytest.approx(0, abs=1e-6)
    assert camera.exposures_ms[-1] == FULL_MS  # set back
    assert not trial.remarks


def test_the_noise_section_can_be_read_as_part_of_a_rig() -> None:
    transfer = try_camera(LinearCamera(), 4, "red").transfer
    assert transfer is not None
    document = tomllib.loads(noise_section(transfer))["stripe"]["noise"]
    section = check(NoiseSection, document, where="section")
    assert section.dn_per_electron == pytest.approx(transfer.dn_per_electron, rel=1e-3)
    assert section.read_dn == pytest.approx(transfer.read_dn, rel=1e-3)


def test_a_camera_whose_exposure_is_fixed_says_so() -> None:
    camera = LinearCamera()
    camera.can_set_exposure = False
    trial = try_camera(camera, 8, "red")
    assert trial.linearity is None
    assert trial.transfer is not None
    assert "exposure time of this camera cannot be set" in trial.remarks[0]


def test_a_black_channel_is_a_remark_not_a_crash() -> None:
    trial = try_camera(LinearCamera(), 4, "blue")
    assert trial.transfer is None
    assert any("unclipped levels" in remark for remark in trial.remarks)


def test_too_few_pictures() -> None:
    with pytest.raises(InputError, match=r"got 3; allowed: 4 or more"):
        grab_series(LinearCamera(), 3, "grey")


# ---- the command ------------------------------------------------------------------------


class _Driver:
    sections: frozenset[str] = frozenset()

    def __init__(self, device: type) -> None:
        self._device = device

    def validate(self, rig_file: object) -> None:
        pass

    def open(self, *_: object) -> Any:
        return self._device()


def _run(*arguments: str, typed: str = "") -> Any:
    app = typer.Typer()
    app.command()(devices_cli.devices)
    return CliRunner().invoke(app, arguments, input=typed)


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    kinds = {"lscan.cameras": _Driver(LinearCamera), "lscan.tracks": _Driver(ShortTrack)}
    monkeypatch.setattr("lscan.config.rig.find_plugin", lambda group, name, where: kinds[group])
    size = {"width_px": 64, "height_px": 48}
    document = {"camera": {"driver": "x", **size}, "track": {"driver": "x"}}
    rig_file = parse_rig(document, source="rig.toml", trusted=True)
    monkeypatch.setattr(devices_cli, "load_rig", lambda path: rig_file)
    return tmp_path / "rig.toml"


def test_the_list_as_json_and_in_words() -> None:
    listed = json.loads(_run("--json").stdout)
    assert set(listed) == {"cameras", "genicam_cameras", "serial_ports", "drivers"}
    assert {"kind", "name", "does"} == set(listed["drivers"][0])
    assert "replay" in _run().stdout


def test_a_trial_as_json(rig: Path) -> None:
    result = _run(str(rig), "--test", "--pictures", "4", "--approaches", "2", "--json")
    content = json.loads(result.stdout)
    transfer = content["camera"]["transfer"]
    assert abs(transfer["dn_per_electron"] - GAIN) < 5 * transfer["gain_sigma"]
    assert content["camera"]["rig_section"].startswith("[stripe.noise]\nread_dn = ")
    assert content["camera"]["settings"] == []
    commanded_mm = [move["commanded_mm"] for move in content["track"]["moves"]]
    assert commanded_mm == [0.0, 1.0, 2.0, 1.0, 0.0, 1.0, 2.0, 1.0, 0.0]
    assert content["track"]["repeatability"]["deviation_mm"] == pytest.approx(0.01)
    assert content["track"]["facts"] == {}


def test_a_trial_in_words_with_the_cap_first(rig: Path) -> None:
    result = _run(str(rig), "--test", "--dark", "--pictures", "4", typed="\n\n")
    dark_dn = float(result.stdout.partition("dark: ")[2].split()[0])
    # 10 DN; the mean of 4 pictures of 3072 pixels scatters by 0.011 DN, and is rounded to 0.01.
    assert dark_dn == pytest.approx(10, abs=5 * 0.011 + 0.005)
    assert "[stripe.noise]" in result.stdout
    assert "put the cap on" in result.output


def test_a_trial_needs_a_rig() -> None:
    result = _run("--test")
    assert isinstance(result.exception, InputError)
    assert "lscan devices RIG --test" in str(result.exception)
