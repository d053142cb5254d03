"""A measured slice of the sandwave against eq. (4) (Figs. 29 to 32)."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from lscan.config.targets import Sandwave
from lscan.errors import MeasurementError
from lscan.records import Floats, Mask, Surface, has_value
from lscan.surface import Slice

_SCALE_POINTS = 20_000  # of a surface: more make the scale no better known, their errors are alike
_BORDER_MM = 3.0  # of the waves, where the surface steps to the rim


@dataclass(frozen=True)
class SliceErrors:
    """Errors of a slice, measured minus eq. (4).

    Attributes
    ----------
    nominal_mm : (M,) array, mm, eq. (4) at each point of the slice, also beyond the border of the
        waves
    error_mm : (M,) array, mm, at each point of the slice; NaN where it was not compared
    points : int, number compared
    unseen : int, number without data, or known to be out of sight
    at_step : int, number left out beside the border of the waves: there the surface steps to the
        rim, and a height measured over a radius is neither the one nor the other
    """

    nominal_mm: Floats
    error_mm: Floats
    points: int
    unseen: int
    at_step: int

    @property
    def rmse_mm(self) -> float:
        """Root of the mean squared error, mm."""
        return float(np.sqrt(np.nanmean(self.error_mm**2)))

    @property
    def min_mm(self) -> float:
        """Most negative error, mm."""
        return float(np.nanmin(self.error_mm))

    @property
    def max_mm(self) -> float:
        """Most positive error, mm."""
        return float(np.nanmax(self.error_mm))

    def as_json(self) -> dict[str, float | int]:
        """Counts and errors under the keys results.json uses."""
        return {
            "points": self.points,
            "unseen": self.unseen,
            "rmse_mm": self.rmse_mm,
            "min_mm": self.min_mm,
            "max_mm": self.max_mm,
        }


def compare_slice(measured: Slice, piece: Sandwave, visible: Mask | None = None) -> SliceErrors:
    """The errors of a slice against eq. (4) of the sandwave.

    Points nearer to the border of the waves, or farther out, than the radius over which the
    slice's heights were taken are counted as ``at_step`` and not compared.

    Parameters
    ----------
    measured : Slice, of M points, mm, frame of the workpiece
    piece : Sandwave, the nominal shape
    visible : (M,) mask, optional, of the points known to be lit and seen; by default all

    Raises
    ------
    MeasurementError
        Where no point is left to compare.

    References
    ----------
    Eq. (4) and Figs. 29 to 32 of the paper.
    """
    x, y = measured.xy_mm.T
    inside = piece.inset_mm(x, y) >= measured.radius_mm
    seen = has_value(measured.status)
    if visible is not None:
        seen &= visible
    compared = inside & seen
    if not compared.any():
        raise MeasurementError(
            f"slice: none of its {len(x)} points has data on the waves to compare with eq. (4)"
        )
    nominal = piece.height_mm(x, y)
    return SliceErrors(
        nominal_mm=nominal,
        error_mm=np.where(compared, measured.z_mm - nominal, np.nan),
        points=int(compared.sum()),
        unseen=int((inside & ~seen).sum()),
        at_step=int((~inside).sum()),
    )


def scale_along_track(surface: Surface, piece: Sandwave) -> float:
    """How long the sandwave is along y beside its design: above 1 where the track moves too little.

    Eq. (4) is fitted to the heights with y stretched about the middle, and shifts along x, y and z
    beside it, by least squares that outliers hardly move (soft L1).  The waves' meander shows the
    scale: 8,000 heights that scatter by 0.5 mm give it to 1e-3.

    Parameters
    ----------
    surface : Surface, mm, frame of the workpiece
    piece : Sandwave, the nominal shape

    Raises
    ------
    MeasurementError
        Where fewer than 100 points lie on the waves.

    References
    ----------
    Eq. (4) of the paper.
    """
    x, y, z = np.moveaxis(surface.xyz_mm, -1, 0)
    valued = has_value(surface.status) & np.isfinite(x + y + z)
    at = np.flatnonzero(valued & (piece.inset_mm(x, y) > _BORDER_MM))
    if len(at) < 100:
        raise MeasurementError(f"{len(at)} points lie on the waves, 100 are needed for their scale")
    at = at[:: max(1, len(at) // _SCALE_POINTS)]
    x, y, z = x.ravel()[at], y.ravel()[at], z.ravel()[at]
    middle = piece.side_mm / 2

    def miss(fit: Floats) -> Floats:
        stretch, along_x, along_y, up = fit
        designed = middle + (y - middle) / stretch + along_y
        return z - piece.height_mm(x + along_x, designed) - up

    fit = least_squares(miss, [1.0, 0.0, 0.0, 0.0], loss="soft_l1", f_scale=0.5)
    return float(fit.x[0])
