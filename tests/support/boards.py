"""Pictures of calibration boards with known truth, for the tests of the control points.

The lens is defined from the picture to the ray (a polynomial in the picture's radius), so a
pixel's place on the board is a closed form: marks are drawn by asking, for 4 by 4 places in
each half pixel on the rim of a mark, whether they lie on it; of the others their middle decides.
Only the truth needs an iteration.  None of the instrument's code is used.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from lscan.board import read_board
from lscan.config.board import Board
from lscan.errors import LscanError
from lscan.records import BoardReading, Bytes, Floats

PARTS = 4  # per fine pixel and direction: the edge of a dot is placed to about 0.01 px
FINE = 2  # fine pixels in a pixel's side: the lens blurs before the sensor samples


@dataclass(frozen=True)
class View:
    """How a camera sees the board.

    distance_mm: from the camera to the place ``target_mm`` of the board, which is seen in the
    middle of the picture.  tilt_rad: of the optical axis below the board's normal.  roll_rad:
    about the optical axis.  focal_px, barrel: a pixel at the radius r (in focal lengths) from
    the middle lies on the ray of radius r (1 + barrel r^2).
    """

    distance_mm: float = 900.0
    target_mm: tuple[float, float] = (225.0, -225.0)
    tilt_rad: float = np.deg2rad(30.0)
    roll_rad: float = 0.0
    focal_px: float = 850.0
    barrel: float = 0.15
    size: tuple[int, int] = (640, 480)
    shift_px: tuple[float, float] = (0.0, 0.0)

    @property
    def middle(self) -> Floats:
        """(2,) px of the optical axis."""
        return (np.array(self.size) - 1) / 2 + self.shift_px

    def board_mm(self, image_px: Floats) -> Floats:
        """(..., 2) of (x, z) on the board seen at the pixels (..., 2)."""
        at = (image_px - self.middle) / self.focal_px
        radius2 = (at**2).sum(axis=-1, keepdims=True)
        right, down = np.moveaxis(at * (1 + self.barrel * radius2), -1, 0)
        cos_r, sin_r = np.cos(self.roll_rad), np.sin(self.roll_rad)
        right, down = cos_r * right + sin_r * down, cos_r * down - sin_r * right
        cos_t, sin_t = np.cos(self.tilt_rad), np.sin(self.tilt_rad)
        # World: x right, y away from the camera, z up; the board is y = 0.
        away, up = cos_t - sin_t * down, -sin_t - cos_t * down
        camera_y, camera_z = -self.distance_mm * cos_t, self.distance_mm * sin_t
        reach = -camera_y / away
        return np.stack(
            [self.target_mm[0] + reach * right, self.target_mm[1] + camera_z + reach * up],
            axis=-1,
        )

    def image_px(self, board_mm: Floats) -> Floats:
        """(N, 2) px of places (N, 2) mm on the board, by Newton's method to 1e-9 px."""
        at = np.tile(self.middle, (len(board_mm), 1))
        for _ in range(30):
            jacobian = self.jacobian(at)
            miss = self.board_mm(at) - board_mm
            step = np.linalg.solve(jacobian, miss[..., None])[..., 0]
            at = at - np.clip(step, -100, 100)
            if np.abs(step).max(initial=0.0) < 1e-7:  # the next step is the square of that
                break
        return at

    def jacobian(self, image_px: Floats) -> Floats:
        """(N, 2, 2) derivative of the board's place, mm per px."""
        sides = [np.array([0.5, 0.0]), np.array([0.0, 0.5])]
        differences = [self.board_mm(image_px + s) - self.board_mm(image_px - s) for s in sides]
        return np.stack(differences, axis=-1)


@dataclass(frozen=True)
class Light:
    """Grey values: of the plate and the marks, the light's slope across, blur and noise.

    ratio: light at the brightest edge over that at the darkest, falling along ``toward_rad``.
    noise: standard deviation, of full scale.  shot: variance in DN² for each DN of light.
    """

    plate: float = 0.85
    mark: float = 0.15
    ratio: float = 1.0
    toward_rad: float = 0.0
    blur_px: float = 0.6
    noise: float = 0.02
    shot: float = 0.0


def render(board: Board, view: View, light: Light = Light(), seed: int = 0) -> Bytes:
    """(H, W) 8-bit picture of the board."""
    return expose(expected_dn(board, view, light), light, seed)


def expose(expected: Floats, light: Light, seed: int) -> Bytes:
    """(H, W) 8-bit picture: the grey values expected with noise, normal, added and rounded."""
    sigma = np.sqrt((255 * light.noise) ** 2 + light.shot * expected)
    noisy = expected + sigma * np.random.default_rng(seed).standard_normal(expected.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def expected_dn(board: Board, view: View, light: Light = Light(), parts: int = PARTS) -> Floats:
    """(H, W) grey values 0 to 255 of the board's picture without noise and rounding."""
    width, height = view.size
    cover = cv2.GaussianBlur(_cover(board, view, parts), (0, 0), FINE * light.blur_px)
    cover = cover.reshape(height, FINE, width, FINE).mean(axis=(1, 3))
    return 255 * _shade(view.size, light) * (light.plate + (light.mark - light.plate) * cover)


@lru_cache(maxsize=4)  # the same marks are seen through several lenses, each in turn
def _cover(board: Board, view: View, parts: int) -> Floats:
    """(FINE * H, FINE * W) share of each fine pixel that marks cover, not to be written to."""
    width, height = view.size
    finer = replace(
        view,
        size=(FINE * width, FINE * height),
        focal_px=FINE * view.focal_px,
        shift_px=(FINE * view.shift_px[0], FINE * view.shift_px[1]),
    )
    cover = np.zeros(finer.size[::-1])
    for places, diameter in _round_marks(board):
        _add_discs(cover, finer, places, diameter, parts)
    for ring in board.ring:
        middle = np.array([ring.x_mm, ring.z_mm])
        _add_ring(cover, finer, middle, ring.diameter_mm, ring.width_mm, parts)
    return np.minimum(cover, 1)


def _round_marks(board: Board) -> list[tuple[Floats, float]]:
    marks = [(board.grid.points_mm(), board.grid.dot_diameter_mm)]
    marks += [(ruler.points_mm(), ruler.mark_diameter_mm) for ruler in board.ruler]
    marks += [(np.array([[dot.x_mm, dot.z_mm]]), dot.diameter_mm) for dot in board.dot]
    return marks


def _shade(size: tuple[int, int], light: Light) -> Floats:
    u, v = np.meshgrid(np.linspace(-1, 1, size[0]), np.linspace(-1, 1, size[1]))
    along = u * np.cos(light.toward_rad) + v * np.sin(light.toward_rad)
    along /= np.abs(along).max()
    return light.ratio ** (-(along + 1) / 2)


_READINGS: dict[tuple[bytes, str, str], BoardReading | LscanError] = {}


def read_once(image: Bytes, board: Board, **options: Any) -> BoardReading:
    """The reading of ``read_board``, which is asked once for each picture, board and options."""
    key = image.tobytes(), board.model_dump_json(), repr(options)
    if key not in _READINGS:
        try:
            _READINGS[key] = read_board(image, board, **options)
        except LscanError as error:
            _READINGS[key] = error
    found = _READINGS[key]
    if isinstance(found, LscanError):
        raise found
    return found


Beyond = Callable[[Floats], Floats]
"""How far beyond a mark's rim places lie that are so many mm from its middle; negative on it."""


def _add_marks(
    cover: Floats, view: View, middle_mm: Floats, reach: int, parts: int, beyond: Beyond
) -> None:
    """Add the share that marks about ``middle_mm`` (N, 2) cover of each pixel within reach."""
    span = np.arange(-reach, reach + 1)
    offsets = np.stack(np.meshgrid(span, span), axis=-1).reshape(-1, 2)
    pixels = np.rint(view.image_px(middle_mm)).astype(int)[:, None] + offsets
    mark, which = np.nonzero(((pixels >= 0) & (pixels < cover.shape[::-1])).all(axis=2))
    pixels, middle_mm = pixels[mark, which], middle_mm[mark]
    places = pixels.astype(float)
    distance = beyond(np.linalg.norm(view.board_mm(places) - middle_mm, axis=-1))
    share = (distance <= 0).astype(float)
    # No place in a pixel is farther from its middle than 0.71 px; 1 px leaves room for bends.
    rim = np.flatnonzero(np.abs(distance) < np.linalg.norm(view.jacobian(places), axis=(1, 2)))
    inner = (np.arange(parts) + 0.5) / parts - 0.5
    finer = places[rim, None] + np.stack(np.meshgrid(inner, inner), axis=-1).reshape(-1, 2)
    away_mm = np.linalg.norm(view.board_mm(finer) - middle_mm[rim, None], axis=-1)
    share[rim] = (beyond(away_mm) <= 0).mean(axis=1)
    np.add.at(cover, (pixels[:, 1], pixels[:, 0]), share)


def _add_discs(
    cover: Floats, view: View, places_mm: Floats, diameter_mm: float, parts: int
) -> None:
    middle = view.image_px(places_mm)
    per_px = np.abs(np.linalg.det(view.jacobian(middle))).min() ** 0.5
    reach = int(np.ceil(0.75 * diameter_mm / per_px)) + 1
    near = ((middle > -reach) & (middle < np.array(view.size) + reach)).all(axis=1)
    _add_marks(cover, view, places_mm[near], reach, parts, lambda mm: mm - diameter_mm / 2)


def _add_ring(
    cover: Floats, view: View, middle_mm: Floats, diameter_mm: float, width_mm: float, parts: int
) -> None:
    middle = view.image_px(middle_mm[None])
    per_px = np.abs(np.linalg.det(view.jacobian(middle))).min() ** 0.5
    reach = int(np.ceil(0.75 * diameter_mm / per_px)) + 2

    def beyond(mm: Floats) -> Floats:
        return np.abs(mm - diameter_mm / 2) - width_mm / 2

    _add_marks(cover, view, middle_mm[None], reach, parts, beyond)
