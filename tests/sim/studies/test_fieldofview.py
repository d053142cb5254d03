"""Measured width and depth range against refraction at a flat window, worked out by hand."""

import numpy as np
import pytest

from lscan.config.documents import merge
from lscan.config.rig import load_rig, parse_rig
from sim.scene import Scene, scene_of
from sim.studies.design.rig import aim_mm, measured_mm
from sim.water import water_optics

PLAIN = {"lens": {"k1": 0.0, "k2": 0.0}, "laser": {"fan_half_angle_deg": 60.0}}


def scene(**sections: object) -> Scene:
    base = merge(load_rig("paper/sandwave").document, PLAIN)
    document = merge(base, dict(sections))
    return scene_of(parse_rig(document, source="field of view", trusted=True))


def off_axis_mm(of: Scene, angle: float, far_mm: float) -> float:
    """How far off the axis a ray that leaves the pinhole at an angle is, at a depth; Snell."""
    port, water = of.tank.port, water_optics(of.tank.water, of.tank.laser.wavelength_nm).index
    inside, outside = (np.arcsin(np.sin(angle) / index) for index in (port.glass_index, water))
    at_glass = port.gap_mm * np.tan(angle) + port.thickness_mm * np.tan(inside)
    return float(at_glass + (far_mm - port.gap_mm - port.thickness_mm) * np.tan(outside))


def on_the_sheet_mm(of: Scene, angle: float) -> float:
    """Height where a ray above (or below) the axis by an angle meets the sheet y = 0."""
    head, axis = of.tank.head, -np.radians(of.tank.head.depression_deg)
    lower, upper = 0.0, 1e4  # the ray's depth along the axis, halved until it is at the sheet
    for _ in range(100):
        far = (lower + upper) / 2
        off = off_axis_mm(of, angle, far)
        reached = far * np.cos(axis) - off * np.sin(axis) > -head.camera_mm[1]
        lower, upper = (lower, far) if reached else (far, upper)
    return float(head.camera_mm[2] + far * np.sin(axis) + off * np.cos(axis))


@pytest.mark.parametrize("water", [{"kind": "air", "particle_absorption_per_m": None}, {}])
@pytest.mark.parametrize("depression_deg", [20.0, 30.0, 50.0])
def test_width_and_depth_are_those_of_refracted_rays(
    water: dict[str, object], depression_deg: float
) -> None:
    head = {"depression_deg": depression_deg}
    of = scene(head=head)
    if water:
        document = {**of.document, "water": {"kind": "air"}}
        of = scene_of(parse_rig(document, source="air", trusted=True))
    far = float(np.linalg.norm(aim_mm(of.tank.head) - np.array(of.tank.head.camera_mm)))
    across, down = (np.arctan(side / 2 / of.tank.lens.focal_px) for side in (640, 480))
    width, depth = measured_mm(of)
    assert width == pytest.approx(2 * off_axis_mm(of, across, far), abs=0.01)
    upper, lower = on_the_sheet_mm(of, down), on_the_sheet_mm(of, -down)
    # Linear interpolation between places 1.5 mm apart: 1e-6 of the picture's curvature.
    assert depth == pytest.approx(min(upper, of.tank.laser.apex_mm[2]) - lower, abs=0.5)


def test_the_fan_bounds_the_width() -> None:
    of = scene(laser={"fan_half_angle_deg": 10.0})
    reach = (of.tank.laser.apex_mm[2] - aim_mm(of.tank.head)[2]) * np.tan(np.radians(10.0))
    assert measured_mm(of)[0] == pytest.approx(2 * reach, abs=0.01)


def test_nothing_is_measured_where_the_aim_is_dark() -> None:
    assert measured_mm(scene(laser={"aim_deg": 80.0}))[0] == 0.0
