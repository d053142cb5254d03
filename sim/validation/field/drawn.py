"""Boards drawn from closed forms: where each mark is seen is known exactly.

The lens is defined from the picture to the ray, by a polynomial in the picture's radius, so the
place on the board that a pixel sees is a closed form; only the truth, the other way round, needs an
iteration.  An edge is drawn as a straight one blurred by a Gaussian, at its true distance from each
pixel to first order.  None of the instrument's code is used.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from scipy.special import erf

from lscan.records import Bytes, Floats

NEWTON_STEPS = 30


@dataclass(frozen=True)
class DrawnView:
    """A camera before a board.

    Attributes
    ----------
    size : tuple of int, (width, height) of the picture, px
    focal_px : float, px
    distance_mm : float, mm, from the pinhole to the place on the board seen in the middle
    middle_mm : tuple of float, mm, that place, (x, z)
    turn_deg : tuple of float, degrees, of the board about the picture's u, v and the axis of sight
    barrel : float, a pixel at the radius r (over the focal length) from the middle lies on the ray
        of radius r (1 + barrel r^2)
    """

    size: tuple[int, int]
    focal_px: float
    distance_mm: float
    middle_mm: tuple[float, float]
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    barrel: float = 0.0

    @property
    def axes(self) -> Floats:
        """(3, 3) the board's axes in the camera frame: right, down, away from the camera."""
        turned: Floats = Rotation.from_euler("xyz", self.turn_deg, degrees=True).as_matrix().T
        return turned

    def board_mm(self, image_px: Floats) -> Floats:
        """(..., 2) of (x, z) mm on the board that pixels (..., 2) of (u, v) see."""
        at = (image_px - (np.array(self.size) - 1) / 2) / self.focal_px
        at = at * (1 + self.barrel * (at**2).sum(axis=-1, keepdims=True))
        right, down, ahead = self.axes
        rays = np.concatenate([at, np.ones_like(at[..., :1])], axis=-1)
        reach = self.distance_mm * ahead[2] / (rays @ ahead)
        x = reach * (rays @ right) - self.distance_mm * right[2]
        z = self.distance_mm * down[2] - reach * (rays @ down)
        return np.stack([x, z], axis=-1) + np.array(self.middle_mm)

    def image_px(self, board_mm: Floats) -> Floats:
        """(N, 2) px of (u, v) at which places (N, 2) mm of the board are seen."""
        at = np.tile((np.array(self.size) - 1) / 2, (len(board_mm), 1))
        for _ in range(NEWTON_STEPS):
            miss = self.board_mm(at) - board_mm
            by_pixel = np.stack(
                [self.board_mm(at + step) - self.board_mm(at - step) for step in np.eye(2) / 2],
                axis=-1,
            )
            at = at - np.clip(np.linalg.solve(by_pixel, miss[..., None])[..., 0], -100, 100)
        return at

    def line_mm(self, sheet_per_mm: Floats, x_mm: Floats) -> Floats:
        """(N, 2) of (x, z) mm where the plane q . X = 1 of the camera frame cuts the board."""
        right, down, _ = self.axes
        origin = np.array([0.0, 0.0, self.distance_mm]) @ sheet_per_mm
        along = (x_mm - self.middle_mm[0]) * (right @ sheet_per_mm)
        beneath = (1 - origin - along) / (down @ sheet_per_mm)
        return np.column_stack([x_mm, self.middle_mm[1] - beneath])

    def pixels(self) -> Floats:
        """(H, W, 2) of (u, v) of all pixels."""
        u, v = np.meshgrid(np.arange(float(self.size[0])), np.arange(float(self.size[1])))
        return np.stack([u, v], axis=-1)


def dots_cover(
    view: DrawnView, shape: tuple[int, int], pitch_mm: float, diameter_mm: float, blur_px: float
) -> Floats:
    """(H, W) share of each pixel that the dots of a board cover; the first at (0, 0).

    Parameters
    ----------
    view : DrawnView, of the board
    shape : tuple of int, (rows, columns)
    pitch_mm, diameter_mm : float, mm
    blur_px : float, px, Gaussian sigma
    """
    place = view.board_mm(view.pixels())
    most = np.array([shape[1] - 1, 0]), np.array([0, 1 - shape[0]])
    node = np.clip(np.rint(place / pitch_mm), np.minimum(*most), np.maximum(*most)) * pitch_mm
    away = place - node
    distance = np.linalg.norm(away, axis=-1)
    unit = away / np.maximum(distance, 1e-9)[..., None]
    by_v, by_u = np.gradient(place, axis=(0, 1))
    slope = np.hypot((unit * by_u).sum(axis=-1), (unit * by_v).sum(axis=-1))
    return _covered((diameter_mm / 2 - distance) / slope, blur_px)


def chessboard_grey(
    view: DrawnView,
    inner: tuple[int, int],
    square_mm: float,
    slivers: tuple[float, float, float, float],
    blur_px: float,
) -> Floats:
    """(H, W) grey values, 0 black to 1 white, of a chessboard on white; first inner corner at 0.

    Parameters
    ----------
    view : DrawnView, of the board
    inner : tuple of int, (rows, columns) of corners between whole squares
    square_mm : float, mm
    slivers : tuple of float, what shows of further squares, as parts of one: left, right, top,
        bottom
    blur_px : float, px, Gaussian sigma
    """
    place = view.board_mm(view.pixels()) / square_mm * [1.0, -1.0]  # right and down
    by_v, by_u = np.gradient(place, axis=(0, 1))
    slope = np.hypot(by_u, by_v)
    nearest = np.rint(place)
    step = 2 * _covered((place - nearest) / slope, blur_px) - 1
    waves = step * (-1.0) ** nearest
    left, right, top, bottom = slivers
    low = np.array([-1 - left, -1 - top])
    high = np.array([inner[1] + right, inner[0] + bottom])
    inside = _covered((place - low) / slope, blur_px) * _covered((high - place) / slope, blur_px)
    dark = (1 + waves.prod(axis=-1)) / 2
    return 1 - dark * inside.prod(axis=-1)


def photographed(
    grey: Floats, noise_dn: float, rng: np.random.Generator, grain_px: float = 0.0
) -> Bytes:
    """(H, W) picture of grey values 0 to 1, with noise.

    Parameters
    ----------
    grey : (H, W) array
    noise_dn : float, DN, standard deviation
    rng : Generator, of NumPy
    grain_px : float, px, by which the noise is smoothed, as denoising and coding leave it; its
        standard deviation stays
    """
    noise = rng.standard_normal(grey.shape)
    if grain_px > 0:
        noise = gaussian_filter(noise, grain_px)
        noise /= noise.std()
    return np.clip(np.rint(10 + 220 * grey + noise_dn * noise), 0, 255).astype(np.uint8)


def _covered(inside_px: Floats, blur_px: float) -> Floats:
    """How much of a pixel lies within an edge so far outside it, (...) from 0 to 1."""
    return (1 + erf(inside_px / (np.sqrt(2) * blur_px))) / 2
