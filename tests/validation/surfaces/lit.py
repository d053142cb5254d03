"""Pictures of laser lines on a lit, textured target, drawn from closed forms.

The lamps light the target white and black, and so does the laser: both lights are what they are on
white times the reflectance of the place.  Drawn with nine places in a pixel, blurred by the lens,
then with shot noise, reading noise and the end of the range.  The line's true centre is that of the
laser's light, wherever the target reflects it.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from lscan.records import Bytes, Floats

FINE = 3  # places in a pixel, each way
READ_DN = 1.5
DN_PER_ELECTRON = 255 / 15_000


@dataclass(frozen=True)
class LitTarget:
    """A chessboard under lamps and laser.

    Attributes
    ----------
    square_px : float, px, side of a square
    turn_deg : float, degrees, between the squares' sides and the picture's
    dark : float, reflectance of the black squares over that of the white ones
    lamp_dn : tuple of float, DN, red, green and blue of a white square under the lamps
    laser_dn : tuple of float, DN, red, green and blue of the line's crest on a white square
    line_px : float, px, standard deviation of the laser's light across the line
    lens_px : float, px, standard deviation of the lens's blur
    """

    square_px: float = 36.0
    turn_deg: float = 15.0
    dark: float = 0.25
    lamp_dn: tuple[float, float, float] = (130.0, 125.0, 110.0)
    laser_dn: tuple[float, float, float] = (300.0, 25.0, 15.0)
    line_px: float = 1.3
    lens_px: float = 0.7


def lit_mean(target: LitTarget, centres_px: Floats, shares: Floats, height: int) -> Floats:
    """(H, W, 3) expected grey values, DN, before noise and the end of the range.

    Parameters
    ----------
    target : LitTarget
    centres_px : (L, W) array, px, row of each laser's line in each column
    shares : (L,) array, of ``laser_dn``, of each line
    height : int, px, H
    """
    width = centres_px.shape[1]
    u, v = ((np.arange(FINE * n) + 0.5) / FINE - 0.5 for n in (width, height))
    reflectance = _chessboard(target, u, v)
    columns = np.arange(width, dtype=float)
    lines = np.zeros_like(reflectance)
    for centre, share in zip(centres_px, shares, strict=True):
        distance = v[:, None] - np.interp(u, columns, centre)
        lines += share * np.exp(-0.5 * (distance / target.line_px) ** 2)
    lit = np.array(target.lamp_dn) + lines[..., None] * np.array(target.laser_dn)
    light = (reflectance[..., None] * lit).astype(np.float32)
    blurred = cv2.GaussianBlur(light, (0, 0), sigmaX=FINE * target.lens_px)
    mean: Floats = blurred.reshape(height, FINE, width, FINE, 3).mean(axis=(1, 3), dtype=float)
    return mean


def lit_picture(mean_dn: Floats, generator: np.random.Generator, clips_dn: int = 255) -> Bytes:
    """(H, W, 3) one picture with shot noise, reading noise and the end of the range.

    Parameters
    ----------
    mean_dn : (H, W, 3) array, DN, as lit_mean gives it
    generator : numpy.random.Generator, of the noise
    clips_dn : int, DN, at which the camera's range ends
    """
    electrons = generator.poisson(mean_dn / DN_PER_ELECTRON)
    read = DN_PER_ELECTRON * electrons + READ_DN * generator.standard_normal(mean_dn.shape)
    return np.clip(np.rint(read), 0, clips_dn).astype(np.uint8)


def _chessboard(target: LitTarget, u: Floats, v: Floats) -> Floats:
    """Reflectance at rows v and columns u, 1 on white squares."""
    turn = np.radians(target.turn_deg)
    along = (np.cos(turn) * u + np.sin(turn) * v[:, None]) / target.square_px
    across = (np.cos(turn) * v[:, None] - np.sin(turn) * u) / target.square_px
    white = (np.floor(along) + np.floor(across)) % 2 == 0
    return np.where(white, 1.0, target.dark)
