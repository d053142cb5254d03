"""Features of the board measured through a plane map: distances (Table I), circles (Table II)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from lscan.calibration.planemap import PlaneMap
from lscan.config.board import Board, Ring
from lscan.errors import MeasurementError
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

# A measured length with the parts of its uncertainty, and the mean of it over pictures.

OUTLIER = 5.0
"""Values farther from the median than this many of their own standard uncertainties, and of the
robust scatter of all, are left out of a mean."""

TINY = 1e-6  # mm; lengths without any noise weigh alike


@dataclass(frozen=True)
class LengthBudget:
    """A length with the parts of its uncertainty (the budget of the GUM).

    Attributes
    ----------
    value_mm : float, mm
    own_mm : float, mm, standard uncertainty from noise, another in every picture
    common_mm : float, mm, what errs alike in all pictures of one place and is not among the modes
    modes_mm : (M,) array or None, mm, how each mode of the calibration changes the length; None
        where none are known
    """

    value_mm: float
    own_mm: float
    common_mm: float
    modes_mm: Floats | None = None

    @property
    def sigma_mm(self) -> float:
        """Standard uncertainty, all parts together."""
        modes = 0.0 if self.modes_mm is None else float(np.linalg.norm(self.modes_mm))
        return float(np.linalg.norm([self.own_mm, self.common_mm, modes]))


def mean_length(lengths: Sequence[LengthBudget]) -> LengthBudget:
    """The mean of a length over several pictures, weighted by what they know of it.

    Outliers (see OUTLIER) are left out.  The mean's own_mm is that of its weights, enlarged where
    the values scatter more than their own noise says; what is common does not average out.

    Parameters
    ----------
    lengths : sequence of LengthBudget, mm, one a picture
    """
    value = np.array([length.value_mm for length in lengths])
    own = np.array([length.own_mm for length in lengths])
    common = np.array([length.common_mm for length in lengths])
    off = np.abs(value - np.median(value))
    kept = off <= OUTLIER * np.maximum(np.hypot(own, common), 1.4826 * np.median(off)) + 1e-9
    weight = kept / (own**2 + common**2 + TINY**2)
    weight = weight / weight.sum()
    mean = float(weight @ value)
    spread = float(np.linalg.norm(weight * own))
    if kept.sum() > 1:
        scatter = float(weight @ (value - mean) ** 2) / (int(kept.sum()) - 1)
        spread = max(spread, float(np.sqrt(scatter)))
    modes = [length.modes_mm for length in lengths]
    known = [mode for mode in modes if mode is not None]
    common_mm = float(np.sqrt(weight @ common**2))
    modes_mm = weight @ np.array(known) if len(known) == len(modes) else None
    return LengthBudget(value_mm=mean, own_mm=spread, common_mm=common_mm, modes_mm=modes_mm)


# The circle that lies closest to points in a plane.


@dataclass(frozen=True)
class Circle:
    """A fitted circle.

    Attributes
    ----------
    centre_mm : (2,) array, mm, frame of the points
    radius_mm : float, mm
    diameter_sigma_mm : float, mm, standard uncertainty of the diameter where the points err
        independently
    radius_by_point : (K, 2) array, derivative of the radius by each point's (x, z)
    """

    centre_mm: Floats
    radius_mm: float
    diameter_sigma_mm: float
    radius_by_point: Floats


def fit_circle(points_mm: Floats, sigma_mm: Floats) -> Circle:
    """The circle of least squared distances to points.

    Parameters
    ----------
    points_mm : (K, 2) array, mm, in any plane
    sigma_mm : (K,) array, mm, standard uncertainty of each point's distance from the circle; points
        are weighted by it

    Returns
    -------
    Circle
        Its uncertainty is that of the sigmas given or that of the points' scatter, whichever is
        the larger.

    Raises
    ------
    MeasurementError
        For fewer than four points, or points that lie on a line.

    References
    ----------
    Starts from the algebraic circle of I. Kasa, IEEE Trans. Instrum. Meas. 25, 8 (1976).

    Examples
    --------
    >>> corners = np.array([[0.0, 0.0], [0.0, 6.0], [8.0, 0.0], [8.0, 6.0]])
    >>> round(fit_circle(corners, np.full(4, 0.1)).radius_mm, 6)
    5.0
    """
    if len(points_mm) < 4:
        raise MeasurementError(f"circle: {len(points_mm)} points, 4 are needed")
    root = 1 / np.maximum(sigma_mm, 1e-6)

    def weighted_mean(parameters: Floats) -> Floats:
        return (np.linalg.norm(points_mm - parameters[:2], axis=1) - parameters[2]) * root

    def jacobian(parameters: Floats) -> Floats:
        return _circle_derivatives(points_mm, parameters) * root[:, None]

    fit = least_squares(weighted_mean, _algebraic(points_mm), jacobian, method="lm", xtol=1e-12)
    design = jacobian(fit.x)
    inverse = np.linalg.inv(design.T @ design).astype(float)
    scatter = 2 * float(fit.cost) / max(len(points_mm) - 3, 1)
    by_distance = -(inverse @ design.T)[2] * root  # of the radius, by each residual
    return Circle(
        centre_mm=fit.x[:2],
        radius_mm=float(fit.x[2]),
        diameter_sigma_mm=2 * float(np.sqrt(inverse[2, 2] * max(1.0, scatter))),
        radius_by_point=-by_distance[:, None] * _circle_derivatives(points_mm, fit.x)[:, :2],
    )


def _circle_derivatives(points: Floats, parameters: Floats) -> Floats:
    """(K, 3) derivatives of the points' distances from the circle by its centre and radius."""
    away = points - parameters[:2]
    distance = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    return np.column_stack([-away / distance, -np.ones(len(points))])


def _algebraic(points: Floats) -> Floats:
    """(3,) centre and radius that minimise the squared x² + z² + D x + E z + F."""
    middle = points.mean(axis=0)
    centred = points - middle
    spread = np.linalg.eigvalsh(centred.T @ centred)
    if spread[0] < 1e-9 * spread[1] or spread[1] == 0:
        raise MeasurementError("circle: its points lie on a straight line")
    return algebraic_ball(points)


def algebraic_ball(points_mm: Floats) -> Floats:
    """(D + 1,) centre and radius, mm, of the algebraic circle, or sphere, of points.

    They minimise the squared |p|² + a . p + b.

    Parameters
    ----------
    points_mm : (K, D) array, mm, D of 2 or 3

    References
    ----------
    I. Kasa, IEEE Trans. Instrum. Meas. 25, 8 (1976).
    """
    middle = points_mm.mean(axis=0)
    centred = points_mm - middle
    design = np.column_stack([centred, np.ones(len(points_mm))])
    solution = np.linalg.lstsq(design, -(centred**2).sum(axis=1), rcond=None)[0]
    centre = -solution[:-1] / 2
    radius = np.sqrt(max(float(centre @ centre - solution[-1]), 0.0))
    return np.array([*(centre + middle), radius])


# Features of the board measured through a plane map: distances (Table I), circles (Table II).
#
# Two causes of error are kept apart.  What the marks' centres in the picture miss by is each mark's
# own.  What the map misses by displaces all marks together (PlanePoints.modes_mm): of a distance
# only the difference at its two ends counts, of a diameter only what is left once the circle has
# followed the shift of its points.


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
        what = f"no distance of the board can be measured: dots looked for: {names}"
        raise MeasurementError(what)
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
