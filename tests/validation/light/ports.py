"""The camera's closed-form port against a slab and a dome of glass, traced face by face."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from lscan.figures import style
from lscan.figures.page import ReportFigure
from lscan.records import Floats
from sim.render.plugins.camera import RefractiveCamera
from sim.scene import Scene, camera_pose
from sim.truth.camera import camera_of
from tests.validation.light.rigs import (
    TracedCamera,
    camera_rays,
    make_camera,
    page_figure,
    picture_size,
    random_pixels,
    random_rig,
    topic,
)
from tests.validation.rows import Row, Topic, row

Rays = Callable[[Scene, Floats], tuple[Floats, Floats, Floats]]

REACHES_MM = (200.0, 2500.0)  # a ray is known by two of its points
PIXELS = 400
SHOWN = 800  # points of each port in the figure
SEED = 11
GLASS = {"flat": "dielectric slab", "dome": "dielectric shell"}


@dataclass(frozen=True)
class Deviations:
    """Closed form against traced glass at N pixels of many rigs.

    radius: (N,) distance from the picture's centre over half its diagonal.  error_px: (N,).
    transmission: (N,) difference of the share of light let through.
    """

    radius: Floats
    error_px: Floats
    transmission: Floats


def ports(rigs: int) -> Topic:
    """Pixels and transmission, flat port and dome apart, over so many random rigs each."""
    found = {kind: deviations(kind, rigs) for kind in ("flat", "dome")}
    return topic(
        "ports",
        rows=(row for kind, values in found.items() for row in _rows(kind, values, rigs)),
        figures=(_figure(found),),
    )


def _rows(kind: str, found: Deviations, rigs: int) -> tuple[Row, Row]:
    words: dict[str, Any] = {"kind": kind, "glass": GLASS[kind], "rigs": rigs}
    return (
        row("port-ray", float(found.error_px.max()), seed=SEED, **words),
        row("port-transmission", float(found.transmission.max()), seed=SEED, **words),
    )


def deviations(kind: str, rigs: int) -> Deviations:
    """Closed form against traced glass for ``rigs`` random rigs with a "flat" or "dome" port."""
    generator = np.random.default_rng(SEED)
    parts = [_deviations(random_rig(generator, kind), generator) for _ in range(rigs)]
    return Deviations(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _deviations(scene: Scene, generator: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    pixels = random_pixels(generator, scene, PIXELS)
    middle = (np.array(picture_size(scene)) - 1) / 2
    radius = np.linalg.norm((pixels - middle) / np.linalg.norm(middle), axis=1)
    errors = [pixel_errors(scene, pixels, reach) for reach in REACHES_MM]
    ours, theirs = closed_form_rays(scene, pixels), traced_rays(scene, pixels)
    # A ray's weight is its transmission over the squared index.
    difference = np.abs(ours[2] - theirs[2]) * camera_of(scene).water_index ** 2
    return radius, np.max(errors, axis=0), difference


def pixel_errors(scene: Scene, pixels: Floats, reach_mm: float) -> Floats:
    """(N,) how many px beside its own the closed form sees what traced glass shows at a pixel.

    The traced ray's miss, seen across the closed form's ray, in units of what a step of one
    pixel in u and in v moves that ray; infinite where a traced ray was lost.
    """
    origins, directions, _ = traced_rays(scene, pixels)
    points = origins + reach_mm * directions
    start, along, _ = closed_form_rays(scene, pixels)
    path = np.sum((points - start) * along, axis=1, keepdims=True)

    def across(vectors: Floats) -> Floats:
        return vectors - np.sum(vectors * along, axis=1, keepdims=True) * along

    steps = []
    for step in np.eye(2):
        origin, direction, _ = closed_form_rays(scene, pixels + step)
        steps.append(across(origin + path * direction - points))
    miss = across(start + path * along - points)
    basis = np.stack(steps, axis=2) - miss[:, :, np.newaxis]
    with np.errstate(invalid="ignore"):
        normal = np.swapaxes(basis, 1, 2) @ basis
        seen = np.swapaxes(basis, 1, 2) @ miss[:, :, np.newaxis]
    whole = np.isfinite(seen).all(axis=(1, 2))
    errors = np.full(len(pixels), np.inf)
    errors[whole] = np.linalg.norm(np.linalg.solve(normal[whole], seen[whole])[..., 0], axis=1)
    return errors


def closed_form_rays(scene: Scene, pixels: Floats) -> tuple[Floats, Floats, Floats]:
    """Origins, directions (N, 3) in the head frame, mm, and weights (N,): the camera plugin's."""
    return _rays(RefractiveCamera, scene, pixels)


def traced_rays(scene: Scene, pixels: Floats) -> tuple[Floats, Floats, Floats]:
    """The same, traced through dielectric geometry."""
    return _rays(TracedCamera, scene, pixels)


def _rays(
    kind: type[RefractiveCamera], scene: Scene, pixels: Floats
) -> tuple[Floats, Floats, Floats]:
    pose = camera_pose(scene.tank.head)
    return camera_rays(make_camera(kind, scene, camera_of(scene).water_index, pose), scene, pixels)


@style.styled
def _figure(found: dict[str, Deviations]) -> ReportFigure:
    figure, (axes,) = style.panels(1, (style.WIDTH_IN, 2.6))
    for (kind, values), colour in zip(found.items(), (style.FIRST, style.SECOND), strict=True):
        shown = slice(None, None, max(1, len(values.radius) // SHOWN))
        floor = np.maximum(values.error_px[shown], 1e-7)
        axes.plot(values.radius[shown], floor, ".", color=colour, markersize=1.5, label=kind)
    axes.axhline(0.005, color=style.MUTED, linestyle="--", linewidth=0.8)
    axes.set_yscale("log")
    axes.set_xlabel("distance from the picture's centre / half diagonal")
    axes.set_ylabel("error / px")
    style.legend(axes)
    return page_figure("ports", figure)
