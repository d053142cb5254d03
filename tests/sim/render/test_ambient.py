"""Ambient light from the field on surfaces: closed forms, and estimators that draw at random."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from truth_scenes import tank

from lscan.records import Floats
from sim.render import ambient as field, firstorder as picture
from sim.render.ambient import AmbientField, Interpolation, OpenSky, SurfaceNodes
from sim.render.tank import Tank
from sim.scene import Scene, load_scene
from tests.validation.light.gallery import shrunk

TIMES = 4  # pictures of 160 by 120 px
ROUNDS, EACH = 6, 4  # of the estimators at random, samples a pixel
BLOCK = 20  # px a side
DARK: dict[str, Any] = {"on": False}


def lit(**sections: Any) -> Scene:
    """The lit grooved block on its floor in turbid water, without the laser."""
    water = {"particle_scattering_per_m": 1.0}
    return shrunk(load_scene("targets/lit"), TIMES).with_tank(
        **({"laser": DARK, "water": water} | sections)
    )


def at_random(scene: Scene) -> Floats:
    """(ROUNDS, H, W) ambient light of all orders by directions drawn for every sample.

    With a sampler that is random too: a regular one would draw the same few everywhere.
    """
    here = Tank(scene, sampled=True)
    camera, both = here._random_camera, (here.integrator, here.higher)
    return np.array(
        [
            sum(here._layers(camera, one, EACH, 2 * k + n)["ambient"] for n, one in enumerate(both))
            for k in range(ROUNDS)
        ],
        dtype=float,
    )


def blocks(pictures: Floats) -> Floats:
    """Means over blocks of pixels."""
    height, width = pictures.shape[-2] // BLOCK, pictures.shape[-1] // BLOCK
    parts = pictures.reshape(*pictures.shape[:-2], height, BLOCK, width, BLOCK)
    return parts.mean(axis=(-3, -1))


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes four times as far apart."""
    monkeypatch.setattr(field, "SPACING", 1 / 11)


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["groove", "wave"])
def test_the_field_is_what_estimators_at_random_find(shape: str) -> None:
    """1 % on the mean, 2 % in blocks of the groove's corners and of the block's foot, and three
    standard errors of what is drawn.  About the wave is a curtain, some triangles of which face
    into the block."""
    scene = lit()
    if shape == "wave":
        bare = shrunk(load_scene("paper/sandwave"), TIMES)
        scene = bare.with_tank(laser=DARK, light={"ambient_w_m2_sr": 0.7})
    drawn = blocks(at_random(scene))
    mean, error = drawn.mean(axis=0), drawn.std(axis=0, ddof=1) / np.sqrt(ROUNDS)
    here = Tank(scene)
    assert isinstance(here._sky, AmbientField)
    found = blocks(here.render(0.0, 16, scatter_samples=1).ambient)
    assert np.mean(found / mean) == pytest.approx(1, abs=0.01)
    assert np.all(np.abs(found - mean) < 0.02 * mean + 3 * error)
    open_sky = here
    open_sky._sky = OpenSky()
    flat = blocks(open_sky.render(0.0, 16, scatter_samples=1).ambient)
    assert np.any(np.abs(flat - mean) > 0.05 * mean), "what stands about is seen"


@pytest.mark.usefixtures("coarse")
def test_light_by_way_of_surfaces_is_left_out_with_the_higher_orders() -> None:
    """And is 2 % of the picture here, where the laser's higher orders are kept."""
    here = Tank(lit())
    first, every = (here.render(0.0, 4, scatter_samples=k).ambient for k in (0, 1))
    assert np.all(every >= first - 1e-6)
    assert blocks(every / first).max() > 1.02


@pytest.mark.usefixtures("coarse")
def test_the_light_of_one_sky_is_worked_out_once(monkeypatch: pytest.MonkeyPatch) -> None:
    Tank(lit())
    monkeypatch.setattr(field, "_node_light", None)  # would raise if called
    Tank(lit(sensor={"seed": 2}))


@pytest.mark.usefixtures("coarse")
@pytest.mark.parametrize(
    "other",
    [
        {"target": {"albedo": 0.25}},
        {"water": {"particle_scattering_per_m": 0.5}},
        {"target": {"turn_deg": 12.0}},
    ],
    ids=["albedo", "water", "geometry"],
)
def test_what_is_kept_of_one_sky_is_not_taken_for_anothers(
    other: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second tank finds what the first left; made alone, it has the same to the bit."""
    Tank(lit())
    second = Tank(lit(**other))._sky
    monkeypatch.setattr(field, "_KEPT", {})
    alone = Tank(lit(**other))._sky
    assert isinstance(second, AmbientField)
    assert isinstance(alone, AmbientField)
    for kept, made in zip(
        (second.straight, second.indirect), (alone.straight, alone.indirect), strict=True
    ):
        np.testing.assert_array_equal(np.array(kept), np.array(made))


def wall_scene(folder: Path) -> Scene:
    """A wall 120 mm high and long, which hides half of the sky from its foot, on a floor."""
    wall = folder / "wall.ply"
    trimesh.creation.box((1500.0, 20.0, 120.0)).export(wall)
    return tank(
        camera={"width_px": 64, "height_px": 48},
        lens={"focal_px": 80.0, "centre_px": [31.5, 23.5]},
        target={"shape": "mesh", "file": str(wall), "position_mm": [0.0, 10.0, -240.0]},
        floor={"z_mm": -300.0, "albedo": 0.5},
        laser=DARK,
        light={"ambient_w_m2_sr": 1.0},
        water={"kind": "air"},
    )


def test_a_wall_hides_the_sky_by_its_form_factor(tmp_path: Path) -> None:
    """Of a floor at the distance d from an endless wall of height h, (1 - d / sqrt(d2 + h2)) / 2
    is hidden: but for 1 % of the sky that 512 directions miss, and the wall's ends."""
    sky = Tank(wall_scene(tmp_path))._sky
    assert isinstance(sky, AmbientField)
    nodes = sky.lattice.nodes
    x, y, z = nodes.point_mm.T
    before = (np.abs(x) < 50) & (y < -1) & (y > -300) & (nodes.normal[:, 2] > 0.9) & (z < -299)
    assert before.sum() > 30
    hidden = 0.5 * (1 + y[before] / np.hypot(y[before], 120))
    off = np.array(sky.straight)[before] - (1 - hidden)
    assert np.abs(off).max() < 0.015 and np.std(off) < 0.005
    # The wall's front: half of what it faces is the floor.
    front = (np.abs(x) < 50) & (nodes.normal[:, 1] < -0.9) & (np.abs(z + 290) < 9)
    np.testing.assert_allclose(np.array(sky.straight)[front], 0.5, atol=0.01)


@pytest.mark.parametrize("name", ["paper/board", "metric/water"])
def test_nothing_stands_before_a_board(name: str) -> None:
    assert isinstance(Tank(shrunk(load_scene(name), TIMES))._sky, OpenSky)


@pytest.mark.usefixtures("coarse")
def test_few_rays_show_what_many_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """At a crease a centre is off by an 8th of two second differences; most pixels are even."""
    here, sampled = Tank(lit()), []
    plain = picture._sampled

    def counted(*arguments: Any) -> Any:
        sampled.append(arguments[3].size)
        return plain(*arguments)

    monkeypatch.setattr(picture, "_sampled", counted)
    few = here.render(0.0, 4).ambient
    monkeypatch.setattr(picture, "EVEN", -1.0)
    every = here.render(0.0, 4).ambient
    assert sampled[0] < 0.3 * sampled[1] == 0.3 * every.size
    assert np.all(np.abs(few - every) <= 0.01 / 4 * every)


@pytest.mark.parametrize(
    "sections",
    [{"target": {"finish": "wet"}}, {"head": {"speed_mm_s": 20.0}}],
    ids=["wet", "moved"],
)
def test_what_the_field_cannot_know_is_drawn_at_random(sections: dict[str, Any]) -> None:
    scene = lit(**sections)
    here = Tank(scene)
    assert here._sky is None
    assert here.render(0.0, 4, scatter_samples=0).ambient.std() > 0


def test_what_lies_on_a_plane_is_known_by_samples_on_it() -> None:
    """Many samples 20 mm below count next to nothing, though few above are as near: four times as
    far off, they have at most a sixteenth of the weight, and a plane through both what is left."""
    above, below = (
        np.stack(np.meshgrid(np.arange(-80, 81, step), np.arange(-80, 81, step), [z]), -1)
        for step, z in ((40.0, 20.0), (10.0, 0.0))
    )
    wanted = np.array([[7.0, 11.0, 20.0], [-20.0, 20.0, 20.0], [33.0, -18.0, 20.0]])
    point = np.concatenate([above.reshape(-1, 3), below.reshape(-1, 3), wanted])
    normal, count = np.tile([0.0, 0.0, 1.0], (len(point), 1)), len(point) - 3
    part, inside = np.zeros(len(point), int), np.ones(len(point), bool)
    nodes = SurfaceNodes(point, point, normal, part, inside)
    found = Interpolation(nodes, np.arange(count), np.arange(count, count + 3))
    assert np.all(np.abs(found.of((point[:count, 2] < 10) * 1.0)) < 1 / 16)
