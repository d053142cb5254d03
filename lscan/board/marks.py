"""Ruler marks, named dots and milled circles: predicted from the grid, then found."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import map_coordinates, spline_filter
from scipy.spatial import cKDTree

from lscan.board.lattice import LocalMap, grid_points_mm, shift_of_discs
from lscan.board.picture import BLUR_PX, BoardPicture, disc_height, stand_alone, window_sigma
from lscan.board.search import Nodes, look
from lscan.config.board import Board, Ring
from lscan.records import Floats, Ints, Mark, Marks, Mask, RingPoints, RulerReading, Status, select

# Ruler marks and named dots: predicted from the grid, then found like the control points.

BOX = 0.3  # half side of the search box, of the distance to the next mark
WIDEST_BOX_PX = 4.0  # the grid predicts a mark to some tenths of a pixel
FAINTEST = 0.4  # of the height a mark of this size should have


@dataclass(frozen=True)
class Contrast:
    """How much brighter than the ground the marks are, across the board.

    Attributes
    ----------
    board_mm : (N, 2) array, mm, (x, z) of the control points found
    contrast : (N,) array, grey values
    """

    board_mm: Floats
    contrast: Floats

    @classmethod
    def of(cls, nodes: Nodes, mapping: LocalMap, diameter_mm: float) -> "Contrast":
        """The contrast of the control dots, from their heights.

        Parameters
        ----------
        nodes : Nodes, px and grey values
        mapping : LocalMap, through them
        diameter_mm : float, mm, of a control dot
        """
        board = grid_points_mm(nodes.height.shape, mapping.pitch_mm)[nodes.found]
        radius = mapping.expansion(board).scale * diameter_mm / 2
        return cls(board, nodes.height[nodes.found] / disc_height(radius, BLUR_PX))

    def at(self, board_mm: Floats) -> Floats:
        """(M,) contrast of the control dot nearest to each place.

        Parameters
        ----------
        board_mm : (M, 2) array, mm, of (x, z)
        """
        return self.contrast[self._tree.query(board_mm)[1]]

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.board_mm)


def mark_status(found: Mask, in_view: Mask) -> Ints:
    """(N,) of Status: OK, or why there is no mark.

    Parameters
    ----------
    found : (N,) mask, of the marks found
    in_view : (N,) mask, of the marks that the picture does not cut
    """
    missing = np.where(in_view, int(Status.NOT_FOUND), int(Status.OUT_OF_VIEW))
    return np.where(found, int(Status.OK), missing).astype(np.int64)


def read_round_marks(
    picture: BoardPicture, mapping: LocalMap, contrast: Contrast, board: Board
) -> tuple[tuple[RulerReading, ...], dict[str, Mark]]:
    """The marks of the auxiliary rulers (Fig. 14) and the named dots (Fig. 18), by name.

    Both in the order of the board file.

    Parameters
    ----------
    picture : BoardPicture, levelled
    mapping : LocalMap, through the control points
    contrast : Contrast, grey values, of the control points
    board : Board, mm
    """
    rulers = [(ruler.points_mm(), ruler.mark_diameter_mm, ruler.step_mm) for ruler in board.ruler]
    dots = [  # nothing else should be nearer than three diameters
        (np.array([[dot.x_mm, dot.z_mm]]), dot.diameter_mm, 3 * dot.diameter_mm)
        for dot in board.dot
    ]
    if not rulers + dots:
        return (), {}
    places, diameters, clear = zip(*rulers, *dots, strict=True)
    kind = np.repeat(np.arange(len(places)), [len(of_kind) for of_kind in places])
    found = _read_marks(
        picture, mapping, contrast, np.vstack(places), np.array(diameters), np.array(clear), kind
    )
    every = [select(found, kind == number) for number in range(len(places))]
    readings = tuple(
        RulerReading(ruler.direction, ruler.at_mm, marks)
        for ruler, marks in zip(board.ruler, every, strict=False)
    )
    return readings, {
        dot.name: Mark(marks.image_px[0], float(marks.sigma_px[0]), Status(int(marks.status[0])))
        for dot, marks in zip(board.dot, every[len(rulers) :], strict=True)
    }


def _read_marks(
    picture: BoardPicture,
    mapping: LocalMap,
    contrast: Contrast,
    board_mm: Floats,
    diameter_mm: Floats,
    clear_mm: Floats,
    kind: Ints,
) -> Marks:
    """Round marks at known places (N, 2) mm, of K kinds (N,).

    Of each kind: diameter_mm (K,), and the distance clear_mm (K,) that they are from others.
    """
    map_there = mapping.expansion(board_mm)
    expected, scale, radius_mm = map_there.image_px, map_there.scale, diameter_mm[kind] / 2
    radius = scale * radius_mm
    in_view = picture.wholly_in_view(expected, radius)
    box = np.clip(BOX * clear_mm[kind] * scale, 1.0, WIDEST_BOX_PX)
    sigma = window_sigma(radius)
    shift = shift_of_discs(map_there, radius_mm, sigma)
    centres = look(picture, expected + shift, box, sigma, kind)
    full = contrast.at(board_mm) * disc_height(radius, BLUR_PX)
    points = centres.points - shift
    miss = np.abs(points - expected).max(axis=1)
    found = in_view & centres.round & (centres.height > FAINTEST * full) & (miss <= box + 0.5)
    found &= stand_alone(picture.flat, centres, sigma, picture.noise, kind)
    return Marks(
        board_mm=board_mm,
        image_px=np.where(found[:, None], points, np.nan),
        sigma_px=np.where(found, centres.sigma_px, np.nan),
        status=mark_status(found, in_view),
    )


# Points on the centre line of a milled circle (Figs. 18, 19), picked all around it.
#
# The paper picks them by hand in an enlarged picture.  Here the predicted line is crossed by radial
# profiles, and each profile's maximum is that of a second-order polynomial, weighted by a Gaussian
# about itself, as for the dots (picture.py), in one dimension.
#
# Blur draws the ridge of a curved line inwards: a line of curvature k blurred by a Gaussian of
# variance B falls off as exp(-d² / 2B) / sqrt(1 + k d) with the distance d outwards, whose maximum
# lies at d = -k B / 2.  (From the blurred thin ring, exp(-(r² + R²) / 2B) I0(r R / B), for R² much
# larger than B.)  B is read off the profiles themselves, and the points are corrected for the
# shift. The window works across the line only and along its bend, so it shifts nothing.


BREADTH_PX = np.array([-1.0, 0.0, 1.0])  # places along the line averaged into one profile
SPACING_PX = float(len(BREADTH_PX))  # between profiles: no pixel counts twice
FEWEST = 12  # profiles of a small ring
REACH_PX = 4.0  # of a profile to either side
SAMPLE_PX = 0.5
NOISE_LIMIT = 5.0
STEPS = 8


@dataclass(frozen=True)
class RingCrossings:
    """Where the line of a ring is expected, N places.

    Attributes
    ----------
    middle : (N, 2) array, px, of (u, v)
    normal : (N, 2) array, unit vectors across the line, outwards
    scale : (N,) array, px per mm across it
    curvature : (N,) array, 1/px, of the line in the picture, positive where it bends inwards
    """

    middle: Floats
    normal: Floats
    scale: Floats
    curvature: Floats


@dataclass(frozen=True)
class Ridges:
    """Second-order polynomials h + s d + b d² about the maxima of N profiles.

    Attributes
    ----------
    centre : (N,) array, px, from the line expected
    height, bend : (N,) array, h and b there
    sigma_px : (N,) array, px, standard uncertainty of centre
    peaked : (N,) mask, whether there is a maximum inside the profile
    """

    centre: Floats
    height: Floats
    bend: Floats
    sigma_px: Floats
    peaked: Mask


def read_ring(
    picture: BoardPicture, mapping: LocalMap, contrast: Contrast, ring: Ring
) -> RingPoints:
    """Points on the ring's centre line, counter-clockwise from its right.

    One for about every third pixel of the line, so that their errors are independent.  Only
    points that are seen: none where the ring is out of view.

    Parameters
    ----------
    picture : BoardPicture, levelled
    mapping : LocalMap, through the control points
    contrast : Contrast, grey values, of the control points
    ring : Ring, mm
    """
    middle_mm = np.array([[ring.x_mm, ring.z_mm]])
    radius_px = float(mapping.expansion(middle_mm).scale[0]) * ring.diameter_mm / 2
    count = max(FEWEST, int(2 * np.pi * radius_px / SPACING_PX))
    angle = 2 * np.pi * np.arange(count) / count
    # Averaged along the arc: along the tangent the line's sagitta would shrink the ring.
    fine = (angle[:, None] + BREADTH_PX / radius_px).ravel()
    outward_mm = np.column_stack([np.cos(fine), np.sin(fine)])
    board = middle_mm + outward_mm * ring.diameter_mm / 2
    crossings = _crossings(mapping, board, outward_mm, ring.diameter_mm / 2)
    samples = int(min(REACH_PX, radius_px / 2) / SAMPLE_PX)  # to either side
    offsets = np.linspace(-samples * SAMPLE_PX, samples * SAMPLE_PX, 2 * samples + 1)
    profile, noise = _profiles(picture, crossings, offsets)
    crossings = select(crossings, slice(1, None, len(BREADTH_PX)))
    sigma = float(window_sigma(np.array([ring.width_mm * np.median(crossings.scale) / 2]))[0])
    ridges = _ridges(profile, noise, offsets, sigma)
    width_px = ring.width_mm * crossings.scale
    # A smoothed line of contrast 1 is as high as its width times the top of the blurred Gaussian.
    top = np.sqrt(2 * np.pi * (sigma**2 + BLUR_PX**2))
    full = contrast.at(board[1 :: len(BREADTH_PX)]) * np.minimum(width_px / top, 1.0)
    seen = picture.wholly_in_view(crossings.middle, REACH_PX) & ridges.peaked
    seen &= ridges.height > np.maximum(
        FAINTEST * full, NOISE_LIMIT * noise.mean(axis=1) / np.sqrt(SPACING_PX)
    )
    if seen.any():  # the line lies about as far off the predicted one as in the others
        apart = np.abs(ridges.centre - np.median(ridges.centre[seen]))
        seen &= apart <= 4 * 1.4826 * np.median(apart[seen]) + 0.3
    blur_px2 = _blur(ridges, seen, sigma, width_px)
    outwards = ridges.centre + crossings.curvature * blur_px2 / 2
    points = crossings.middle + outwards[:, None] * crossings.normal
    return RingPoints(points[seen], ridges.sigma_px[seen])


def _crossings(
    mapping: LocalMap, board_mm: Floats, outward_mm: Floats, radius_mm: float
) -> RingCrossings:
    """The line through the places (N, 2) mm, as the local map draws it.

    The curvature is that of the ellipse that the map's first derivatives make of the circle.
    """
    map_there = mapping.expansion(board_mm)
    jacobian = map_there.jacobian
    along_mm = np.column_stack([-outward_mm[:, 1], outward_mm[:, 0]])
    along = np.einsum("nij,nj->ni", jacobian, along_mm)
    outward = np.einsum("nij,nj->ni", jacobian, outward_mm)
    length = np.linalg.norm(along, axis=1)
    normal = np.column_stack([along[:, 1], -along[:, 0]]) / length[:, None]
    across = (outward * normal).sum(axis=1)
    curvature = np.abs(across) / (radius_mm * length**2)
    return RingCrossings(
        map_there.image_px, normal * np.sign(across)[:, None], np.abs(across), curvature
    )


def _profiles(
    picture: BoardPicture, crossings: RingCrossings, offsets: Floats
) -> tuple[Floats, Floats]:
    """Grey values and noise of a pixel (N, M) along the normals, those of one place averaged."""
    points = crossings.middle[:, None] + offsets[:, None] * crossings.normal[:, None]
    low = np.maximum(np.floor(points.min(axis=(0, 1))).astype(int) - 12, 0)
    high = np.maximum(np.ceil(points.max(axis=(0, 1))).astype(int) + 13, low + 1)
    part = np.s_[low[1] : high[1], low[0] : high[0]]
    if picture.flat[part].size == 0:
        empty = np.zeros(points.shape[:2])
        return _average_neighbours(empty), _average_neighbours(empty)
    places = [points[..., 1] - low[1], points[..., 0] - low[0]]
    spline = spline_filter(picture.flat[part].astype(np.float64))
    grey = map_coordinates(spline, places, order=3, prefilter=False, cval=0.0)
    noise = map_coordinates(picture.noise[part].astype(np.float64), places, order=1, mode="nearest")
    return _average_neighbours(grey), _average_neighbours(noise)


def _average_neighbours(profiles: Floats) -> Floats:
    """Each profile with its neighbours along the line: (3 N, M) to (N, M)."""
    triples = profiles.reshape(-1, len(BREADTH_PX), profiles.shape[1])
    return np.asarray(triples.mean(axis=1))


def _ridges(profile: Floats, noise: Floats, offsets: Floats, sigma: float) -> Ridges:
    """The maxima of the profiles (N, M), whose pixels have the noise (N, M)."""
    centre = offsets[profile.argmax(axis=1)]
    for _ in range(STEPS):
        distance = offsets - centre[:, None]
        weight = np.exp(-((distance / sigma) ** 2) / 2)
        powers = np.stack([weight] * 5)  # times powers of the distance
        for power in range(1, 5):
            np.multiply(powers[power - 1], distance, out=powers[power])
        right = (powers[:3] * profile).sum(axis=2)
        left = powers.sum(axis=2)[np.add.outer(np.arange(3), np.arange(3))]
        height, slope, bend = np.linalg.solve(left.transpose(2, 0, 1), right.T[..., None])[..., 0].T
        peaked = bend < 0
        step = np.where(peaked, -slope / np.where(peaked, 2 * bend, -1.0), 0.0)
        centre = np.clip(centre + np.clip(step, -sigma, sigma), offsets[0], offsets[-1])
    inside = np.abs(centre) < offsets[-1] - SAMPLE_PX
    sound = peaked & inside & (np.abs(step) < 0.01)
    # The samples are finer than the pixels: noise n on an area a has the density n² a, so the
    # slope, sum of w d f over that of w d², has the variance below.
    product = weight * distance
    spread = (product**2 * noise**2).sum(axis=1) * SAMPLE_PX / SPACING_PX
    slope_variance = spread / ((product * distance).sum(axis=1) * SAMPLE_PX) ** 2
    scatter = np.sqrt(slope_variance) / np.where(peaked, -2 * bend, 1.0)
    return Ridges(centre, height, bend, scatter, sound)


def _blur(ridges: Ridges, seen: Mask, sigma: float, width_px: Floats) -> float:
    """Variance of the picture's blur across the line, px², of all profiles together.

    With Gaussian weights of variance W the fit gives the smoothed line's height h + b W and
    second derivative 2 b; their ratio is minus the variance of the smoothed line, T + W, and
    T is that of the blur and of the line's width w, w² / 12.
    """
    if not seen.any():
        return 0.0
    height = (ridges.height + ridges.bend * sigma**2)[seen].mean()
    total = -height / (2 * ridges.bend[seen].mean()) - sigma**2
    return max(float(total - (width_px[seen] ** 2).mean() / 12), 0.0)
