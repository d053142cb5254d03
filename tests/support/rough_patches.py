"""Patches of known roughness."""

import numpy as np

from lscan.records import Floats, Mask
from lscan.roughness import Patch, PowerLaw
from lscan.roughness.patch import wavenumbers

PADDING = 4


def patch(z_cm: Floats, seen: Mask | None, cell_cm: float, noise_cm2: float = 0.0) -> Patch:
    """A patch of heights where they are seen."""
    seen = np.ones(z_cm.shape, dtype=bool) if seen is None else seen
    return Patch(np.where(seen, z_cm, 0.0), seen, cell_cm, noise_cm2)


def whole(z_cm: Floats, cell_cm: float) -> Patch:
    """A patch without holes."""
    return patch(z_cm, None, cell_cm)


def wave(
    shape: tuple[int, int], cell_cm: float, waves: float, heading_deg: float, amplitude_cm: float
) -> Floats:
    """Heights of a plane wave: so many in the patch's first side, its crests across the heading."""
    y, x = ((np.arange(count) + 0.5) * cell_cm for count in shape)
    k = 2 * np.pi * waves / (shape[0] * cell_cm)
    way = np.radians(heading_deg)
    return amplitude_cm * np.cos(k * (np.sin(way) * y[:, None] + np.cos(way) * x[None, :]))


def drawn(
    law: PowerLaw, shape: tuple[int, int], cell_cm: float, seed: int
) -> tuple[Floats, Floats]:
    """Two independent fields of a law, each cut from one four times as long and as wide."""
    y, x = wavenumbers((PADDING * shape[0], PADDING * shape[1]), cell_cm)
    area = (2 * np.pi / cell_cm) ** 2 / (y.size * x.size)
    size = np.sqrt(law.density(y, x) * area)
    both = np.random.default_rng(seed).standard_normal((2, *size.shape))
    field = np.fft.fft2(size * (both[0] + 1j * both[1]))[: shape[0], : shape[1]]
    return field.real, field.imag


def holes(shape: tuple[int, int], share: float, seed: int) -> Mask:
    """Where cells are seen: a third of the missing ones single, the rest in squares of 2 to 6."""
    rng = np.random.default_rng(seed)
    seen = rng.random(shape) > share / 3
    while seen.mean() > 1 - share:
        side = rng.integers(2, 7)
        row, column = (rng.integers(0, count) for count in shape)
        seen[row : row + side, column : column + side] = False
    return seen
