"""Each chapter of the evidence passes, and fails where the tank is made wrong."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import ROOT

from sim.render.plugins.camera import RefractiveCamera
from sim.render.plugins.sheet import LaserSheet
from sim.render.tank import Tank
from sim.scene import load_scene
from tests.validation.light import (
    energy,
    laserleg,
    ports,
    projection,
    refraction,
    sensor,
    single,
    water as matter,
    water as phases,
)
from tests.validation.light.chapters import QUICK, chapters
from tests.validation.light.gallery import gallery, least_samples, shrunk
from tests.validation.rows import Topic


def beyond(check: Topic) -> list[str]:
    return [row.what for row in check.rows if not row.passed]


CHAPTERS = {
    "ports": lambda: ports.ports(2),
    "projection": lambda: projection.projection(2),
    "refraction": refraction.refraction,
    "matter": matter.matter,
    "phases": phases.phases,
    "single": lambda: single.single_scattering(2),
    "laser leg": lambda: laserleg.laser_leg(1 << 20),
    "energy": energy.energy,
    "sensor": sensor.sensor,
}
SLOW = {"laser leg"}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in CHAPTERS],
)
def test_the_chapter_passes(name: str) -> None:
    check = CHAPTERS[name]()
    assert beyond(check) == []
    assert check.rows and all(row.reference and row.tolerance_from for row in check.rows)
    assert len(check.text.split(". ")) >= 2


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


@pytest.mark.slow
def test_a_quick_chapter_has_every_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """The two chapters that take minutes otherwise, with the least effort: all rows, all finite.

    In one water of the three, which differ in numbers alone; make validate QUICK=1 runs them all.
    """
    monkeypatch.setattr("tests.validation.light.chapters.WATERS", ("coastal",))
    box, orders = (chapters(QUICK)[name]() for name in ("closed box", "all orders of scattering"))
    assert len(box.rows) == 1 and len(orders.rows) == 6
    assert all(np.isfinite(row.figure) and row.noisy for row in (*box.rows, *orders.rows))


@pytest.mark.slow
def test_the_gallery_takes_a_picture_of_each_scene() -> None:
    """Those cut into 2 by 2 and 3 by 3 parts a pixel too, which 4 samples do not divide into.

    In pictures an eighth as wide and high, of as many samples a pixel.
    """
    plates, rows = gallery(ROOT / "scenes" / "best", quick=True)
    assert [row.error for row in rows] == [""] and rows[0].passed
    assert [plate.file for plate in plates] == ["board.toml", "groove.toml", "sandwave.toml"]
    assert all(plate.uri.startswith("data:image/jpeg;base64,") for plate in plates)


def test_a_scene_that_cannot_be_rendered_is_a_failed_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b", "c"):
        (tmp_path / f"{name}.toml").write_text('name = "x"\n[target]\nshape = "none"\n')

    def taken(scene: Any, file: Path, quick: bool) -> object:
        if file.name == "b.toml":
            raise ValueError("a ray has no end")
        return f"picture of {file}"

    monkeypatch.setattr("tests.validation.light.gallery.load_scene", lambda path: path)
    monkeypatch.setattr("tests.validation.light.gallery.plate", taken)
    plates, (count, failed) = gallery(tmp_path)
    assert plates == ["picture of a.toml", "picture of c.toml"]
    assert (count.figure, count.passed) == (1, False)
    assert failed.what == "picture of the scene b.toml" and failed.passed is False
    assert "a ray has no end" in failed.error and "ValueError" in failed.error


@pytest.mark.parametrize("fineness", [1, 2, 3, 5])
@pytest.mark.parametrize("wanted", [1, 4, 9, 16, 17])
def test_the_fewest_samples_fill_each_part_with_a_square(wanted: int, fineness: int) -> None:
    samples = least_samples(wanted, fineness)
    side = np.sqrt(samples / fineness**2)
    assert samples >= wanted and side == round(side)
    # One sample fewer a side of each part would be too few.
    assert (fineness * (round(side) - 1)) ** 2 < wanted


@pytest.mark.slow
def test_a_shrunk_picture_shows_the_same_view() -> None:
    """An eighth as wide and high, each of its pixels is the mean of 64: the plates agree."""
    scene = load_scene(ROOT / "scenes" / "paper" / "board.toml")
    whole = Tank(scene).render(0.0, 16, scatter_samples=0).ambient
    small = Tank(shrunk(scene, 8)).render(0.0, 64, scatter_samples=0).ambient
    assert small.shape == (60, 80)
    means = whole.reshape(60, 8, 80, 8).mean(axis=(1, 3))
    # Marks of 2 px in an eighth of the picture: 16 and 64 samples place their edges to 1/8 px.
    assert np.abs(small - means).mean() < 0.02 * means.mean()
