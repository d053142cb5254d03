"""A coat of sand on the sandwave block."""

import numpy as np
import trimesh

from lscan.config.targets import Sandwave
from lscan.records import Floats
from sim.meshes.parts import grid_faces, plain_mesh
from sim.meshes.workpieces import sandwave_body
from sim.scene.matter import Sand

# Facets a grain: fewer would flatten the caps.
FACETS_PER_GRAIN = 3


def sanded_sandwave_mesh(piece: Sandwave, sand: Sand) -> trimesh.Trimesh:
    """The block's whole upper side under a coat of grains, and its body, workpiece frame.

    The grains lie on a jittered square pack; each is a sphere sunk to its middle, so the
    coat is the upper envelope of their caps.
    """
    step = sand.grain_mm / FACETS_PER_GRAIN
    low, high = -piece.rim_mm, piece.side_mm + piece.rim_mm
    count = int(np.ceil((high - low) / step)) + 1
    axis = np.linspace(low, high, count)
    x, y = np.meshgrid(axis, axis)
    z = _bare_height(piece, x, y) + _coat_height(sand, x - low, y - low)
    top = plain_mesh(np.column_stack([x.ravel(), y.ravel(), z.ravel()]), grid_faces(count, count))
    return trimesh.util.concatenate([top, sandwave_body(piece)])


def _bare_height(piece: Sandwave, x: Floats, y: Floats) -> Floats:
    """Height of the uncoated block at (x, y): wave, rim or wedge."""
    inside = (x >= 0) & (x <= piece.side_mm) & (y >= 0) & (y <= piece.side_mm)
    z = np.where(inside, piece.height_mm(x, y), 0.0)
    wedge, middle = piece.wedge, piece.side_mm / 2
    share = 1 - np.abs(y - middle) / (wedge.base_mm / 2)
    from_side = np.minimum(x + piece.rim_mm, piece.side_mm + piece.rim_mm - x)
    return np.where(from_side <= wedge.reach_mm * share, wedge.height_mm, z)


def _coat_height(sand: Sand, x: Floats, y: Floats) -> Floats:
    """Height of the grains' envelope at (x, y), both from 0 upwards."""
    generator = np.random.default_rng(sand.seed)
    cells = int(np.ceil(max(x.max(), y.max()) / sand.grain_mm)) + 3
    jitter = generator.uniform(-0.25, 0.25, (2, cells, cells))
    radius = sand.grain_mm / 2 * generator.uniform(1 - sand.spread, 1 + sand.spread, (cells, cells))
    column, row = (x / sand.grain_mm).astype(int) + 1, (y / sand.grain_mm).astype(int) + 1
    height = np.zeros_like(x)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            i, j = row + down, column + right
            centre_x = (j - 0.5 + jitter[0, i, j]) * sand.grain_mm
            centre_y = (i - 0.5 + jitter[1, i, j]) * sand.grain_mm
            cap = radius[i, j] ** 2 - (x - centre_x) ** 2 - (y - centre_y) ** 2
            height = np.maximum(height, np.sqrt(np.maximum(cap, 0.0)))
    return height
