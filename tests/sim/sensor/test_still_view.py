"""Views kept of a still place: the same light and the same noise as a picture exposed anew."""

import numpy as np
import pytest
from numpy.typing import NDArray
from sensor_scenes import EXPOSURE_MS, layers_of, sensor_scene

from lscan.errors import InputError
from sim.sensor import Webcam

PICTURES = 150
SIZE = (32, 24)


def exposed(sensor: dict[str, object], still: bool) -> NDArray[np.float64]:
    """(PICTURES, H, W, 3) of a field half dark, half speckled, by one way or the other."""
    scene = sensor_scene(SIZE, **sensor)
    webcam = Webcam(scene)
    per_unit = float(webcam.mean_electrons(layers_of(scene, direct=1.0), EXPOSURE_MS)[0, 0, 0])
    direct = np.zeros((SIZE[1], SIZE[0]), np.float32)
    direct[10:] = 3000 / per_unit
    layers = layers_of(scene, direct=direct, scattered=500 / per_unit, ambient=100 / per_unit)
    generator = np.random.default_rng(5 + still)
    if still:
        view = webcam.still(layers, EXPOSURE_MS)
        pictures = [view.picture(generator) for _ in range(PICTURES)]
    else:
        pictures = [webcam.expose(layers, EXPOSURE_MS, generator) for _ in range(PICTURES)]
    return np.array(pictures, dtype=float)


@pytest.mark.parametrize(
    "sensor",
    [
        {"speckle": "depolarised", "prnu": 0.05, "dsnu_e": 40.0},
        {"speckle": "none", "hot_pixels": 0.05},
        {"speckle": "polarised", "bayer": "RGGB"},
        {"speckle": "depolarised", "dark_noise_e": 2.0},
        {"speckle": "depolarised", "gamma": 2.2},
    ],
    ids=["patterns", "no speckle", "bayer", "quiet", "gamma"],
)
def test_mean_and_noise_are_those_of_a_picture_exposed_anew(sensor: dict[str, object]) -> None:
    """Every pixel's mean within 6 standard errors; every region's variance within 6 of its own.

    The variance of each pixel is known from N pictures to the share sqrt(2/(N - 1)), and more
    where the speckle's gamma law has excess kurtosis, 6 C^2 at most 6: sqrt(2 + 6)/sqrt(N).
    Averaged over the pixels of a region and colour, some correlated by the Bayer filter's
    neighbourhood of 9, to sqrt(9/K) of that.
    """
    anew, still = exposed(sensor, still=False), exposed(sensor, still=True)
    spread = np.sqrt((anew.var(axis=0) + still.var(axis=0)) / PICTURES) + 1e-3
    assert np.all(np.abs(anew.mean(axis=0) - still.mean(axis=0)) < 6 * spread)
    for rows in (slice(0, 8), slice(12, 24)):
        one, other = (p.var(axis=0)[rows].reshape(-1, 3) for p in (anew, still))
        share = 6 * np.sqrt(2 * 8 / PICTURES * 9 / len(one))
        assert np.all(np.abs(one.mean(axis=0) - other.mean(axis=0)) < share * one.mean(axis=0))


def test_no_two_pictures_are_alike() -> None:
    pictures = exposed({"dark_noise_e": 53.0}, still=True)
    assert len({picture.tobytes() for picture in pictures}) == PICTURES


def test_a_sensor_without_noise_is_refused() -> None:
    scene = sensor_scene(SIZE, noise=False)
    with pytest.raises(InputError, match=r"sensor\.noise"):
        Webcam(scene).still(layers_of(scene), EXPOSURE_MS)
