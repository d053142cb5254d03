"""The laser's light from few rays, against samples in every pixel: the same line, the same veil."""

import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from truth_scenes import tank

from lscan.records import Floats
from sim.render.plugins.opaque import opaque
from sim.render.sparse import picture
from sim.render.sparse.survey import _uneven
from sim.render.tank import Tank
from sim.scene import LaserLine, Scene, load_scene
from sim.scene.instrument import Drift
from sim.validation.physics.gallery import shrunk

TIMES = 4  # pictures of 160 by 120 px
SAMPLES, MANY = 16, 256
FIRST = {"scatter_samples": 0}
TURBID = {"particle_scattering_per_m": 3.0}
CASES = [
    "paper/sandwave", "lasers/bowed", "lasers/two-lines", "lasers/misaligned", "ports/dome",
    "targets/coloured-mesh", "targets/wet", "targets/sand", "best/sandwave",
]  # fmt: skip


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


@pytest.mark.parametrize("name", CASES)
def test_line_and_veil_are_those_of_samples_everywhere(name: str, uneven: list[Floats]) -> None:
    """The line by the same samples, the veil by many.

    Line: single precision, 1e-5 of the peak, but for one sample of SAMPLES in a pixel in a
    thousand, whose ray passes a silhouette by its last bit; beyond five standard deviations of
    the sheet there is 4e-6 of its light.  Veil in even pixels: what the sampled integrand varies
    by, 2e-3 (its own test's bar) over the root of 256 samples in each of 18,000 pixels, where 5
    standard errors are to be expected.  In uneven pixels a shadow's edge is seen at 16 places:
    one of 4 rows of them, at most.
    """
    scene = small(name)
    camera = scene.rig.camera
    few, same, many = (
        Tank(scene, sampled=sampled)
        .render(100.0, samples)
        .binned((camera.height_px, camera.width_px))
        for sampled, samples in ((False, SAMPLES), (True, SAMPLES), (True, MANY))
    )
    peak, veil = same.direct.max(), many.scattered.max()
    assert peak > 0 and veil > 0
    off = np.abs(few.direct - same.direct) / peak
    assert (off > 1e-5).mean() < 1e-3 and off.max() <= 1 / SAMPLES
    off = np.abs(few.scattered - many.scattered).ravel() / veil
    assert uneven[0].mean() < 0.1, "few pixels are sampled"
    assert off[~uneven[0]].max() < 5 * 2e-3 / np.sqrt(MANY)
    assert off.max() < 1 / 4


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


def test_water_in_a_shadow_has_no_veil(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some hundred pixels show it, at a tenth of the veil and more; tolerances as above."""
    scene = shadow_scene(tmp_path)
    few, many = (
        Tank(scene, sampled=sampled).render(0.0, MANY).scattered for sampled in (False, True)
    )
    veil = many.max()
    assert np.abs(few - many).max() < 0.03 * veil
    monkeypatch.setattr(picture, "sheet_reach", lambda _, sheet: Everywhere(sheet.half_angle))
    without = Tank(scene).render(0.0, MANY).scattered
    assert (np.abs(without - many) > 0.1 * veil).sum() > 100


class Everywhere:
    """The reach of a sheet that nothing stops."""

    def __init__(self, half_angle: Any) -> None:
        self.half_angle = half_angle

    def shows(self, phi: Any, rho: Any) -> tuple[Any, Any]:
        return rho < opaque(np.inf), rho > opaque(np.inf)


def test_a_pixel_is_even_where_its_neighbours_are_like_it() -> None:
    states = np.zeros((5, 8), np.uint8)
    states[:, 4:] = 1
    assert set(_uneven(states) % 8) == {3, 4}
    states[:] = 1
    assert _uneven(states).size == 0
    states[2, 1] = 255
    assert sorted(_uneven(states)) == [8, 9, 10, 16, 17, 18, 24, 25, 26]


def test_another_place_and_another_wavelength_are_seen_anew() -> None:
    """One tank rendered here and there, early and late, is as one made for each picture."""
    scene = small("paper/sandwave", laser={"drift": Drift(rise_c=30.0, nm_per_c=0.3)})
    moved = Tank(scene)
    for position_mm, time_s in ((0.0, 0.0), (120.0, 900.0), (60.0, 100.0)):
        for found, expected in zip(
            pair(moved, position_mm, time_s), pair(Tank(scene), position_mm, time_s), strict=True
        ):
            np.testing.assert_array_equal(found, expected)
    early, late = pair(moved, 0.0, 0.0), pair(moved, 0.0, 900.0)
    assert late[1].max() < 0.99 * early[1].max(), "water absorbs more at longer wavelengths"


def pair(here: Tank, position_mm: float, time_s: float) -> tuple[Floats, Floats]:
    """Direct and scattered light."""
    layers = here.render(position_mm, SAMPLES, time_s=time_s)
    return layers.direct, layers.scattered


def test_a_laser_that_is_off_gives_no_light_and_ambient_light_stays() -> None:
    scene = small("targets/lit", laser={"on": False})
    layers = Tank(scene).render(0.0, 1)
    assert not layers.direct.any() and not layers.scattered.any() and layers.ambient.all()


@pytest.mark.parametrize(
    ("sections", "reason"),
    [
        ({"head": {"speed_mm_s": 20.0}}, r"head\.speed_mm_s: the head moves"),
        ({"lens": {"focus_mm": 700.0}}, r"lens\.focus_mm: .*out of focus"),
        ({"laser": {"lines": (LaserLine(tilt_deg=0.0, share=0.1),) * 8}}, r"laser\.lines: more"),
    ],
)
def test_what_few_rays_cannot_show_is_sampled_and_said(
    sections: dict[str, Any], reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    scene = small("paper/sandwave", **sections)
    with caplog.at_level(logging.WARNING):
        few = Tank(scene).render(100.0, 1)
    assert len(caplog.records) == 1
    assert caplog.records[0].getMessage().startswith("note: ")
    assert re.search(reason, caplog.text)
    every = Tank(scene, sampled=True).render(100.0, 1)
    for name in ("direct", "scattered", "ambient"):
        np.testing.assert_array_equal(getattr(few, name), getattr(every, name))
