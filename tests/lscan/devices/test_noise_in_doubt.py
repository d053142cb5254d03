"""Noise that the pictures do not determine is reported as doubtful, without lines for the rig."""

from typing import Any

import cv2
import numpy as np
import pytest

from lscan.cli import devices as devices_cli
from lscan.cli.console import show
from lscan.devices.api import Grab
from lscan.devices.photontransfer import ROUNDING_DN, Levels, photon_transfer
from lscan.devices.trials import CameraTrial, noise_section, try_camera
from lscan.records import Bytes

SHAPE = 96, 128
GAIN, READ_DN, BLACK_DN = 0.02, 0.9, 10.0


class Webcam:
    """A linear sensor of fixed exposure before a still scene, and what is done to its pictures."""

    size_px = SHAPE[1], SHAPE[0]

    def __init__(
        self,
        scene_dn: Any,
        quality: int | None = None,
        speckle: float = 0.0,
        flicker: float = 0.0,
        bands: float = 3.0,
        row_dn: float = 0.0,
    ) -> None:
        """quality: of the JPEG.  speckle: contrast of the light, new in each picture.
        flicker: amplitude of a lamp's, ``bands`` periods to a picture; row_dn: the rows' noise."""
        self._flicker, self._bands, self._row_dn = flicker, bands, row_dn
        self._scene_dn, self._quality, self._speckle = scene_dn, quality, speckle
        self._generator, self._time_s = np.random.default_rng(3), 0.0

    def grab(self, frame: int | None = None) -> Grab:
        self._time_s += 0.1
        generator = self._generator
        light = self._scene_dn * np.abs(1 + self._speckle * generator.normal(size=SHAPE))
        phase = self._bands * np.arange(SHAPE[0])[:, None] / SHAPE[0] + generator.random()
        light = light * (1 + self._flicker * np.sin(2 * np.pi * phase))
        light = light + self._row_dn * generator.normal(size=(SHAPE[0], 1))
        value = BLACK_DN + GAIN * generator.poisson(light / GAIN)
        noisy = np.rint(value + generator.normal(0, READ_DN, SHAPE))
        image = np.repeat(np.clip(noisy, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        return Grab(self._coded(image), self._time_s, 10.0)

    def _coded(self, image: Bytes) -> Bytes:
        if self._quality is None:
            return image
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, self._quality])
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)

    def close(self) -> None:
        pass


def lit_scene() -> Any:
    return np.tile(np.linspace(20.0, 200.0, SHAPE[1]), (SHAPE[0], 1))


def dark_scene_with_a_line(first_dn: float = 30.0, last_dn: float = 160.0) -> Any:
    scene = np.full(SHAPE, 4.0)  # 14 DN with the black level: in the middle of a level
    scene[44:52] = np.linspace(first_dn, last_dn, SHAPE[1])
    return scene


def printed(trial: CameraTrial, capsys: pytest.CaptureFixture[str]) -> str:
    show(None, *devices_cli._camera_lines(trial), json=False)
    return capsys.readouterr().out


def as_json(trial: CameraTrial) -> Any:
    return devices_cli._camera_json(trial)


def test_a_lit_scene_of_a_linear_camera_leaves_no_doubt(
    capsys: pytest.CaptureFixture[str],
) -> None:
    trial = try_camera(Webcam(lit_scene()), 16, "red")
    assert trial.doubts == ()
    assert "for the rig file:\n\n[stripe.noise]" in printed(trial, capsys)
    assert as_json(trial)["rig_section"] == trial.noise_section


@pytest.mark.parametrize(
    ("bands", "words"), [(3.0, "bands of 32 rows"), (2.4, "bands of 48 rows"), (0.0, "all rows")]
)
@pytest.mark.parametrize("dimmest", [1.0, 0.3])
def test_a_lamps_flicker_is_said_and_is_no_noise(bands: float, words: str, dimmest: float) -> None:
    """By 5 %, rms 3.5 %: 7 DN of 200, where noise is 2.2; gain and noise are the sensor's."""
    scene = lit_scene() * np.linspace(dimmest, 1, SHAPE[0])[:, None]
    trial = try_camera(Webcam(scene, flicker=0.05, bands=bands), 16, "red")
    assert trial.transfer is not None and trial.doubts == ()
    assert abs(trial.transfer.dn_per_electron - GAIN) < 5 * trial.transfer.gain_sigma
    (said,) = [remark for remark in trial.remarks if remark.startswith("light:")]
    assert words in said
    # Of grey values, which hold the black level too; by 8 phases it is known to a third.
    share = 3.5 * (1 - BLACK_DN / (BLACK_DN + scene.mean()))
    assert float(said.partition("by ")[2].partition(" %")[0]) == pytest.approx(share, rel=0.5)


@pytest.mark.parametrize("row_dn", [0.0, 2.0])
def test_what_has_no_period_is_no_flicker(row_dn: float) -> None:
    trial = try_camera(Webcam(lit_scene(), row_dn=row_dn), 16, "red")
    assert not any(remark.startswith("light:") for remark in trial.remarks)


@pytest.mark.parametrize(
    ("camera", "words"),
    [
        (Webcam(lit_scene(), quality=75), "JPEG pictures"),
        (Webcam(dark_scene_with_a_line(), speckle=0.3), "laser's speckle"),
    ],
    ids=["jpeg", "speckle"],
)
def test_noise_that_is_not_the_sensors_is_not_offered(
    camera: Webcam, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    trial = try_camera(camera, 16, "red")
    assert trial.transfer is not None
    assert any(words in doubt for doubt in trial.doubts)
    text = printed(trial, capsys)
    assert words in text
    assert "for the rig file" not in text
    assert "read_dn =" not in text
    assert as_json(trial)["rig_section"] is None


def test_a_scene_with_too_little_information_says_what_to_show(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Between 80 and 85 DN the line's end at 0 is known to worse than itself."""
    scene = np.tile(np.linspace(80.0, 85.0, SHAPE[1]), (SHAPE[0], 1))
    trial = try_camera(Webcam(scene), 4, "red")
    assert trial.noise_section is None
    assert "printed sheet under a lamp, the laser off" in printed(trial, capsys)


def test_a_line_through_two_levels_proves_nothing() -> None:
    trial = try_camera(Webcam(dark_scene_with_a_line(60.0, 60.0)), 16, "red")
    assert trial.transfer is not None
    assert len(trial.transfer.levels.mean_dn) == 2
    assert trial.noise_section is None


def test_pictures_that_cannot_be_measured_offer_nothing(
    capsys: pytest.CaptureFixture[str],
) -> None:
    trial = try_camera(Webcam(np.full(SHAPE, 500.0)), 4, "red")
    assert trial.transfer is None
    assert as_json(trial)["rig_section"] is None
    assert "for the rig file" not in printed(trial, capsys)


def test_read_noise_at_the_floor_of_rounding_is_a_bound() -> None:
    """Closed form: two levels of 1e6 differences at variance 0.05 + 0.001 DN² a DN."""
    mean_dn = np.array([10.0, 100.0])
    levels = Levels(mean_dn, 0.05 + 0.001 * mean_dn, np.full(2, 1e6), np.zeros(2), np.ones(2))
    found = photon_transfer(levels)
    assert found.read_is_rounding
    assert found.read_dn == pytest.approx(ROUNDING_DN)
    sigma_of_variance = 2 * found.read_dn * found.read_sigma_dn
    assert found.read_at_most_dn**2 == pytest.approx(1 / 12 + 2 * sigma_of_variance)
    assert "of rounding alone" in noise_section(found)


def test_a_bound_is_reported_as_a_bound() -> None:
    mean_dn = np.array([10.0, 100.0])
    levels = Levels(mean_dn, 0.05 + 0.001 * mean_dn, np.full(2, 1e6), np.zeros(2), np.ones(2))
    line = devices_cli._transfer_line(photon_transfer(levels))
    assert "read noise at most 0.289 DN (rounding makes 0.289)" in line
