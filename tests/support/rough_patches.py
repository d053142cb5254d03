"""Patches of known roughness."""

import numpy as np

from lscan.records import Floats, Mask
from lscan.roughness import Patch, PowerLaw
from sim.meshes.parts import random_fields
from tests.validation.roughness import fields

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
    law: PowerLaw, shape: tuple[int, int], cell_cm: float, seed: int, finer: int = 1
) -> tuple[Floats, Floats]:
    """Two independent fields of a law, each cut from one four times as long and as wide.

    finer: how many times finer the field is that they are sampled from: its law goes on so far
    beyond the cells' own wavenumbers, and half as long as otherwise, for such fields are large.
    """
    generator, steps = np.random.default_rng(seed), (cell_cm / finer, cell_cm / finer)
    fine, padding = (finer * shape[0], finer * shape[1]), PADDING if finer == 1 else 2
    one, other = random_fields(law.density, fine, steps, padding, generator)
    return one[::finer, ::finer], other[::finer, ::finer]


def holes(shape: tuple[int, int], share: float, seed: int) -> Mask:
    """Where cells are seen; as the figures of ``make validate NAME=roughness`` have it."""
    return fields.holes(shape, share, np.random.default_rng(seed))
