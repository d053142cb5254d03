"""Features of the board measured through a plane map: distances (Table I), circles (Table II).

Two causes of error are kept apart.  What the marks' centres in the picture miss by is each
mark's own.  What the map misses by displaces all marks together (PlanePoints.modes_mm): of a
distance only the difference at its two ends counts, of a diameter only what is left once the
circle has followed the shift of its points.
"""

from dataclasses import dataclass

import numpy as np

from lscan.calibration.planemap import PlaneMap
from lscan.config.board import Board, Ring
from lscan.errors import MeasurementError
from lscan.measure.circle import fit_circle
from lscan.records import (
    BoardReading,
    Floats,
    Length,
    Mark,
    PlanePoints,
    RingPoints,
    Status,
    has_value,
)


def distances(reading: BoardReading, board: Board, plane_map: PlaneMap) -> dict[str, Length]:
    """The distances of Table I under keys like "A1A2", mm, in the order of board.distances.

    Each is the distance in the sheet of the two dots' places.  Its variance is that of the two
    places along the line between them, each mark's own part added, the part that the calibration
    gives to both in common taken as the difference it makes.  Distances of which a dot was not
    found or lies outside the map are not in the answer: :func:`unmeasured_distances` names them.

    Parameters
    ----------
    reading : BoardReading, px, whose dots were found in a picture
    board : Board, mm, nominal places of the dots and pairs wanted
    plane_map : PlaneMap, from the pixels of that camera to the laser sheet

    Raises
    ------
    MeasurementError
        Where not one distance can be measured.

    Examples
    --------
    >>> import lscan
    >>> calibration = lscan.load_calibration("calibration.json")
    >>> board = lscan.load_rig("paper/board").rig.board
    >>> found = lscan.distances(calibration.reading, board, calibration.plane_map)
    >>> len(found), abs(found["A1A2"].error_mm) < 0.4
    (14, True)
    """
    places = _dots_in_plane(reading, board, plane_map)
    measured = {
        first + second: _distance(places[first], places[second], board.distance_mm(first, second))
        for first, second in board.distances
        if _why_not(places[first], places[second]) is Status.OK
    }
    if not measured:
        names = ", ".join(sorted(places)) or "none are on the board"
        raise MeasurementError(
            f"no distance of the board can be measured: dots looked for: {names}"
        )
    return measured


def unmeasured_distances(
    reading: BoardReading, board: Board, plane_map: PlaneMap
) -> dict[str, Status]:
    """Why each distance of board.distances that ``distances`` leaves out has no value.

    Parameters
    ----------
    reading : BoardReading, px, as for ``distances``
    board : Board, mm, as for ``distances``
    plane_map : PlaneMap, as for ``distances``
    """
    places = _dots_in_plane(reading, board, plane_map)
    reasons = {a + b: _why_not(places[a], places[b]) for a, b in board.distances}
    return {key: reason for key, reason in reasons.items() if reason is not Status.OK}


def diameters(reading: BoardReading, board: Board, plane_map: PlaneMap) -> dict[str, Length]:
    """The diameters of Table II by ring name, mm, in the order of board.ring.

    A circle is fitted to the ring's points mapped into the sheet; points without a place there
    are left out.  The variance is that of the points' own errors through the fit, that of the
    calibration's common errors carried through the same fit, and once that of the map's lack of
    fit, which is alike in neighbouring points and does not average out around a ring.

    Parameters
    ----------
    reading : BoardReading, px, with the points of the rings
    board : Board, mm, nominal diameters of the rings wanted
    plane_map : PlaneMap, from the pixels of that camera to the laser sheet

    Raises
    ------
    MeasurementError
        Names the ring for which fewer than four points are left, or whose points lie on a line.

    Examples
    --------
    >>> import lscan
    >>> calibration = lscan.load_calibration("calibration.json")
    >>> board = lscan.load_rig("paper/board").rig.board
    >>> sorted(lscan.diameters(calibration.reading, board, calibration.plane_map))
    ['E', 'F', 'G']
    """
    return {ring.name: _diameter(reading, ring, plane_map) for ring in board.ring}


def _diameter(reading: BoardReading, ring: Ring, plane_map: PlaneMap) -> Length:
    seen = reading.rings.get(ring.name, RingPoints(np.empty((0, 2)), np.empty(0)))
    points = plane_map.to_plane(seen.image_px, seen.sigma_px)
    good = has_value(points.status)
    if good.sum() < 4:
        raise MeasurementError(
            f"ring {ring.name}: {int(good.sum())} of its {len(good)} points lie in the "
            "calibrated plane, 4 are needed"
        )
    map_variance = plane_map.to_plane(seen.image_px).sigma_mm[good] ** 2
    # Across the ring either coordinate counts in turn, hence their mean variance.
    picking = np.maximum(points.sigma_mm[good] ** 2 - map_variance, 0.0).mean(axis=1)
    circle = fit_circle(points.xz_mm[good], np.sqrt(picking))
    modes = _modes(points)[good]
    common = 2 * np.einsum("kc,kcm->m", circle.radius_by_point, modes)
    lack_of_fit = np.maximum(map_variance - (modes**2).sum(axis=2), 0.0).mean()
    variance = circle.diameter_sigma_mm**2 + common @ common + lack_of_fit
    return Length(ring.diameter_mm, 2 * circle.radius_mm, float(np.sqrt(variance)))


def _modes(points: PlanePoints) -> Floats:
    """(N, 2, M) common errors, M = 0 where nothing is known to be common."""
    return np.zeros((len(points.status), 2, 0)) if points.modes_mm is None else points.modes_mm


@dataclass(frozen=True)
class DotPlace:
    """Where a dot lies in the sheet, or why it has no place.

    Attributes
    ----------
    xz : (2,) array, mm, plane frame
    own : (2,) array, mm², variances without the common part
    modes : (2, M) array, mm, the common part
    status : Status, OK or the reason
    """

    xz: Floats
    own: Floats
    modes: Floats
    status: Status


def _dots_in_plane(reading: BoardReading, board: Board, plane_map: PlaneMap) -> dict[str, DotPlace]:
    """Every dot that a distance needs, mapped in one go."""
    names = sorted({name for pair in board.distances for name in pair})
    nowhere = Mark(np.full(2, np.nan), float("nan"), Status.NOT_FOUND)
    marks = [reading.dots.get(name, nowhere) for name in names]
    image = np.array([mark.image_px for mark in marks]).reshape(-1, 2)
    points = plane_map.to_plane(image, np.array([mark.sigma_px for mark in marks]))
    modes = _modes(points)
    own = np.maximum(points.sigma_mm**2 - (modes**2).sum(axis=2), 0.0)
    places = {}
    for k, (name, mark) in enumerate(zip(names, marks, strict=True)):
        status = Status(int(points.status[k])) if mark.status == Status.OK else mark.status
        places[name] = DotPlace(points.xz_mm[k], own[k], modes[k], status)
    return places


def _why_not(first: DotPlace, second: DotPlace) -> Status:
    """OK where both dots have a place, or the reason why one has none."""
    missing = [p.status for p in (first, second) if not has_value(np.array(p.status))]
    return missing[0] if missing else Status.OK


def _distance(first: DotPlace, second: DotPlace, nominal_mm: float) -> Length:
    across = second.xz - first.xz
    length = float(np.linalg.norm(across))
    direction = across / length if length > 0 else np.zeros(2)
    common = direction @ (second.modes - first.modes)
    variance = direction**2 @ (first.own + second.own) + common @ common
    return Length(nominal_mm, length, float(np.sqrt(variance)))
