"""Auto exposure: what it meters, what it reports, and that a resumed scan gets the same bytes."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from places import SCENES
from sensor_scenes import layers_of, sensor_scene

from lscan.config.rig import RigFile, load_rig, parse_rig
from lscan.errors import InputError
from sim.devices import SimCamera, SimTrack, TrackOptions, camera_driver
from sim.render.layers import Layers
from sim.scene import Scene
from sim.sensor import Webcam

PAPER = SCENES / "paper"


class StillTank:
    """A tank that shows a ramp of laser light, ten times brighter behind position 5."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene

    def take(self, scene: Scene) -> None:
        """Nothing of this tank changes from picture to picture."""

    def render(self, position_mm: float, **_: float) -> Layers:
        width = self._scene.rig.camera.width_px
        peak = 0.5 if position_mm > 5 else 0.05
        return layers_of(self._scene, direct=peak * np.arange(width) / (width - 1))


def rig_with(**options: object) -> RigFile:
    document = dict(load_rig(PAPER / "board.toml").document)
    document["camera"] = {
        **document["camera"], "width_px": 160, "height_px": 120, "options": options,
    }  # fmt: skip
    document["sensor"] = {**document["sensor"], "speckle": "none"}  # it has no upper end
    document["lens"] = {**document["lens"], "focal_px": 212.5, "centre_px": [79.5, 59.5]}
    return parse_rig(document, source="exposure")


@pytest.fixture
def track(monkeypatch: pytest.MonkeyPatch) -> SimTrack:
    monkeypatch.setattr("sim.render.tank.Tank", StillTank)
    return SimTrack(TrackOptions())


def opened(track: SimTrack, **options: object) -> SimCamera:
    return camera_driver.open(rig_with(**options), track)


@examples(25)
@given(
    target=st.floats(60, 250), gamma=st.floats(1, 2.5), gain=st.floats(1, 3),
    peak=st.floats(1e-3, 10),
)  # fmt: skip
def test_metering_puts_the_percentile_at_the_target(
    target: float, gamma: float, gain: float, peak: float
) -> None:
    """A noise-free picture at the metered exposure; bar: the rounding to a grey value."""
    scene = sensor_scene((128, 96), noise=False, gamma=gamma, gain=gain)
    webcam = Webcam(scene)
    layers = layers_of(scene, direct=peak * np.linspace(0, 1, 128 * 96).reshape(96, 128))
    exposure_ms = webcam.metered_ms(layers, target, 99.0)
    image = webcam.expose(layers, exposure_ms, np.random.default_rng(0))
    assert np.percentile(image.max(axis=-1), 99.0) == pytest.approx(target, abs=0.51)


def test_without_it_the_rig_says_how_long(track: SimTrack) -> None:
    assert opened(track).grab().exposure_ms == 20.0
    assert opened(track, target_dn=100).grab().exposure_ms == 20.0


def test_the_grab_reports_the_exposure_used(track: SimTrack) -> None:
    """Ten times the light, a tenth of the exposure, and the same grey value but for noise."""
    camera = opened(track, auto_exposure=True, target_dn=150, percentile=99)
    dim = camera.grab(0)
    track.move_to(10.0)
    bright = camera.grab(1)
    assert dim.exposure_ms == pytest.approx(10 * bright.exposure_ms, rel=1e-5)
    for grab in (dim, bright):
        # Noise of 2 DN at most over 1 % of 19200 pixels moves the percentile by less than 3.
        assert np.percentile(grab.image[..., 0], 99) == pytest.approx(150, abs=3)


def test_the_exposure_stays_within_its_limits(track: SimTrack) -> None:
    for limits in ({"min_ms": 90.0}, {"max_ms": 0.2}):
        camera = opened(track, auto_exposure=True, **limits)
        assert camera.grab().exposure_ms in limits.values()
    dark = Webcam(sensor_scene((32, 24)))
    assert dark.metered_ms(layers_of(sensor_scene((32, 24))), 200.0, 99.9) == float("inf")


def test_a_picture_does_not_depend_on_those_before(track: SimTrack) -> None:
    first = opened(track, auto_exposure=True)
    first.grab(0)
    track.move_to(10.0)
    picture, again = first.grab(1), opened(track, auto_exposure=True).grab(1)
    assert picture.image.tobytes() == again.image.tobytes()
    assert picture.exposure_ms == again.exposure_ms


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"auto_exposure": "yes"}, r"camera\.options\.auto_exposure"),
        ({"target_dn": 255}, r"camera\.options\.target_dn: .*below 255"),
        ({"min_ms": 5, "max_ms": 2}, r"camera\.options: min_ms must not be above max_ms"),
        ({"auto_exposure": True, "target_dn": 2}, r"target_dn: is no brighter than black"),
    ],
)
def test_options_are_strict(options: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        camera_driver.validate(rig_with(**options))
