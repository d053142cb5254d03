"""Each chapter of the evidence passes, and fails where the tank is made wrong."""

from typing import Any

import numpy as np
import pytest

from sim.render.plugins.camera import RefractiveCamera
from sim.render.plugins.sheet import LaserSheet
from tests.validation.light import (
    laserleg,
    ports,
    projection,
    sensor,
    single,
    water as matter,
    water as phases,
)
from tests.validation.rows import Topic


def beyond(check: Topic) -> list[str]:
    return [row.what for row in check.rows if not row.passed]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["flat", "dome"])
def test_a_glass_a_thousandth_off_breaks_the_ports(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A glass index 0.001 wrong in the closed form only is seen in the rays of either port."""
    right = RefractiveCamera.make_port

    def wrong(camera: Any, port: Any, glass: float, water: float) -> Any:
        return right(camera, port, glass + 1e-3, water)

    monkeypatch.setattr(RefractiveCamera, "make_port", wrong)
    found = ports.deviations(kind, 3)
    assert found.error_px.max() > 0.005


@pytest.mark.slow
def test_a_camera_a_hundredth_pixel_off_breaks_the_projection(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    right = projection.project
    monkeypatch.setattr(projection, "project", lambda *a: right(*a) + np.array([0.01, 0.0]))
    assert len(beyond(projection.projection(1))) == 4


def test_wrong_matter_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A unit in the sixth decimal of the index, and 1 % of absorption, break their rows."""
    index, absorption, glass = (
        matter.refractive_index, matter.absorption_per_m, matter.glass_index,
    )  # fmt: skip
    monkeypatch.setattr(matter, "refractive_index", lambda *a: index(*a) + 1e-6)
    monkeypatch.setattr(matter, "absorption_per_m", lambda *a: 1.01 * absorption(*a))
    monkeypatch.setattr(matter, "glass_index", lambda *a: glass(*a) + 1e-6)
    failed = beyond(matter.matter())
    for start in ("index of water relative to air", "absorption of pure water", "index of PMMA"):
        assert any(what.startswith(start) for what in failed), (start, failed)


def test_a_wrong_phase_function_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """One Henyey-Greenstein lobe in the mixture's place fails in value and in backscatter."""

    def lobe(angle: np.ndarray) -> np.ndarray:
        return (1 - 0.924**2) / (4 * np.pi * (1 + 0.924**2 - 1.848 * np.cos(angle)) ** 1.5)

    fournier, _, petzold = phases.particles()
    monkeypatch.setattr(phases, "particles", lambda: (fournier, lobe, petzold))
    failed = beyond(phases.phases())
    assert any("lobes over Petzold" in what for what in failed)
    assert "fitted lobes, backscattered share" in failed


def test_a_tenth_of_a_percent_of_veil_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    right = single.rendered
    monkeypatch.setattr(single, "rendered", lambda sight: 1.001 * right(sight))
    assert len(beyond(single.single_scattering(1))) == 1


@pytest.mark.parametrize("widths", [0.0, 4.0])
def test_light_from_the_apex_is_noticed(widths: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Did light leave each point of a parallel sheet away from the apex, what the water turns
    on its way to the floor would be 21 % too little on the line and 4 % too much beside it."""
    monkeypatch.setattr(LaserSheet, "curvature", lambda sheet, rho: 1 / rho)
    monkeypatch.setattr(laserleg, "PLACES", ((0.0, widths),))
    found, error = laserleg.deviation("parallel", 1 << 20)
    assert found > 0.02 + 4 * error


def test_wrong_noise_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dark noise 5 % off its declaration shows in the variance, a 1 % gain in the mean."""
    right = sensor.expose
    scene = sensor.scene_with(lens=sensor.PLAIN_LENS, sensor={"dark_noise_e": 53.0})
    assert max(sensor.noise_deviations(scene, 0.05)) <= sensor.STANDARD_ERRORS

    def louder(scene: Any, layers: Any) -> np.ndarray:
        changed = scene.tank.sensor.model_copy(update={"dark_noise_e": 1.05 * 53.0})
        tank = scene.tank.model_copy(update={"sensor": changed})
        return right(type(scene)(scene.rig, tank, scene.document, scene.source), layers)

    monkeypatch.setattr(sensor, "expose", louder)
    assert sensor.noise_deviations(scene, 0.05)[1] > sensor.STANDARD_ERRORS
    monkeypatch.setattr(sensor, "expose", lambda *a: 1.01 * right(*a))
    assert sensor.noise_deviations(scene, 0.05)[0] > sensor.STANDARD_ERRORS
