"""Ruler marks and named dots: predicted from the grid, then found like the control points."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from lscan.board.centre import disc_height, stand_alone, window_sigma
from lscan.board.lattice import LocalMap, grid_points_mm
from lscan.board.perspective import shift_of_discs
from lscan.board.picture import BLUR_PX, BoardPicture
from lscan.board.search import Nodes, look
from lscan.config.board import Dot, Ruler
from lscan.records import Floats, Ints, Mark, Marks, Mask, RulerReading, Status

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
        radius = mapping.expanded(board).scale * diameter_mm / 2
        return cls(board, nodes.height[nodes.found] / disc_height(radius, BLUR_PX))

    def at(self, board_mm: Floats) -> Floats:
        """(M,) contrast of the control dot nearest to each place.

        Parameters
        ----------
        board_mm : (M, 2) array, mm, of (x, z)
        """
        _, index = cKDTree(self.board_mm).query(board_mm)
        return self.contrast[index]


def mark_status(found: Mask, in_view: Mask) -> Ints:
    """(N,) of Status: OK, or why there is no mark.

    Parameters
    ----------
    found : (N,) mask, of the marks found
    in_view : (N,) mask, of the marks that the picture does not cut
    """
    missing = np.where(in_view, int(Status.NOT_FOUND), int(Status.OUT_OF_VIEW))
    return np.where(found, int(Status.OK), missing).astype(np.int64)


def read_ruler(
    picture: BoardPicture, mapping: LocalMap, contrast: Contrast, ruler: Ruler
) -> RulerReading:
    """The marks of one auxiliary ruler (Fig. 14), in the order of the board file.

    Parameters
    ----------
    picture : BoardPicture, levelled
    mapping : LocalMap, through the control points
    contrast : Contrast, grey values, of the control points
    ruler : Ruler, mm
    """
    marks = _read_marks(
        picture, mapping, contrast, ruler.points_mm(), ruler.mark_diameter_mm, ruler.step_mm
    )
    return RulerReading(ruler.direction, ruler.at_mm, marks)


def read_dot(picture: BoardPicture, mapping: LocalMap, contrast: Contrast, dot: Dot) -> Mark:
    """A named dot (Fig. 18).

    Parameters
    ----------
    picture : BoardPicture, levelled
    mapping : LocalMap, through the control points
    contrast : Contrast, grey values, of the control points
    dot : Dot, mm
    """
    place = np.array([[dot.x_mm, dot.z_mm]])
    clear = 3 * dot.diameter_mm  # nothing else should be nearer than that
    marks = _read_marks(picture, mapping, contrast, place, dot.diameter_mm, clear)
    return Mark(marks.image_px[0], float(marks.sigma_px[0]), Status(int(marks.status[0])))


def _read_marks(
    picture: BoardPicture,
    mapping: LocalMap,
    contrast: Contrast,
    board_mm: Floats,
    diameter_mm: float,
    clear_mm: float,
) -> Marks:
    """Round marks of one size at known places (N, 2) mm, ``clear_mm`` apart from others."""
    map_there = mapping.expanded(board_mm)
    expected, scale = map_there.image_px, map_there.scale
    radius = scale * diameter_mm / 2
    in_view = picture.wholly_in_view(expected, radius)
    box = np.clip(BOX * clear_mm * scale, 1.0, WIDEST_BOX_PX)
    sigma = window_sigma(radius)
    shift = shift_of_discs(map_there, diameter_mm / 2, sigma)
    centres = look(picture, expected + shift, box, sigma)
    full = contrast.at(board_mm) * disc_height(radius, BLUR_PX)
    points = centres.points - shift
    miss = np.abs(points - expected).max(axis=1)
    found = in_view & centres.round & (centres.height > FAINTEST * full) & (miss <= box + 0.5)
    found &= stand_alone(picture.flat, centres, sigma, picture.noise)
    return Marks(
        board_mm=board_mm,
        image_px=np.where(found[:, None], points, np.nan),
        sigma_px=np.where(found, centres.sigma_px, np.nan),
        status=mark_status(found, in_view),
    )
