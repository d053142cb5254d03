"""Correcting for what the sheet's thickness does to a line on a sloping or curved target.

On smooth targets the first terms of a series say it exactly (sheetresponse.py); on relief as fine
as the sheet is thick they do not, and the relief's spectrum does better.  In each part of a surface
the correction with the smaller expected error is made, and what it cannot recover enters the
uncertainty.  A wall has a wide spectrum too: where most of a surface is smooth, what the spectra of
its other parts say is taken for walls, and the series is used.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.ndimage import distance_transform_edt, uniform_filter

from lscan.config.rig import SheetSection
from lscan.records import Floats, Ints, Mask, Surface, has_value
from lscan.surface.alignment import own_variances, shear
from lscan.surface.sheetresponse import (
    FEWEST,
    SEGMENT,
    ReliefSpectrum,
    Sight,
    responses,
    series_shifts,
    spectrum_of,
)
from lscan.surface.surface import require_head_frame

# What the sheet's thickness does to a line on relief as fine as itself.
#
# The surface is taken block by block.  A block is laid along the direction d in which the
# camera looks across the sheet (sheetresponse.py), its spectrum says which waves of the relief are
# in what was measured (sheetresponse.py), and a smooth estimate of the true relief is made, from
# which follows what the sheet's thickness does to it.  That is taken off the heights as measured;
# their own noise stays theirs.


BLOCK = SEGMENT  # rows and columns
HOP = BLOCK // 2
KERNEL_SIGMAS = 14.0  # half length of the filter, which falls off with the distance
FINE = 16  # times a segment, over which the filter is spread
ROUNDS = 3  # of what is not linear in the relief, each of which leaves some tenths of it
STEEPEST = 2.0  # rise of a target over y between rows: what is steeper is a wall
NOISY = 6.0  # standard deviations of the noise beside that
UNEVEN = (
    0.5  # of a step between rows, by which one may differ from the others: else a row is missing
)
NEAR_SIGMAS = 3.25  # 99.9 % of the light: nearer to a wall or a gap, light is missing or another's
SHORTEST = 9  # rows of a piece that an estimate is made of
MISFIT = 1.5  # times the variance expected of what the estimate leaves: more is no chance
AROUND = 5  # rows and columns over which that is judged
NO_BETTER_MM = 1e-3
"""Heights are weighed as if known to no better than this: exact ones have a spectrum too."""


@dataclass(frozen=True)
class _Lattice:
    """A surface's heights by row (frame) and column, and how they are lit and seen.

    height: (R, C) mm, NaN where there is no point.  own: (R, C) mm², variance of each one's own
    noise.  missing: (R - 1,) whether rows are missing between two.  x_mm: (C,) of the columns.
    row_mm, column_mm: from one to the next, negative where y or x falls.  step: (C,) columns from
    row to row along d.
    """

    height: Floats
    own: Floats
    missing: Mask
    x_mm: Floats
    row_mm: float
    column_mm: float
    step: Floats
    sheet: SheetSection

    @property
    def sigma_mm(self) -> float:
        """Standard deviation of the sheet's irradiance."""
        return self.sheet.thickness_mm / 2

    @property
    def pitch_mm(self) -> float:
        """Distance between rows."""
        return abs(self.row_mm)

    @property
    def reach(self) -> int:
        """Half length of the filter in rows, no more than its spectrum is known for."""
        return min(
            int(np.ceil(KERNEL_SIGMAS * self.sigma_mm / self.pitch_mm)), FINE * BLOCK // 2 - 1
        )

    def sight(self, height: Floats, columns: Ints) -> Sight:
        """How points at these heights (R, C) in mm, in these columns (C,), are lit and seen."""
        camera, apex = self.sheet.camera_mm, self.sheet.apex_mm
        x = self.x_mm[columns]
        to_apex = np.stack([np.broadcast_to(apex[0] - x, height.shape), apex[2] - height])
        tau = (height - camera[2]) / camera[1]
        return Sight(tau, (x - camera[0]) / -camera[1], to_apex)


def _lattice(surface: Surface, sheet: SheetSection, yaw_rad: float) -> _Lattice:
    valid = has_value(surface.status) & np.isfinite(surface.xyz_mm).all(axis=-1)
    raw = np.where(valid[..., None], surface.xyz_mm, np.nan)
    true = raw @ shear(yaw_rad).T
    row_mm, drift_mm = (_spacing(true[..., axis], 0) for axis in (1, 0))
    steps = np.diff(surface.position_mm)
    usual_mm = float(np.median(steps)) if len(steps) else 0.0
    column_mm, x = _spacing(true[..., 0], 1), _columns_mm(raw[..., 0])
    kappa = (x - sheet.camera_mm[0]) / -sheet.camera_mm[1]
    return _Lattice(
        height=raw[..., 2],
        own=own_variances(surface)[..., 2],
        missing=np.abs(steps - usual_mm) > UNEVEN * abs(usual_mm),
        x_mm=x,
        row_mm=row_mm,
        column_mm=column_mm,
        step=(kappa * row_mm - drift_mm) / (column_mm or 1.0),
        sheet=sheet,
    )


def _spacing(coordinate: Floats, axis: int) -> float:
    """Median step between neighbours along an axis, mm; 0 where there are none."""
    steps = np.diff(coordinate, axis=axis)
    steps = steps[np.isfinite(steps)]
    return float(np.median(steps)) if len(steps) else 0.0


def _columns_mm(x: Floats) -> Floats:
    """(C,) median x of each column, interpolated where a column has no point."""
    at = np.flatnonzero(np.isfinite(x).any(axis=0))
    if len(at) == 0:
        return np.zeros(x.shape[1])
    return np.interp(np.arange(x.shape[1]), at, np.nanmedian(x[:, at], axis=0))


@dataclass(frozen=True)
class ReliefBlock:
    """What the relief of a block says of the sheet's thickness.

    Attributes
    ----------
    rows, columns : slice, of the surface
    weight : (R, C) array, with which it is blended into its neighbours
    spectrum : ReliefSpectrum, of the relief
    own : bool, whether it is the block's own, not the whole surface's
    shift_mm : (R, C) array, mm, displacement of the heights; NaN where unknown
    variance_mm2 : (R, C) array, mm², of a height that is corrected by it, less its own noise
    """

    rows: slice
    columns: slice
    weight: Floats
    spectrum: ReliefSpectrum
    own: bool
    shift_mm: Floats
    variance_mm2: Floats


def relief_blocks(surface: Surface, sheet: SheetSection, yaw_rad: float) -> Iterator[ReliefBlock]:
    """The blocks of a surface, which overlap by half; none where it is too small for a spectrum.

    Parameters
    ----------
    surface : Surface, mm, frame of the head, as stacked, its heights found from whole-line
        centroids
    sheet : SheetSection, its thickness, twice the standard deviation of the irradiance; from where
        it is lit and seen
    yaw_rad : float, rad, angle of the sheet against the track
    """
    lattice = _lattice(surface, sheet, yaw_rad)
    shape = lattice.height.shape
    if min(shape) < 2 or lattice.row_mm == 0 or lattice.column_mm == 0:
        return
    every = np.arange(shape[1])
    whole = _LaidBlock(lattice.height, every, np.broadcast_to(every, shape), 0, 1.0)
    if (usual := _spectrum(lattice, whole)) is None:
        return
    for rows, columns, weight in _blocks(shape):
        laid = _lay_along(lattice, rows, columns)
        own = _spectrum(lattice, laid)
        spectrum = own or usual
        shift, variance = _unlaid(laid, _laid_shift(lattice, laid, spectrum), rows, columns)
        yield ReliefBlock(rows, columns, weight, spectrum, own is not None, shift, variance)


def _blocks(shape: tuple[int, ...]) -> Iterator[tuple[slice, slice, Floats]]:
    """Rows, columns and blending weight of each block."""
    ramp = np.hanning(BLOCK + 2)[1:-1] + 1e-6
    for row in range(0, max(shape[0] - HOP, 1), HOP):
        for column in range(0, max(shape[1] - HOP, 1), HOP):
            rows = slice(row, min(row + BLOCK, shape[0]))
            columns = slice(column, min(column + BLOCK, shape[1]))
            sizes = rows.stop - rows.start, columns.stop - columns.start
            yield rows, columns, np.outer(ramp[: sizes[0]], ramp[: sizes[1]])


@dataclass(frozen=True)
class _LaidBlock:
    """A part of a lattice whose columns run along d.

    height: (R, C) mm, NaN where unknown.  columns: (C,) of the lattice, where the laid columns
    cross the middle row.  place: (R, C) columns of the lattice, between which they run.  first_row:
    of the lattice.  noise_share: of the variance of a height's own noise that is left.
    """

    height: Floats
    columns: Ints
    place: Floats
    first_row: int
    noise_share: float


def _lay_along(lattice: _Lattice, rows: slice, columns: slice) -> _LaidBlock:
    """The block and what the filter reaches around it, laid along d."""
    count, width = lattice.height.shape
    middle = (rows.start + rows.stop - 1) / 2
    aside = int(np.ceil(np.abs(lattice.step[columns]).max() * (rows.stop - rows.start) / 2)) + 1
    chosen = np.arange(max(columns.start - aside, 0), min(columns.stop + aside, width))
    every = np.arange(max(rows.start - lattice.reach, 0), min(rows.stop + lattice.reach, count))
    place = chosen + lattice.step[chosen] * (every - middle)[:, None]
    low = np.clip(np.floor(place), 0, width - 2).astype(int)
    part = place - low
    beside = lattice.height[every[:, None], low], lattice.height[every[:, None], low + 1]
    height = np.where(part == 0, beside[0], (1 - part) * beside[0] + part * beside[1])
    height[(part < 0) | (part > 1)] = np.nan
    share = float(np.mean(part**2 + (1 - part) ** 2))
    return _LaidBlock(height, chosen, place, int(every[0]), min(share, 1.0))


def _spectrum(lattice: _Lattice, laid: _LaidBlock) -> ReliefSpectrum | None:
    """The spectra of a laid part; None where it holds too few whole segments."""
    own = lattice.own[:, laid.columns]
    own = own[np.isfinite(own)]
    if len(own) == 0:
        return None
    noise_mm = float(np.sqrt(max(np.median(own) * laid.noise_share, NO_BETTER_MM**2)))
    wall = _walls(lattice, laid, noise_mm)
    parts = []
    for start in range(0, len(laid.height) - SEGMENT + 1, HOP):
        piece = laid.height[start : start + SEGMENT]
        whole = np.isfinite(piece).all(axis=0) & ~wall[start : start + SEGMENT - 1].any(axis=0)
        parts.append(piece[:, whole])
    segments = np.concatenate(parts, axis=1) if parts else np.zeros((SEGMENT, 0))
    if segments.shape[1] < FEWEST:
        return None
    return spectrum_of(segments, lattice.pitch_mm, lattice.sigma_mm, noise_mm)


def _walls(lattice: _Lattice, laid: _LaidBlock, noise_mm: float) -> Mask:
    """(R - 1, C) between which rows the target is steeper than a slope, or rows are missing."""
    most = STEEPEST * lattice.pitch_mm + NOISY * np.sqrt(2) * noise_mm
    steep = np.abs(np.diff(laid.height, axis=0)) > most
    return np.asarray(steep | lattice.missing[laid.first_row :][: len(steep), None])


def _laid_shift(
    lattice: _Lattice, laid: _LaidBlock, spectrum: ReliefSpectrum
) -> tuple[Floats, Floats]:
    """(R, C) displacement of a laid part's heights in mm and its variance; NaN where unknown."""
    noise_mm = float(np.sqrt(spectrum.noise / lattice.pitch_mm))
    kernel = _kernel(spectrum, lattice)
    ends = _pieces(laid.height, _walls(lattice, laid, noise_mm))
    smooth = np.full(laid.height.shape, np.nan)
    curved = np.zeros(laid.height.shape)
    for _ in range(ROUNDS):
        straight = laid.height - curved
        for column, start, stop in ends:
            smooth[start:stop, column] = _filter(straight[start:stop, column], kernel)
        filled = _fill_gaps(smooth)
        shown, linear = responses(
            filled,
            lattice.row_mm,
            lattice.column_mm,
            lattice.sigma_mm,
            lattice.sight(filled, laid.columns),
        )
        curved = shown - linear
    near = int(np.ceil(NEAR_SIGMAS * lattice.sigma_mm / lattice.pitch_mm))
    clear = np.zeros(laid.height.shape, dtype=bool)
    for column, start, stop in ends:
        clear[start + near : stop - near, column] = True
    misfit = np.where(clear, laid.height - shown, np.nan)
    variance = spectrum.correction_variance + _unexplained_variance(misfit, spectrum.left_variance)
    return np.where(clear, shown - filled, np.nan), np.where(clear, variance, np.nan)


def _kernel(spectrum: ReliefSpectrum, lattice: _Lattice) -> Floats:
    """(2 J + 1,) the filter by rows, tapered towards its ends, of the sum 1."""
    reach = lattice.reach
    fine = np.fft.rfftfreq(FINE * BLOCK, lattice.pitch_mm)
    whole = np.fft.irfft(np.interp(fine, spectrum.wavenumber_per_mm, spectrum.filter))
    rows = np.arange(-reach, reach + 1)
    kernel = whole[rows] * np.cos(np.pi * rows / (2 * reach + 2)) ** 2
    return np.asarray(kernel / kernel.sum())


def _pieces(height: Floats, wall: Mask) -> list[tuple[int, int, int]]:
    """Column, first row and end of each run of heights without a gap or a wall."""
    known = np.isfinite(height)
    joined = known[:-1] & known[1:] & ~wall
    found = []
    for column in np.flatnonzero(known.any(axis=0)):
        breaks = np.flatnonzero(~joined[:, column]) + 1
        bounds = np.concatenate([[0], breaks, [len(height)]])
        found += [
            (int(column), int(start), int(stop))
            for start, stop in pairwise(bounds)
            if stop - start >= SHORTEST
        ]
    return found


def _filter(heights: Floats, kernel: Floats) -> Floats:
    """(R,) heights through the filter; at the ends they go on as their own image in a point."""
    beyond = len(kernel) // 2
    if 0 < beyond < len(heights):  # as np.pad does, in a fifth of its time
        before, after = heights[beyond:0:-1], heights[-2 : -beyond - 2 : -1]
        padded = np.concatenate([2 * heights[0] - before, heights, 2 * heights[-1] - after])
    else:
        padded = np.pad(heights, beyond, mode="reflect", reflect_type="odd")
    return np.convolve(padded, kernel, mode="valid")


def _fill_gaps(values: Floats) -> Floats:
    """The array with the nearest value in each gap; 0 where there is none at all."""
    gaps = ~np.isfinite(values)
    if gaps.all():
        return np.zeros_like(values)
    nearest = distance_transform_edt(gaps, return_distances=False, return_indices=True)
    return values[tuple(nearest)]


def _unexplained_variance(misfit: Floats, expected: float) -> Floats:
    """(R, C) mean square of the misfit about each place, less what is expected."""
    known = np.isfinite(misfit)
    count = uniform_filter(known.astype(float), AROUND)
    mean = uniform_filter(np.where(known, misfit, 0.0) ** 2, AROUND) / np.maximum(count, 1e-9)
    return np.maximum(mean - MISFIT * expected, 0.0)


def _unlaid(
    laid: _LaidBlock, values: tuple[Floats, Floats], rows: slice, columns: slice
) -> tuple[Floats, ...]:
    """Values of the laid part at the block's own places, (R, C) each."""
    wanted = np.arange(columns.start, columns.stop)
    inside = range(rows.start - laid.first_row, rows.stop - laid.first_row)
    return tuple(
        np.stack([np.interp(wanted, laid.place[row], part[row], np.nan, np.nan) for row in inside])
        for part in values
    )


# Correcting for what the sheet's thickness does to a line on a sloping or curved target.


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
    docs/explanation/concavity.md; derived in sheetresponse.py.
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
