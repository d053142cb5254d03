"""Scenes for the checks, built here: they rest on no file that a user may edit."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib.figure import Figure

from lscan.config.documents import Document, merge
from lscan.config.rig import parse_rig
from lscan.errors import InputError
from lscan.figures import style
from lscan.figures.page import ReportFigure
from lscan.files.disk import packaged_table
from lscan.records import Floats, Status
from sim.render.plugins.arrays import floats
from sim.render.plugins.camera import PortCrossing, PortOptics, RefractiveCamera, port_rotation
from sim.scene import PlanePort, Port, Pose, Scene, load_scene, scene_of
from sim.scene.matter import AmbientLight, Target, Water
from sim.scene.poses import camera_pose
from sim.truth import StripeTruth, stripe_truth
from sim.water import glass_index
from tests.validation.light.judge import Window
from tests.validation.rows import Row, Topic

# The camera plugin behind a port that is real dielectric geometry instead of a closed form.
#
# Geometry, refraction and Fresnel's loss are Mitsuba's own: stock shapes with the stock
# ``dielectric``, in a small scene of the camera frame that moves with the camera.  So it checks
# sim.render.plugins.camera without sharing a formula with it, and can stand in for it in any
# picture.


# A port has an inner and an outer face.
FACES = 2
# A refracted ray starts this much past the face it has crossed, so as not to meet it again.
# Along the ray: Mitsuba's own spawn_ray steps aside along the normal, by up to 9e-3 mm where
# coordinates are 100 mm, which moves a ray at 45 degrees by 0.01 px at 0.5 m.
STEP_MM = 1e-3
# Half the side of a flat port's faces over its distance: rays up to 84 degrees pass.
FLAT_REACH = 10.0


class TracedPort:
    """A port of any shapes with ``dielectric`` BSDFs, two of them on the way of each ray.

    shapes: Mitsuba dictionaries or objects by name, in the camera frame, mm.  Meshes serve
    as well as analytic shapes, as finely as they are tessellated.
    """

    def __init__(self, shapes: Mapping[str, Any]) -> None:
        """Build the port's own scene."""
        self.scene = mi.load_dict({"type": "scene", **shapes})
        # Lobe 0 of a dielectric is its reflection, lobe 1 its transmission.  Alone, a lobe
        # is drawn with certainty, and its weight is the share of radiance transmitted, which
        # in a light's radiance mode holds the change of index squared too.
        self.context = mi.BSDFContext()
        self.context.component = 1

    def cross(self, origin: mi.Point3f, direction: mi.Vector3f) -> PortCrossing:
        """The rays behind the second face they meet; those that meet fewer weigh 0."""
        ray = mi.Ray3f(mi.Point3f(origin), direction)
        weight, active = mi.Float(1.0), mi.Bool(True)
        for _ in range(FACES):
            si = self.scene.ray_intersect(ray, active)
            active &= si.is_valid()
            # The numbers drawn decide nothing: there is one lobe, and it is a delta.
            lobe, share = si.bsdf().sample(self.context, si, 0.5, mi.Point2f(0.5), active)
            weight *= share.x
            refracted = si.to_world(lobe.wo)
            ray = mi.Ray3f(si.p + refracted * STEP_MM, refracted)
        return PortCrossing(si.p, ray.d, dr.select(active, weight, 0.0))


class TracedCamera(RefractiveCamera):
    """As ``RefractiveCamera``, its port traced; the port's numbers are compiled in."""

    def make_port(self, port: Port, glass_index: float, water_index: float) -> PortOptics:
        """The port as dielectric geometry.

        Parameters
        ----------
        port : Port, its air gap and its glass
        glass_index, water_index : float, relative to air
        """
        return TracedPort(port_shapes(port, glass_index, water_index))


def port_shapes(port: Port, glass_index: float, water_index: float) -> dict[str, dict[str, Any]]:
    """The port's two faces as Mitsuba dictionaries, camera frame, mm, normals to the water.

    Rectangles for a flat port, analytic spheres for a dome: Mitsuba solves its spheres in
    double precision and puts the hit back on the sphere.
    """
    if isinstance(port, PlanePort):
        near, far = port.gap_mm, port.gap_mm + port.thickness_mm
        rotation = port_rotation(port)
        inner, outer = (rectangle(rotation, at, FLAT_REACH * far) for at in (near, far))
    else:
        sphere = {"type": "sphere", "center": list(port.centre_mm)}
        near, far = port.radius_mm, port.radius_mm + port.thickness_mm
        inner, outer = ({**sphere, "radius": radius} for radius in (near, far))
    return {
        "inner": {**inner, "bsdf": dielectric(1.0, glass_index)},
        "outer": {**outer, "bsdf": dielectric(glass_index, water_index)},
    }


def dielectric(inside: float, outside: float) -> dict[str, Any]:
    """A smooth interface; ``outside`` is the index on the side its normal points to."""
    return {"type": "dielectric", "int_ior": inside, "ext_ior": outside}


def rectangle(rotation: Floats, distance_mm: float, half_side_mm: float) -> dict[str, Any]:
    """A square across the last column of ``rotation``, at ``distance_mm`` along it."""
    to_world = np.eye(4)
    to_world[:3, :3] = rotation * half_side_mm
    to_world[:3, 3] = rotation[:, 2] * distance_mm
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f(to_world)}


mi.register_sensor("traced_camera", TracedCamera)


# Scenes for the checks, built here: the evidence rests on no file that a user may edit.


PLUGINS = {RefractiveCamera: "refractive_camera", TracedCamera: "traced_camera"}
SCENES = packaged_table("tests.validation.light", "scenes.toml")
RANDOM = SCENES["random"]


def scene_with(name: str = "base", **sections: Document) -> Scene:
    """The scene of that name in scenes.toml with these sections laid over it.

    InputError where they do not fit.
    """
    document = merge(merge(SCENES["base"], SCENES[name]), sections)
    return scene_of(parse_rig(document, source="verify", trusted=True))


def drawn(generator: np.random.Generator, ranges: Mapping[str, Any]) -> dict[str, Any]:
    """A value for each key: uniform between two bounds, a list where there is a list of them."""
    values = {key: generator.uniform(*np.array(pair).T) for key, pair in ranges.items()}
    return {key: np.asarray(value).tolist() for key, value in values.items()}


def random_rig(generator: np.random.Generator, kind: str) -> Scene:
    """A scene with a random lens, head and port of ``kind`` "flat" or "dome".

    Drawn again while its lens would fold the picture.
    """
    while True:
        port = {"kind": kind, **drawn(generator, RANDOM[kind])}
        if kind == "dome":
            radius = port["radius_mm"]
            port |= drawn(generator, {"centre_mm": [(-0.15 * radius, 0.15 * radius)] * 3})
        try:
            lens, head = (drawn(generator, RANDOM[name]) for name in ("lens", "head"))
            return scene_with(lens=lens, port=port, head=head)
        except InputError:
            continue


def random_pixels(generator: np.random.Generator, scene: Scene, count: int) -> Floats:
    """(count, 2) places (u, v) all over the picture, px."""
    camera = scene.rig.camera
    return generator.uniform(-0.5, 0.5, (count, 2)) * [camera.width_px, camera.height_px] + [
        (camera.width_px - 1) / 2,
        (camera.height_px - 1) / 2,
    ]


def make_camera(
    kind: type[RefractiveCamera], scene: Scene, water_index: float, pose: Pose
) -> RefractiveCamera:
    """The scene's camera at ``pose``, its port in closed form or traced as ``kind`` says."""
    width, height = picture_size(scene)
    film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "luminance"}
    camera = mi.load_dict({"type": PLUGINS[kind], "film": film})
    assert isinstance(camera, kind)
    port = scene.tank.port
    glass = glass_index(port.glass_index, scene.tank.laser.wavelength_nm)
    camera.configure(scene.tank.lens, port, glass, water_index)
    camera.place(pose)
    return camera


def camera_rays(
    camera: RefractiveCamera, scene: Scene, pixels: Floats
) -> tuple[Floats, Floats, Floats]:
    """Origins (N, 3) mm, unit directions (N, 3) and weights (N,) of the rays through pixels.

    pixels: (N, 2) of (u, v).  The frame is that of the camera's pose.
    """
    place = (pixels + 0.5) / np.array(picture_size(scene))
    sample = mi.Point2f(*map(floats, place.T))
    ray, weight = camera.sample_ray(0.0, 0.0, sample, mi.Point2f(0.5))
    origins, directions = (np.array(vectors, dtype=float).T for vectors in (ray.o, ray.d))
    return origins, directions, np.array(weight, dtype=float).ravel()


def picture_size(scene: Scene) -> tuple[int, int]:
    """(width, height) of the scene's pictures in px."""
    return scene.rig.camera.width_px, scene.rig.camera.height_px


# Targets seen by random rigs in turbid water, and a window about their line.


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


# The topics of the page and their figures, with the words of topics.toml.


def topic(key: str, rows: Iterable[Row], figures: tuple[ReportFigure, ...] = ()) -> Topic:
    """The topic of that key of topics.toml."""
    words = _words(key)
    return Topic(key, words["title"], words["text"].replace("\n", " "), tuple(rows), figures)


def page_figure(key: str, drawn: Figure) -> ReportFigure:
    """The figure of the topic of that key, as drawn."""
    words = _words(key)["figure"]
    words["caption"] = words["caption"].replace("\n", " ")
    return ReportFigure(**words, paper="", body=style.svg(drawn, words["key"], words["alt"]))


def _words(key: str) -> Any:
    return packaged_table("tests.validation.light", "topics.toml")[key]


def reference(key: str) -> Any:
    """The values that the topic of that key is held against."""
    return packaged_table("tests.validation.light", "references.toml")[key]
