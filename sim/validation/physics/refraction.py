"""Refraction as a diver knows it: what a flat port does to the field of view."""

import numpy as np
from scipy.optimize import brentq, least_squares

from lscan.figures import style
from lscan.figures.reportfigure import ReportFigure
from lscan.records import Floats
from sim.render.plugins.camera import RefractiveCamera
from sim.scene import Pose, Scene, camera_pose
from sim.truth import project
from sim.validation.physics.rigs import camera_rays, make_camera, scene_with
from sim.validation.physics.topics import page_figure, topic
from sim.validation.rows import Row, Topic, row
from sim.water import refractive_index

WATER_INDEX, GLASS_INDEX = 1.3313, 1.49  # of the published values
FOCAL_PX = 600.0
FIT_AT_MM, WIDEST_DEG = 1000.0, 25.0
# Distance in mm: largest error in px of the camera fitted at 1 m.
PUBLISHED_ERROR_PX = {500.0: 0.98, 700.0: 0.42, 1500.0: 0.33, 2000.0: 0.49}
PUBLISHED_FOCAL = 1.3278
MEDIA = {"air": None, "fresh water": 0.0, "sea water": 35.0}  # salinity in psu
AT_C, AT_NM = 20.0, 650.0


def refraction() -> Topic:
    """Sines against the index in three media, and the single-viewpoint fit's own failure."""
    focal, errors = single_viewpoint_errors()
    worst = max(abs(errors[at] - figure) for at, figure in PUBLISHED_ERROR_PX.items())
    rows = [
        *(_sine_row(name, salinity) for name, salinity in MEDIA.items()),
        row("angle-in-water", abs(angle_in_water_deg() - 22.06)),
        row("single-viewpoint-focal", abs(focal - PUBLISHED_FOCAL)),
        row("single-viewpoint-error", worst),
    ]
    return topic("refraction", rows=rows, figures=(_figure(),))


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


def single_viewpoint_errors() -> tuple[float, dict[float, float]]:
    """Focal length over f of the fit at 1 m, and its largest error in px at each distance."""
    fitted = fit_single_viewpoint()
    return float(fitted[0]) / FOCAL_PX, {
        at: float(np.abs(residuals(fitted, at)[1]).max()) for at in PUBLISHED_ERROR_PX
    }


def fit_single_viewpoint() -> Floats:
    """Focal length in px and two radial terms of the central camera that fits best at 1 m."""
    radii, pixels = field_radii(FIT_AT_MM)

    def misses(parameters: Floats) -> Floats:
        return _single_viewpoint(parameters, radii / FIT_AT_MM) - pixels

    start, scale = np.array([800.0, 0.0, 0.0]), np.array([100.0, 1.0, 1.0])
    solved = least_squares(misses, start, x_scale=scale, xtol=1e-15, ftol=1e-15)
    return np.asarray(solved.x)


def residuals(fitted: Floats, z_mm: float) -> tuple[Floats, Floats]:
    """(101,) pixel offsets at a distance, and the fitted camera's errors there, px."""
    radii, pixels = field_radii(z_mm)
    return pixels, _single_viewpoint(fitted, radii / z_mm) - pixels


def _single_viewpoint(parameters: Floats, tangent: Floats) -> Floats:
    focal, k1, k2 = parameters
    return np.asarray(focal * tangent * (1 + k1 * tangent**2 + k2 * tangent**4))


@style.styled
def _figure() -> ReportFigure:
    figure, (axes,) = style.panels(1, (style.WIDTH_IN, 2.6))
    fitted = fit_single_viewpoint()
    colours = (style.FIRST, style.SECOND, style.THIRD, style.ACCENT)
    for (at, _), colour in zip(PUBLISHED_ERROR_PX.items(), colours, strict=True):
        pixels, errors = residuals(fitted, at)
        axes.plot(pixels, errors, color=colour, label=f"{at / 1000:g} m")
    axes.set_xlabel("distance from the centre / px")
    axes.set_ylabel("error / px")
    style.legend(axes)
    return page_figure("refraction", figure)
