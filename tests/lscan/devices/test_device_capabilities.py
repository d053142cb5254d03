"""A rig's capabilities, stated without opening devices; what a camera made of its settings."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import typer
from fake_capture import HEIGHT_PX, WIDTH_PX, World
from places import SCENES
from typer.testing import CliRunner

from lscan.acquisition.writer import create_run
from lscan.cli import devices as devices_cli
from lscan.cli.console import show
from lscan.config.rig import CameraSection, RigFile, load_rig, parse_rig
from lscan.devices.api import Fact, Grab
from lscan.devices.listing import rig_devices
from lscan.devices.opencv_camera import OpencvCamera, OpencvOptions
from lscan.devices.trials import try_camera
from lscan.records import Frame

NOWHERE = "/nowhere/that/exists"
SANDWAVE = SCENES / "paper" / "sandwave.toml"
SERIAL = {"port": NOWHERE, "min_mm": 0, "max_mm": 180, "homing": False}

# ---- capabilities -----------------------------------------------------------------------


def rig(camera: dict[str, Any], track: dict[str, Any]) -> RigFile:
    size = {"width_px": WIDTH_PX, "height_px": HEIGHT_PX, "exposure_ms": 5.0}
    return parse_rig({"camera": {**size, **camera}, "track": track}, source="rig.toml")


def opencv(**options: Any) -> dict[str, Any]:
    return {"driver": "opencv", "options": options}


def grbl(**options: Any) -> dict[str, Any]:
    return {"driver": "grbl", "options": {**SERIAL, **options}}


def test_of_hardware_that_is_not_there() -> None:
    """Nothing is opened: neither device exists."""
    found = rig_devices(rig(opencv(device=NOWHERE), grbl()))
    assert found["camera"] == {
        "driver": "opencv",
        "width_px": WIDTH_PX,
        "height_px": HEIGHT_PX,
        "exposure_ms": 5.0,
        "takes_dark_pictures": True,
        "device": NOWHERE,
        "exposure_settable": True,
    }
    assert found["track"] == {
        "driver": "grbl",
        "switches_laser": True,
        "port": NOWHERE,
        "dialect": "grbl",
        "min_mm": 0.0,
        "max_mm": 180.0,
        "tolerance_mm": 0.02,
        "homes_on_opening": False,
    }


@pytest.mark.parametrize(
    ("options", "settable"),
    [
        ({"device": 0}, True),
        ({"device": 0, "auto_exposure": True}, False),
        ({"url": "http://127.0.0.1:1/a"}, False),
    ],
)
def test_exposure_is_settable_as_the_opened_camera_says(
    options: dict[str, Any], settable: bool
) -> None:
    assert rig_devices(rig(opencv(**options), grbl()))["camera"]["exposure_settable"] is settable
    section = CameraSection(driver="opencv", width_px=WIDTH_PX, height_px=HEIGHT_PX)
    world = World()
    camera = OpencvCamera(section, OpencvOptions(**options), world.open)
    assert camera.can_set_exposure is settable
    camera.close()


def test_a_hand_crank_switches_no_laser() -> None:
    manual = {"driver": "manual", "options": {"min_mm": 0, "max_mm": 300}}
    track = rig_devices(rig(opencv(device=0), manual))["track"]
    assert track == {
        "driver": "manual",
        "switches_laser": False,
        "min_mm": 0.0,
        "max_mm": 300.0,
        "tolerance_mm": 0.5,
    }


def test_of_a_recorded_run(tmp_path: Path) -> None:
    """Three frames, of which the track missed the last by the most."""
    recorded = rig({"driver": "gone"}, {"driver": "gone"})
    document = {**recorded.document, "plan": {"start_mm": 10.0, "step_mm": 0.5, "frames": 3}}
    with create_run(tmp_path / "a", parse_rig(document, "rig.toml", trusted=True)) as writer:
        for index, miss_mm in enumerate((0.0, 0.001, -0.004)):
            image = np.full((HEIGHT_PX, WIDTH_PX), 50 + index, np.uint8)
            place_mm = 10.0 + 0.5 * index
            writer.append(Frame(image, index, place_mm, place_mm + miss_mm, float(index), 5.0))
    replay = {"driver": "replay", "options": {"run_file": str(tmp_path / "a")}}
    found = rig_devices(rig(replay, replay))
    assert found["camera"]["recorded_frames"] == 3
    assert (found["track"]["min_mm"], found["track"]["max_mm"]) == (10.0, 11.0)
    assert found["track"]["tolerance_mm"] == pytest.approx(0.004)


def test_of_the_tank() -> None:
    found = rig_devices(load_rig(SANDWAVE))
    assert found["camera"]["exposure_settable"] is False
    assert found["track"]["switches_laser"] is True
    assert (found["track"]["min_mm"], found["track"]["max_mm"]) == (-1000.0, 1000.0)


def test_a_driver_of_somebody_else_need_not_state_capabilities(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("lscan.config.rig.find_plugin", lambda *_, **__: object())
    found = rig_devices(parse_rig({"camera": {"driver": "x"}, "track": {"driver": "y"}}, "rig"))
    expected: dict[str, Fact] = {"driver": "y", "switches_laser": False}
    assert found["track"] == expected
    assert found["camera"]["takes_dark_pictures"] is False


def test_the_command_lists_them(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(
        'camera = { driver = "opencv", options = { device = 7 } }\n'
        f'track = {{ driver = "grbl", options = {{ port = "{NOWHERE}", min_mm = 0, max_mm = 9 }} }}'
    )
    listed = json.loads(run("devices", str(file), "--json"))
    assert listed["rig"]["track"]["port"] == NOWHERE
    words = run("devices", str(file))
    for line in ("exposure_settable", "switches_laser", "homes_on_opening"):
        assert any(line in row and "yes" in row for row in words.splitlines()), line


def run(command: str, *arguments: str) -> str:
    app = typer.Typer()
    app.command()(devices_cli.devices)
    app.callback()(lambda: None)
    result = CliRunner().invoke(app, [command, *arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


# ---- settings ---------------------------------------------------------------------------


def deaf_to_gain(property_id: int, value: float) -> float:
    return 1.0 if property_id == cv2.CAP_PROP_GAIN else value


def test_settings_are_listed_and_the_ignored_marked(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lscan.devices.opencv_camera.options.AGAIN_WAIT_S", 0.0)
    section = CameraSection(driver="opencv", width_px=WIDTH_PX, height_px=HEIGHT_PX)
    options = OpencvOptions(device=0, gain=30, focus=12, warm_up_frames=0)
    camera = OpencvCamera(section, options, World(obeys=deaf_to_gain).open)
    trial = try_camera(camera, 4, "red")
    camera.close()
    found = {
        setting.name: (setting.asked, setting.got, setting.obeyed) for setting in trial.settings
    }
    assert found["gain"] == (30.0, 1.0, False)
    assert found["focus"] == (12.0, 12.0, True)
    assert {name for name, (_, _, obeyed) in found.items() if not obeyed} == {"gain"}
    show(None, *devices_cli._camera_lines(trial), json=False)
    marked = [
        line for line in capsys.readouterr().out.splitlines() if "│ no" in " ".join(line.split())
    ]
    assert len(marked) == 1
    assert "gain" in marked[0]


# ---- doubts about the noise -------------------------------------------------------------


class Sensor:
    """Poisson light through a curve, 0.1 DN an electron, and 1.2 DN of read noise; seed 6.

    It looks at a ramp from ``scene_dn[0]`` to ``scene_dn[1]``.
    """

    size_px = (64, 48)

    def __init__(self, scene_dn: tuple[float, float] = (5.0, 220.0), gamma: float = 1.0) -> None:
        width, height = self.size_px
        self._scene_dn = np.tile(np.linspace(*scene_dn, width), (height, 1))
        self._gamma, self._generator = gamma, np.random.default_rng(6)
        self._time_s = 0.0

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        self._time_s += 0.1
        light_dn = 0.1 * self._generator.poisson(self._scene_dn / 0.1)
        curved_dn = 255 * (light_dn / 255) ** self._gamma
        value = 10 + curved_dn + self._generator.normal(0, 1.2, curved_dn.shape)
        return Grab(np.clip(np.rint(value), 0, 255).astype(np.uint8), self._time_s, 20.0)

    def close(self) -> None:
        pass


def noise_doubts(sensor: Sensor, pictures: int = 16) -> tuple[str, ...]:
    trial = try_camera(sensor, pictures, "grey")
    assert trial.transfer is not None
    return trial.doubts


def test_a_linear_sensor_raises_no_doubt() -> None:
    assert noise_doubts(Sensor()) == ()


def test_a_gamma_curve_raises_doubt() -> None:
    """Behind a gamma of 0.45 the light's noise falls where it grows: a gain below nought."""
    doubts = noise_doubts(Sensor(gamma=0.45))
    assert any("gamma curve" in doubt for doubt in doubts)


def test_a_bent_line_raises_doubt() -> None:
    """Behind a gamma g the light's variance goes with its power 2 g - 1, so with 0.6 for 0.8."""
    doubts = noise_doubts(Sensor((0.0, 250.0), gamma=0.8), pictures=64)
    assert any("gamma curve" in doubt for doubt in doubts)


def test_a_scene_of_one_brightness_leaves_the_noise_open() -> None:
    """Over 5 DN of light, 1.5 DN in the standard deviation, the slope is poorly determined.

    A pair of 3072 pixels gives a variance of 7 DN² to 2.6 %, the slope to 0.18 / 1.5 = 0.12, more
    than its 0.1; at no light, 58 DN further down, the variance is open by 7 DN², not known at all.
    """
    doubts = noise_doubts(Sensor((56.0, 61.0)), pictures=4)
    assert any("leave it open" in doubt for doubt in doubts)
