"""The line in the harbor's turbid water, in all orders of light: its intervals, and two lasers.

Light adds up: each sheet is rendered by itself, and any share of the power is a sum.  What the
renderer draws at random is alike in all exposures and would pass for an error of the instrument:
five times the line's own light arrives scattered, and of 64 samples a pixel half is chance.
Scattered light is smooth but for the line's halo, which water spreads alike everywhere, so it is
estimated from all pixels together; what is left of the renderer's noise stands in the rows.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import nnls

from lscan.config.documents import merge
from lscan.config.rig import parse_rig
from lscan.records import Floats
from lscan.stripe import extract_stripe
from sim.render.layers import Layers
from sim.render.tank import Tank
from sim.scene import Scene, load_scene, scene_of
from sim.scene.instrument import LaserLine
from tests.validation.exposures import pictures, share_inside
from tests.validation.rows import Row, row
from tests.validation.surfaces.drawn import FieldEffort
from tests.validation.surfaces.line import (
    EXTRACTORS,
    count_rows,
    counted,
    told_apart_rows,
    true_line,
)

LEFT, TOP, WIDTH, HEIGHT = 170, 310, 300, 150  # px of the paper's picture, which hold the block
SAMPLES = 32  # a pixel, of scattered light, in either of two renders
TILTS_DEG = (0.0, 3.0)
SHARES = ((0.5, 0.5), (0.7, 0.3))
LEAST_SCATTERING = "steger"  # of the extractors, in this water
HALO_PX = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0)
REST_PX = 6.0  # over which what is no halo is smooth
SPECK = 6.0  # times the light expected: from a path that is hardly ever drawn
ROUNDS = 4  # of weights from light and light from weights


def harbor_rows(scenes: Path, effort: FieldEffort) -> list[Row]:
    """Rows of the line in turbid water.

    Parameters
    ----------
    scenes : Path, folder of the scene files
    effort : FieldEffort, its seeds are those of sensor noise; plain: a few samples a pixel
    """
    nominal = load_scene(scenes / "waters" / "harbor.toml")
    u, v = nominal.tank.lens.centre_px
    changes = {
        "camera": {"width_px": WIDTH, "height_px": HEIGHT},
        "lens": {"centre_px": [u - LEFT, v - TOP]},
        "render": {"scatter_samples": 1 if effort.plain else SAMPLES},
        "laser": {"lines": [{"tilt_deg": tilt, "share": 0.5} for tilt in TILTS_DEG]},
    }
    scene = scene_of(parse_rig(merge(nominal.document, changes), source="harbor", trusted=True))
    first, second = (_drawn_twice(scene, line) for line in scene.tank.laser.sheets)
    sheets = [added(halves, (0.5, 0.5)) for halves in (first, second)]
    lines = np.array([true_line(scene, line) for line in range(len(sheets))])
    rows = _interval_rows(scene, first, effort)
    for shares in SHARES:
        what = f"two lasers, {100 * shares[0]:g}/{100 * shares[1]:g}, harbor"
        shown = pictures(scene, added(sheets, shares), effort.seeds)
        rows += told_apart_rows(what, shown, scene.rig.stripe, lines, effort)
    return rows


def steady(layers: Layers) -> Layers:
    """The layers with their scattered light estimated from all pixels together.

    Least squares give it as a sum of Gaussians about the line's direct light and an even veil,
    weighted by the inverse square of the light; what differs from that is smoothed and added.

    Parameters
    ----------
    layers : Layers, W/(m2 sr), of one sheet, one entry for each pixel
    """
    direct, light = (layer.astype(np.float64) for layer in (layers.direct, layers.scattered))
    terms = [*(_blurred(direct, sigma) for sigma in HALO_PX), np.ones_like(direct)]
    design = np.column_stack([term.ravel() for term in terms])
    halo = np.full_like(light, light.mean())
    for _ in range(ROUNDS):
        weight = ((light < SPECK * halo) / np.maximum(halo, 0.05 * light.mean())).ravel()
        shares, _ = nnls(design * weight[:, None], light.ravel() * weight)
        halo = (design @ shares).reshape(light.shape)
    rest = _blurred(np.minimum(light, SPECK * halo) - halo, REST_PX)
    return replace(layers, scattered=np.maximum(halo + rest, 0).astype(np.float32))


def added(parts: Sequence[Layers], shares: Sequence[float]) -> Layers:
    """The light of several sheets together.

    Parameters
    ----------
    parts : sequence of Layers, W/(m2 sr), of each sheet with all the power
    shares : sequence of float, of the power
    """

    weights = np.array(shares, np.float32)
    layers = ((part.direct, part.scattered, part.ambient) for part in parts)
    return Layers(*(np.tensordot(weights, np.array(each), 1) for each in zip(*layers, strict=True)))


def _blurred(light: Floats, sigma_px: float) -> Floats:
    """Beyond the picture there is no light."""
    blurred = cv2.GaussianBlur(light, (0, 0), sigma_px, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(blurred, dtype=np.float64)


def _drawn_twice(scene: Scene, line: LaserLine) -> list[Layers]:
    """Light of one of the sheets with all the power, rendered with two seeds."""
    alone = scene.with_tank(laser={"lines": (line.model_copy(update={"share": 1.0}),)})
    tanks = (Tank(alone.with_tank(render={"seed": seed})) for seed in (1, 2))
    return [steady(tank.render(0.0)) for tank in tanks]


def _interval_rows(scene: Scene, halves: Sequence[Layers], effort: FieldEffort) -> list[Row]:
    """The first line alone: found, and how often the intervals of its centres hold."""
    truth = true_line(scene)
    shown = pictures(scene, added(halves, (0.5, 0.5)), effort.seeds)
    silent = scene.with_tank(sensor={"noise": False})
    bare = [pictures(silent, half, effort.seeds[:1])[0] for half in halves]
    rows = []
    for extractor in EXTRACTORS:
        chosen = scene.rig.stripe.model_copy(update={"extractor": extractor})
        stripes = [extract_stripe(picture, chosen) for picture in shown]
        error = np.array([stripe.centre_px - truth for stripe in stripes])
        sigma = np.array([stripe.sigma_px for stripe in stripes])
        known = np.isfinite(error)
        one, other = (extract_stripe(picture, chosen).centre_px for picture in bare)
        percent = 100 * share_inside(error[known], sigma[known])
        held = "harbor-intervals" if extractor == LEAST_SCATTERING else "harbor-intervals-wide"
        rows += count_rows("harbor", extractor, counted(stripes, truth), effort)
        rows += [
            row(
                held, abs(percent - 94), percent=percent, extractor=extractor, seeds=effort.seeded,
                off=np.median(np.abs(error[known])), stated=np.median(sigma[known]),
                drawn=np.nanmedian(np.abs(one - other)) / 2,
                samples=2 * scene.tank.render.scatter_samples,
            )
        ]  # fmt: skip
    return rows
