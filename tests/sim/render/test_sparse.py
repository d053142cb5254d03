"""The laser's light from few rays, against samples in every pixel: the same line, the same veil."""

import logging
import re
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
import trimesh
from places import SCENES
from truth_scenes import tank

from lscan.config.documents import merge
from lscan.records import Floats
from sim.render import firstorder as picture
from sim.render.firstorder import EVEN, ROUGHEST
from sim.render.tank import Tank
from sim.scene import LaserLine, Scene, head_pose, load_scene
from sim.scene.instrument import Drift
from tests.validation.light.gallery import shrunk

TIMES = 4  # pictures of 160 by 120 px
SAMPLES, MANY = 16, 256
FIRST = {"scatter_samples": 0}
TURBID = {"particle_scattering_per_m": 3.0}
CASES = ["paper/sandwave", "targets/coloured-mesh", "targets/wet", "best/sandwave"]


def small(name: str, **sections: Any) -> Scene:
    """The named scene in a small picture, its light of the first order alone, in turbid water."""
    scene = shrunk(load_scene(name), TIMES)
    return scene.with_tank(**({"render": FIRST, "water": TURBID} | sections))


@pytest.fixture
def uneven(monkeypatch: pytest.MonkeyPatch) -> list[Floats]:
    """Masks of the pixels that were sampled, flat, one for each picture rendered."""
    masks = []

    def watched(*arguments: Any) -> Any:
        seen = plain(*arguments)
        mask = np.zeros(seen.veil.size, dtype=bool)
        mask[seen.uneven] = True
        masks.append(mask)
        return seen

    plain = picture.survey
    monkeypatch.setattr(picture, "survey", watched)
    return masks


def random_rig(seed: int) -> Scene:
    """A sheet of any width and lean before a camera that looks anywhere near it."""
    between = np.random.default_rng(seed).uniform
    kinds: list[dict[str, Any]] = [
        {"target": {"shape": "none"}},
        {"workpiece": {"kind": "grooved-block"}, "target": {"shape": "workpiece"}},
        {"workpiece": {"kind": "sandwave"}, "target": {"shape": "workpiece"}},
        {"target": {"shape": "mesh", "file": str(SCENES / "targets" / "mound.ply")}},
    ]
    piece = merge(kinds[seed % 4], {
        "target": {
            "position_mm": [between(-120, 0), between(-50, 50), between(-300, -200)],
            "tilt_x_deg": between(-20, 20), "tilt_y_deg": between(-20, 20),
        }
    })  # fmt: skip
    lean = between(-4, 4)
    return tank(
        **piece,
        camera={"width_px": 100, "height_px": 80},
        lens={"focal_px": between(90, 160), "centre_px": [49.5, 39.5], "k1": between(-0.2, 0.1)},
        head={
            "camera_mm": [between(-100, 100), between(-900, -250), between(100, 450)],
            "depression_deg": between(15, 60), "roll_deg": between(-10, 10),
            "yaw_deg": between(-5, 5),
        },
        laser={
            "apex_mm": [between(-80, 80), between(-30, 30), between(150, 600)],
            "fan_half_angle_deg": between(15, 50), "waist_mm": between(0.3, 4.0),
            "waist_distance_mm": between(200, 900), "skew_deg": between(-8, 8),
            "port_tilt_deg": between(-20, 20) * (seed % 2),
            "lines": [{"tilt_deg": lean, "share": 0.4}, {"tilt_deg": lean / 2, "share": 0.6}],
        },
        port={"kind": "dome" if seed % 3 == 0 else "flat"},
        floor={"z_mm": between(-450, -300)},
        water={"particle_scattering_per_m": between(0.1, 5.0)},
        render=FIRST,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("scene", [*CASES, 0, 1])
def test_line_and_veil_are_those_of_samples_everywhere(
    scene: str | int, uneven: list[Floats]
) -> None:
    """The line by the same samples or more, the veil by many.

    Line: single precision, 1e-5 of the peak, but at edges, which are sampled more finely;
    beyond five standard deviations of the sheet there is 4e-6 of its light.  Veil in even
    pixels: ROUGHEST, and what the sampled integrand varies by, 2e-3 (its own test's bar) over the
    root of MANY samples in each of 18,000 pixels, where 5 standard errors are to be expected.  In
    uneven pixels edges are seen by 4 rows of samples, each of which sees all or nothing of a
    quarter: 1 / sqrt(12) of it off, were each pixel an edge's.
    """
    seen = small(scene) if isinstance(scene, str) else random_rig(scene)
    camera, places = seen.rig.camera, ((False, SAMPLES), (True, SAMPLES), (True, MANY))
    shape = camera.height_px, camera.width_px
    tanks = [Tank(seen, sampled=sampled) for sampled, _ in places]
    few, same, many = (
        here.render(100.0, samples).binned(shape)
        for here, (_, samples) in zip(tanks, places, strict=True)
    )
    peak, veil = same.direct.max(), many.scattered.max()
    assert veil > 0 and (peak > 0 or not isinstance(scene, str))
    finer = np.abs(few.direct - same.direct) > 1e-5 * peak
    if finer.any():
        error, before = (np.std((layers.direct - many.direct)[finer]) for layers in (few, same))
        assert error < before
    off = np.abs(few.scattered - many.scattered).ravel() / veil
    assert uneven[0].mean() < 0.2, "few pixels are sampled"
    assert off[~uneven[0]].max() < ROUGHEST + 5 * 2e-3 / np.sqrt(MANY)
    assert np.sqrt(np.mean(off[uneven[0]] ** 2)) < 1 / 4 / np.sqrt(12)


def test_what_is_out_of_focus_is_that_of_samples_everywhere() -> None:
    """Blurred by some px: all of the line is sampled, and scatters less about it than at random.

    Beyond five standard deviations of the sheet there is 4e-6 of its light.  Light is neither
    lost nor won: N pixels' errors of a standard deviation s add up to s sqrt(N), at most 5 of it.
    """
    scene = small("paper/sandwave", lens={"focus_mm": 60.0, "f_number": 0.5})
    here, every = Tank(scene), Tank(scene, sampled=True)
    few = here.render(100.0, SAMPLES).direct
    same, many = (every.render(100.0, samples).direct for samples in (SAMPLES, MANY))
    assert here._sparse is not None and here._sparse.rays.defocus is not None
    assert 3 <= here._sparse.rays.defocus.radius_px(np.array([700.0])) <= 8
    seen = here._sparse.picture(head_pose(scene.tank.head, 100.0), SAMPLES).seen
    sampled = np.zeros(many.size, bool)
    sampled[seen.uneven] = True
    assert sampled.mean() < 0.5, "most pixels are not sampled"
    assert many.ravel()[~sampled].max() < 1e-5 * many.max()
    bright = many > 1e-3 * many.max()
    error, before = (np.std((light - many)[bright]) for light in (few, same))
    assert error < before
    assert abs((few - many).sum()) < 5 * error * np.sqrt(bright.sum())


@pytest.mark.slow
def test_light_of_higher_orders_is_out_of_focus_with_the_line() -> None:
    """None of it is lost but at the picture's border, and its peak falls as a line's over a disc.

    A line over a disc of radius r is 2 / (pi r) of its light a pixel high; light about the line
    falls by less, for it is wider.
    """
    scene = small("paper/sandwave", render={"scatter_samples": 1})
    sharp = Tank(scene)
    lens = {"focus_mm": 60.0, "f_number": 0.5}
    blurred = Tank(scene.with_tank(lens=lens))
    assert blurred.gathers and blurred._sparse is not None
    before, after = (
        sum(tank.higher_orders(100.0, SAMPLES).values(), np.zeros(())) for tank in (sharp, blurred)
    )
    defocus = blurred._sparse.rays.defocus
    assert defocus is not None
    radius = defocus.radius_px(np.array([800.0]))
    assert after.sum() == pytest.approx(before.sum(), rel=0.01)
    assert 2 / (np.pi * radius) < after.max() / before.max() < 0.8


def test_edges_out_of_focus_are_those_of_samples_everywhere(tmp_path: Path) -> None:
    """Daylight on a plate over a darker floor.

    Where the blur shows, n samples of two sides that differ by d scatter by d / 2 / sqrt(n) at
    most; elsewhere a pixel is right to EVEN of its light.
    """
    sharp = shadow_scene(tmp_path).with_tank(
        light={"ambient_w_m2_sr": 0.3},
        water={"particle_scattering_per_m": 0.1},
        target={"albedo": 0.8},
        floor={"albedo": 0.2},
        laser={"on": False},
    )
    scene = sharp.with_tank(lens={"focus_mm": 60.0, "f_number": 0.5})
    samples = 144
    few, many, edge = (
        Tank(one, sampled=sampled).render(0.0, count, scatter_samples=0).ambient
        for one, sampled, count in (
            (scene, False, samples), (scene, True, MANY), (sharp, False, samples)
        )
    )  # fmt: skip
    contrast = np.ptp(many)
    assert contrast > 0.05 * many.max()
    blurred = np.abs(many - edge) > 0.1 * contrast
    assert np.sqrt(np.mean((few - many)[blurred] ** 2)) < contrast / 2 / np.sqrt(samples)
    assert np.sqrt(np.mean((few - many)[~blurred] ** 2)) < EVEN * many.max()


def shadow_scene(folder: Path) -> Scene:
    """A plate over half of the floor, in the sheet: it shades the water beneath it."""
    plate = folder / "plate.ply"
    trimesh.creation.box((150.0, 60.0, 4.0)).export(plate)
    return tank(
        camera={"width_px": 160, "height_px": 120},
        lens={"focal_px": 200.0, "centre_px": [79.5, 59.5]},
        target={"shape": "mesh", "file": str(plate), "position_mm": [-75.0, 0.0, 100.0]},
        floor={"z_mm": -250.0},
        water=TURBID,
        render=FIRST,
    )


def test_water_in_a_shadow_has_no_veil(tmp_path: Path) -> None:
    """Some hundred pixels would show it, at a tenth of the veil and more; tolerances as above."""
    scene = shadow_scene(tmp_path)
    few, many = (
        Tank(scene, sampled=sampled).render(0.0, MANY).scattered for sampled in (False, True)
    )
    assert np.abs(few - many).max() < 0.03 * many.max()


def test_another_place_and_another_wavelength_are_seen_anew() -> None:
    """One tank rendered here and there, early and late, is as one made for each picture."""
    scene = small("paper/sandwave", laser={"drift": Drift(rise_c=30.0, nm_per_c=0.3)})
    moved = Tank(scene)
    for position_mm, time_s in ((0.0, 0.0), (120.0, 900.0)):
        for found, expected in zip(
            pair(moved, position_mm, time_s), pair(Tank(scene), position_mm, time_s), strict=True
        ):
            np.testing.assert_array_equal(found, expected)
    early, late = pair(moved, 0.0, 0.0), pair(moved, 0.0, 900.0)
    assert late[1].max() < 0.99 * early[1].max(), "water absorbs more at longer wavelengths"


def test_no_kernel_is_compiled_anew_from_picture_to_picture() -> None:
    here = Tank(small("paper/sandwave", laser={"drift": Drift()}))
    pair(here, 0.0, 0.0)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        pair(here, 77.0, 300.0)
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    assert len(kernels) > 3 and all(kernel["cache_hit"] for kernel in kernels)


def pair(here: Tank, position_mm: float, time_s: float) -> tuple[Floats, Floats]:
    """Direct and scattered light."""
    layers = here.render(position_mm, SAMPLES, time_s=time_s)
    return layers.direct, layers.scattered


def test_a_laser_that_is_off_gives_no_light_and_ambient_light_stays() -> None:
    scene = small("paper/board", laser={"on": False})
    layers = Tank(scene).render(0.0, 1)
    assert not layers.direct.any() and not layers.scattered.any() and layers.ambient.all()


@pytest.mark.parametrize(
    ("sections", "reason"),
    [
        ({"head": {"speed_mm_s": 20.0}}, r"head\.speed_mm_s: the head moves"),
        ({"laser": {"lines": (LaserLine(tilt_deg=0.0, share=0.1),) * 8}}, r"laser\.lines: more"),
    ],
)
def test_what_few_rays_cannot_show_is_sampled_and_said(
    sections: dict[str, Any], reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    scene = small("paper/sandwave", **sections)
    with caplog.at_level(logging.WARNING):
        tank = Tank(scene)
    assert len(caplog.records) == 1
    assert caplog.records[0].getMessage().startswith("note: ")
    assert re.search(reason, caplog.text)
    assert tank._sparse is None


def test_a_camera_within_the_sheet_sees_its_veil() -> None:
    """Straight down from 0.7 mm beside the middle of a sheet of 1.5 mm: its rays cross it behind
    the port, where it is not, and see it from there on.  A twelfth of the veil was lost so.  Here
    both pictures' noise is 0.2 % of the whole."""
    scene = small(
        "paper/groove",
        head={"camera_mm": (250.0, 0.7, 200.0), "depression_deg": 90.0, "yaw_deg": 0.0},
        laser={"apex_mm": (225.0, 0.0, 250.0)},
    )
    light = Tank(scene).render(100.0, SAMPLES).scattered
    every = Tank(scene, sampled=True).render(100.0, MANY).scattered
    assert light.sum() == pytest.approx(every.sum(), rel=0.01)
