"""Refraction as a diver knows it: what a flat port does to the field of view."""

from collections.abc import Mapping

import numpy as np
from scipy.optimize import brentq

from lscan.figures import style
from lscan.figures.page import ReportFigure
from lscan.records import Floats
from sim.render.plugins.camera import RefractiveCamera
from sim.scene import Pose, Scene, camera_pose
from sim.truth import project
from sim.water import refractive_index
from tests.validation.light.rigs import camera_rays, make_camera, page_figure, scene_with, topic
from tests.validation.rows import Row, Topic, row

WATER_INDEX, GLASS_INDEX = 1.3313, 1.49  # of the check values
FOCAL_PX = 600.0
FIT_AT_MM, WIDEST_DEG = 1000.0, 25.0
# docs/explanation/physics.md, section 6.  Distance in mm: largest error in px of the camera
# fitted at 1 m.
CHECK_ERROR_PX = {500.0: 0.98, 700.0: 0.42, 1500.0: 0.33, 2000.0: 0.49}
CHECK_FOCAL = 1.3278
MEDIA = {"air": None, "fresh water": 0.0, "sea water": 35.0}  # salinity in psu
AT_C, AT_NM = 20.0, 650.0


def refraction() -> Topic:
    """Sines against the index in three media, and the single-viewpoint fit's own failure."""
    fitted = fit_single_viewpoint()
    errors = {at: residuals(fitted, at) for at in CHECK_ERROR_PX}
    worst = max(
        abs(np.abs(errors[at][1]).max() - expected) for at, expected in CHECK_ERROR_PX.items()
    )
    rows = [
        *(_sine_row(name, salinity) for name, salinity in MEDIA.items()),
        row("angle-in-water", abs(angle_in_water_deg() - 22.06)),
        row("single-viewpoint-focal", abs(float(fitted[0]) / FOCAL_PX - CHECK_FOCAL)),
        row("single-viewpoint-error", float(worst)),
    ]
    return topic("refraction", rows=rows, figures=(_figure(errors),))


def _sine_row(name: str, salinity: float | None) -> Row:
    index = 1.0 if salinity is None else refractive_index(AT_C, salinity, AT_NM)
    return row("sines", _sine_error(index), name=name, index=index)


def _sine_error(index: float) -> float:
    """Largest deviation of sin(air) / sin(water) from the index, over a row of pixels."""
    scene = scene_with(lens={"focal_px": FOCAL_PX}, port={"glass_index": GLASS_INDEX})
    straight = Pose(np.eye(3), np.zeros(3))
    camera = make_camera(RefractiveCamera, scene, index, straight)
    offsets = np.arange(200.0, 320.0)
    pixels = np.column_stack([319.5 + offsets, np.full_like(offsets, 239.5)])
    _, directions, _ = camera_rays(camera, scene, pixels)
    in_air = offsets / np.hypot(offsets, FOCAL_PX)
    return float(np.abs(in_air / directions[:, 0] - index).max())


def scene_of_index(water_index: float, lens: dict[str, object]) -> Scene:
    """A scene whose fresh water has just this index at 650 nm, by its temperature."""
    celsius = brentq(lambda t: refractive_index(t, 0.0, AT_NM) - water_index, 0.0, 30.0, xtol=1e-13)
    return scene_with(
        lens=lens,
        water={"temperature_c": float(celsius)},
        port={"glass_index": GLASS_INDEX},
        laser={"wavelength_nm": AT_NM},
    )


def tangents(r_mm: Floats, z_mm: Floats) -> Floats:
    """(N,) tangent of the angle in air to points r beside the axis and z before the pinhole."""
    scene = scene_of_index(WATER_INDEX, {"focal_px": 1.0, "centre_px": [0.0, 0.0]})
    points = np.column_stack([r_mm, np.zeros_like(r_mm), z_mm])
    return project(scene, camera_pose(scene.tank.head).apply(points))[:, 0]


def radius_at(angle_deg: float, z_mm: float) -> float:
    """Distance from the axis in mm of the point at ``z_mm`` seen at an angle in air."""

    def excess(r_mm: float) -> float:
        found = tangents(np.array([r_mm]), np.array([z_mm]))[0]
        return float(found - np.tan(np.radians(angle_deg)))

    return float(brentq(excess, 0.0, z_mm, xtol=1e-9))


def angle_in_water_deg() -> float:
    """Angle in water of the ray at 30 degrees in air, from two points of equal image."""
    aside = radius_at(30.0, 1500.0) - radius_at(30.0, 500.0)
    return float(np.degrees(np.arctan(aside / 1000.0)))


def field_radii(z_mm: float) -> tuple[Floats, Floats]:
    """(101,) radii in mm at a distance whose rays reach 0 to 25 degrees in air, and their pixels.

    The pixels are those of the projection, offsets from the centre.
    """
    radii = np.linspace(0.0, radius_at(WIDEST_DEG, z_mm), 101)
    return radii, FOCAL_PX * tangents(radii, np.full_like(radii, z_mm))


def fit_single_viewpoint() -> Floats:
    """(3,) focal length f in px, f k1 and f k2 of the central camera that fits best at 1 m."""
    radii, pixels = field_radii(FIT_AT_MM)
    return np.asarray(np.linalg.lstsq(_odd_powers(radii / FIT_AT_MM), pixels, rcond=None)[0], float)


def residuals(fitted: Floats, z_mm: float) -> tuple[Floats, Floats]:
    """(101,) pixel offsets at a distance, and the fitted camera's errors there, px."""
    radii, pixels = field_radii(z_mm)
    return pixels, _odd_powers(radii / z_mm) @ fitted - pixels


def _odd_powers(tangent: Floats) -> Floats:
    """(N, 3) what a central camera with two radial terms is linear in."""
    return np.asarray(tangent[:, np.newaxis] ** [1, 3, 5])


@style.styled
def _figure(errors: Mapping[float, tuple[Floats, Floats]]) -> ReportFigure:
    """errors: the camera's pixel offsets and errors in px at each distance in mm."""
    figure, (axes,) = style.panels(1, (style.WIDTH_IN, 2.6))
    colours = (style.FIRST, style.SECOND, style.THIRD, style.ACCENT)
    for (at, (pixels, error)), colour in zip(errors.items(), colours, strict=True):
        axes.plot(pixels, error, color=colour, label=f"{at / 1000:g} m")
    axes.set_xlabel("distance from the centre / px")
    axes.set_ylabel("error / px")
    style.legend(axes)
    return page_figure("refraction", figure)
