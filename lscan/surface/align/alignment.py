"""An alignment, and a surface taken to the workpiece frame by it, errors and all."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lscan.records import Floats, Ints, Surface
from lscan.surface.align.datum import displacement
from lscan.surface.align.levelling import shear
from lscan.surface.stack import require_head_frame


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
    modes : (7, M + 7) array, mm and rad, how the alignment errs (datum.py): with each of the
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
    alignment : Alignment, found in this surface, or in another (keptalignment.py)
    surface : Surface, frame of the head

    Raises
    ------
    InputError
        For a surface that is not in the head frame.
    """
    require_head_frame(surface)
    turn, xyz = alignment.rotation, alignment.to_workpiece(surface.xyz_mm)
    answered = displacement(xyz, alignment.pivot_mm, turn, alignment.yaw_rad) @ alignment.modes
    modes = answered.astype(np.float32)
    if surface.modes_mm is not None:
        matrix = (turn @ shear(alignment.yaw_rad)).astype(np.float32)
        modes[..., : surface.modes_mm.shape[-1]] += matrix @ surface.modes_mm
    total = np.square(modes, dtype=np.float64).sum(axis=-1)
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
    return np.maximum(total - np.square(surface.modes_mm, dtype=np.float64).sum(axis=-1), 0.0)


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
