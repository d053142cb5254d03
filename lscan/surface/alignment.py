"""An alignment, and a surface taken to the workpiece frame by it, errors and all."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, model_validator
from scipy.linalg import block_diag

from lscan.calibration.fields import Matrix, Place, Vector, check_covariance, of_length
from lscan.config.documents import Strict, check
from lscan.config.targets import Sandwave
from lscan.errors import InputError, MeasurementError
from lscan.files.disk import read_json, write_json
from lscan.records import Floats, Ints, Provenance, Surface
from lscan.surface.edges import EdgeCrossings
from lscan.surface.surface import StoredProvenance, require_head_frame
from lscan.version import __version__

# The matrices of an alignment: the shear of the yaw, and the levelling of eqs. (5) to (7).


def shear(yaw_rad: float) -> Floats:
    """(3, 3) matrix from raw points (x, s, z) to true points in the head's axes.

    Parameters
    ----------
    yaw_rad : float, rad, angle of the sheet against the track
    """
    return np.array([[1.0, np.sin(yaw_rad), 0.0], [0.0, np.cos(yaw_rad), 0.0], [0.0, 0.0, 1.0]])


def levelling_step(normal: Floats) -> Floats:
    """(3, 3) rotation R_x R_y of eqs. (5) to (7) that levels a base plane.

    As printed, with alpha = -asin(n_y) and beta = asin(n_x), eqs. (5) and (6) would turn a
    level plane (alpha = beta = 0) by 90 degrees about both axes: their sines and cosines hold
    for angles counted from the axes, that is for alpha + 90° and beta + 90°.  With these put
    in, sin becomes cos and cos becomes -sin, as here; then R_x R_y n is
    (0, 0, 1) but for terms of third order in the tilt, and repeating it (eq. 7) removes those.

    Parameters
    ----------
    normal : (3,) array, unit normal of the base plane

    References
    ----------
    Eqs. (5) to (7) of the paper.

    Examples
    --------
    >>> normal = np.array([0.0, 0.6, 0.8])
    >>> (levelling_step(normal) @ normal).round(6) + 0.0
    array([0., 0., 1.])
    """
    alpha, beta = -np.arcsin(normal[1]), np.arcsin(normal[0])
    sin_a, cos_a, sin_b, cos_b = np.sin(alpha), np.cos(alpha), np.sin(beta), np.cos(beta)
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cos_a, sin_a], [0.0, -sin_a, cos_a]])
    about_y = np.array([[cos_b, 0.0, -sin_b], [0.0, 1.0, 0.0], [sin_b, 0.0, cos_b]])
    return about_x @ about_y


def level(points_mm: Floats) -> Floats:
    """(3, 3) rotation that levels the base plane of points.

    Eq. (7) repeated, the plane fitted anew each time, until its normal settles at (0, 0, 1).

    Parameters
    ----------
    points_mm : (K, 3) array, mm, of the base plane, frame of the head

    Raises
    ------
    MeasurementError
        Where the points carry no plane.

    References
    ----------
    Eqs. (5) to (7) of the paper.
    """
    rotation = np.eye(3)
    for _ in range(20):
        normal = plane_normal(points_mm @ rotation.T)
        if np.hypot(normal[0], normal[1]) < 1e-12:
            break
        rotation = levelling_step(normal) @ rotation
    return rotation


def plane_normal(points_mm: Floats) -> Floats:
    """(3,) upward unit normal of the least-squares plane of points.

    Parameters
    ----------
    points_mm : (K, 3) array, mm

    Raises
    ------
    MeasurementError
        For fewer than three points, or points on one line.
    """
    if len(points_mm) < 3:
        raise MeasurementError(f"base plane: {len(points_mm)} points, 3 are needed")
    centred = points_mm - points_mm.mean(axis=0)
    spread, axes = np.linalg.eigh(centred.T @ centred)
    if spread[1] < 1e-9 * spread[2]:
        raise MeasurementError("base plane: the points lie on one line")
    normal = axes[:, 0]
    return normal if normal[2] > 0 else -normal


# What errors of the points do to the alignment that is found from them.
#
# The alignment makes seven quantities of the aligned points zero: height and two slopes of the
# wedges' tops, the turn of the line of the corners, the lean of the edges against that line, and
# the two coordinates of the corners' middle.  Each is a linear function of a small displacement of
# the points.  So is the displacement that each of the alignment's own seven parameters gives to
# them.  To first order, then, a displacement common to many points, such as an error of the
# calibration, is answered by the change of parameters that makes the seven zero again; and what
# noise leaves in the seven is answered by errors of the parameters that all points share.
#
# About a shaft there is no yaw, and the edges' lean is made zero in place of the line of the
# corners' turn: six parameters make six quantities zero.


PARAMETERS = 7
"""Rotations about x, y and z, yaw, shifts in x, y and z."""

YAW = 3
"""Index of the yaw among the parameters."""

TURN, LEAN = 3, 4
"""Indices, among the seven quantities, of the corners' turn and of the lean against it."""


@dataclass(frozen=True)
class Datum:
    """What an alignment is made from, in the workpiece frame.

    Attributes
    ----------
    tops : (K, 3) array, mm, points of the wedges' tops
    top_index : (K,) array, of them among all points of the surface
    top_sigma_mm : (K,) array, mm, noise of their z, each one's own
    edges : sequence of EdgeCrossings, the four of the wedges (left near, left far, right near,
        right far), then the sides
    edge_covariance : (E + 1, E + 1) array, of the lean and of each edge's place, mm
    yaw_variance : float, rad², to be added to that of the lean
    corners : (2, 2) array, mm, left and right one
    rotation : (3, 3) array, of the alignment
    yaw_rad : float, rad, of the alignment
    by_sides : bool, whether the corners are where the wedges' far edges are at the x that the two
        sides, the last two edges, say, instead of where the near and the far ones meet
    sheared : bool, False for a scan about a shaft
    """

    tops: Floats
    top_index: Ints
    top_sigma_mm: Floats
    edges: Sequence[EdgeCrossings]
    edge_covariance: Floats
    yaw_variance: float
    corners: Floats
    rotation: Floats
    yaw_rad: float
    by_sides: bool = False
    sheared: bool = True

    @property
    def index(self) -> Ints:
        """(P,) of all the points it is made from: the tops, then edge by edge."""
        return np.concatenate([self.top_index, *(edge.index for edge in self.edges)])

    @property
    def pivot(self) -> Floats:
        """(3,) mm, the middle of the corners at the height of the tops."""
        return np.array([*self.corners.mean(axis=0), self.tops[:, 2].mean()])


def parameter_modes(datum: Datum, modes: NDArray[np.floating]) -> Floats:
    """(7, M + 7) how the alignment's parameters err, in mm and rad.

    The first M columns answer the modes; the last 7 are the noise of the alignment itself.
    Without a yaw its row is zero.

    Parameters
    ----------
    datum : Datum, mm, frame of the workpiece
    modes : (P, 3, M) array, mm, displacements of the points of ``datum.index``, along the
        workpiece's axes
    """
    points = np.concatenate([datum.tops, *(edge.inside for edge in datum.edges)])
    given = displacement(points, datum.pivot, datum.rotation, datum.yaw_rad)
    noise, vectors = np.linalg.eigh(_noise_covariance(datum))
    left = np.column_stack([_conditions(datum, modes), vectors * np.sqrt(np.maximum(noise, 0.0))])
    matrix = _conditions(datum, given)
    if datum.sheared:
        return np.asarray(-np.linalg.solve(matrix, left))
    free = np.delete(np.arange(PARAMETERS), YAW)
    for rows in (left, matrix):  # the edges' lean by itself, not against the corners
        rows[LEAN] -= rows[TURN]
    left, matrix = (np.delete(rows, TURN, axis=0) for rows in (left, matrix))
    errors = np.zeros((PARAMETERS, left.shape[1]))
    errors[free] = -np.linalg.solve(matrix[:, free], left)
    return errors


def displacement(points: Floats, pivot: Floats, rotation: Floats, yaw_rad: float) -> Floats:
    """(..., 3, 7) displacement of workpiece points, mm, by each parameter's unit.

    Parameters
    ----------
    points : (..., 3) array, mm, frame of the workpiece
    pivot : (3,) array, mm, about which is turned, and where the yaw displaces nothing
    rotation : (3, 3) array, of the alignment
    yaw_rad : float, rad, of the alignment
    """
    x, y, z = np.moveaxis(points - pivot, -1, 0)
    zero = np.zeros_like(x)
    # Track position of a point relative to the pivot, from its place: the inverse of the pose.
    sine, cosine = np.sin(yaw_rad), np.cos(yaw_rad)
    track = ((points - pivot) @ rotation)[..., 1] / cosine
    about = [
        np.stack([zero, -z, y], axis=-1),
        np.stack([z, zero, -x], axis=-1),
        np.stack([-y, x, zero], axis=-1),
        track[..., None] * (rotation @ np.array([cosine, -sine, 0.0])),
    ]
    shifts = np.broadcast_to(np.eye(3), (*points.shape[:-1], 3, 3))
    return np.concatenate([np.stack(about, axis=-1), shifts], axis=-1)


def _conditions(datum: Datum, field: NDArray[np.floating]) -> Floats:
    """(7, C) the seven quantities of C displacements (P, 3, C) of the tops, then the edges."""
    count = len(datum.tops)
    plane = np.linalg.lstsq(_plane_design(datum), field[:count, 2], rcond=None)[0]
    counts = [len(edge.index) for edge in datum.edges]
    which = np.repeat(np.arange(len(datum.edges)), counts)
    y = np.concatenate([edge.inside[:, 1] for edge in datum.edges]) - datum.pivot[1]
    # What the lean and each edge's place do to the crossings, as in edges.py.
    design = np.column_stack([y, np.eye(len(datum.edges))[which]])
    slope = np.repeat([edge.slope for edge in datum.edges], counts)
    across = field[count:, 0] - slope[:, None] * field[count:, 1]
    edges = np.linalg.lstsq(design, across, rcond=None)[0]
    return np.concatenate([plane, _from_edges(datum) @ edges])


def _noise_covariance(datum: Datum) -> Floats:
    """(7, 7) covariance of the seven quantities from the points' own noise."""
    spread = np.linalg.pinv(_plane_design(datum)) * datum.top_sigma_mm
    edges = _from_edges(datum)
    of_edges = edges @ datum.edge_covariance @ edges.T
    of_edges[1, 1] += datum.yaw_variance
    return np.asarray(block_diag(spread @ spread.T, of_edges))


def _plane_design(datum: Datum) -> Floats:
    """(K, 3) of a plane through the tops."""
    return np.column_stack([np.ones(len(datum.tops)), (datum.tops - datum.pivot)[:, :2]])


def _from_edges(datum: Datum) -> Floats:
    """(4, E + 1) turn, lean against the line of the corners, and middle (x, y), from the lean
    and the places of the edges."""
    size = len(datum.edges) + 1
    sides = np.where(np.arange(size) >= size - 2, 0.5, 0.0)
    corners = []
    for near, far in ((0, 1), (2, 3)):
        if datum.by_sides:  # where the far edge is at the corner's x, which the sides say
            corners.append((sides, (sides - np.eye(size)[1 + far]) / datum.edges[far].slope))
            continue
        # Where x = at + slope y of both edges agree.
        y = np.zeros(size)
        y[[1 + near, 1 + far]] = np.array([-1.0, 1.0]) / (
            datum.edges[near].slope - datum.edges[far].slope
        )
        x = datum.edges[near].slope * y
        x[1 + near] += 1.0
        corners.append((x, y))
    (left_x, left_y), (right_x, right_y) = corners
    turn = (right_y - left_y) / (datum.corners[1, 0] - datum.corners[0, 0])
    lean = np.eye(size)[0] + turn
    return np.stack([turn, lean, (left_x + right_x) / 2, (left_y + right_y) / 2])


# An alignment, and a surface taken to the workpiece frame by it, errors and all.


@dataclass(frozen=True)
class Alignment:
    """How raw points become workpiece points: ``rotation @ shear(yaw) @ raw + translation``.

    Attributes
    ----------
    yaw_rad, yaw_sigma_rad : float, rad, angle of the sheet against the track, its standard
        uncertainty
    rotation : (3, 3) array, of the four-step alignment without the shear
    translation_mm : (3,) array, mm, frame of the workpiece
    normal : (3,) array, unit normal of the base plane in the head's axes
    base_mm : float, mm, height of the base plane in the workpiece frame
    left_corner_mm, right_corner_mm : (2,) array, mm, W_L and W_R in the workpiece plan
    pivot_mm : (3,) array, mm, the corners' middle, about which the parameters of ``modes`` turn
    modes : (7, M + 7) array, mm and rad, how the alignment errs: with each of the
        surface's M modes, and with seven independent errors of its own
    sheared : bool, False where the scan was made about a shaft and so has no yaw

    References
    ----------
    Eqs. (5) to (7) of the paper; Sec. IV.C.
    """

    yaw_rad: float
    yaw_sigma_rad: float
    rotation: Floats
    translation_mm: Floats
    normal: Floats
    base_mm: float
    left_corner_mm: Floats
    right_corner_mm: Floats
    pivot_mm: Floats
    modes: Floats
    sheared: bool = True

    @property
    def yaw_deg(self) -> float | None:
        """The yaw, degrees; None about a shaft, where there is none."""
        return float(np.degrees(self.yaw_rad)) if self.sheared else None

    def to_workpiece(self, raw_mm: Floats) -> Floats:
        """(..., 3) points in the frame of the workpiece, mm.

        Parameters
        ----------
        raw_mm : (..., 3) array, mm, raw points, frame of the head
        """
        return raw_mm @ (self.rotation @ shear(self.yaw_rad)).T + self.translation_mm

    def to_raw(self, workpiece_mm: Floats) -> Floats:
        """(..., 3) raw points in the frame of the head, mm.

        Parameters
        ----------
        workpiece_mm : (..., 3) array, mm, frame of the workpiece
        """
        matrix = np.linalg.inv(self.rotation @ shear(self.yaw_rad))
        return (workpiece_mm - self.translation_mm) @ matrix.T


def apply(alignment: Alignment, surface: Surface) -> Surface:
    """The surface in the workpiece frame, mm, its uncertainties turned with it.

    modes_mm are the surface's own, less what the alignment takes out of them (it is found from
    the same points), and seven more: the alignment's own errors.  They displace along all three
    axes, so what an error of x or y does to a height is the slope's to say; sigma_z_mm is that of
    z alone.  Where the surface has no modes only the alignment's own are known.

    Parameters
    ----------
    alignment : Alignment, found in this surface, or in another
    surface : Surface, frame of the head

    Raises
    ------
    InputError
        For a surface that is not in the head frame.
    """
    require_head_frame(surface)
    turn, xyz = alignment.rotation, alignment.to_workpiece(surface.xyz_mm)
    moved = displacement(xyz, alignment.pivot_mm, turn, alignment.yaw_rad)
    answered = moved.reshape(-1, moved.shape[-1]) @ alignment.modes  # one product, not one a point
    modes = answered.astype(np.float32).reshape(*xyz.shape, -1)
    if surface.modes_mm is not None:
        matrix = (turn @ shear(alignment.yaw_rad)).astype(np.float32)
        modes[..., : surface.modes_mm.shape[-1]] += matrix @ surface.modes_mm
    total = _squares(modes)
    sigma = np.sqrt(own_variances(surface) @ (turn**2).T + total)
    return replace(
        surface,
        xyz_mm=xyz,
        sigma_x_mm=sigma[..., 0],
        sigma_y_mm=None if surface.sigma_y_mm is None else sigma[..., 1],
        sigma_z_mm=sigma[..., 2],
        frame="workpiece",
        modes_mm=modes,
        yaw_rad=alignment.yaw_rad if alignment.sheared else None,
        yaw_sigma_rad=alignment.yaw_sigma_rad if alignment.sheared else None,
    )


def own_variances(surface: Surface) -> Floats:
    """(F, N, 3) variances of x, y and z, mm², without what the modes make common to all points.

    That of y is 0 where y is the track's.

    Parameters
    ----------
    surface : Surface, of F by N points
    """
    y = np.zeros_like(surface.sigma_z_mm) if surface.sigma_y_mm is None else surface.sigma_y_mm
    total = np.stack([surface.sigma_x_mm, y, surface.sigma_z_mm], axis=-1) ** 2
    if surface.modes_mm is None:
        return total
    return np.maximum(total - _squares(surface.modes_mm), 0.0)


def _squares(modes: NDArray[np.float32]) -> Floats:
    """(...) sums of the squares of (..., M), in double precision, without a copy of all modes."""
    return np.asarray(np.einsum("...m,...m->...", modes, modes, dtype=np.float64))


def turned_modes(surface: Surface, matrix: Floats, index: Ints) -> NDArray[np.float32]:
    """(P, 3, M) modes of some of the surface's points along turned axes, mm.

    Parameters
    ----------
    surface : Surface, of F by N points
    matrix : (3, 3) array, that turns the axes
    index : (P,) array, of the points, among all F N
    """
    if surface.modes_mm is None:
        return np.zeros((len(index), 3, 0), dtype=np.float32)
    rows, columns = np.unravel_index(index, surface.status.shape)
    return matrix.astype(np.float32) @ surface.modes_mm[rows, columns]


# An alignment kept in a file: the yaw and level of a rig, found once from a scan of the block.
#
# The sheet's yaw against the track and the level of what stands in the tank stay as they are from
# scan to scan, but only the sandwave block with its wedges shows them.  A scan of it gives the
# alignment that scans of other targets are then brought into the block's frame with.
#
# The alignment errs with each of the calibration's errors, which displaced the block's points, and
# by noise of its own.  A target scanned with the same calibration is displaced by the same errors,
# and what levelling the block took out of them is taken out of its points too.  With another
# calibration they are independent.


FORMAT: Final = "lscan-alignment"
VERSION = 1

ORTHONORMAL = 1e-9
"""How far the product of a rotation with its transpose may be from one: rounding is 1e-15."""

LARGEST = 1e6
"""Of any number of the file, mm or degrees: a kilometre."""

IN_FILE = np.array([180 / np.pi] * 4 + [1.0] * 3)
"""From the parameters' units to those of a file: four angles in degrees, three shifts in mm."""


@dataclass(frozen=True)
class KeptAlignment:
    """An alignment, and the scan it was found in.

    Attributes
    ----------
    alignment : Alignment, as found
    provenance : Provenance, of the scan it was found in
    source : str, where it is from, in words
    """

    alignment: Alignment
    provenance: Provenance
    source: str

    def of(self, raw: Surface) -> Alignment:
        """The alignment as it errs in another surface.

        Parameters
        ----------
        raw : Surface, frame of the head
        """
        count = 0 if raw.modes_mm is None else raw.modes_mm.shape[-1]
        given = raw.provenance.calibration_sha256 if raw.provenance else None
        same = given == self.provenance.calibration_sha256
        modes = self.alignment.modes
        if same and modes.shape[1] == count + PARAMETERS:
            return self.alignment
        independent = np.hstack([np.zeros((PARAMETERS, count)), modes])
        return replace(self.alignment, modes=independent)


Triple = Annotated[Vector, of_length(3)]


class DeterminedFrom(StoredProvenance):
    """The scan an alignment was found in."""

    workpiece: Sandwave


def _rotation(matrix: Floats) -> Floats:
    """The matrix; ValueError where it is no rotation."""
    if matrix.shape == (3, 3) and np.abs(matrix).max() < 2:  # larger ones overflow
        off = np.abs(matrix @ matrix.T - np.eye(3)).max()
        if off < ORTHONORMAL and np.linalg.det(matrix) > 0:
            return matrix
    raise ValueError("must be a rotation, 3 by 3")


class AlignmentFile(Strict):
    """The whole file.

    rotation, translation_mm: as of alignment.Alignment.  covariance: of the alignment's own
    errors, in this order: rotations about x, y and z, yaw (degrees), shifts (mm), all
    about the pivot.  by_calibration: change of these parameters by each independent error of the
    calibration that is one standard deviation large.
    """

    format: Literal["lscan-alignment"] = FORMAT
    version: Annotated[int, Field(strict=True, ge=1, le=VERSION)]
    software: str
    determined_from: DeterminedFrom
    yaw_deg: Annotated[float, Field(ge=-45, le=45)]
    rotation: Annotated[Matrix, AfterValidator(_rotation)]
    translation_mm: Triple
    base_mm: float
    left_corner_mm: Place
    right_corner_mm: Place
    pivot_mm: Triple
    covariance: Matrix
    by_calibration: Annotated[Matrix, of_length(PARAMETERS)]

    @model_validator(mode="after")
    def _usable(self) -> Self:
        check_covariance(self.covariance, PARAMETERS)
        for name in ("translation_mm", "pivot_mm", "covariance", "by_calibration"):
            if np.abs(getattr(self, name)).max(initial=0.0) > LARGEST:
                raise ValueError(f"{name} must hold no number above {LARGEST:g}")
        values = np.linalg.eigvalsh(self.covariance / _scales(self.covariance))
        if values[0] < -ORTHONORMAL:
            raise ValueError("covariance must be that of seven quantities: none is below nought")
        return self

    def alignment(self) -> Alignment:
        """As the program holds it."""
        modes = np.hstack([self.by_calibration, _root(self.covariance)]) / IN_FILE[:, None]
        return Alignment(
            yaw_rad=float(np.radians(self.yaw_deg)),
            yaw_sigma_rad=float(np.linalg.norm(modes[YAW])),
            rotation=self.rotation,
            translation_mm=self.translation_mm,
            normal=self.rotation[2],
            base_mm=self.base_mm,
            left_corner_mm=self.left_corner_mm,
            right_corner_mm=self.right_corner_mm,
            pivot_mm=self.pivot_mm,
            modes=modes,
        )


def save_alignment(
    path: Path, alignment: Alignment, provenance: Provenance, piece: Sandwave
) -> None:
    """Write an alignment to a JSON file: a whole file or none.

    Parameters
    ----------
    path : Path, of the file
    alignment : Alignment, found in a scan of the sandwave along a linear track
    provenance : Provenance, of that scan's surface
    piece : Sandwave, the block's nominal shape

    Raises
    ------
    InputError
        Where the scan was made about a shaft, or the file cannot be written.
    """
    if not alignment.sheared:
        what = "a scan about a shaft has no yaw to keep"
        raise InputError(what, where=path, allowed="a linear track")
    modes = alignment.modes * IN_FILE[:, None]
    count = modes.shape[1] - PARAMETERS
    own = modes[:, count:]
    content = AlignmentFile(
        version=VERSION,
        software=__version__,
        determined_from=DeterminedFrom(workpiece=piece, **asdict(provenance)),
        yaw_deg=float(np.degrees(alignment.yaw_rad)),
        rotation=alignment.rotation,
        translation_mm=alignment.translation_mm,
        base_mm=alignment.base_mm,
        left_corner_mm=alignment.left_corner_mm,
        right_corner_mm=alignment.right_corner_mm,
        pivot_mm=alignment.pivot_mm,
        covariance=own @ own.T,
        by_calibration=modes[:, :count],
    )
    write_json(path, content.model_dump(mode="json"))


def load_alignment(path: Path) -> KeptAlignment:
    """The alignment that was saved in a file.

    Parameters
    ----------
    path : Path, of the file

    Raises
    ------
    InputError
        Names the file and the key of anything that is not as it was written.
    """
    document = read_json(path)
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise InputError("is no alignment", where=path, allowed=f'format "{FORMAT}"')
    content = check(AlignmentFile, document, where=path)
    provenance = content.determined_from.provenance()
    return KeptAlignment(
        content.alignment(), provenance, f"the block scanned with {provenance.rig!r}"
    )


def _scales(covariance: Floats) -> Floats:
    """(P, P) products of standard deviations, 1 for those that are 0."""
    sigma = np.sqrt(np.diag(covariance))
    sigma = np.where(sigma > 0, sigma, 1.0)
    return np.outer(sigma, sigma)


def _root(covariance: Floats) -> Floats:
    """(P, P) matrix whose product with its transpose is the covariance; it may be singular."""
    scales = _scales(covariance)
    values, vectors = np.linalg.eigh(covariance / scales)
    return np.asarray(
        np.sqrt(np.diag(scales))[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    )
