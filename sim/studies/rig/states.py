"""The two states of a rig that a row stands for: as it was calibrated, and as it scans."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ndtr, ndtri

from lscan.config.documents import check
from lscan.config.targets import Sandwave
from lscan.errors import InputError, MeasurementError
from lscan.records import Floats, Ints, Mask, Status, select
from sim.scene import Pose, Scene, head_pose, into_world, rotation, target_pose
from sim.scene.varying import Change, number_at, with_numbers
from sim.studies.studyfile import Cause, Study
from sim.truth import StripeTruth, stripe_truths
from sim.truth.sheet import TrueSheet, sheet_of, sheet_plane
from sim.truth.surfaces import Wave, surfaces_of, target_surfaces
from sim.truth.visibility import apex_xz, fan_angle

SEEDS = 2**31
CALIBRATE, SCAN = "calibrate.", "scan."
SEEDED = {
    "track_errors.noise_mm": "track_errors.seed",
    "board_errors.dot_noise_mm": "board_errors.seed",
}  # what is drawn at random within one rig is drawn anew in the next


@dataclass(frozen=True)
class RigStates:
    """A rig in its states.

    Attributes
    ----------
    calibrate : Scene, of the board, as the instrument was calibrated
    recalibrate : Scene, of the board, in the state of the scan; None where nothing has drifted
    frame, frame_anew : Pose, from the frame that either calibration defines, which is that of the
        board where it ought to lie, to that of the head: a board is put into the sheet, so that
        where the sheet lies decides what is measured from
    scan : Scene, of what is measured
    seeds : dict, of each noise that is at work, by its key
    """

    calibrate: Scene
    recalibrate: Scene | None
    scan: Scene
    frame: Pose
    frame_anew: Pose
    seeds: dict[str, int]


def states_of(study: Study, row: Floats, root: Floats | None = None) -> RigStates:
    """The states of the rig that a row of numbers stands for.

    Parameters
    ----------
    study : Study
    row : (D,) array, of numbers in (0, 1) or NOMINAL, one for each cause
    root : (D, D) array, optional, lower root of the causes' correlations, where there are any

    Raises
    ------
    InputError
        A number is out of the range of its key, or no number has that key.
    """
    shares = correlate(row, root)
    before: dict[str, float] = {}
    since: dict[str, float] = {}
    changes: list[Change] = []
    seeds: dict[str, int] = {}
    where = study.source
    for cause, share in zip(study.file.cause.values(), shares.tolist(), strict=True):
        if np.isnan(share):
            continue
        if cause.when == "noise":
            seeds[cause.key] = _seed(share)
            continue
        if cause.when == "each-frame":
            changes.append(_change(cause, share, where))
            continue
        numbers = cause.together | {cause.key: share_of(study, cause, share)}
        if cause.key in SEEDED:
            numbers[SEEDED[cause.key]] = _seed(share)
        since |= numbers
        if cause.when == "as-built":
            before |= numbers
    board, anew = (
        apply_numbers(study.calibrate, state, CALIBRATE, where) for state in (before, since)
    )
    scan = apply_numbers(study.scan, since, SCAN, where)
    if changes:
        every = (*scan.tank.change, *changes)
        scan = replace(scan, tank=scan.tank.model_copy(update={"change": every}))
    motion, motion_anew = (sheet_motion(study.calibrate, one) for one in (board, anew))
    ought = board_in_sheet(study.calibrate)
    return RigStates(
        calibrate=_into_sheet(board, motion),
        recalibrate=_into_sheet(anew, motion_anew) if since != before else None,
        scan=scan,
        frame=motion @ ought,
        frame_anew=motion_anew @ ought,
        seeds=seeds,
    )


def sheet_motion(nominal: Scene, scene: Scene) -> Pose:
    """How the first of a laser's sheets lies against where it ought to, head frame.

    Parameters
    ----------
    nominal, scene : Scene, of the rig as it ought to be and as it is
    """
    there, ought = (
        sheet_plane(one.tank.laser, one.tank.laser.sheets[0]) for one in (scene, nominal)
    )
    turned = there.rotation @ ought.rotation.T
    return Pose(turned, there.origin_mm - turned @ ought.origin_mm)


def board_in_sheet(scene: Scene) -> Pose:
    """The frame of a board to that of the head, its origin moved straight into the first sheet.

    Parameters
    ----------
    scene : Scene, its target is the board
    """
    pose = _target_in_head(scene)
    sheet = sheet_plane(scene.tank.laser, scene.tank.laser.sheets[0])
    x, _, z = sheet.invert(pose.origin_mm)
    return Pose(pose.rotation, sheet.apply(np.array([x, 0.0, z])))


def _target_in_head(scene: Scene) -> Pose:
    target = scene.tank.target
    angles = (target.turn_deg, target.tilt_y_deg, target.tilt_x_deg)
    return Pose(rotation("ZYX", angles), np.array(target.position_mm))


def _into_sheet(board: Scene, motion: Pose) -> Scene:
    """The board moved as the sheet is: whoever calibrates puts it there."""
    if np.array_equal(motion.rotation, np.eye(3)) and not motion.origin_mm.any():
        return board
    pose = motion @ _target_in_head(board)
    angles = Rotation.from_matrix(pose.rotation).as_euler("ZYX", degrees=True)
    turn, tilt_y, tilt_x = angles.tolist()
    moved = {
        "position_mm": tuple(pose.origin_mm.tolist()),
        "turn_deg": turn, "tilt_y_deg": tilt_y, "tilt_x_deg": tilt_x,
    }  # fmt: skip
    return board.with_tank(target=moved)


def share_of(study: Study, cause: Cause, share: float) -> float:
    """The number of a cause at a quantile of its distribution."""
    scene = study.calibrate if cause.key.startswith(CALIBRATE) else study.scan
    own = 0.0
    if cause.off or cause.relative:
        own = number_at(scene, cause.key.removeprefix(CALIBRATE).removeprefix(SCAN))
    return cause.number(share, own)


def check_keys(study: Study) -> None:
    """Refuse causes whose keys name no number, or whose usual numbers are out of range.

    Parameters
    ----------
    study : Study

    Raises
    ------
    InputError
        Names the cause, the key and what is allowed.
    """
    for column in range(len(study.causes)):
        for share in (0.05, 0.95):
            row = np.full(len(study.causes), np.nan)
            row[column] = share
            try:
                states_of(study, row)
            except InputError as error:
                where = f"{study.source}, [cause.{study.causes[column]}]"
                value, allowed = error.value, error.allowed
                raise InputError(error.what, where=where, value=value, allowed=allowed) from error


def apply_numbers(scene: Scene, numbers: Mapping[str, float], own: str, where: str) -> Scene:
    """The scene with the numbers that are meant for it.

    Parameters
    ----------
    scene : Scene
    numbers : mapping, from keys, those of one scene alone with CALIBRATE or SCAN before them
    own : str, CALIBRATE or SCAN, which of these is the scene
    where : str, what an error names

    Raises
    ------
    InputError
        A number is out of the range of its key, or no number has that key.
    """
    mine = {
        key.removeprefix(own): number
        for key, number in numbers.items()
        if key.startswith(own) or not key.startswith((CALIBRATE, SCAN))
    }
    return with_numbers(scene, mine, where) if mine else scene


def _change(cause: Cause, share: float, where: str) -> Change:
    """What is new in each picture, its draws told apart by the row's number."""
    spread: dict[str, object] = {"values": cause.values, "weights": cause.weights}
    if cause.normal is not None:
        spread["normal"] = cause.normal[1]
    if cause.uniform is not None:
        spread["uniform"] = cause.uniform[1]
    stated = {
        "key": cause.key.removeprefix(SCAN),
        "relative": cause.relative,
        "correlation": cause.correlation,
        "seed": _seed(share),
    }
    return check(Change, stated | spread, where)


def correlate(row: Floats, root: Floats | None) -> Floats:
    """The row's numbers with the causes' correlations; the same where these are independent.

    Parameters
    ----------
    row : (D,) array, of numbers in (0, 1) or NOMINAL
    root : (D, D) array or None, lower root of the correlations of the normal numbers behind them
    """
    if root is None:
        return row
    active = ~np.isnan(row)
    normal = ndtri(np.where(active, row, 0.5))
    return np.where(active, ndtr(root @ normal), np.nan)


def _seed(share: float) -> int:
    return int(share * SEEDS) % SEEDS


# The places of a scan at which its errors are found, and the surface about each of them.


EDGE_PX = 12.0  # from the ends of the line: a rig that is somewhat off does not lose the place
MARGIN_MM = 3.0  # along the track, to where a face ends, likewise
LEVEL = 0.3  # cosine of the steepest face whose height is looked at
STEP_MM = 1e-3  # of the derivative along a ray
CLOSE_MM = 1e-7  # a place is found to that
TURNS = 30
FEWEST = 10
WAVE, PLANE, FLOOR = 0, 1, 2


@dataclass(frozen=True)
class ScanPlaces:
    """P places on the surface, and the rays of the laser's fan that reach them.

    Attributes
    ----------
    frame : (P,) array, number of the picture
    position_mm : (P,) array, mm, commanded then
    entry : (P,) array, the column (or row) of the picture that the place shows in
    angle : (P,) array, rad, of the ray in the fan, from its axis
    distance_mm : (P,) array, mm, from the apex
    kind : (P,) array, WAVE: of the sandwave; PLANE: of a face of the target, or of a mesh, taken
        for the plane of its triangle; FLOOR
    normal, point_mm : (P, 3) array, of the face of a PLANE, target frame
    world_mm : (P, 3) array, mm, the place, world frame
    """

    frame: Ints
    position_mm: Floats
    entry: Ints
    angle: Floats
    distance_mm: Floats
    kind: Ints
    normal: Floats
    point_mm: Floats
    world_mm: Floats


def places_of(scene: Scene, pictures: int, columns: int) -> ScanPlaces:
    """ScanPlaces spread over the scan of a scene as it ought to be.

    Parameters
    ----------
    scene : Scene, without changes and errors of its track
    pictures : int, of the plan that are looked at, at most
    columns : int, of each picture, at most

    Raises
    ------
    MeasurementError
        Fewer than ten places are lit and seen.
    """
    frames = spread_over(scene.rig.plan.frames, pictures)
    positions = scene.rig.plan.positions_mm()
    found = []
    for frame in frames:
        before, truth, behind = stripe_truths(
            scene, [positions[frame] + way for way in (-MARGIN_MM, 0.0, MARGIN_MM)]
        )
        inside = (before.face == truth.face) & (behind.face == truth.face)
        found.append(_of_picture(scene, truth, inside, frame, columns))
    places = joined_places(found)
    if len(places.frame) < FEWEST:
        raise MeasurementError(
            f"{scene.source}: the line is lit and seen in {len(places.frame)} of the places looked "
            f"at; a study needs {FEWEST}"
        )
    return places


def spread_over(count: int, most: int) -> list[int]:
    """Up to ``most`` numbers of ``count``, from 0, evenly spread, none at an end.

    Examples
    --------
    >>> spread_over(10, 2), spread_over(2, 5)
    ([2, 7], [0, 1])
    """
    parts = min(count, most)
    return [int((2 * k + 1) * count / (2 * parts)) for k in range(parts)]


@dataclass(frozen=True)
class PlacesInState:
    """P places of pictures that show the rig in one state.

    Attributes
    ----------
    scene : Scene, as it is then
    places : ScanPlaces
    position_mm : (P,) array, mm, of the head along the track, where it truly is
    """

    scene: Scene
    places: ScanPlaces
    position_mm: Floats

    @cached_property
    def sheet(self) -> TrueSheet:
        """The laser's sheet."""
        return sheet_of(self.scene)

    @cached_property
    def _away(self) -> Floats:
        angle = self.places.angle + np.radians(self.scene.tank.laser.aim_deg)
        return np.column_stack([np.sin(angle), -np.cos(angle)])

    def on_rays(self, distance_mm: Floats) -> Floats:
        """(P, 3) mm, head frame: points of the fan's rays.

        Parameters
        ----------
        distance_mm : (P,) array, mm, from the apex
        """
        return self.sheet.in_head(
            apex_xz(self.scene.tank.laser) + distance_mm[:, None] * self._away
        )


def lit_points(parts: Sequence[PlacesInState]) -> tuple[list[Floats], Floats]:
    """Where the rays of the fan meet the surface: (P_i, 3) mm, head frame; (P, 3) mm, world frame.

    Parameters
    ----------
    parts : sequence of PlacesInState, of P places in all

    Raises
    ------
    MeasurementError
        A ray no longer meets its face.
    """
    ends = np.cumsum([len(part.position_mm) for part in parts])[:-1]

    def points(distance: Floats) -> list[Floats]:
        pairs = zip(parts, np.split(distance, ends), strict=True)
        return [part.on_rays(own) for part, own in pairs]

    def world(distance: Floats) -> Floats:
        pairs = zip(parts, points(distance), strict=True)
        return np.concatenate(
            [into_world(part.scene.tank.head, own, part.position_mm) for part, own in pairs]
        )

    above = _heights_above(parts)
    distance = np.concatenate([part.places.distance_mm for part in parts])
    here, further = world(distance), world(distance + STEP_MM)
    way = (further - here) / STEP_MM
    is_straight = all(part.sheet.bow is None for part in parts)
    for _ in range(TURNS):
        height = above(here)
        slope = (above(here + STEP_MM * way) - height) / STEP_MM
        step = height / np.where(slope == 0, np.nan, slope)
        distance = distance - step
        if not np.isfinite(distance).all():
            break
        here = here - step[:, np.newaxis] * way if is_straight else world(distance)
        if np.abs(step).max() < CLOSE_MM:
            return points(distance), here
    raise MeasurementError("a ray of the laser no longer meets the surface where it ought to")


def _heights_above(parts: Sequence[PlacesInState]) -> Callable[[Floats], Floats]:
    """``height_above`` of the places of all parts: in one go where they scan the same thing."""
    first = parts[0].scene
    scanned = [(p.scene.tank.target, p.scene.tank.floor, p.scene.rig.workpiece) for p in parts]
    if all(one == scanned[0] for one in scanned[1:]):
        together = joined_places([part.places for part in parts])
        return lambda points: height_above(first, together, points)
    ends = np.cumsum([len(part.position_mm) for part in parts])[:-1]
    return lambda points: np.concatenate(
        [
            height_above(part.scene, part.places, own)
            for part, own in zip(parts, np.split(points, ends), strict=True)
        ]
    )


def joined_places(several: Sequence[ScanPlaces]) -> ScanPlaces:
    """Several places as one.

    Parameters
    ----------
    several : sequence of ScanPlaces
    """
    return ScanPlaces(
        *(np.concatenate(parts) for parts in zip(*map(_fields, several), strict=True))
    )


def height_above(scene: Scene, places: ScanPlaces, points_world: Floats) -> Floats:
    """(P,) mm, how high (P, 3) points lie above the surface beneath them, target frame's z.

    On a mesh: above the plane of the triangle that the place lies on.

    Parameters
    ----------
    scene : Scene, its target and its floor
    places : ScanPlaces, one for each point
    points_world : (P, 3) array, mm, world frame
    """
    local = target_pose(scene).invert(points_world)
    height = np.empty(len(local))
    wave, plane, floor = (places.kind == kind for kind in (WAVE, PLANE, FLOOR))
    if wave.any():
        shape = scene.rig.workpiece
        assert isinstance(shape, Sandwave)
        x, y, z = local[wave].T
        height[wave] = z - shape.height_mm(x, y)
    off = np.einsum("ij,ij->i", local[plane] - places.point_mm[plane], places.normal[plane])
    height[plane] = off / places.normal[plane, 2]
    if scene.tank.floor is not None:
        height[floor] = points_world[floor, 2] - scene.tank.floor.z_mm
    return height


def _of_picture(
    scene: Scene, truth: StripeTruth, inside: Mask, frame: int, columns: int
) -> ScanPlaces:
    """The places of one picture; inside: (N,) whether the same face shows nearby, too."""
    chosen = np.array(spread_over(len(truth.status), columns))
    good = inside & (truth.status == Status.OK) & ~truth.multiple & (truth.edge_px > EDGE_PX)
    chosen = chosen[good[chosen]]
    sheet = sheet_of(scene)
    head = np.column_stack([truth.xz_mm[chosen, 0], truth.y_mm[chosen], truth.xz_mm[chosen, 1]])
    world = head_pose(scene.tank.head, truth.position_mm).apply(head)
    flat = sheet.flatten(head)
    kind, normal = _faces(scene, truth.face[chosen], world)
    places = ScanPlaces(
        frame=np.full(len(chosen), frame),
        position_mm=np.full(len(chosen), truth.position_mm),
        entry=chosen,
        angle=fan_angle(scene.tank.laser, flat),
        distance_mm=np.linalg.norm(flat - apex_xz(scene.tank.laser), axis=1),
        kind=kind,
        normal=normal,
        point_mm=target_pose(scene).invert(world),
        world_mm=world,
    )
    wanted = normal[:, 2] > LEVEL
    if scene.tank.target.shape != "none":
        wanted &= kind != FLOOR  # the tank's floor is not what is measured
    return select(places, wanted)


def _faces(scene: Scene, face: Ints, world: Floats) -> tuple[Ints, Floats]:
    """(P,) kinds and (P, 3) unit normals, upwards, target frame, of places on faces."""
    surfaces, targets = surfaces_of(scene), len(target_surfaces(scene))
    kind, normal = np.full(len(face), PLANE), np.zeros((len(face), 3))
    rotation = target_pose(scene).rotation
    for number in np.unique(face):
        here, surface = face == number, surfaces[number]
        kind[here] = FLOOR if number >= targets else WAVE if isinstance(surface, Wave) else PLANE
        normal[here] = surface.normals(world[here]) @ rotation
    return kind, normal * np.where(normal[:, 2:] < 0, -1.0, 1.0)


def _fields(places: ScanPlaces) -> Sequence[np.ndarray]:
    return tuple(vars(places).values())


def require_one_line(scene: Scene) -> None:
    """Refuse what the geometric tier does not know.

    Parameters
    ----------
    scene : Scene, of the scan

    Raises
    ------
    InputError
        The laser has several lines, or the head moves while a picture is taken.
    """
    if len(scene.tank.laser.sheets) > 1:
        value, allowed = len(scene.tank.laser.sheets), "one line; the rendered tier takes several"
        raise InputError("laser.lines", where=scene.source, value=value, allowed=allowed)
    if scene.tank.head.speed_mm_s != 0:
        what = "head.speed_mm_s: the head moves while a picture is taken"
        where = scene.source
        allowed = '0, or tier = "rendered"'
        raise InputError(what, where=where, value=scene.tank.head.speed_mm_s, allowed=allowed)
