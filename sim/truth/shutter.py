"""The laser line as it ought to be found, the shutter rolling while the head moves.

Row v is exposed about the time (v/H - 1/2) readout_ms, so it shows what the head sees from
where it is then.  The line is found for head positions spread over those of the rows it
lies in, and each column takes its point from the two of them between which its row falls.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lscan.records import Floats, Ints, Mask, Status
from sim.scene import Scene
from sim.truth.stripe import StripeTruth, edge_distance, standing_truth
from sim.truth.target.section import surfaces_of
from sim.truth.target.surfaces import TankSurface

# Between two positions the line's place is taken as linear in time.  On the sandwave it
# bends by 1/2 px/mm2 at most (0.6/mm of curvature, 0.85 px/mm): 0.5/8 times 0.04 squared.
STEP_MM = 0.04
MOST_STEPS = 500  # beyond, steps grow: 20 mm of travel in one read-out


def stripe_truth(scene: Scene, position_mm: float, line: int = 0) -> StripeTruth:
    """The true line in one picture.

    Parameters
    ----------
    scene
        The tank.
    position_mm
        Track position of the head; where it moves, in the middle of the read-out.
    line
        Index into ``laser.sheets``.

    Raises
    ------
    InputError
        As ``stripe_truths``.

    Examples
    --------
    >>> import sim
    >>> scene = sim.load_scene("paper/groove")
    >>> truth = sim.stripe_truth(scene, 0.0)
    >>> bool((truth.lit & truth.seen).any())
    True
    """
    return stripe_truths(scene, [position_mm], line)[0]


def stripe_truths(scene: Scene, positions_mm: Sequence[float], line: int = 0) -> list[StripeTruth]:
    """The true line at each track position.

    With the head moving and the shutter rolling, centres are good to 1e-4 px where the line is
    smooth.  Where it changes face or status within STEP_MM of travel the point is that of the
    nearest position, up to STEP_MM/2 away.

    Parameters
    ----------
    scene
        The tank.
    positions_mm
        Of the head; where it moves, in the middle of the read-out.
    line
        Index into ``laser.sheets``.

    Raises
    ------
    InputError
        Where there is no such line or the target cannot be cut: a mesh file that is not one, a
        sandwave tilted too far for its slopes.
    """
    surfaces = surfaces_of(scene)
    if travel_mm(scene) == 0:
        return [standing_truth(scene, surfaces, position, line) for position in positions_mm]
    return [_moving_truth(scene, surfaces, position, line) for position in positions_mm]


def travel_mm(scene: Scene) -> float:
    """How far the head moves along the track while a picture is read out, mm."""
    return scene.tank.head.speed_mm_s * scene.tank.sensor.readout_ms / 1000


def row_positions_mm(scene: Scene, position_mm: float, rows: Floats) -> Floats:
    """(...,) track positions of the head at the mid-exposure of rows v, mm."""
    return position_mm + travel_mm(scene) * (rows / scene.rig.camera.height_px - 0.5)


def _moving_truth(
    scene: Scene, surfaces: Sequence[TankSurface], position_mm: float, line: int
) -> StripeTruth:
    height = scene.rig.camera.height_px

    def at(rows: Floats) -> list[StripeTruth]:
        places = row_positions_mm(scene, position_mm, rows)
        return [standing_truth(scene, surfaces, float(place), line) for place in places]

    low, high = _rows_of(at(np.array([-0.5, height / 2, height - 0.5])), height)
    travel = abs(travel_mm(scene)) * (high - low) / height
    steps = min(int(np.ceil(travel / STEP_MM)), MOST_STEPS)
    rows = np.linspace(low, high, max(steps, 1) + 1)
    return replace(_joined(at(rows), rows), position_mm=position_mm)


def _rows_of(truths: Sequence[StripeTruth], height: int) -> tuple[float, float]:
    """First and last row the line may lie in, from truths at the picture's ends and middle.

    It may run farther between them than at them: by as much as they differ again.
    """
    if truths[0].axis == "rows":
        return -0.5, height - 0.5
    centres = np.stack([truth.centre_px for truth in truths])
    if np.isnan(centres).all():
        return -0.5, height - 0.5
    known = ~np.isnan(centres).all(axis=0)
    moves = np.nanmax(centres[:, known], axis=0) - np.nanmin(centres[:, known], axis=0)
    margin = float(moves.max()) + 1
    low, high = float(np.nanmin(centres)) - margin, float(np.nanmax(centres)) + margin
    return max(low, -0.5), min(high, height - 0.5)


def _joined(truths: Sequence[StripeTruth], rows: Floats) -> StripeTruth:
    """The columns as they are in the rows they are seen in; truths: one for each of ``rows``.

    A column whose line is never where the shutter is shows none.
    """
    centres = np.stack([truth.centre_px for truth in truths])
    index = np.arange(centres.shape[1])
    shown = centres if truths[0].axis == "columns" else index + 0 * centres
    ahead = shown - rows[:, np.newaxis]  # of the row read out with the head there
    near = np.where(np.isnan(ahead), np.inf, np.abs(ahead)).argmin(axis=0)
    other = _other_side(ahead, near)
    caught = np.abs(ahead[near, index]) <= rows[1] - rows[0]

    def values(name: str, of: Ints) -> np.ndarray:
        return np.stack([getattr(truth, name) for truth in truths])[of, index]

    same = [values(name, near) == values(name, other) for name in ("status", "face")]
    part = _share(ahead[near, index], ahead[other, index], np.all(same, axis=0))

    def blend(name: str) -> Floats:
        first, second = values(name, near).T, values(name, other).T
        mixed = first + np.where(part > 0, part * (second - first), 0.0)
        return np.where(caught, mixed, np.nan).T

    status = np.where(caught, values("status", near), int(Status.NO_PEAK))
    continues = caught & np.append(caught[1:], False) & values("continues", near)
    return replace(
        truths[0],
        centre_px=blend("centre_px"),
        xz_mm=blend("xz_mm"),
        y_mm=blend("y_mm"),
        lit=caught & values("lit", near),
        seen=caught & values("seen", near),
        multiple=caught & values("multiple", near),
        status=status,
        face=np.where(caught, values("face", near), -1),
        edge_px=edge_distance(status, continues),
        continues=continues,
    )


def _share(here: Floats, there: Floats, same: Mask) -> Floats:
    """(N,) how far from ``here`` to ``there`` a line through both is 0; 0 where not ``same``."""
    crosses = same & (here * there <= 0) & (here != there)
    part = np.zeros(len(here))
    part[crosses] = here[crosses] / (here - there)[crosses]
    return part


def _other_side(ahead: Floats, near: Ints) -> Ints:
    """(N,) the neighbour of ``near`` at which the line is on the other side of its row."""
    index, last = np.arange(ahead.shape[1]), len(ahead) - 1
    before, after = np.maximum(near - 1, 0), np.minimum(near + 1, last)
    crosses_before = ahead[near, index] * ahead[before, index] < 0
    return np.where(crosses_before, before, after)
