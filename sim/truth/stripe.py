"""The laser line in a picture taken at one moment: one point for each of its columns."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lscan.records import Axis, Floats, Ints, Mask, Status
from sim.scene import Scene, head_pose
from sim.truth.camera import project
from sim.truth.sheet import TrueSheet, sheet_of
from sim.truth.surfaces import TankSurface, TargetSection, section_at, split, spread, surfaces_of
from sim.truth.visibility import in_picture, lit, seen

COARSE_MM = 5.0  # pieces looked at to find out which part of the section is in the picture
FINE_MM = 0.05  # pieces the line's columns are found on
JUMP_PX = 0.5  # of a line between two columns; less is within the spread of any lens
MARGIN_PX = 100.0  # more than a coarse piece is long in the picture


@dataclass(frozen=True)
class StripeTruth:
    """The true laser line, one entry per column (or row) of the picture, as records.Stripe.

    Centres are good to 1e-4 px on the sandwave; on plane faces and meshes they are exact, with
    a bowed sheet good to 1e-4 px.  Shadow edges are exact but where the wave itself hides a
    point from the camera by less than 3 um.  With the laser off there is no line.

    Attributes
    ----------
    position_mm : float, mm, track position of the head in the middle of the picture's read-out
    line : int, which of ``laser.sheets``
    axis : Axis, str, "columns" or "rows"
    centre_px : (N,) array, px, v (u for rows) of the sheet's mid-plane on the target
    xz_mm : (N, 2) array, mm, that point in the head frame at the moment the pixel is exposed
    y_mm : (N,) array, mm, its y in the head frame; 0 where the sheet lies as it ought to
    lit : (N,) array, whether the laser reaches it
    seen : (N,) array, whether the camera sees it
    status : (N,) array, OK where both; OCCLUDED where the sheet meets something in this column but
        no point of it is both lit and seen: the entry then describes the lit, else the uppermost of
        the hidden points; NO_PEAK, and NaN, where the sheet meets nothing
    face : (N,) array, index of the surface in ``surfaces_of(scene)``; -1 where NO_PEAK
    edge_px : (N,) array, px, distance along the line to the nearer end of the run of neighbouring
        OK columns that ``continues`` joins, 0 at its ends; NaN where not OK
    continues : (N,) array, whether the line runs on into the next column: on the same face, without
        a gap, without a jump, and on a mesh without a crease (sim.truth.surfaces)
    multiple : (N,) array, whether the column holds more than one lit and seen point; the uppermost
        (leftmost for rows) is the one given

    Examples
    --------
    >>> import sim
    >>> scene = sim.load_scene("paper/groove")
    >>> truth = sim.stripe_truth(scene, 0.0)
    >>> truth.axis, truth.centre_px.shape, truth.xz_mm.shape
    ('columns', (640,), (640, 2))
    """

    position_mm: float
    line: int
    axis: Axis
    centre_px: Floats
    xz_mm: Floats
    y_mm: Floats
    lit: Mask
    seen: Mask
    status: Ints
    face: Ints
    edge_px: Floats
    continues: Mask
    multiple: Mask


@dataclass(frozen=True)
class ColumnCrossings:
    """Where the section crosses the columns: K points, several a column or none.

    column: (K,).  centre_px: (K,) v there.  slope: (K,) px of v per column there.
    xz_mm: (K, 2) in the sheet's plane.  face, chain: (K,) as in TargetSection.
    """

    column: Ints
    centre_px: Floats
    slope: Floats
    xz_mm: Floats
    face: Ints
    chain: Ints


def standing_truth(
    scene: Scene, surfaces: Sequence[TankSurface], position_mm: float, line: int = 0
) -> StripeTruth:
    """The true line in a picture taken all at once with the head at ``position_mm``."""
    laser, sheet = scene.tank.laser, sheet_of(scene, line)
    plane = head_pose(scene.tank.head, position_mm) @ sheet.pose
    section = section_at(surfaces if laser.on else [], plane, sheet.bow)
    found = crossings(scene, sheet, section)
    points = sheet.in_head(found.xz_mm)
    reached, visible = lit(laser, section, found.xz_mm), seen(scene, surfaces, points, position_mm)
    good = reached & visible
    # The uppermost lit and seen point of each column, or a hidden one.
    order = np.lexsort([found.centre_px, ~reached, ~good, found.column])
    column, chosen = np.unique(found.column[order], return_index=True)
    best, (axis, count) = order[chosen], _columns(scene)

    def entries(values: np.ndarray, missing: float) -> np.ndarray:
        return _fill(count, column, values[best], missing)

    status = entries(np.where(good, Status.OK, Status.OCCLUDED), Status.NO_PEAK)
    continues = is_continued(found, best, status)
    x, y, z = (entries(coordinate, np.nan) for coordinate in points.T)
    return StripeTruth(
        position_mm=position_mm,
        line=line,
        axis=axis,
        centre_px=entries(found.centre_px, np.nan),
        xz_mm=np.column_stack([x, z]),
        y_mm=y,
        lit=entries(reached, False),
        seen=entries(visible, False),
        status=status,
        face=entries(found.face, -1),
        edge_px=edge_distance(status, continues),
        continues=continues,
        multiple=np.bincount(found.column[good], minlength=count) > 1,
    )


def crossings(scene: Scene, sheet: TrueSheet, section: TargetSection) -> ColumnCrossings:
    """Where the section, projected, crosses the middles of the picture's columns (or rows)."""
    axis, count = _columns(scene)
    a, b = (0, 1) if axis == "columns" else (1, 0)
    fine = split(_pieces_in_view(scene, sheet, split(section, COARSE_MM)), FINE_MM)
    pixels = _project_ends(scene, sheet, fine)
    whole = np.all(np.isfinite(pixels), axis=(1, 2))
    pixels, fine = pixels[whole], fine.only(whole)

    start, end = pixels[:, 0, a], pixels[:, 1, a]
    first = np.clip(np.ceil(np.minimum(start, end)), 0, count).astype(int)
    last = np.clip(np.ceil(np.maximum(start, end)), 0, count).astype(int)
    owner, step = spread(last - first)
    column = first[owner] + step
    part = ((column - start[owner]) / (end[owner] - start[owner]))[:, np.newaxis]
    ends, rise = fine.ends_mm[owner], pixels[owner, 1] - pixels[owner, 0]
    xz = ends[:, 0] + part * (ends[:, 1] - ends[:, 0])
    place = pixels[owner, 0] + part * rise
    kept = in_picture(scene, place)
    owner, slope = owner[kept], rise[kept, b] / rise[kept, a]
    place, xz, column = place[kept, b], xz[kept], column[kept]
    return ColumnCrossings(column, place, slope, xz, fine.face[owner], fine.chain[owner])


def _columns(scene: Scene) -> tuple[Axis, int]:
    """Whether the line has a place in each of the picture's columns or rows, and how many."""
    camera, axis = scene.rig.camera, scene.rig.stripe.axis
    return axis, camera.width_px if axis == "columns" else camera.height_px


def _pieces_in_view(scene: Scene, sheet: TrueSheet, section: TargetSection) -> TargetSection:
    """The pieces that may show in the picture."""
    size = np.array(scene.rig.camera.size_px)
    pixels = _project_ends(scene, sheet, section)
    near = (pixels > -MARGIN_PX) & (pixels < size + MARGIN_PX)
    return section.only(np.any(np.all(near, axis=2), axis=1))


def _project_ends(scene: Scene, sheet: TrueSheet, section: TargetSection) -> Floats:
    """(M, 2, 2) pixels of the pieces' ends; an end that the next piece starts at, once."""
    ends = section.ends_mm
    own = np.append(np.any(ends[:-1, 1] != ends[1:, 0], axis=1), True)[: len(ends)]
    pixels = project(scene, sheet.in_head(np.concatenate([ends[:, 0], ends[own, 1]])))
    starts = pixels[: len(ends)]
    found = np.stack([starts, np.roll(starts, -1, axis=0)], axis=1)
    found[own, 1] = pixels[len(ends) :]
    return found


def is_continued(found: ColumnCrossings, best: Ints, status: Ints) -> Mask:
    """(N,) as in StripeTruth; best: the crossing that each column of ``found`` takes.

    Between two columns a smooth line that bends one way climbs by no less than the one of its
    slopes there and no more than the other: else another part of it lies in between, unseen.
    """
    column, climb = found.column[best], np.diff(found.centre_px[best])
    slopes = np.sort(np.stack([found.slope[best][:-1], found.slope[best][1:]]), axis=0)
    joined = np.diff(column) == 1
    joined &= np.diff(found.chain[best]) == 0
    joined &= (climb >= slopes[0] - JUMP_PX) & (climb <= slopes[1] + JUMP_PX)
    joined &= (status[column[:-1]] == Status.OK) & (status[column[1:]] == Status.OK)
    return _fill(len(status), column[:-1][joined], joined[joined], False)


def edge_distance(status: Ints, continues: Mask) -> Floats:
    """(N,) entries to the nearer end of the run of joined OK entries; NaN where not OK.

    continues: (N,) whether an entry is joined to the next.
    """
    starts = np.flatnonzero(np.append(True, ~continues[:-1]))
    ends = np.append(starts[1:], len(status)) - 1
    run = np.repeat(np.arange(len(starts)), ends - starts + 1)
    index = np.arange(len(status))
    distance = np.minimum(index - starts[run], ends[run] - index).astype(float)
    return np.where(status == Status.OK, distance, np.nan)


def _fill(count: int, column: Ints, values: np.ndarray, missing: float) -> np.ndarray:
    """(count,) ``values`` at ``column``, ``missing`` elsewhere."""
    filled = np.full(count, missing, dtype=values.dtype)
    filled[column] = values
    return filled


# The laser line as it ought to be found, the shutter rolling while the head moves.
#
# Row v is exposed about the time (v/H - 1/2) readout_ms, so it shows what the head sees from where
# it is then.  The line is found for head positions spread over those of the rows it lies in, and
# each column takes its point from the two of them between which its row falls.


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
    return replace(_join_rows(at(rows), rows), position_mm=position_mm)


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


def _join_rows(truths: Sequence[StripeTruth], rows: Floats) -> StripeTruth:
    """The columns as they are in the rows they are seen in; truths: one for each of ``rows``.

    A column whose line is never where the shutter is shows none.
    """
    centres = np.stack([truth.centre_px for truth in truths])
    index = np.arange(centres.shape[1])
    shown = centres if truths[0].axis == "columns" else index + 0 * centres
    ahead = shown - rows[:, np.newaxis]  # of the row read out with the head there
    near = np.where(np.isnan(ahead), np.inf, np.abs(ahead)).argmin(axis=0)
    before, after = np.maximum(near - 1, 0), np.minimum(near + 1, len(rows) - 1)
    # The neighbour at which the line is on the other side of its row.
    other = np.where(ahead[near, index] * ahead[before, index] < 0, before, after)
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
