"""The lens blurs before the pixels gather: what cutting pixels into parts mends, and keeps.

A Gaussian line of sigma s px has the spectrum exp(-2 pi² s² k²), gathered by pixels times
sinc(k).  The centroid of the samples of a function g is sum n g(n) / sum g(n), by Poisson's
formula the derivative of its spectrum at all whole k: beside the true place, k = +-1 give

    exp(-2 pi² s²) / pi sin(2 pi (u + 1/2)),    u the line's place.

A symmetric kernel on the pixels themselves leaves that as it is.  In parts of 1 / f px the
same law has s f in place of s, and a part in place of the pixel.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from drawn_examples import examples
from hypothesis import given, strategies as st
from scipy.special import ndtr
from sensor_scenes import EXPOSURE_MS, sensor_scene
from truth_scenes import tank

from lscan.errors import InputError
from lscan.records import Floats
from sim.datasets.labels import label_scene
from sim.render.layers import Layers, fineness_of, finer_lens
from sim.render.tank import Tank
from sim.scene import Scene
from sim.sensor import Webcam
from sim.truth import project

CAMERA = {"width_px": 64, "height_px": 48}
LENS = {"focal_px": 85.0, "centre_px": [31.3, 23.8], "k1": -0.1, "p1": 0.002}
ROWS = 64


def line_layers(sigma_px: float, centre_px: Floats, fineness: int) -> Layers:
    """A Gaussian line's light as parts of a pixel gather it: a column for each centre."""
    edges = np.arange(fineness * ROWS + 1) / fineness - 0.5
    gathered = fineness * np.diff(ndtr((edges[:, None] - centre_px) / sigma_px), axis=0)
    direct = np.repeat(gathered, fineness, axis=1).astype(np.float32)
    return Layers(direct, np.zeros_like(direct), np.zeros_like(direct))


def line_errors(sigma_px: float, fineness: int, phases: Floats) -> Floats:
    """(N,) centroid less true centre, px, of a line that does not change along itself."""
    scene = sensor_scene((len(phases), ROWS), {"blur_px": 0.7})
    found = []
    # Each phase is a picture of its own: blurred along itself, the line stays as it is.
    for phase in phases:
        layers = line_layers(sigma_px, np.full(len(phases), ROWS / 2 + phase), fineness)
        light = Webcam(scene).mean_electrons(layers, EXPOSURE_MS)[:, 0, 0].astype(float)
        found.append(light @ np.arange(ROWS) / light.sum() - ROWS / 2 - phase)
    return np.array(found)


def random_phases(count: int) -> Floats:
    return np.random.default_rng(15).uniform(-0.5, 0.5, count)


@pytest.mark.parametrize("sigma_px", [0.3, 0.35, 0.4])
def test_a_pixel_in_one_part_displaces_a_thin_line_by_the_closed_form(sigma_px: float) -> None:
    """0.054 to 0.013 px, more than 0.005; the next harmonic is exp(-8 pi² s²) / 2 pi."""
    phases = random_phases(20)
    amplitude = np.exp(-2 * np.pi**2 * sigma_px**2) / np.pi
    expected = -amplitude * np.sin(2 * np.pi * phases)
    errors = line_errors(sigma_px, 1, phases)
    second = np.exp(-8 * np.pi**2 * sigma_px**2) / (2 * np.pi)
    # Single precision of a light's moments over 64 rows: 64 times 6e-8, a few times.
    np.testing.assert_allclose(errors, expected, rtol=0, atol=second + 2e-5)
    assert np.abs(errors).max() > 0.005


@examples(40)
@given(sigma_px=st.floats(0.3, 0.8), phase=st.floats(-0.5, 0.5), fineness=st.sampled_from([2, 3]))
def test_pixels_in_parts_do_not_displace_a_line(
    sigma_px: float, phase: float, fineness: int
) -> None:
    """Before the blur the alias is that of parts, behind it that of a line 0.7 px wider.

    exp(-2 pi² (f s)²) / (pi f) + exp(-2 pi² (s² + 0.7²)) / pi: 1.3e-4 px at most.  Summing f
    parts has, at k = 1, the slope of the pixel's sinc times (pi / f) / sin(pi / f), 1.6 at most.
    """
    parts = np.exp(-2 * np.pi**2 * (fineness * sigma_px) ** 2) / (np.pi * fineness)
    pixels = 1.6 * np.exp(-2 * np.pi**2 * (sigma_px**2 + 0.7**2)) / np.pi
    error = line_errors(sigma_px, fineness, np.array([phase]))[0]
    assert abs(error) <= parts + pixels + 2e-5
    assert abs(error) <= 0.002


@examples(25)
@given(
    fineness=st.integers(1, 3),
    blur_px=st.floats(0.0, 2.0),
    glare=st.floats(0.0, 0.5),
    seed=st.integers(0, 1000),
)
def test_no_light_is_lost(fineness: int, blur_px: float, glare: float, seed: int) -> None:
    """All photons of the parts, each of an area of 1 / f² pixels, are those of the pixels.

    The picture's margin, wider than the glare reaches, is dark.  Kernels of single precision
    add up to 1 within some 1e-7.
    """
    lens = {"blur_px": blur_px, "glare": glare, "glare_px": 3.0}
    scene = sensor_scene((48, 40), lens)
    light = np.zeros((fineness * 40, fineness * 48), np.float32)
    inner = slice(fineness * 15, -fineness * 15)
    drawn = np.random.default_rng(seed).uniform(0, 1, light[inner, inner].shape)
    light[inner, inner] = drawn
    dark = np.zeros_like(light)
    webcam = Webcam(scene)
    whole = webcam.mean_electrons(Layers(light, dark, dark), EXPOSURE_MS)[..., 0]
    flat = np.ones((40, 48), np.float32)
    none = np.zeros_like(flat)
    one = webcam.mean_electrons(Layers(flat, none, none), EXPOSURE_MS)[20, 24, 0]
    expected = float(one) * drawn.sum() / fineness**2
    assert whole.sum(dtype=float) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("fineness", [1, 2, 3])
def test_the_spread_of_a_point_is_as_wide_in_parts(fineness: int) -> None:
    """A point in the middle of a pixel: variance blur² and that of what gathers it.

    A part gathers as a box of 1 / f px, and the f parts of a pixel are f places 1 / f px apart:
    (1 - 1 / f²) / 12 more.  A sampled Gaussian of 1.2 px has its variance to
    8 pi² s² exp(-2 pi² s²) < 1e-10; cut off at 4 sigma it lacks 1.1e-3 of it.
    """
    scene = sensor_scene((41, 41), {"blur_px": 1.2})
    light = np.zeros((fineness * 41,) * 2, np.float32)
    middle = slice(fineness * 20, fineness * 21)
    light[middle, middle] = 1.0
    seen = Webcam(scene).mean_electrons(Layers(light, 0 * light, 0 * light), EXPOSURE_MS)[..., 0]
    share = seen.sum(axis=1, dtype=float) / seen.sum(dtype=float)
    rows = np.arange(41) - 20
    assert share @ rows == pytest.approx(0.0, abs=1e-5)
    box = 2 * (1 - 1 / fineness**2) / 12  # of the lit parts, and of those gathered
    assert share @ rows**2 == pytest.approx(1.2**2 + box, rel=2e-3)


@pytest.mark.parametrize("noise", [True, False])
def test_light_even_over_pixels_makes_the_same_bytes_without_blur(noise: bool) -> None:
    """Speckle and electrons are the pixels': parts that are all alike change nothing."""
    scene = sensor_scene((40, 30), noise=noise, speckle="polarised", bayer="RGGB")
    pixels = np.random.default_rng(5).uniform(0, 0.3, (3, 30, 40)).astype(np.float32)
    parts = pixels.repeat(2, axis=1).repeat(2, axis=2)
    coarse, fine = (
        Webcam(scene).expose(Layers(*stack), EXPOSURE_MS, np.random.default_rng(1))
        for stack in (pixels, parts)
    )
    np.testing.assert_array_equal(coarse, fine)


def test_layers_of_another_size_are_refused() -> None:
    scene = sensor_scene((40, 30))
    for shape in ((31, 40), (60, 40), (30, 80), (15, 20), (30, 40, 3)):
        with pytest.raises(InputError, match=r"layers and picture differ.*\(30, 40\)"):
            fineness_of(shape, (30, 40))
    light = np.zeros((60, 120), np.float32)
    with pytest.raises(InputError, match="differ in size"):
        Webcam(scene).mean_electrons(Layers(light, light, light), EXPOSURE_MS)
    with pytest.raises(InputError, match="differ in size"):
        Layers(light, light, light).binned((30, 40))


def small(fineness: int, **sections: Any) -> Scene:
    """A level floor seen by a small camera; 36 samples a pixel at any fineness."""
    render = {"samples": 36, "scatter_samples": 0, "fineness": fineness}
    base: dict[str, Any] = {
        "camera": CAMERA, "lens": LENS, "floor": {"z_mm": -100.0}, "render": render,
        "laser": {"waist_mm": 8.0}, "water": {"kind": "pure"},
    }  # fmt: skip
    return tank(**(base | sections))


@pytest.mark.parametrize("fineness", [2, 3])
def test_parts_of_a_pixel_see_what_the_pixel_sees(fineness: int) -> None:
    """The truth agrees: pixel u's middle is that of its parts, whatever the distortion."""
    scene = small(fineness)
    lens = finer_lens(scene.tank.lens, fineness)
    fine = replace(scene, tank=scene.tank.model_copy(update={"lens": lens}))
    points = np.array([[0.0, 0.0, -100.0], [120.0, 5.0, -130.0], [-90.0, -3.0, -60.0]])
    expected = fineness * project(scene, points) + (fineness - 1) / 2
    np.testing.assert_allclose(project(fine, points), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("fineness", "moving"), [(3, False), (2, True)])
def test_the_tank_s_light_is_the_same_in_parts(fineness: int, moving: bool, tmp_path: Path) -> None:
    """The parts' regular grids make up the pixel's: the means are equal, sample by sample.

    Also behind a rolling shutter, where all parts of a pixel are read at one time: the head
    moves 4 mm over a slope in a row's time, and the shutter is open for none of it.  Places
    differ in their last bit of single precision, 4e-6 px of 48, which a line of sigma a
    third of a pixel turns into some 1e-5 of its peak.
    """
    slope = tmp_path / "slope.ply"
    trimesh.creation.box((4000.0, 4000.0, 10.0)).export(slope)
    sections: dict[str, Any] = {
        "target": {
            "shape": "mesh", "file": str(slope), "tilt_x_deg": 20.0,
            "position_mm": [0.0, 0.0, -60.0],
        },
    }  # fmt: skip
    if moving:
        sections |= {
            "camera": {**CAMERA, "exposure_ms": 1e-6},
            "head": {"speed_mm_s": 1000.0},
            "sensor": {"readout_ms": 192.0},
        }
    whole = Tank(small(1, **sections)).render(0.0)
    parts = Tank(small(fineness, **sections)).render(0.0)
    assert parts.direct.shape == (fineness * 48, fineness * 64)
    for name in ("direct", "ambient"):
        found = getattr(parts.binned((48, 64)), name)
        expected = getattr(whole, name)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4 * whole.direct.max())
    assert whole.direct.max() > 0


def test_a_window_is_cut_out_of_the_parts_too() -> None:
    scene = small(2)
    here = Tank(scene)
    film = here.make_camera((10, 20, 30, 15)).film()
    assert tuple(film.size()) == (128, 96)
    assert tuple(film.crop_offset()) == (20, 40) and tuple(film.crop_size()) == (60, 30)


def test_scattered_samples_are_shared_out_rounded_up() -> None:
    """10 of them a pixel are 3 in each of its 4 parts: as if 12 had been asked for."""
    water = {"water": {"particle_scattering_per_m": 0.4}}
    scene = small(2, **water)
    here = Tank(scene)
    ten, twelve, none = (
        here.render(0.0, 4, scatter_samples=count).scattered for count in (10, 12, 0)
    )
    np.testing.assert_array_equal(ten, twelve)
    assert ten.sum() > none.sum() > 0


def test_labels_are_of_whole_pixels() -> None:
    scene = small(2)
    layers = Tank(scene).render(0.0)
    labels = label_scene(scene, 0.0, layers)
    assert labels.shape == (48, 64)
    np.testing.assert_array_equal(labels, label_scene(scene, 0.0, layers.binned((48, 64))))


@pytest.mark.parametrize(
    ("render", "message"),
    [
        ({"fineness": 2, "samples": 9}, r"render.*square of fineness 2 \(4, 16, 36"),
        ({"fineness": 3, "samples": 4}, r"render.*square of fineness 3 \(9, 36, 81"),
        ({"fineness": 4, "samples": 16}, r"render\.fineness.*4"),
    ],
)
def test_samples_that_cannot_be_shared_out_are_refused(
    render: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        tank(render=render)


def test_a_render_refuses_samples_that_cannot_be_shared_out() -> None:
    here = Tank(small(2))
    for samples in (9, 6, 0, -4):
        with pytest.raises(InputError, match=rf"samples: not a square.*{samples}.*4, 16, 36"):
            here.render(0.0, samples)
