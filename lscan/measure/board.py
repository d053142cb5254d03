"""Features of the board measured through a plane map: distances (Table I), circles (Table II)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lscan.board import Board
from lscan.errors import InputError, MeasurementError
from lscan.measure.circle import fit_circle
from lscan.planemap.api import PlaneMap
from lscan.records import BoardReading, Floats, Measured, PlanePoints, Status, has_value

SIGMA_PX = 0.05
"""Standard uncertainty of a mark's centre unless told otherwise: well-printed dots in a good
picture reach 0.02 to 0.05 px."""


@dataclass(frozen=True)
class Diameter(Measured):
    """A diameter, with the number of ring points it came from and the number left out."""

    points: int
    left_out: int


def distances(
    reading: BoardReading, board: Board, plane_map: PlaneMap, sigma_px: float = SIGMA_PX
) -> dict[str, Measured]:
    """The distances of Table I under keys like "A1A2", mm, in the order of board.distances.

    Each is the distance in the sheet of the two dots' places under ``plane_map``; its sigma
    combines those of the two places along the line between them, taken as independent.
    sigma_px: standard uncertainty of a dot's u and of its v.
    Distances of which a dot was not found or lies outside the map are not in the answer:
    :func:`unmeasured_distances` names them with their reason.

    Raises MeasurementError where not one distance can be measured.
    """
    places = _dots_in_plane(reading, board, plane_map, sigma_px)
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
    """Why each distance of board.distances that ``distances`` leaves out has no value."""
    places = _dots_in_plane(reading, board, plane_map, SIGMA_PX)
    reasons = {a + b: _why_not(places[a], places[b]) for a, b in board.distances}
    return {key: reason for key, reason in reasons.items() if reason is not Status.OK}


def diameters(
    reading: BoardReading, board: Board, plane_map: PlaneMap, sigma_px: float = SIGMA_PX
) -> dict[str, Measured]:
    """The diameters of Table II by ring name, mm, in the order of board.ring.

    A circle is fitted to the ring's points mapped into the sheet.  Points without a place there
    are left out and counted: the values are of the class :class:`Diameter`.
    sigma_px: standard uncertainty of each point's u and v.  The sigma adds to the fit's that of
    the map, once: it is alike in neighbouring points and does not average out around a ring.

    Raises MeasurementError that names the ring for which fewer than four points are left.
    """
    _check_sigma(sigma_px)
    found: dict[str, Measured] = {}
    for ring in board.ring:
        image = np.asarray(reading.rings.get(ring.name, np.empty((0, 2))), dtype=float)
        points = plane_map.to_plane(image.reshape(-1, 2), np.full(len(image), sigma_px))
        map_variance = plane_map.to_plane(image.reshape(-1, 2)).sigma_mm ** 2
        good = has_value(points.status)
        if good.sum() < 4:
            raise MeasurementError(
                f"ring {ring.name}: {int(good.sum())} of its {len(image)} points lie in the "
                "calibrated plane, 4 are needed"
            )
        # Across the ring either coordinate counts in turn, hence their mean variance.
        picking = points.sigma_mm[good] ** 2 - map_variance[good]
        sigma = np.sqrt(np.maximum(picking, 0.0).mean(axis=1))
        circle = fit_circle(points.xz_mm[good], sigma)
        map_sigma = np.sqrt(map_variance[good].mean())
        found[ring.name] = Diameter(
            nominal_mm=ring.diameter_mm,
            measured_mm=2 * circle.radius_mm,
            sigma_mm=float(np.hypot(circle.diameter_sigma_mm, map_sigma)),
            points=int(good.sum()),
            left_out=int((~good).sum()),
        )
    return found


@dataclass(frozen=True)
class _Place:
    """Where a dot lies in the sheet: xz and sigma (2,) in mm, or why it has no place."""

    xz: Floats
    sigma: Floats
    status: Status


def _check_sigma(sigma_px: float) -> None:
    if not (np.isfinite(sigma_px) and sigma_px >= 0):
        raise InputError("bad sigma", where="sigma_px", value=sigma_px, allowed="0 px or more")


def _dots_in_plane(
    reading: BoardReading, board: Board, plane_map: PlaneMap, sigma_px: float
) -> dict[str, _Place]:
    """Every dot that a distance needs, mapped in one go."""
    _check_sigma(sigma_px)
    names = sorted({name for pair in board.distances for name in pair})
    unknown = np.full(2, np.nan)
    image = np.array([reading.dots.get(name, unknown) for name in names]).reshape(-1, 2)
    points = plane_map.to_plane(image, np.full(len(names), sigma_px))
    return {name: _place(image[k], points, k) for k, name in enumerate(names)}


def _place(image_px: Floats, points: PlanePoints, k: int) -> _Place:
    found = bool(np.isfinite(image_px).all())
    status = Status(int(points.status[k])) if found else Status.NOT_FOUND
    return _Place(points.xz_mm[k], points.sigma_mm[k], status)


def _why_not(first: _Place, second: _Place) -> Status:
    """OK where both dots have a place, or the reason why one has none."""
    for place in (first, second):
        if not has_value(np.array(place.status)):
            return place.status
    return Status.OK


def _distance(first: _Place, second: _Place, nominal_mm: float) -> Measured:
    across = second.xz - first.xz
    length = float(np.linalg.norm(across))
    direction = across / length if length > 0 else np.zeros(2)
    variance = direction**2 @ (first.sigma**2 + second.sigma**2)
    return Measured(nominal_mm, length, float(np.sqrt(variance)))
