"""A scene file: a rig file whose camera and track are the tank's, and the tank around them."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isqrt
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from lscan.config.board import Board
from lscan.config.documents import Document, Strict, check, read_document
from lscan.config.rig import BENDS, Rig, RigFile, inline_board, parse_rig
from lscan.errors import InputError
from lscan.records import Floats
from sim.scene import instrument
from sim.scene.errors import STEEPEST, BoardErrors, TrackErrors, TrueBoard
from sim.scene.matter import AmbientLight, Floor, Target, Water
from sim.scene.poses import Pose, head_pose, rotation, track_pose
from sim.scene.varying import Change, check_changes, with_offsets

FLOOR_BEYOND_MM = 3000.0
"""Farther off, a metre of turbid water has absorbed the light."""

FLOOR_PLACES = 25
"""Of the plan's, spread evenly, beneath which the floor lies."""


class Render(Strict):
    """How many samples a pixel, and in how many parts.

    samples: for light that meets one surface or one place of the water, a square number:
    they lie on a regular grid inside the pixel.  light: how the laser's light of all higher
    orders is found: "gathered", summed up without noise (sim.render.gathered), or "sampled",
    drawn at random.  scatter_samples: for what is drawn at random; 0 leaves the higher orders
    out, gathered or sampled.  fineness: parts of a pixel's side
    in which the lens spreads the light before the pixel gathers it (sim.render.layers).
    """

    samples: Annotated[int, Field(ge=1, le=65536)] = 9
    light: Literal["gathered", "sampled"] = "gathered"
    scatter_samples: Annotated[int, Field(ge=0, le=65536)] = 1
    fineness: Annotated[int, Field(ge=1, le=3)] = 1
    seed: instrument.Seed = 1

    @model_validator(mode="after")
    def _square(self) -> Self:
        if not _is_square_of(self.samples, self.fineness):
            raise ValueError(f"samples must be {_allowed_samples(self.fineness)}")
        return self


def check_samples(samples: int, fineness: int, where: str) -> None:
    """Refuse samples a pixel that are no square number in each of its parts.

    Parameters
    ----------
    samples : int, rays a pixel
    fineness : int, parts a side of each pixel
    where : str or Path, what the error names as the place of the number

    Raises
    ------
    InputError
        The samples are no such number; names those that are close to it.
    """
    if samples < 1 or not _is_square_of(samples, fineness):
        what = "not a square number" + (" in each part of a pixel" if fineness > 1 else "")
        raise InputError(what, where=where, value=samples, allowed=_allowed_samples(fineness))


def _is_square_of(samples: int, fineness: int) -> bool:
    side = isqrt(samples)
    return side**2 == samples and side % fineness == 0


def _allowed_samples(fineness: int) -> str:
    some = ", ".join(str((fineness * side) ** 2) for side in range(1, 6))
    share = f" times the square of fineness {fineness}" if fineness > 1 else ""
    return f"a square number{share} ({some} ...)"


class TankSections(Strict):
    """The sections of a scene file that a rig file of real hardware does not have."""

    lens: instrument.Lens
    head: instrument.Head
    port: instrument.Port = instrument.PlanePort()
    laser: instrument.Laser
    water: Water = Water()
    light: AmbientLight = AmbientLight()
    target: Target
    floor: Floor | None = None
    sensor: instrument.Sensor = instrument.Sensor()
    render: Render = Render()
    board_errors: BoardErrors = BoardErrors()
    track_errors: TrackErrors = TrackErrors()
    change: tuple[Change, ...] = ()


@dataclass(frozen=True)
class Scene:
    """A rig, the tank around it, and the document both came from.

    Attributes
    ----------
    rig : Rig, camera, track and plan, as the scanner has them
    tank : TankSections, the sections that only the tank has
    document : Document, the file as it was read, boards written in
    source : str, path of the file, for errors

    Examples
    --------
    >>> import sim
    >>> scene = sim.load_scene("paper/groove")
    >>> scene.rig.name, scene.tank.target.shape
    ('paper: grooved block', 'workpiece')
    """

    rig: Rig
    tank: TankSections
    document: Document
    source: str

    def board(self) -> Board:
        """The board that is the target; InputError where the target is another."""
        if self.tank.target.shape != "board" or self.rig.board is None:
            what, allowed = "target is not the board", 'shape = "board"'
            raise InputError(what, where=self.source, value=self.tank.target.shape, allowed=allowed)
        return self.rig.board

    def true_board(self) -> TrueBoard:
        """The board as it truly is; InputError where the target is another."""
        return TrueBoard(self.board(), self.tank.board_errors)

    def with_tank(self, **sections: Mapping[str, Any]) -> "Scene":
        """The scene with fields of its tank's sections replaced, which are not checked anew.

        Parameters
        ----------
        sections : mapping, by name of a section, the fields to replace with their values
        """
        changed = {
            name: getattr(self.tank, name).model_copy(update=dict(fields))
            for name, fields in sections.items()
        }
        return replace(self, tank=self.tank.model_copy(update=changed))


SECTIONS = frozenset(TankSections.model_fields)


def load_scene(path: Path | str) -> Scene:
    """The scene described by a TOML file.

    Parameters
    ----------
    path
        The file, or a name that ``lscan scenes`` lists.

    Raises
    ------
    InputError
        Names the file, the key, the value and what is allowed.

    Examples
    --------
    >>> scene = load_scene(Path("paper/groove"))
    >>> scene.tank.laser.wavelength_nm
    650.0
    """
    document = inline_board(read_document(path), source=str(path))
    if strange := sorted(set(document) - set(Rig.model_fields) - SECTIONS):
        allowed = ", ".join(sorted({*Rig.model_fields, *SECTIONS}))
        raise InputError(f"{strange[0]}: unknown section", where=path, allowed=allowed)
    return scene_of(parse_rig(document, source=str(path), trusted=True))


def scene_of(rig_file: RigFile) -> Scene:
    """The scene in a rig file that has the tank's sections.

    Parameters
    ----------
    rig_file : RigFile, read by ``lscan.load_rig``

    Raises
    ------
    InputError
        Names the file, the key, the value and what is allowed.
    """
    own = {key: value for key, value in rig_file.document.items() if key in SECTIONS}
    try:
        tank = check(TankSections, own, where=rig_file.source)
    except InputError as error:
        required = {key for key, field in TankSections.model_fields.items() if field.is_required()}
        if required - own.keys() != {"target"}:
            raise
        # What else is wrong comes first: with a target there is nothing but that to find.
        check(TankSections, {**own, "target": {"shape": "none"}}, where=rig_file.source)
        raise InputError(
            f"{error.what}: this is a rig in the tank with nothing to scan",
            where=error.where,
            allowed=f"a scene, such as paper/board (`lscan scenes` lists all), or a file that "
            f"includes this one and adds [target] with {error.allowed}",
        ) from None
    head = _on_its_shaft(tank.head, rig_file)
    sensor = tank.sensor
    if "laser_response" not in sensor.model_fields_set:  # then a webcam's at that wavelength
        response = instrument.response_at(tank.laser.wavelength_nm)
        sensor = sensor.model_copy(update={"laser_response": response})
    scene = Scene(
        rig=rig_file.rig,
        tank=tank.model_copy(update={"head": head, "sensor": sensor}),
        document=rig_file.document,
        source=rig_file.source,
    )
    _check_target(scene)
    check_lens(scene)
    check_changes(scene)
    if scene.rig.camera.bits > 8 and sensor.jpeg_quality is not None:
        what = "sensor.jpeg_quality: JPEG holds 8 bits a colour"
        allowed = "camera.bits = 8, or no jpeg_quality"
        raise InputError(what, where=scene.source, value=scene.rig.camera.bits, allowed=allowed)
    return scene


def _on_its_shaft(head: instrument.Head, rig_file: RigFile) -> instrument.Head:
    """The head with the shaft it truly turns about, where the rig has one: else the rig's own."""
    stated, source = rig_file.rig.shaft, rig_file.source
    if stated is None:
        if head.shaft is not None:
            allowed = "head.shaft left out, or the section [shaft] beside it"
            raise InputError("head.shaft: needs the section [shaft]", where=source, allowed=allowed)
        return head
    if head.speed_mm_s != 0:
        what = "head.speed_mm_s: a head on a shaft stands still while a picture is taken"
        raise InputError(what, where=source, value=head.speed_mm_s, allowed="0")
    true = head.shaft or instrument.TrueShaft(point_mm=stated.point_mm, direction=stated.direction)
    if true.arc_radius_mm is None:
        true = true.model_copy(update={"arc_radius_mm": stated.arc_radius_mm})
    return head.model_copy(update={"shaft": true})


def _check_target(scene: Scene) -> None:
    shape, rig = scene.tank.target.shape, scene.rig
    needed: dict[str, Any] = {"board": rig.board, "workpiece": rig.workpiece}
    if shape in needed and needed[shape] is None:
        what = f"target.shape: needs the section [{shape}]"
        allowed = f"the section [{shape}] beside it, or another shape"
        raise InputError(what, where=scene.source, value=shape, allowed=allowed)
    if rig.board is not None:
        left, right, bottom, top = rig.board.outline_mm()
        for axis, side_mm in (("x", right - left), ("z", top - bottom)):
            bend_mm = getattr(scene.tank.board_errors, f"bend_{axis}_mm")
            if STEEPEST * abs(bend_mm) > side_mm:
                what = f"board_errors.bend_{axis}_mm: too much for this board"
                allowed = f"at most {side_mm / STEEPEST:g} either way"
                raise InputError(what, where=scene.source, value=bend_mm, allowed=allowed)


def check_lens(scene: Scene) -> None:
    """Refuse a distortion that folds within the picture: what is there would be seen twice."""
    lens, camera = scene.tank.lens, scene.rig.camera
    if instrument.is_folded(lens, camera.width_px, camera.height_px):
        raise InputError(
            "lens: the distortion folds the picture before its corners, or 90 degrees off the axis "
            "are nearer than these",
            where=scene.source,
            value={name: value for name in BENDS if (value := getattr(lens, name))},
            allowed="coefficients, and a focal_px, with an inverse all over the picture",
        )


def target_pose(scene: Scene) -> Pose:
    """Workpiece (or board, or mesh) frame to world frame.

    Parameters
    ----------
    scene : Scene, its target is placed; a board turns with the head's yaw
    """
    target = scene.tank.target
    angles = (target.turn_deg, target.tilt_y_deg, target.tilt_x_deg)
    pose = Pose(rotation("ZYX", angles), np.array(target.position_mm))
    return track_pose(scene.tank.head, 0.0) @ pose if target.shape == "board" else pose


def floor_corners_mm(scene: Scene) -> Floats:
    """(4, 3) corners of the floor, mm, counter-clockwise from above, world frame.

    It reaches FLOOR_BEYOND_MM to each side of the world's origin, and where the plan takes camera
    or laser farther out than half of that, so far beyond them too.

    Parameters
    ----------
    scene : Scene, with a floor
    """
    assert scene.tank.floor is not None
    head, places_mm = scene.tank.head, np.array(scene.rig.plan.positions_mm())
    places_mm = places_mm[np.linspace(0, len(places_mm) - 1, FLOOR_PLACES).astype(int)]
    own = np.array([head.camera_mm, scene.tank.laser.apex_mm])
    there = np.concatenate([head_pose(head, place).apply(own) for place in places_mm.tolist()])
    low, high = np.full(2, -FLOOR_BEYOND_MM), np.full(2, FLOOR_BEYOND_MM)
    if np.abs(there[:, :2]).max() > FLOOR_BEYOND_MM / 2:
        low = np.minimum(low, there[:, :2].min(axis=0) - FLOOR_BEYOND_MM)
        high = np.maximum(high, there[:, :2].max(axis=0) + FLOOR_BEYOND_MM)
    x, y = np.stack([low, high])[[0, 1, 1, 0], 0], np.stack([low, high])[[0, 0, 1, 1], 1]
    return np.column_stack([x, y, np.full(4, scene.tank.floor.z_mm)])


# The scene as it is in one picture: with that picture's numbers, the head where it truly is.
#
# All is a function of the scene, the picture's number and the commanded position alone, so that a
# scan which is stopped and resumed gives the same pictures, and camera and truth see the same.


@dataclass(frozen=True)
class Moment:
    """What holds in one picture.

    Attributes
    ----------
    scene : Scene, with the picture's numbers; its head is turned and shifted as the track's errors
        have it, which are no longer in it themselves
    position_mm : float, mm, true position along the track: ``head_pose`` of both is the head's
        true pose

    Examples
    --------
    >>> import sim
    >>> moment = sim.at_moment(sim.load_scene("paper/groove"), 0, 2.5)
    >>> moment.scene.rig.name, moment.position_mm
    ('paper: grooved block', 2.5)
    """

    scene: Scene
    position_mm: float


def at_moment(scene: Scene, frame: int, position_mm: float) -> Moment:
    """The scene as picture ``frame`` shows it, the track commanded to ``position_mm``.

    Parameters
    ----------
    scene
        The scene; without ``[track_errors]`` and ``[[change]]`` it comes back as it is.
    frame
        Number of the picture in the scan, from 0.
    position_mm
        Commanded position of the track.

    Raises
    ------
    InputError
        Changes put a number of the scene out of its range.

    Examples
    --------
    >>> import sim
    >>> scene = sim.load_scene("paper/groove")
    >>> sim.at_moment(scene, 3, 10.0).position_mm
    10.0
    """
    tank = scene.tank
    if not is_changing(scene):
        return Moment(scene, position_mm)
    drawn = [(change, change.offset(frame, position_mm)) for change in tank.change]
    where = f"{scene.source}, picture {frame}"
    errors, changed = tank.track_errors, with_offsets(scene, drawn, where)
    head = changed.tank.head
    turn = np.add(head.turn_deg, errors.turn_deg(position_mm))
    shift = np.add(head.shift_mm, errors.shift_mm(position_mm))
    here = {"turn_deg": tuple(turn.tolist()), "shift_mm": tuple(shift.tolist())}
    update = {"head": head.model_copy(update=here), "track_errors": TrackErrors(), "change": ()}
    changed = replace(changed, tank=changed.tank.model_copy(update=update))
    return Moment(changed, errors.true_mm(scene.rig.plan, frame, position_mm))


def is_changing(scene: Scene) -> bool:
    """Whether anything but the commanded position sets one picture apart from another.

    Parameters
    ----------
    scene : Scene, its changes and its track's errors
    """
    return bool(scene.tank.change) or scene.tank.track_errors != TrackErrors()
