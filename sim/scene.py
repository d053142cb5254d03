"""The scene file: a rig file whose camera and track are the tank's, and the tank around them.

Lengths mm, angles in degrees in the file, inherent optical properties per metre.  Poses of
camera and laser are in the head frame (lscan.records): the laser sheet is its plane y = 0,
x and z are those of the plane frame, whose origin is control point O of the board.  The
target stands in the world frame, which is the head frame of track position 0 turned by the
sheet's yaw, so that the track runs along y.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from lscan.documents import Document, Strict, check, read_document
from lscan.errors import InputError
from lscan.records import Floats
from lscan.rig import Rig, RigFile, inline_board, parse_rig

FLOOR_HALF_SIDE_MM = 3000.0  # beyond, a metre of turbid water has swallowed the light
Vector = tuple[float, float, float]
Fraction = Annotated[float, Field(ge=0, le=1)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]
SmallAngle = Annotated[float, Field(gt=-45, lt=45)]


class Lens(Strict):
    """Pinhole with Brown-Conrady distortion, as OpenCV writes it, in px of the picture.

    blur_px: standard deviation of the lens's point spread, taken as Gaussian.
    """

    focal_px: PositiveFloat
    centre_px: tuple[float, float]
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    f_number: PositiveFloat = 2.8
    transmission: Fraction = 0.85
    blur_px: NonNegativeFloat = 0.7


class Head(Strict):
    """Where the camera sits in the head, and how the head sits on the track.

    camera_mm: the pinhole.  The axis lies ``depression_deg`` below the horizon, turned by
    ``heading_deg`` about z (positive to the left), the camera rolled by ``roll_deg`` about it.
    yaw_deg: the sheet against the track; the track runs along (sin yaw, cos yaw, 0) of the head.
    """

    camera_mm: Vector
    depression_deg: Annotated[float, Field(gt=-90, lt=90)] = 30.0
    heading_deg: float = 0.0
    roll_deg: float = 0.0
    yaw_deg: SmallAngle = 0.0


class Port(Strict):
    """Flat port: ``gap_mm`` of air from pinhole to glass along its normal, then the glass.

    The normal is the camera's axis turned by the tilts about the camera's x and y.
    """

    gap_mm: PositiveFloat = 10.0
    thickness_mm: PositiveFloat = 6.0
    glass_index: Annotated[float, Field(ge=1, le=2.5)] = 1.488  # PMMA, physics.md section 1
    tilt_x_deg: SmallAngle = 0.0
    tilt_y_deg: SmallAngle = 0.0


class Laser(Strict):
    """A Gaussian sheet that opens from ``apex_mm`` in the plane y = 0 of the head.

    The fan's axis points down, turned by ``aim_deg`` towards +x.  waist_mm is the 1/e2 half
    thickness at ``waist_distance_mm`` from the apex; m2 the beam quality of its divergence.
    fan "uniform": a Powell lens; "gaussian": a cylinder lens, the fan's half angle being
    the 1/e2 half width of its power, cut off there.
    """

    power_mw: Annotated[float, Field(gt=0, le=1e5)]
    wavelength_nm: Annotated[float, Field(ge=450, le=700)] = 650.0
    apex_mm: Vector
    aim_deg: float = 0.0
    fan_half_angle_deg: Annotated[float, Field(gt=0, lt=80)] = 35.0
    fan: Literal["uniform", "gaussian"] = "uniform"
    waist_mm: PositiveFloat = 1.5
    waist_distance_mm: float = 600.0
    m2: Annotated[float, Field(ge=1)] = 1.0
    on: bool = True

    @model_validator(mode="after")
    def _apex_in_sheet(self) -> Self:
        if self.apex_mm[1] != 0:
            raise ValueError("apex_mm must lie in the sheet, the head's plane y = 0")
        return self


class Water(Strict):
    """The water: its state gives the index, its particles the rest (sim/water.py).

    particle_absorption_per_m comes on top of pure water's absorption at the laser's
    wavelength, particle_scattering_per_m on top of molecular scattering.
    """

    temperature_c: Annotated[float, Field(ge=0, le=30)] = 20.0
    salinity_psu: Annotated[float, Field(ge=0, le=35)] = 0.0
    particle_absorption_per_m: NonNegativeFloat = 0.0
    particle_scattering_per_m: NonNegativeFloat = 0.0


class Light(Strict):
    """Ambient light: radiance in W/(m2 sr) that reaches every point from all directions."""

    ambient_w_m2_sr: Annotated[float, Field(ge=0, le=1e6)] = 0.0


class Sand(Strict):
    """A coat of sand glued to the workpiece: spherical grains, half sunk, on a flat pack."""

    grain_mm: Annotated[float, Field(gt=0.05, le=5)] = 0.4
    spread: Annotated[float, Field(ge=0, lt=1)] = 0.3
    seed: Seed = 1


class Target(Strict):
    """What stands in the tank.

    shape "board": the rig's board, in the sheet of the head at track position 0, moved by
    ``position_mm`` and turned, both in the head frame.  "workpiece": the rig's workpiece;
    "mesh": a mesh file in mm; both placed in the world frame, turned about the workpiece
    frame's origin first about x (tilt_x), then y (tilt_y), then z (turn).
    albedo: diffuse reflectance at the laser's wavelength; of the marks where it is a board.
    """

    shape: Literal["board", "workpiece", "mesh", "none"]
    file: str | None = None
    position_mm: Vector = (0.0, 0.0, 0.0)
    turn_deg: float = 0.0
    tilt_x_deg: float = 0.0
    tilt_y_deg: float = 0.0
    albedo: Fraction = 0.5
    mark_albedo: Fraction = 0.05
    sand: Sand | None = None

    @model_validator(mode="after")
    def _file_goes_with_mesh(self) -> Self:
        if (self.shape == "mesh") != (self.file is not None):
            raise ValueError('file goes with shape = "mesh", and only with it')
        return self


class Floor(Strict):
    """The tank's floor, level in the world frame."""

    z_mm: float
    albedo: Fraction = 0.3


class Response(Strict):
    """Quantum efficiency of the red, green and blue pixels to one kind of light."""

    red: Fraction
    green: Fraction
    blue: Fraction


class Sensor(Strict):
    """EMVA 1288 linear model of a webcam's sensor (physics.md section 5).

    gain: 1 puts the full well at 255 DN.  gamma: the camera's; 1 is linear, a webcam has 2.2.
    """

    pixel_um: PositiveFloat = 6.0
    full_well_e: PositiveFloat = 15000.0
    dark_noise_e: NonNegativeFloat = 53.0
    prnu: Annotated[float, Field(ge=0, le=0.2)] = 0.01
    gain: PositiveFloat = 1.0
    black_level_dn: Annotated[float, Field(ge=0, lt=255)] = 2.0
    gamma: Annotated[float, Field(ge=1, le=3)] = 1.0
    laser_response: Response = Response(red=0.40, green=0.03, blue=0.01)
    ambient_response: Response = Response(red=0.30, green=0.33, blue=0.28)
    noise: bool = True
    seed: Seed = 1


class Render(Strict):
    """samples a pixel, a square number: they lie on a regular grid inside the pixel."""

    samples: Annotated[int, Field(ge=1, le=65536)] = 9
    seed: Seed = 1

    @model_validator(mode="after")
    def _square(self) -> Self:
        if round(self.samples**0.5) ** 2 != self.samples:
            raise ValueError("samples must be a square number (1, 4, 9, 16, 25 ...)")
        return self


class Tank(Strict):
    """The sections of a scene file that a rig file of real hardware does not have."""

    lens: Lens
    head: Head
    port: Port = Port()
    laser: Laser
    water: Water = Water()
    light: Light = Light()
    target: Target
    floor: Floor | None = None
    sensor: Sensor = Sensor()
    render: Render = Render()


@dataclass(frozen=True)
class Scene:
    """A rig, the tank around it, and the document both came from."""

    rig: Rig
    tank: Tank
    document: Document
    source: str


SECTIONS = frozenset(Tank.model_fields)


def load_scene(path: Path) -> Scene:
    """The scene described by the TOML file at ``path``; InputError names what is wrong."""
    document = inline_board(read_document(path))
    strange = sorted(set(document) - set(Rig.model_fields) - SECTIONS)
    if strange:
        allowed = ", ".join(sorted({*Rig.model_fields, *SECTIONS}))
        raise InputError(f"{strange[0]}: unknown section", where=path, allowed=allowed)
    return scene_of(parse_rig(document, source=str(path), trusted=True))


def scene_of(rig_file: RigFile) -> Scene:
    """The scene in a rig file that has the tank's sections; InputError names what is wrong."""
    own = {key: value for key, value in rig_file.document.items() if key in SECTIONS}
    scene = Scene(
        rig=rig_file.rig,
        tank=check(Tank, own, where=rig_file.source),
        document=rig_file.document,
        source=rig_file.source,
    )
    _check_target(scene)
    check_lens(scene)
    return scene


def _check_target(scene: Scene) -> None:
    shape, rig = scene.tank.target.shape, scene.rig
    needed: dict[str, Any] = {"board": rig.board, "workpiece": rig.workpiece}
    if shape in needed and needed[shape] is None:
        raise InputError(
            f"target.shape needs the section [{shape}]", where=scene.source, value=shape
        )


def check_lens(scene: Scene) -> None:
    """Refuse a distortion that folds the picture: the radius must grow all over the frame."""
    lens, camera = scene.tank.lens, scene.rig.camera
    corners = [(u, v) for u in (0, camera.width_px - 1) for v in (0, camera.height_px - 1)]
    offsets = np.array(corners) - np.array(lens.centre_px)
    reach = float(np.hypot(*(offsets / lens.focal_px).T).max())
    r = np.linspace(0, 2 * reach, 400)
    slope = 1 + 3 * lens.k1 * r**2 + 5 * lens.k2 * r**4 + 7 * lens.k3 * r**6
    distorted = r * (1 + lens.k1 * r**2 + lens.k2 * r**4 + lens.k3 * r**6)
    monotone = np.minimum.accumulate(slope) > 0
    if not np.any(monotone & (distorted >= reach)):
        raise InputError(
            "lens: the distortion folds the picture before its corners",
            where=scene.source,
            value=(lens.k1, lens.k2, lens.k3),
            allowed="coefficients for which the radius grows monotonically over the frame",
        )


def rotation_z(angle_deg: float) -> Floats:
    """(3, 3) rotation about z, counter-clockwise seen from above."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def rotation_x(angle_deg: float) -> Floats:
    """(3, 3) rotation about x, y towards z."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]])


def rotation_y(angle_deg: float) -> Floats:
    """(3, 3) rotation about y, z towards x."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[c, 0, s], [0, 1.0, 0], [-s, 0, c]])


@dataclass(frozen=True)
class Pose:
    """A rigid motion: P_outer = rotation @ P_inner + origin_mm."""

    rotation: Floats
    origin_mm: Floats

    def apply(self, points: Floats) -> Floats:
        """(..., 3) points of the inner frame in the outer one, mm."""
        return points @ self.rotation.T + self.origin_mm

    def invert(self, points: Floats) -> Floats:
        """(..., 3) points of the outer frame in the inner one, mm."""
        return (points - self.origin_mm) @ self.rotation

    def __matmul__(self, inner: Pose) -> Pose:
        return Pose(self.rotation @ inner.rotation, self.apply(inner.origin_mm))


def camera_pose(head: Head) -> Pose:
    """Camera frame (x right, y down, z along the axis) to head frame."""
    level = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # looking along the head's y
    rotation = (
        rotation_z(head.heading_deg)
        @ level
        @ rotation_x(-head.depression_deg)
        @ rotation_z(head.roll_deg)
    )
    return Pose(rotation, np.array(head.camera_mm))


def head_pose(head: Head, position_mm: float) -> Pose:
    """Head frame to world frame with the head at a track position in mm."""
    return Pose(rotation_z(head.yaw_deg), np.array([0.0, position_mm, 0.0]))


def target_pose(scene: Scene) -> Pose:
    """Workpiece (or board, or mesh) frame to world frame."""
    target = scene.tank.target
    turned = (
        rotation_z(target.turn_deg) @ rotation_y(target.tilt_y_deg) @ rotation_x(target.tilt_x_deg)
    )
    pose = Pose(turned, np.array(target.position_mm))
    return head_pose(scene.tank.head, 0.0) @ pose if target.shape == "board" else pose
