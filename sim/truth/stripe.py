"""The laser line as it ought to be found: one point for each column of the picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lscan.records import Axis, Floats, Ints, Mask, Status
from sim.scene import Scene, head_pose
from sim.truth.projection import project
from sim.truth.section import Section, section_at, split, surfaces_of
from sim.truth.surfaces import Surface, spread
from sim.truth.visibility import in_picture, lit, seen

COARSE_MM = 5.0  # pieces looked at to find out which part of the section is in the picture
FINE_MM = 0.05  # pieces the line's columns are found on
MARGIN_PX = 100.0  # more than a coarse piece is long in the picture


@dataclass(frozen=True)
class StripeTruth:
    """The true laser line, one entry per column (or row) of the picture, as records.Stripe.

    position_mm: track position of the head.  axis: "columns" or "rows".
    centre_px: (N,) v (u for rows) of the sheet's mid-plane on the target.
    xz_mm: (N, 2) that point in the plane frame.
    lit, seen: (N,) whether the laser reaches it, whether the camera sees it.
    status: (N,) OK where both; OCCLUDED where the sheet meets something in this column but
        no point of it is both lit and seen: the entry then describes the lit, else the
        uppermost of the hidden points; NO_PEAK, and NaN, where the sheet meets nothing.
    face: (N,) index of the surface in ``surfaces_of(scene)``; -1 where NO_PEAK.
    edge_px: (N,) distance along the line to the nearer end of the run of neighbouring OK
        columns of one face, 0 at its ends; NaN where not OK.
    multiple: (N,) whether the column holds more than one lit and seen point; the uppermost
        (leftmost for rows) is the one given.
    """

    position_mm: float
    axis: Axis
    centre_px: Floats
    xz_mm: Floats
    lit: Mask
    seen: Mask
    status: Ints
    face: Ints
    edge_px: Floats
    multiple: Mask


@dataclass(frozen=True)
class Crossings:
    """Where the section crosses the columns: K points, several a column or none.

    line: (K,) the column.  centre_px: (K,) v there.  xz_mm: (K, 2).  face: (K,).
    """

    line: Ints
    centre_px: Floats
    xz_mm: Floats
    face: Ints


def stripe_truth(scene: Scene, position_mm: float) -> StripeTruth:
    """The true line in the picture of the head at ``position_mm``; see ``stripe_truths``."""
    return stripe_truths(scene, [position_mm])[0]


def stripe_truths(scene: Scene, positions_mm: Sequence[float]) -> list[StripeTruth]:
    """The true line at each track position.

    Centres are good to 1e-4 px on the sandwave and exact on plane faces and meshes.
    Shadow edges are exact but where the wave itself hides a point from the camera by less
    than 3 um.  With the laser off there is no line.  Raises InputError where the target
    cannot be cut (a mesh file that is not one, a sandwave tilted past its slopes).
    """
    surfaces = surfaces_of(scene)
    return [_truth_at(scene, surfaces, position) for position in positions_mm]


def _truth_at(scene: Scene, surfaces: Sequence[Surface], position_mm: float) -> StripeTruth:
    laser = scene.tank.laser
    sheet = head_pose(scene.tank.head, position_mm)
    section = section_at(surfaces if laser.on else [], sheet)
    found = crossings(scene, section)
    reached = lit(laser, section, found.xz_mm)
    visible = seen(scene, surfaces, in_head(found.xz_mm), position_mm)
    return _assemble(scene, position_mm, found, reached, visible)


def crossings(scene: Scene, section: Section) -> Crossings:
    """Where the section, projected, crosses the middles of the picture's columns (or rows)."""
    camera, axis = scene.rig.camera, scene.rig.stripe.axis
    a, b, count = (0, 1, camera.width_px) if axis == "columns" else (1, 0, camera.height_px)
    fine = split(_in_view(scene, split(section, COARSE_MM)), FINE_MM)
    pixels = _project_ends(scene, fine)
    whole = np.all(np.isfinite(pixels), axis=(1, 2))
    pixels, ends, face = pixels[whole], fine.ends_mm[whole], fine.face[whole]

    start, end = pixels[:, 0, a], pixels[:, 1, a]
    first = np.clip(np.ceil(np.minimum(start, end)), 0, count).astype(int)
    last = np.clip(np.ceil(np.maximum(start, end)), 0, count).astype(int)
    owner, step = spread(last - first)
    line = first[owner] + step
    part = ((line - start[owner]) / (end[owner] - start[owner]))[:, np.newaxis]
    xz = ends[owner, 0] + part * (ends[owner, 1] - ends[owner, 0])
    place = pixels[owner, 0] + part * (pixels[owner, 1] - pixels[owner, 0])
    kept = in_picture(scene, place)
    return Crossings(line[kept], place[kept, b], xz[kept], face[owner][kept])


def in_head(xz_mm: Floats) -> Floats:
    """(N, 3) points of the head frame from (N, 2) of the plane frame."""
    return np.column_stack([xz_mm[:, 0], np.zeros(len(xz_mm)), xz_mm[:, 1]])


def _in_view(scene: Scene, section: Section) -> Section:
    """The pieces that may show in the picture."""
    camera = scene.rig.camera
    size = np.array([camera.width_px, camera.height_px])
    pixels = _project_ends(scene, section)
    near = (pixels > -MARGIN_PX) & (pixels < size + MARGIN_PX)
    kept = np.any(np.all(near, axis=2), axis=1)
    return Section(section.ends_mm[kept], section.face[kept])


def _project_ends(scene: Scene, section: Section) -> Floats:
    """(M, 2, 2) pixels of the pieces' ends."""
    return project(scene, in_head(section.ends_mm.reshape(-1, 2))).reshape(-1, 2, 2)


def _assemble(
    scene: Scene, position_mm: float, found: Crossings, reached: Mask, visible: Mask
) -> StripeTruth:
    """One entry a column: the uppermost lit and seen point, or a hidden one, or none."""
    camera, axis = scene.rig.camera, scene.rig.stripe.axis
    count = camera.width_px if axis == "columns" else camera.height_px
    good = reached & visible
    order = np.lexsort([found.centre_px, ~reached, ~good, found.line])
    line, chosen = np.unique(found.line[order], return_index=True)
    best = order[chosen]

    status = np.full(count, int(Status.NO_PEAK))
    status[line] = np.where(good[best], Status.OK, Status.OCCLUDED)
    face = _fill(count, line, found.face[best], -1)
    return StripeTruth(
        position_mm=position_mm,
        axis=axis,
        centre_px=_fill(count, line, found.centre_px[best], np.nan),
        xz_mm=np.column_stack([_fill(count, line, c, np.nan) for c in found.xz_mm[best].T]),
        lit=_fill(count, line, reached[best], False),
        seen=_fill(count, line, visible[best], False),
        status=status,
        face=face,
        edge_px=edge_distance(status, face),
        multiple=np.bincount(found.line[good], minlength=count) > 1,
    )


def edge_distance(status: Ints, face: Ints) -> Floats:
    """(N,) entries to the nearer end of the run of OK entries of one face; NaN where not OK."""
    label = np.where(status == Status.OK, face, -1)
    starts = np.flatnonzero(np.diff(label, prepend=label[0] + 1) != 0)
    ends = np.append(starts[1:], len(label)) - 1
    run = np.repeat(np.arange(len(starts)), ends - starts + 1)
    index = np.arange(len(label))
    distance = np.minimum(index - starts[run], ends[run] - index).astype(float)
    return np.where(label >= 0, distance, np.nan)


def _fill(count: int, line: Ints, values: np.ndarray, missing: float) -> np.ndarray:
    """(count,) ``values`` at ``line``, ``missing`` elsewhere."""
    filled = np.full(count, missing, dtype=values.dtype)
    filled[line] = values
    return filled
