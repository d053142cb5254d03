"""Targets seen by random rigs in turbid water, and a window about their line."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from lscan.records import Status
from sim.render.judge.judged import Window
from sim.scene import Scene, load_scene
from sim.scene.matter import AmbientLight, Target, Water
from sim.scene.poses import camera_pose
from sim.truth import StripeTruth, stripe_truth
from sim.validation.physics.rigs import RANDOM, drawn

# A board that leans back, so that the sheet crosses it.
BOARD = Target(shape="board", position_mm=(0.0, 172.0, -100.0), tilt_x_deg=-50.0)
TARGETS: Mapping[str, tuple[str, Target | None]] = {
    "board": ("paper/groove", BOARD),
    "groove": ("paper/groove", None),
    "sandwave": ("paper/sandwave", None),
    "mesh": ("targets/coloured-mesh", None),
}
ABSORPTION_PER_M = 0.36
AIM_MM = np.array([225.0, 0.0, -300.0])  # what the camera's axis meets
ABOVE_MM = 1.0  # of the floor by more, a line is on the target
LEAST_SHOWN = 0.8  # of the window's columns show a line there


@dataclass(frozen=True)
class LightCase:
    """A scene with a random rig, and the window about a part of its line."""

    scene: Scene
    position_mm: float
    window: Window
    truth: StripeTruth


def light_case(
    target: str, depth: float, generator: np.random.Generator, columns: int, reach_px: int
) -> LightCase:
    """The target with a random rig a metre away, drawn again until the window shows its line.

    depth: scattering coefficient, 1/m.  columns: the window's.  reach_px: rows on either side of
    the line that it holds.
    """
    name, other = TARGETS[target]
    scene = load_scene(name)
    plan, height_px = scene.rig.plan, scene.rig.camera.height_px
    position_mm = plan.start_mm + 0.5 * plan.step_mm * plan.frames
    water = Water(absorption_per_m=ABSORPTION_PER_M, scattering_per_m=depth)
    sections = {"water": water, "light": AmbientLight(), "target": other or scene.tank.target}
    scene = replace(scene, tank=scene.tank.model_copy(update=sections))
    assert scene.tank.floor is not None
    while True:
        ranges = RANDOM["light"]
        laser, lens, head = (drawn(generator, ranges[part]) for part in ("laser", "lens", "head"))
        distance_mm = head.pop("distance_mm")
        found = scene.with_tank(laser={**laser, "on": True}, lens=lens, head=head)
        away = distance_mm * camera_pose(found.tank.head).rotation[:, 2]
        found = found.with_tank(head={"camera_mm": tuple((AIM_MM - away).tolist())})
        truth = stripe_truth(found, position_mm)
        left = int(generator.integers(len(truth.status) - columns))
        here = slice(left, left + columns)
        above = truth.xz_mm[here, 1] > scene.tank.floor.z_mm + ABOVE_MM
        if np.mean((truth.status[here] == Status.OK) & above) > LEAST_SHOWN:
            centre = truth.centre_px[here]
            top = max(int(np.nanmin(centre)) - reach_px, 0)
            bottom = min(int(np.nanmax(centre)) + reach_px + 1, height_px)
            return LightCase(found, position_mm, (left, top, columns, bottom - top), truth)
