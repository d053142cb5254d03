"""Gathered light in whole pictures: what it does as settings say, and never otherwise."""

import logging
from typing import Any

import drjit as dr
import numpy as np
import pytest

from sim.render.gathered.picture import EDGE_SAMPLES, _cut_pixels
from sim.render.layers import Layers
from sim.render.tank import Tank
from sim.scene import LaserLine, Scene, load_scene
from sim.scene.instrument import Drift
from tests.validation.light.gallery import shrunk

TIMES = 8  # pictures of 80 by 60 px
SAMPLES = 16
POSITION_MM = 1.0


def small(name: str = "paper/groove", **sections: Any) -> Scene:
    """The named scene in a small picture, in full physics."""
    scene = shrunk(load_scene(name), TIMES)
    return scene.with_tank(**({"render": {"scatter_samples": 1}} | sections))


@pytest.fixture(scope="module")
def groove() -> Tank:
    return Tank(small())


@pytest.fixture(scope="module")
def picture(groove: Tank) -> Layers:
    return groove.render(POSITION_MM, SAMPLES)


def test_pictures_hold_all_families_and_first_order_none(groove: Tank, picture: Layers) -> None:
    """Without samples of scattered light there is none of higher orders; the line stays."""
    first = groove.render(POSITION_MM, SAMPLES, scatter_samples=0)
    families = groove.higher_orders(POSITION_MM, SAMPLES)
    assert set(families) == {"surfaces", "camera", "veil"}
    assert all(light.max() > 0 and light.min() >= 0 for light in families.values())
    more = picture.scattered - first.scattered
    np.testing.assert_allclose(more, sum(families.values()), rtol=1e-3, atol=1e-5 * more.max())
    np.testing.assert_array_equal(picture.direct, first.direct)
    assert Tank(small(render={"scatter_samples": 0}))._gathered is None


def test_pictures_are_repeated_bit_for_bit(groove: Tank, picture: Layers) -> None:
    """After another place, and by another tank with other random numbers."""
    groove.render(POSITION_MM + 5, SAMPLES)
    other = Tank(small(render={"scatter_samples": 1, "seed": 5}))
    for tank in (groove, other):
        again = tank.render(POSITION_MM, SAMPLES)
        np.testing.assert_array_equal(again.scattered, picture.scattered)
        np.testing.assert_array_equal(again.direct, picture.direct)


def test_pictures_do_not_depend_on_the_number_of_threads(groove: Tank) -> None:
    pictures, before = [], dr.thread_count()
    for count in (1, 2):
        dr.set_thread_count(count)
        pictures.append(groove.render(POSITION_MM, SAMPLES))
    dr.set_thread_count(before)
    for name in ("direct", "scattered"):
        np.testing.assert_array_equal(*(getattr(one, name) for one in pictures))


def test_no_kernel_is_compiled_anew_from_picture_to_picture(groove: Tank, picture: Layers) -> None:
    """From the second on: the first also evaluates what all of them share."""
    groove.render(POSITION_MM + 3, SAMPLES)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        groove.render(POSITION_MM + 7, SAMPLES)
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    assert len(kernels) > 3 and all(kernel["cache_hit"] for kernel in kernels)


def test_pixels_where_surfaces_end_are_cut_near_the_line() -> None:
    """The line's into 13 rows a column together, others on an edge into four samples."""
    direct, bent = np.zeros((96, 8), np.float32), np.zeros((96, 8), bool)
    direct[40:43, :6], bent[[50, 90], 2] = 1.0, True
    pixels, samples = _cut_pixels(direct, bent)
    cut = dict(zip(pixels.tolist(), samples.tolist(), strict=True))
    assert cut.pop(50 * 8 + 2) == EDGE_SAMPLES
    assert cut == {8 * row + column: 5 for row in (40, 41, 42) for column in range(6)}


def test_samples_of_a_pixel_lie_within_it_and_even_out(groove: Tank) -> None:
    """Between the rays of its neighbours half a pixel away, and about its own in the mean: of n
    samples a golden fraction apart to 1/n of a pixel, as any interval of theirs is."""
    groove.render(POSITION_MM)
    gathered = groove._gathered
    assert gathered is not None
    width = gathered._rays.size_px[0]
    pixel = np.array([width * 20 + 30])
    ways = gathered._pixel_rays[:, 3:].T
    right, down = (ways[:, pixel + step] - ways[:, pixel] for step in (1, width))
    for count in (EDGE_SAMPLES, 13):
        found = gathered._within(pixel, np.array([count]))[:, 3:].T
        offsets = np.linalg.lstsq(np.hstack([right, down]), found - ways[:, pixel], rcond=None)[0]
        assert np.all(np.abs(offsets) < 0.502)
        assert np.all(np.abs(offsets.mean(axis=1)) < 1 / count)
        assert np.all(np.ptp(offsets, axis=1) > 1 - 2 / count)


def test_sheets_add_up(picture: Layers) -> None:
    """Two sheets of half the power in one place are one."""
    half = LaserLine(tilt_deg=0.0, share=0.5)
    two = Tank(small(laser={"lines": (half, half)})).render(POSITION_MM, SAMPLES)
    peak = picture.scattered.max()
    np.testing.assert_allclose(two.scattered, picture.scattered, rtol=1e-3, atol=1e-4 * peak)


def test_finer_pictures_hold_the_same_light(groove: Tank, picture: Layers) -> None:
    """Their samples lie in the same places, of which each part of a pixel has a quarter."""
    tank = Tank(small(render={"scatter_samples": 1, "fineness": 2}))
    fine = tank.render(POSITION_MM, SAMPLES)
    assert fine.scattered.shape == tuple(2 * side for side in picture.scattered.shape)
    found = fine.binned(picture.scattered.shape).scattered
    peak = picture.scattered.max()
    np.testing.assert_allclose(found, picture.scattered, rtol=1e-3, atol=1e-4 * peak)


def test_sampled_light_is_random(picture: Layers) -> None:
    """Where it is asked for, other seeds are other pictures, and nothing is noted."""
    settings = {"scatter_samples": 1, "light": "sampled"}
    tanks = [Tank(small(render=settings | {"seed": seed})) for seed in (1, 2)]
    assert not any(tank.gathers for tank in tanks)
    one, two = (tank.render(POSITION_MM, 1).scattered for tank in tanks)
    assert np.mean(one != two) > 0.5


@pytest.mark.parametrize(
    ("sections", "reason"),
    [
        ({"target": {"finish": "wet"}}, "target.finish"),
        ({"target": {"finish": "mirror"}}, "target.finish"),
        ({"water": {"kind": "air"}}, "water"),
        ({"laser": {"drift": Drift()}}, "laser.drift"),
    ],
)
def test_what_cannot_be_gathered_is_drawn_and_said(
    sections: dict[str, Any], reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    """In one line, and none where no light of higher orders is wanted."""
    with caplog.at_level(logging.WARNING):
        Tank(small("paper/groove", **sections, render={"scatter_samples": 0}))
        assert not caplog.records
        tank = Tank(small("paper/groove", **sections))
    assert not tank.gathers
    assert len(caplog.records) == 1
    assert caplog.records[0].getMessage().startswith("note: ")
    assert f"higher orders are random ({reason}" in caplog.text


def test_a_laser_that_is_off_gives_no_light() -> None:
    layers = Tank(small(laser={"on": False})).render(POSITION_MM, 1)
    assert not layers.scattered.any()
