"""A head on a shaft (the paper's Sec. I): profiles turned about it, and where the shaft is.

The head turns rigidly about a line.  A point X of the head's frame at position s lies, in the
frame of the head at position 0, at

    p + R(d, s / r) (X - p)

p being a point of the shaft, d its direction, r the arc radius and R Rodrigues' rotation.  What
is not known of the shaft has five parameters: two offsets of p square to d, two tilts of d and
the relative scale of the angle; each displaces every point of the scan in a way of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lscan.config.documents import check, read_document, write_toml
from lscan.config.rig import ShaftSection
from lscan.config.targets import Sandwave
from lscan.errors import InputError, MeasurementError
from lscan.records import Floats, Ints, Mask, Profile, Surface, has_value
from lscan.surface.align import rough_pose
from lscan.surface.alignment import own_variances, turned_modes
from lscan.surface.features import above_top, find_features
from lscan.surface.surface import stack

# Profiles turned about a shaft, the paper's other way to move the head (its Sec. I).

PARAMETERS = 5
"""Offsets along the shaft's two axes (mm), tilts towards them (rad), scale of the angle."""


@dataclass(frozen=True)
class Shaft:
    """A shaft in the frame of the head at position 0, and how well it is known.

    Attributes
    ----------
    point_mm : (3,) array, mm, a point of it
    direction : (3,) array, unit vector, right-hand rule
    arc_radius_mm : float, mm; a position divided by it is the angle in rad
    covariance : (5, 5) array, of two offsets (mm) and two tilts (rad) along ``axes``, and the scale
    """

    point_mm: Floats
    direction: Floats
    arc_radius_mm: float
    covariance: Floats

    @property
    def axes(self) -> Floats:
        """(2, 3) unit vectors square to the shaft: y less its part along it, and the third."""
        first = np.array([0.0, 1.0, 0.0]) - self.direction[1] * self.direction
        first = first / np.linalg.norm(first)
        return np.stack([first, np.cross(self.direction, first)])

    def rotation(self, position_mm: Floats) -> Floats:
        """(..., 3, 3) rotation of the head at positions: Rodrigues' formula.

        Parameters
        ----------
        position_mm : (...,) array, mm, the arc turned by
        """
        angle = np.asarray(position_mm)[..., None, None] / self.arc_radius_mm
        cross = np.cross(np.eye(3), self.direction)  # by which a vector is multiplied, d x v
        return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)

    def turn(self, points_mm: Floats, position_mm: Floats) -> Floats:
        """(..., 3) points of the head in the frame of position 0, mm.

        Parameters
        ----------
        points_mm : (..., 3) array, mm, frame of the head at its position
        position_mm : (...,) array, mm, the arc turned by
        """
        offset = points_mm - self.point_mm
        turned = (self.rotation(position_mm) @ offset[..., None])[..., 0]
        return np.asarray(turned + self.point_mm)

    def moved(self, parameters: Floats) -> "Shaft":
        """The shaft with its five parameters changed; the covariance stays.

        Parameters
        ----------
        parameters : (5,) array, two offsets (mm) and two tilts (rad) along ``axes``, and the scale
        """
        offsets, tilts = parameters[:2] @ self.axes, parameters[2:4] @ self.axes
        direction = self.direction + tilts
        return replace(
            self,
            point_mm=self.point_mm + offsets,
            direction=direction / np.linalg.norm(direction),
            arc_radius_mm=self.arc_radius_mm / (1 + float(parameters[4])),
        )

    def displacement(
        self, points_mm: Floats, position_mm: Floats, axes: Floats | None = None
    ) -> Floats:
        """(..., 3, 5) what the unit of each parameter displaces turned points by, mm.

        A tilt by e turns all about the shaft by w = d x e: the points by w x R q, but q itself by
        -R (w x q), q = X - p.

        Parameters
        ----------
        points_mm : (..., 3) array, mm, frame of position 0, as ``turn`` gives them
        position_mm : (...,) array, mm, the arc turned by
        axes : (2, 3) array, optional, along which offsets and tilts are counted; the shaft's own by
            default
        """
        turned = points_mm - self.point_mm
        rotation = self.rotation(position_mm)
        own = self.axes if axes is None else axes
        columns = [np.broadcast_to(axis - rotation @ axis, turned.shape) for axis in own]
        for axis in own:
            about = np.cross(self.direction, axis)
            columns.append(np.cross(about, turned) - np.cross(rotation @ about, turned))
        angle = np.asarray(position_mm)[..., None] / self.arc_radius_mm
        columns.append(angle * np.cross(self.direction, turned))
        return np.stack(columns, axis=-1)

    @property
    def sigma(self) -> Floats:
        """(5,) standard uncertainties of the parameters: mm, mm, rad, rad, 1."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def root(self) -> Floats:
        """(5, 5) matrix whose product with its transpose is the covariance; it may be singular.

        Its columns are five independent errors, each one standard deviation large.
        """
        scale = np.where(self.sigma > 0, self.sigma, 1.0)
        values, vectors = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        return np.asarray(scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def shaft_of(section: ShaftSection) -> Shaft:
    """The shaft that a rig file's ``[shaft]`` describes.

    Parameters
    ----------
    section : ShaftSection, mm and degrees
    """
    direction = np.array(section.direction)
    sigma = np.array(
        [*section.offset_sigma_mm, *np.radians(section.tilt_sigma_deg), section.scale_sigma]
    )
    return Shaft(
        point_mm=np.array(section.point_mm),
        direction=direction / np.linalg.norm(direction),
        arc_radius_mm=section.arc_radius_mm,
        covariance=np.outer(sigma, sigma) * section.correlation_matrix(),
    )


def section_of(shaft: Shaft) -> ShaftSection:
    """The ``[shaft]`` of a rig file that describes the shaft.

    Parameters
    ----------
    shaft : Shaft, mm and rad
    """
    scale = np.where(shaft.sigma > 0, shaft.sigma, 1.0)
    correlation = (shaft.covariance / np.outer(scale, scale))[np.triu_indices(PARAMETERS, 1)]
    first, second, *tilts, of_scale = shaft.sigma.tolist()
    return ShaftSection.model_validate(
        {
            "arc_radius_mm": shaft.arc_radius_mm,
            "point_mm": shaft.point_mm.tolist(),
            "direction": shaft.direction.tolist(),
            "offset_sigma_mm": (first, second),
            "tilt_sigma_deg": np.degrees(tilts).tolist(),
            "scale_sigma": of_scale,
            "correlation": np.clip(correlation, -1.0, 1.0).tolist(),
        }
    )


def stack_about(profiles: Sequence[Profile], shaft: Shaft) -> Surface:
    """The surface of F profiles of N points, turned about the shaft, in the frame of position 0.

    Uncertainties and modes are turned along; where the profiles have modes, the shaft's five
    independent errors are put behind them, else the shaft's alone are known.

    Parameters
    ----------
    profiles : sequence of Profile, mm, frame of the sheet
    shaft : Shaft, about which the head turned

    Raises
    ------
    InputError
        As ``stack``.
    """
    raw = stack(profiles)
    position = np.broadcast_to(raw.position_mm[:, None], raw.status.shape)
    in_sheet = raw.xyz_mm * [1.0, 0.0, 1.0]
    xyz = shaft.turn(in_sheet, position)
    rotation = shaft.rotation(raw.position_mm)[:, None]
    modes = (shaft.displacement(xyz, position) @ shaft.root).astype(np.float32)
    if raw.modes_mm is not None:
        modes = np.concatenate([rotation.astype(np.float32) @ raw.modes_mm, modes], axis=-1)
    own = own_variances(raw) @ np.swapaxes(rotation[:, 0] ** 2, 1, 2)
    common = np.square(modes, dtype=np.float64).sum(axis=-1)
    sigma = np.sqrt(own + common)
    return replace(
        raw,
        xyz_mm=xyz,
        sigma_x_mm=sigma[..., 0],
        sigma_y_mm=sigma[..., 1],
        sigma_z_mm=sigma[..., 2],
        modes_mm=modes,
    )


# A shaft's place and direction against the sheet, from a scan of the sandwave block.
#
# As the paper finds the yaw of its sheet (Sec. IV.C), from a workpiece whose shape is known.  The
# unknowns are the workpiece's pose (six), the five parameters of the shaft and the amounts of the
# plane map's modes; the rig's stated uncertainties of the shaft and the modes' own are the priors.
# What is made least is the sum of squares of the points' distances from the nominal top, each in
# units of its own uncertainty.
#
# Distances of neighbours err together where something in the picture is not described (a dim flank,
# a lens's blur), so the covariance is not that of as many independent points: scores are summed
# over cells of the block first, and it is their scatter from cell to cell that counts (a "sandwich"
# estimate, Huber 1967; summed over clusters, Liang and Zeger 1986).
#
# All is of first order in the noise: on a crest of curvature k, noise s lifts the mean distance by
# k s² / 2, which at 0.1 mm is 0.001 mm and shifts a parameter by up to 0.4 of its uncertainty.


POSE = 6
"""Rotations about x, y and z, then shifts, of the workpiece."""

OF_SHAFT = slice(POSE, POSE + PARAMETERS)

ROUGHLY = np.array([0.05, 0.05, 0.05, 5.0, 5.0, 5.0])
"""How well the wedges' tops place the workpiece to begin with, rad and mm: on a piece that does
not show where it lies in plan, the pose stays at that."""

MOST_POINTS = 30_000
"""More are thinned out evenly: what they add is far below what neighbours have in common."""

MARGIN_MM = 2.5
"""Points this near to a step of the block are left out: the sheet is about 1.5 mm thick."""

OUTLIER = 4.0
"""Points beyond so many robust standard deviations are left out: of a normal distribution one in
16 000, so that leaving them out changes no variance by more than 0.1 %."""

CELL_MM = 15.0
"""Side of the cells whose scores are summed: near half a wave, over which errors change sign."""

CELLS_ACROSS = 100_000
"""More than there are on any block: numbers the cells row by row."""

FEWEST_CELLS = 60
"""The covariance of some twelve unknowns needs several times as many cells."""

LEAST_SIGMA_MM = 1e-4
"""Points are weighed as if known to no better than this: exact ones have weights too."""

MAX_ITERATIONS = 60

UNDECIDED_ITERATIONS = 10
"""Rounds after which it stays as it is which points are outliers."""

SETTLED = 1e-4
"""Length of a step, in standard deviations, at which the iteration ends."""


@dataclass(frozen=True)
class ShaftFit:
    """A shaft found from a scan, its covariance in it.

    Attributes
    ----------
    shaft : Shaft, found
    prior : Shaft, what was known before
    moved : (5,) array, by how much each parameter changed, along the prior's axes (mm, rad, 1)
    rotation : (3, 3) array, from the frame of the head at position 0 to the workpiece's
    translation_mm : (3,) array, mm, frame of the workpiece
    points : int, number of points used
    outliers : int, number of points left out as too far off
    cells : int, number of cells of the block seen
    rms_mm : float, mm, root mean square distance of the points from the nominal top
    """

    shaft: Shaft
    prior: Shaft
    moved: Floats
    rotation: Floats
    translation_mm: Floats
    points: int
    outliers: int
    cells: int
    rms_mm: float


def calibrate_shaft(profiles: Sequence[Profile], piece: Sandwave, prior: Shaft) -> ShaftFit:
    """The shaft that brings a scan of the sandwave block closest to its nominal shape.

    A parameter that the scan says nothing about keeps its uncertainty.

    Parameters
    ----------
    profiles : sequence of Profile, mm, frame of the sheet
    piece : Sandwave, the nominal shape
    prior : Shaft, the rig's; parameters of no uncertainty stay as they are

    Raises
    ------
    InputError
        Where all of the prior is known exactly.
    MeasurementError
        Where the block is not found or too little of it is in the scan.

    References
    ----------
    Sec. IV.C of the paper, which finds the yaw of its sheet from a known workpiece; the covariance
    is Huber's (1967), summed over clusters as of Liang and Zeger (1986).
    """
    if not np.any(prior.covariance):
        what = "shaft: is stated to be known exactly, which leaves nothing to find"
        raise InputError(what, allowed="offset_sigma_mm, tilt_sigma_deg or scale_sigma above 0")
    roughly = stack_about(profiles, prior)
    pose = rough_pose(find_features(roughly, piece), piece)
    height = roughly.xyz_mm @ pose.rotation[2] + pose.shift[2]
    samples = _samples(profiles, height > -piece.body_mm / 2)
    zero = np.zeros(POSE + PARAMETERS + samples.modes.shape[2])
    start = _State(pose.rotation, pose.shift, zero)
    state, terms, kept = _solve(samples, piece, prior, start)
    covariance, cells = _covariance(terms, kept)
    root = prior.root
    moved = root @ state.amounts[OF_SHAFT]
    shaft = prior.moved(moved)
    own = covariance[OF_SHAFT, OF_SHAFT]
    turn = np.eye(PARAMETERS)  # from the axes before to those of the shaft found
    turn[:2, :2] = turn[2:4, 2:4] = shaft.axes @ prior.axes.T
    distance = terms.distance[kept]
    return ShaftFit(
        shaft=replace(shaft, covariance=turn @ (root @ own @ root.T) @ turn.T),
        prior=prior,
        moved=moved,
        rotation=state.rotation,
        translation_mm=state.shift,
        points=int(kept.sum()),
        outliers=int((terms.clear & ~kept).sum()),
        cells=cells,
        rms_mm=float(np.sqrt(np.mean(distance**2))),
    )


@dataclass(frozen=True)
class _SheetSamples:
    """Points of the scan as measured in the sheet.

    points: (N, 3) mm, y = 0.  position: (N,) mm.  variance: (N, 2) own, of x and z, mm².
    modes: (N, 3, M) of the plane map, mm.
    """

    points: Floats
    position: Floats
    variance: Floats
    modes: Floats


def _samples(profiles: Sequence[Profile], on_block: Mask) -> _SheetSamples:
    """The points on the block (F, N) that have a value, evenly thinned out to MOST_POINTS."""
    raw = stack(profiles)
    valid = has_value(raw.status) & np.isfinite(raw.xyz_mm).all(axis=-1)
    there = np.flatnonzero(valid & on_block)
    there = there[:: int(np.ceil(len(there) / MOST_POINTS))]
    points = raw.xyz_mm.reshape(-1, 3)[there] * [1.0, 0.0, 1.0]
    position = np.repeat(raw.position_mm, raw.status.shape[1])[there]
    variance = own_variances(raw).reshape(-1, 3)[there][:, [0, 2]]
    modes = turned_modes(raw, np.eye(3), there).astype(float)
    return _SheetSamples(points, position, variance, modes)


@dataclass(frozen=True)
class _State:
    """The unknowns: the workpiece's pose (3, 3) and (3,) mm, and all amounts (11 + M,): by how
    much the pose was changed (rad, mm), and, in standard deviations, of the shaft's independent
    errors and of the plane map's modes."""

    rotation: Floats
    shift: Floats
    amounts: Floats

    def after_step(self, step: Floats, pivot: Floats) -> "_State":
        """The state after a step (11 + M,), the workpiece turned about ``pivot`` (3,)."""
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        shift = turn @ (self.shift - pivot) + pivot + step[3:POSE]
        return _State(turn @ self.rotation, shift, self.amounts + step)


@dataclass(frozen=True)
class _Terms:
    """The least squares about a state, N points by P unknowns.

    distance: (N,) from the nominal top along its normal, mm, sigma: (N,) its own.
    design: (N, P) of the distances.  amounts: (P,) of the state, prior: (P,) their weights.
    clear: (N,) away from steps.  cell: (N,) number of its cell.
    """

    distance: Floats
    sigma: Floats
    design: Floats
    amounts: Floats
    prior: Floats
    clear: Mask
    cell: Ints


def _solve(
    samples: _SheetSamples, piece: Sandwave, prior: Shaft, state: _State
) -> tuple[_State, _Terms, Mask]:
    """The state of least squares, the terms there, and which points had a part in it."""
    pivot = np.array([piece.side_mm / 2, piece.side_mm / 2, 0.0])
    kept: Mask | None = None
    for iteration in range(MAX_ITERATIONS):
        terms = _terms(samples, piece, prior, state, pivot)
        if kept is None or iteration < UNDECIDED_ITERATIONS:
            kept = _no_outliers(terms)
        terms = _widen_sigmas(terms, kept)
        step, length = _step(terms, kept)
        state = state.after_step(step, pivot)
        if length < SETTLED and iteration >= UNDECIDED_ITERATIONS:
            return state, _widen_sigmas(_terms(samples, piece, prior, state, pivot), kept), kept
    what = f"the shaft did not settle in {MAX_ITERATIONS} rounds: still {length:.2g} sigma a step"
    raise MeasurementError(what)


def _terms(
    samples: _SheetSamples, piece: Sandwave, prior: Shaft, state: _State, pivot: Floats
) -> _Terms:
    """Distances from the nominal top and how they go with the unknowns, first order."""
    root = prior.root
    shaft = prior.moved(root @ state.amounts[OF_SHAFT])
    in_sheet = samples.points + samples.modes @ state.amounts[POSE + PARAMETERS :]
    turned = shaft.turn(in_sheet, samples.position)
    place = turned @ state.rotation.T + state.shift
    distance, top = above_top(piece, place, MARGIN_MM)
    normal = top.normal
    in_head = normal @ state.rotation
    facing = np.einsum("ni,nij->nj", in_head, shaft.rotation(samples.position))
    of_shaft = shaft.displacement(turned, samples.position, prior.axes) @ root
    design = [
        np.cross(place - pivot, normal),
        normal,
        np.einsum("ni,nij->nj", in_head, of_shaft),
        np.einsum("ni,nij->nj", facing, samples.modes),
    ]
    variance = (facing[:, [0, 2]] ** 2 * samples.variance).sum(axis=1)
    plan = np.floor((place[:, :2] + piece.rim_mm) / CELL_MM).astype(np.int64)
    known = np.ones(len(state.amounts) - POSE)
    return _Terms(
        distance=distance,
        sigma=np.sqrt(np.maximum(variance, LEAST_SIGMA_MM**2)),
        design=np.concatenate(design, axis=1),
        amounts=state.amounts,
        prior=np.concatenate([ROUGHLY**-2.0, known]),
        clear=top.clear,
        cell=plan[:, 0] * CELLS_ACROSS + plan[:, 1],
    )


def _no_outliers(terms: _Terms) -> Mask:
    """(N,) which clear points are no outliers."""
    if not terms.clear.any():
        raise MeasurementError("no point of the scan lies on the block's nominal top")
    ratio = np.abs(terms.distance / terms.sigma)
    # Of a normal distribution the median of the absolute value is 0.6745 sigma.
    spread = float(np.median(ratio[terms.clear])) / 0.6745
    return terms.clear & (ratio < OUTLIER * spread)


def _widen_sigmas(terms: _Terms, kept: Mask) -> _Terms:
    """The terms with sigmas widened to the scatter of the points, where that is larger."""
    chi2 = float(np.mean((terms.distance[kept] / terms.sigma[kept]) ** 2))
    return replace(terms, sigma=terms.sigma * max(np.sqrt(chi2), 1.0))


def _step(terms: _Terms, kept: Mask) -> tuple[Floats, float]:
    """The Gauss-Newton step (P,) and its length in standard deviations."""
    weighted = terms.design[kept] / terms.sigma[kept, None]
    hessian = weighted.T @ weighted + np.diag(terms.prior)
    gradient = weighted.T @ (terms.distance[kept] / terms.sigma[kept]) + terms.prior * terms.amounts
    step = np.asarray(-np.linalg.solve(hessian, gradient), dtype=float)
    return step, float(np.sqrt(step @ hessian @ step))


def _covariance(terms: _Terms, kept: Mask) -> tuple[Floats, int]:
    """(P, P) covariance of the unknowns, and the number of cells it was judged from."""
    weighted = terms.design[kept] / terms.sigma[kept, None]
    data = weighted.T @ weighted
    _, cell = np.unique(terms.cell[kept], return_inverse=True)
    cells = int(cell.max()) + 1
    if cells < FEWEST_CELLS:
        raise MeasurementError(
            f"too little of the block is in the scan: {cells} cells of {CELL_MM:g} mm hold "
            f"points, {FEWEST_CELLS} are needed"
        )
    scores = np.zeros((cells, data.shape[0]))
    np.add.at(scores, cell, weighted * (terms.distance[kept] / terms.sigma[kept])[:, None])
    bread = np.linalg.inv(data + np.diag(terms.prior))
    # The fit takes its own freedom out of the scores' scatter.
    fitted = float(np.trace(bread @ data))
    meat = scores.T @ scores * (cells / max(cells - fitted, 1.0))
    return bread @ (meat + np.diag(terms.prior)) @ bread, cells


# The section ``[shaft]`` as a file by itself, to be included in a rig file.


def save_shaft(path: Path, fit: ShaftFit) -> None:
    """Write the shaft found as a TOML file that a rig file can name in its ``include``.

    Numbers are written in full.

    Parameters
    ----------
    path : Path, of the file
    fit : ShaftFit, mm and rad; the file has degrees

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    found = (
        f"# Found from {fit.points} points of a scan, {fit.rms_mm:.4f} mm rms off the workpiece."
    )
    write_toml(path, {"shaft": section_of(fit.shaft).model_dump()}, found)


def load_shaft(path: Path) -> ShaftSection:
    """The ``[shaft]`` of a TOML file, whatever else it holds.

    Parameters
    ----------
    path : Path, of the file

    Raises
    ------
    InputError
        Where the file cannot be read, has no such section or a bad one.
    """
    document = read_document(path)
    if not isinstance(document.get("shaft"), dict):
        raise InputError("has no section [shaft]", where=path)
    return check(ShaftSection, document["shaft"], where=path, prefix="shaft")
