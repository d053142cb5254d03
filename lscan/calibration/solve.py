"""A calibration: a plane map together with the board reading it was solved from."""

from dataclasses import dataclass, field, replace

import numpy as np

from lscan.calibration.api import NOTHING_KNOWN, PlaneMap, find_solver
from lscan.calibration.outliers import ScreenedReading, screened
from lscan.calibration.region import spacing_px
from lscan.camera.resection import pixel_derivatives
from lscan.config.plugins import others_versions
from lscan.config.rig import OpticsSection
from lscan.records import BoardReading, Floats
from lscan.version import __version__

MANY_SIGMAS = 10.0  # of real pictures, whose noise is stated too small by up to that; ours
GROSS = 0.01  # of the spacing of the marks: a printed board is off by less (board.evidence)


@dataclass(frozen=True)
class Calibration:
    """A solved plane map and what it rests on.

    Attributes
    ----------
    name : str, full name of the map, as it was asked for
    plane_map : PlaneMap, from the pixels of that camera to the laser sheet
    reading : BoardReading, the marks it was solved from, without the outliers
    residuals_mm : (N, 2) array, mm, map of each control point less its nominal place; NaN where the
        point was not found or the map gives it no value
    residuals_px : (N, 2) array, px, the same as a shift in the picture
    optics : OpticsSection, what was known of the camera beforehand
    software : str, name and version of the program that solved it
    outliers_mm : (K, 2) array, mm, (x, z) of marks that were found and left out, as they do not lie
        where all others predict them (outliers.py)

    Examples
    --------
    >>> import lscan
    >>> calibration = lscan.load_calibration("calibration.json")
    >>> calibration.name, calibration.rms_mm < 0.2
    ('graticule-2', True)
    """

    name: str
    plane_map: PlaneMap
    reading: BoardReading
    residuals_mm: Floats
    residuals_px: Floats
    optics: OpticsSection
    software: str
    outliers_mm: Floats = field(default_factory=lambda: np.empty((0, 2)))

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) of the picture, px."""
        return self.reading.image_size

    @property
    def rms_mm(self) -> float:
        """Root mean square distance of the control points from their nominal places, mm."""
        return _rms(self.residuals_mm)

    @property
    def max_mm(self) -> float:
        """Greatest distance of a control point from its nominal place, mm."""
        return float(np.nanmax(np.hypot(*self.residuals_mm.T)))

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals' lengths in the picture, px."""
        return _rms(self.residuals_px)

    @property
    def misfit(self) -> str:
        """What a user should know of residuals that noise does not explain; "" where it does."""
        sigma_px = np.sqrt(2 * np.nanmean(self.reading.grid.sigma_px**2))
        ratio = self.rms_px / max(float(sigma_px), 1e-9)
        if ratio < MANY_SIGMAS or self.rms_px < GROSS * spacing_px(self.reading):
            return ""
        return (
            f"residuals of {self.rms_px:.2f} px rms are {ratio:.0f} times the uncertainty of the "
            "marks: the map is too stiff for this lens, or the board file, [optics], the board's "
            "flatness or the pixels' squareness is not as stated"
        )


def calibrate(
    reading: BoardReading, map_name: str, optics: OpticsSection | None = None
) -> Calibration:
    """The plane map of a full name solved from a board reading.

    Marks that do not lie where all others predict them are left out (outliers.py).

    Parameters
    ----------
    reading : BoardReading, px and mm, the marks of one picture
    map_name : str, full name of the map, or "auto"
    optics : OpticsSection, optional, what is known of the camera beforehand; by default what an
        empty section [optics] says

    Raises
    ------
    InputError
        For an unknown name.
    BoardNotFound
        For too few marks.

    Examples
    --------
    >>> import lscan
    >>> reading = lscan.load_calibration("calibration.json").reading
    >>> lscan.calibrate(reading, "polynomial-5").plane_map.name
    'polynomial-5'
    """
    known, sound = optics or NOTHING_KNOWN, screened(reading)
    solved = find_solver(map_name).solve(sound.reading, known)
    return calibration_by(map_name, solved, sound, known)


def calibration_by(
    map_name: str, plane_map: PlaneMap, sound: ScreenedReading, optics: OpticsSection
) -> Calibration:
    """The calibration by a map that was solved from a reading.

    Parameters
    ----------
    map_name : str, full name of the map, as it was asked for
    plane_map : PlaneMap, solved from the reading of ``sound``
    sound : ScreenedReading, px and mm
    optics : OpticsSection, what was known of the camera
    """
    mm, px = residuals(plane_map, sound.reading)
    versions = {"lscan": __version__, **others_versions("lscan.planemaps", map_name)}
    software = ", ".join(f"{name} {version}" for name, version in versions.items())
    return Calibration(
        map_name, plane_map, sound.reading, mm, px, optics, software, sound.outliers_mm
    )


def resolve(calibration: Calibration) -> Calibration:
    """The same calibration solved again from the marks and the optics it holds.

    Parameters
    ----------
    calibration : Calibration, its reading, name and optics count

    Raises
    ------
    InputError, BoardNotFound
        As ``calibrate``.
    """
    again = calibrate(calibration.reading, calibration.name, calibration.optics)
    return replace(again, outliers_mm=np.vstack([calibration.outliers_mm, again.outliers_mm]))


def residuals(plane_map: PlaneMap, reading: BoardReading) -> tuple[Floats, Floats]:
    """Residuals of the control points, (N, 2) in mm and (N, 2) in px, NaN where there is none.

    In px: the shift of the mark that would make up for the residual, by the map's Jacobian.

    Parameters
    ----------
    plane_map : PlaneMap, from the pixels of that camera to the laser sheet
    reading : BoardReading, px and mm, of N control points
    """
    image = reading.grid.image_px
    mm = plane_map.to_plane(image).xz_mm - reading.grid.board_mm
    return mm, in_picture(plane_map, image, mm)


def in_picture(plane_map: PlaneMap, image_px: Floats, shift_mm: Floats) -> Floats:
    """(N, 2) px: how far pixels must move for the map to move them so far, by the map's Jacobian.

    NaN where the map has none.

    Parameters
    ----------
    plane_map : PlaneMap, from pixels to the laser sheet
    image_px : (N, 2) array, px, of (u, v)
    shift_mm : (N, 2) array, mm, of (x, z) in the plane frame
    """
    jacobian = pixel_derivatives(lambda pixels: plane_map.to_plane(pixels).xz_mm, image_px)
    finite = np.isfinite(jacobian).all(axis=(1, 2)) & np.isfinite(shift_mm).all(axis=1)
    known = np.flatnonzero(finite)
    known = known[np.linalg.det(jacobian[known]) != 0]
    px = np.full_like(shift_mm, np.nan)
    px[known] = np.linalg.solve(jacobian[known], shift_mm[known, :, None])[:, :, 0]
    return px


def _rms(pairs: Floats) -> float:
    return float(np.sqrt(np.nanmean((pairs**2).sum(axis=1))))
