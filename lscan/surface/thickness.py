"""Correcting for what the sheet's thickness does to a line on a sloping or curved target.

On smooth targets the first terms of a series say it exactly (concavity.py); on relief as fine as
the sheet is thick they do not, and the relief's spectrum does better (relief.py).  In each part of
a surface the correction with the smaller expected error is made, and what it cannot recover
enters the uncertainty.  A wall has a wide spectrum too: where most of a surface is smooth, what the
spectra of its other parts say is taken for walls, and the series is used.
"""

from dataclasses import replace

import numpy as np

from lscan.config.rig import SheetSection
from lscan.records import Floats, Surface
from lscan.surface.concavity import series_shifts
from lscan.surface.relief import ReliefBlock, relief_blocks
from lscan.surface.stack import require_head_frame


def correct_thickness(surface: Surface, sheet: SheetSection, yaw_rad: float = 0.0) -> Surface:
    """The surface with its heights moved to those of the sheet's middle plane.

    The target is taken for matt, of one reflectance within the sheet's thickness.  sigma_z_mm
    grows by the noise of the correction and by what it cannot recover of the relief.  Points
    without enough neighbours keep their height, and get the root mean square of all corrections as
    a further uncertainty.

    Parameters
    ----------
    surface : Surface, mm, frame of the head, as stacked, its heights found from whole-line
        centroids
    sheet : SheetSection, its thickness, twice the standard deviation of the irradiance; from where
        it is lit and seen.  Behind a flat port the rays in the water come from close to the pinhole
        too.
    yaw_rad : float, rad, angle of the sheet against the track, as ``align_sandwave`` finds it

    Raises
    ------
    InputError
        For a surface that is not in the head frame.

    References
    ----------
    docs/explanation/concavity.md; derived in concavity.py, sheetresponse.py and reliefspectrum.py.
    """
    require_head_frame(surface)
    shift, variance, recovered = _shifts(surface, sheet, yaw_rad)
    known = np.isfinite(shift)
    typical = float(np.mean(shift[known] ** 2)) if known.any() else 0.0
    xyz = surface.xyz_mm.copy()
    xyz[..., 2] -= np.where(known, shift, 0.0)
    total = np.sqrt(surface.sigma_z_mm**2 + np.where(known, variance, typical))
    done = f"sheet thickness of {sheet.thickness_mm:g} mm at a yaw of {np.degrees(yaw_rad):.3f} deg"
    if recovered is not None:
        done += f", relief down to waves of {recovered:.1f} mm"
    corrections = (*surface.corrections, done)
    return replace(surface, xyz_mm=xyz, sigma_z_mm=total, corrections=corrections)


def _shifts(
    surface: Surface, sheet: SheetSection, yaw_rad: float
) -> tuple[Floats, Floats, float | None]:
    """(F, N) displacements in mm and their variances; the finest waves recovered where relief is.

    NaN where neither correction is known.
    """
    series, sigma = series_shifts(surface, sheet, yaw_rad)
    total, shift, variance = (np.zeros(series.shape) for _ in range(3))
    recovered = []
    blocks = list(relief_blocks(surface, sheet, yaw_rad))
    usual = float(np.median([b.spectrum.series_variance for b in blocks])) if blocks else 0.0
    votes = [_is_fine(block) for block in blocks if block.own]
    fine = 2 * sum(votes) > len(votes)
    for block in blocks:
        at = block.rows, block.columns
        left = block.spectrum.series_variance
        found, doubt = series[at], sigma[at] ** 2 + (left if fine else min(left, usual))
        if fine and _is_fine(block):
            recovered.append(block.spectrum.resolved_mm)
            better = np.isfinite(block.shift_mm)
            found = np.where(better, block.shift_mm, found)
            doubt = np.where(better, block.variance_mm2, doubt)
        used = np.where(np.isfinite(found) & np.isfinite(doubt), block.weight, 0.0)
        total[at] += used
        shift[at] += used * np.where(used > 0, found, 0.0)
        variance[at] += used * np.where(used > 0, doubt, 0.0)
    blended = total > 0
    total = np.where(blended, total, 1.0)
    return (
        np.where(blended, shift / total, series),
        np.where(blended, variance / total, sigma**2),
        float(np.median(recovered)) if recovered else None,
    )


def _is_fine(block: ReliefBlock) -> bool:
    """Whether the spectrum corrects a block better than the series does."""
    return block.spectrum.correction_variance < block.spectrum.series_variance
