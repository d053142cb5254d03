"""An alignment, and a surface taken to the workpiece frame by it, errors and all."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lscan.errors import InputError
from lscan.records import Floats, Ints, Surface
from lscan.surface.align.datum import displacement
from lscan.surface.align.edges import EdgeLine
from lscan.surface.align.levelling import shear


@dataclass(frozen=True)
class Alignment:
    """How raw points become workpiece points: ``rotation @ shear(yaw) @ raw + translation``.

    yaw_rad, yaw_sigma_rad: angle of the sheet against the track, its standard uncertainty.
    rotation: (3, 3) of the four-step alignment without the shear.  translation_mm: (3,).
    normal: (3,) unit normal of the base plane in the head's axes.
    base_mm: height of the base plane in the workpiece frame.
    flatness_mm: rms distance of the wedges' top points from the base plane.
    left_corner_mm, right_corner_mm: (2,) W_L and W_R in the workpiece plan.
    edges: the lines found, in the workpiece plan, by name: "left wedge, near edge" and so on,
        "left side" and, where it is in the scan, "right side".
    top_points: number of points the base plane was fitted to.
    iterations: number of rounds of shear, levelling and rotation until they settled.
    pivot_mm: (3,) the corners' middle, about which the parameters of ``modes`` turn.
    modes: (7, M + 7) how the alignment errs (datum.py): with each of the surface's M modes, and
        with seven independent errors of its own.
    sheared: False where the scan was made about a shaft and so has no yaw.
    """

    yaw_rad: float
    yaw_sigma_rad: float
    rotation: Floats
    translation_mm: Floats
    normal: Floats
    base_mm: float
    flatness_mm: float
    left_corner_mm: Floats
    right_corner_mm: Floats
    edges: dict[str, EdgeLine]
    top_points: int
    iterations: int
    pivot_mm: Floats
    modes: Floats
    sheared: bool = True

    def to_workpiece(self, raw_mm: Floats) -> Floats:
        """(..., 3) workpiece points, mm, of raw head-frame points (..., 3), mm."""
        return raw_mm @ (self.rotation @ shear(self.yaw_rad)).T + self.translation_mm

    def to_raw(self, workpiece_mm: Floats) -> Floats:
        """(..., 3) raw head-frame points, mm, of workpiece points (..., 3), mm."""
        matrix = np.linalg.inv(self.rotation @ shear(self.yaw_rad))
        return (workpiece_mm - self.translation_mm) @ matrix.T


def apply(alignment: Alignment, surface: Surface) -> Surface:
    """The surface in the workpiece frame, mm, its uncertainties turned with it.

    modes_mm are the surface's own, less what the alignment takes out of them (it is found from
    the same points), and seven more: the alignment's own errors.  They displace along all three
    axes, so what an error of x or y does to a height is the slope's to say; sigma_z_mm is that of
    z alone.  Where the surface has no modes only the alignment's own are known.

    Raises InputError for a surface that is not in the head frame.
    """
    if surface.frame != "head":
        raise InputError(
            "is aligned already", where="surface", value=surface.frame, allowed="the head frame"
        )
    turn, xyz = alignment.rotation, alignment.to_workpiece(surface.xyz_mm)
    own_x, own_z = own_variance(surface)
    answered = displacement(xyz, alignment.pivot_mm, turn, alignment.yaw_rad) @ alignment.modes
    modes = answered.astype(np.float32)
    if surface.modes_mm is not None:
        matrix = (turn @ shear(alignment.yaw_rad)).astype(np.float32)
        modes[..., : surface.modes_mm.shape[-1]] += matrix @ surface.modes_mm
    total = np.square(modes, dtype=np.float64).sum(axis=-1)
    own = np.stack([own_x, _own_y(surface), own_z], axis=-1) @ (turn**2).T
    sigma = np.sqrt(own + total)
    return replace(
        surface,
        xyz_mm=xyz,
        sigma_x_mm=sigma[..., 0],
        sigma_y_mm=None if surface.sigma_y_mm is None else sigma[..., 1],
        sigma_z_mm=sigma[..., 2],
        frame="workpiece",
        modes_mm=modes,
    )


def own_variance(surface: Surface) -> tuple[Floats, Floats]:
    """(F, N) variances of x and of z, mm², without what the modes make common to all points."""
    variance_x, variance_z = surface.sigma_x_mm**2, surface.sigma_z_mm**2
    if surface.modes_mm is None:
        return variance_x, variance_z
    common = np.square(surface.modes_mm, dtype=np.float64).sum(axis=-1)
    return (
        np.maximum(variance_x - common[..., 0], 0.0),
        np.maximum(variance_z - common[..., 2], 0.0),
    )


def _own_y(surface: Surface) -> Floats:
    """(F, N) variance of y, mm², without what the modes make common; 0 where y is the track's."""
    if surface.sigma_y_mm is None:
        return np.zeros_like(surface.sigma_z_mm)
    if surface.modes_mm is None:
        return surface.sigma_y_mm**2
    common = np.square(surface.modes_mm[..., 1, :], dtype=np.float64).sum(axis=-1)
    return np.maximum(surface.sigma_y_mm**2 - common, 0.0)


def turned_modes(surface: Surface, matrix: Floats, index: Ints) -> NDArray[np.float32]:
    """(P, 3, M) modes of the surface's points ``index`` along axes turned by ``matrix`` (3, 3)."""
    if surface.modes_mm is None:
        return np.zeros((len(index), 3, 0), dtype=np.float32)
    rows, columns = np.unravel_index(index, surface.status.shape)
    return matrix.astype(np.float32) @ surface.modes_mm[rows, columns]
