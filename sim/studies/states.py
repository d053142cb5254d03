"""The two states of a rig that a row stands for: as it was calibrated, and as it scans."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ndtr, ndtri

from lscan.config.documents import check
from lscan.errors import InputError
from lscan.records import Floats
from sim.scene import Pose, Scene, rotation
from sim.scene.varying import Change, number_at, with_numbers
from sim.studies.studyfile import Cause, Study
from sim.truth.sheet import sheet_plane

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
    shares = correlated(row, root)
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
    board, anew = (_applied(study.calibrate, state, CALIBRATE, where) for state in (before, since))
    scan = _applied(study.scan, since, SCAN, where)
    motion, motion_anew = (sheet_motion(study.calibrate, one) for one in (board, anew))
    ought = board_in_sheet(study.calibrate)
    return RigStates(
        calibrate=_into_sheet(board, motion),
        recalibrate=_into_sheet(anew, motion_anew) if since != before else None,
        scan=_with_changes(scan, changes),
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
                raise replace_where(error, where) from error


def replace_where(error: InputError, where: str) -> InputError:
    """The same error, of another place."""
    return InputError(error.what, where=where, value=error.value, allowed=error.allowed)


def _applied(scene: Scene, numbers: dict[str, float], own: str, where: str) -> Scene:
    """The scene with the numbers that are meant for it."""
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


def _with_changes(scene: Scene, changes: list[Change]) -> Scene:
    if not changes:
        return scene
    own = scene.tank.change
    return replace(scene, tank=scene.tank.model_copy(update={"change": (*own, *changes)}))


def correlated(row: Floats, root: Floats | None) -> Floats:
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
