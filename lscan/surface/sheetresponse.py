"""What a sheet of finite thickness makes of relief: of curves, of waves, of a spectrum.

Light that falls a little before or behind the sheet's middle plane meets the target at
another height, and the camera, which looks at the sheet askew, sees it displaced even where
the target is level.  In a column of the picture, which follows the direction d = (kappa, 1)
in plan, light at the distance y from the middle plane appears in the sheet at the height

    zeta(y) = h(kappa y, y) + tau y,      kappa = r_x / r_y,  tau = -r_z / r_y

where h is the target's height about the point and r the line of sight.  A matt target lit by
a sheet of Gaussian irradiance g(y), standard deviation sigma, returns c(y) g(y), c being the
cosine of incidence, and the picture stretches it by zeta' = d zeta / dy.  The line's centroid is
that of zeta under the weight c zeta' g, of what is seen.

For a relief of small slopes the terms linear in h are left: the integral of h y² g / sigma², a
convolution along d.  A wave of wavenumber k is shown with the gain

    H(k) = (1 - q) exp(-q / 2),      q = (2 pi k sigma)²

which is 0 at 2 pi k sigma = 1 and negative beyond (both derived here).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from math import hypot, sqrt

import numpy as np
from scipy.ndimage import spline_filter1d
from scipy.special import jv

from lscan.config.rig import SheetSection
from lscan.files.compiling import compiled_sums
from lscan.records import Floats, Ints, Surface, has_value
from lscan.surface.alignment import shear

# What a sheet of finite thickness makes of a target's relief: the height that its line shows.

OFFSETS = np.arange(-4.25, 4.3, 0.25)
"""Distances from the middle plane, in sigmas, at which the light is taken: of y² g, by which the
linear terms are weighed, 4e-4 lies beyond."""


@dataclass(frozen=True)
class Sight:
    """How the camera sees, and the laser lights, R by C points of a target.

    Attributes
    ----------
    tau : (R, C) array, rise of the line of sight for each mm along d
    kappa : (C,) array, x for each mm of y along d
    to_apex : (2, R, C) array, mm, x and z from the points to where the light comes from
    """

    tau: Floats
    kappa: Floats
    to_apex: Floats


def transfer(wavenumber_per_mm: Floats, sigma_mm: float) -> Floats:
    """Gain with which waves of small slope are shown, as H above.

    Parameters
    ----------
    wavenumber_per_mm : array, 1/mm, along d
    sigma_mm : float, mm, standard deviation of the sheet's irradiance

    Examples
    --------
    >>> transfer(np.array([0.0, 1 / (2 * np.pi * 0.75)]), 0.75).round(6).tolist()
    [1.0, 0.0]
    """
    q = (2 * np.pi * wavenumber_per_mm * sigma_mm) ** 2
    return np.asarray((1 - q) * np.exp(-q / 2))


def responses(
    height_mm: Floats, row_mm: float, column_mm: float, sigma_mm: float, sight: Sight
) -> tuple[Floats, Floats]:
    """(R, C) heights that the line shows of a target, and those by the linear terms alone, mm.

    Parameters
    ----------
    height_mm : (R, C) array, mm, without gaps; each column runs along d
    row_mm, column_mm : float, mm, from row to row in y, and from column to column in x
    sigma_mm : float, mm, standard deviation of the sheet's irradiance
    sight : Sight, of those points
    """
    rows = OFFSETS * (sigma_mm / row_mm)
    sloped = height_mm.shape[1] > 1
    slope_x = np.gradient(height_mm, column_mm, axis=1) if sloped else np.zeros_like(height_mm)
    # Heights between rows are those of cubic splines; beyond the ends the last height goes on.
    spline = spline_filter1d(height_mm, axis=0, mode="nearest")
    beyond = int(np.ceil(np.abs(rows).max())) + 2
    padded = np.pad(spline.T, ((0, 0), (beyond, beyond)), mode="edge")
    first, t = np.floor(rows).astype(np.int64), rows - np.floor(rows)
    pieces = np.stack(
        [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, 1 + 3 * t + 3 * t**2 - 3 * t**3, t**3]
    )
    # Each layout of an array would have the loop compiled once more.
    arrays = padded, pieces.T / 6, slope_x, sight.tau, *sight.to_apex
    whole, parts, slope, tau, apex_x, apex_z = map(np.ascontiguousarray, arrays)
    places = first + beyond - 1
    return _responses(whole, places, parts, slope, tau, sight.kappa, apex_x, apex_z, sigma_mm)


@compiled_sums
def _responses(
    spline: Floats,
    first: Ints,
    pieces: Floats,
    slope_x: Floats,
    tau: Floats,
    kappa: Floats,
    apex_x: Floats,
    apex_z: Floats,
    sigma_mm: float,
) -> tuple[Floats, Floats]:
    """The same of the splines' coefficients (C, R + ...), four of which make a height (K, 4)."""
    count, step = len(OFFSETS), (OFFSETS[1] - OFFSETS[0]) * sigma_mm
    light = np.exp(-(OFFSETS**2) / 2)
    kernel = OFFSETS**2 * light
    kernel /= kernel.sum()
    shown, linear = np.empty(slope_x.shape), np.empty(slope_x.shape)
    seen, in_sight = np.empty(count), np.empty(count)
    for r in range(slope_x.shape[0]):
        for c in range(slope_x.shape[1]):
            along, lift, highest, even = spline[c, r:], tau[r, c], -np.inf, 0.0
            for k in range(count):
                height, at = 0.0, first[k]
                for piece in range(4):
                    height += pieces[k, piece] * along[at + piece]
                even += kernel[k] * height
                seen[k] = height + lift * OFFSETS[k] * sigma_mm
                highest = max(highest, seen[k])
                in_sight[k] = light[k] if seen[k] >= highest - 1e-9 else 0.0
            across, total, moment = slope_x[r, c], 0.0, 0.0
            facing = apex_z[r, c] - across * apex_x[r, c]
            level = lift + kappa[c] * across
            for k in range(count):
                before, after = max(k - 1, 0), min(k + 1, count - 1)
                rise = (seen[after] - seen[before]) / ((after - before) * step)
                weight = max(rise, 0.0) * in_sight[k]
                weight *= max(facing, 0.0) / sqrt(1 + across**2 + (rise - level) ** 2)
                total += weight
                moment += weight * seen[k]
            shown[r, c], linear[r, c] = moment / total if total > 0 else even, even
    return shown, linear


def compile_reliefs() -> None:
    """Compile the loops of this module, for the processes that follow."""
    one, sight = np.zeros((1, 1)), Sight(np.zeros((1, 1)), np.zeros(1), np.ones((2, 1, 1)))
    responses(one, 1.0, 1.0, 1.0, sight)
    at = np.zeros(1, np.int64)
    _normal_equations(np.zeros((1, 1, 3)), one, 0, at, at, 1.0)


# What the sheet's thickness does to a line on a smoothly curved target: a series.
#
# Light that falls a little before or behind the sheet's middle plane meets the target at another
# height, and the camera, which looks at the sheet askew, sees it displaced even where the target is
# level.  In a column of the picture, which follows the direction d = (kappa, 1) in plan, light at
# the distance y from the middle plane appears in the sheet at the height
#
#     zeta(y) = h(kappa y, y) + tau y,      kappa = r_x / r_y,  tau = -r_z / r_y
#
# where h is the target's height about the point and r the line of sight.  A matt target lit by a
# sheet of Gaussian irradiance, standard deviation sigma, returns c(y) exp(-y²/2 sigma²), c being
# the cosine of incidence, and the picture stretches it by zeta'.  The centroid of zeta(y) under the
# weight c zeta' exp(-y²/2 sigma²) is displaced, to the second order in sigma, by
#
#     sigma² (3/2 zeta'' + zeta' (ln c)')
#
# (derived here: half of zeta'' is the mean of the parabola, one zeta'' the stretching).  The first
# term follows the concavity across the sheet, the second slope times concavity. Profiles of
# neighbouring track positions give both, for the target stands still.  Relief as fine as the sheet
# is thick has higher terms: thickness.py.


REACH_IN_SIGMAS = 4.0
"""Radius in plan over which the target is taken for a quadratic, in sigmas of the sheet; no
less than REACH_IN_SAMPLES of the coarser sample spacing."""

REACH_IN_SAMPLES = 2.0

FEWEST_POINTS = 9
"""Fewest points for the quadratic's six coefficients."""

MOST_BESIDE = 24
"""Rows, and columns, on either side of a point that the quadratic is fitted to: of closer ones some
are left out, evenly.  Of a sheet of 100 mm sampled every 0.1 mm all would be four million."""

NO_BETTER_MM = 1e-6
"""Heights are weighed as if known to no better than this: exact ones have weights too."""


def series_shifts(surface: Surface, sheet: SheetSection, yaw_rad: float) -> tuple[Floats, Floats]:
    """(F, N) displacement of the heights in mm, and its standard uncertainty; NaN where unknown.

    The uncertainty is the noise of the displacement, and all of it where within two sigmas of the
    sheet the target folds out of the camera's sight, which the series does not describe.  Points
    need enough neighbours for their concavity.

    Parameters
    ----------
    surface : Surface, mm, frame of the head, as stacked, its heights found from whole-line
        centroids
    sheet : SheetSection, its thickness, twice the standard deviation of the irradiance; from where
        it is lit and seen
    yaw_rad : float, rad, angle of the sheet against the track
    """
    parts = [
        _shift(forms, surface.xyz_mm[f], sheet)
        for f, forms in _quadratics(surface, sheet.thickness_mm / 2, yaw_rad)
    ]
    shift, sigma = (np.stack(column) for column in zip(*parts, strict=True))
    return shift, sigma


@dataclass(frozen=True)
class _Quadratics:
    """The local quadratics of one profile, (N,) each; NaN where there are too few points.

    slope: (N, 2) of h by x and by y.  bend: (N, 3) of h by xx, xy, yy, 1/mm.
    covariance: (N, 3, 3) of the bend.
    """

    slope: Floats
    bend: Floats
    covariance: Floats


def _quadratics(
    surface: Surface, sigma_mm: float, yaw_rad: float
) -> Iterator[tuple[int, _Quadratics]]:
    """Index and local quadratics of each profile, fitted to it and its neighbours."""
    valid = has_value(surface.status) & np.isfinite(surface.xyz_mm).all(axis=-1)
    true = np.where(valid[..., None], surface.xyz_mm, np.nan) @ shear(yaw_rad).T
    along, across = _spacing(true[..., 1], 0), _spacing(true[..., 0], 1)
    radius = max(REACH_IN_SIGMAS * sigma_mm, REACH_IN_SAMPLES * max(along, across))
    frames, columns = (int(np.ceil(radius / step)) for step in (along, across))
    noise, beside = np.ascontiguousarray(surface.sigma_z_mm), _offsets_around(columns)
    for f in range(len(true)):
        near = f + _offsets_around(frames)
        near = near[(near >= 0) & (near < len(true))]
        yield f, _solved(*_normal_equations(true, noise, f, near, beside, radius), radius)


def _offsets_around(reach: int) -> Ints:
    """Offsets from -reach to reach, evenly picked, 0 among them."""
    step = -(-reach // MOST_BESIDE)
    return np.arange(-(reach // step) * step, reach + 1, step)


def _spacing(coordinate: Floats, axis: int) -> float:
    """Median distance of neighbours along an axis, mm; 1 where there are none."""
    steps = np.abs(np.diff(coordinate, axis=axis))
    steps = steps[np.isfinite(steps) & (steps > 0)]
    return float(np.median(steps)) if len(steps) else 1.0


@compiled_sums
def _normal_equations(
    points: Floats, noise: Floats, profile: int, near: Ints, beside: Ints, radius: float
) -> tuple[Floats, Floats, Floats, Ints, Floats]:
    """The normal equations of the quadratics about the N points of a profile.

    Left (N, 6, 6) and right (N, 6) sides, sums of squares (N,), how many points each quadratic is
    of, and their mean variance in mm².  near: profiles.  beside: offsets of their columns, which
    the quadratics count in radii.
    """
    count = points.shape[1]
    normal, right = np.zeros((count, 6, 6)), np.zeros((count, 6))
    squares, used, typical = np.zeros(count), np.zeros(count, np.int64), np.zeros(count)
    terms = np.ones(6)
    for n in range(count):
        here = points[profile, n]
        for turn in range(2):  # the mean variance, of which the weights are made, and the sums
            for f in near:
                for offset in beside:
                    at = n + offset
                    if at < 0 or at >= count:
                        continue
                    x = (points[f, at, 0] - here[0]) / radius
                    y = (points[f, at, 1] - here[1]) / radius
                    height = points[f, at, 2] - here[2]
                    if not (hypot(x, y) <= 1 and abs(height) < np.inf):  # nor is it NaN
                        continue
                    variance = max(noise[f, at] ** 2, NO_BETTER_MM**2)
                    if turn == 0:
                        typical[n] += variance
                        used[n] += 1
                        continue
                    weight = typical[n] / max(variance, 1e-3 * typical[n])
                    terms[1], terms[2] = x, y
                    terms[3], terms[4], terms[5] = x * x / 2, x * y, y * y / 2
                    for i in range(6):
                        weighted = weight * terms[i]
                        right[n, i] += weighted * height
                        for j in range(i + 1):
                            normal[n, i, j] += weighted * terms[j]
                    squares[n] += weight * height * height
            if turn == 0:
                typical[n] /= max(used[n], 1)
        for i in range(6):
            for j in range(i):
                normal[n, j, i] = normal[n, i, j]
    return normal, right, squares, used, typical


def _solved(
    normal: Floats, right: Floats, squares: Floats, count: Ints, typical: Floats, radius: float
) -> _Quadratics:
    """The quadratics of :func:`_normal_equations`."""
    good = (count >= FEWEST_POINTS) & (np.linalg.eigvalsh(normal)[:, 0] > 1e-4)
    inverse = np.linalg.inv(np.where(good[:, None, None], normal, np.eye(6)))
    fitted = (inverse @ right[..., None])[..., 0]
    scatter = (squares - (fitted * right).sum(axis=1)) / np.maximum(count - 6, 1)
    fitted = np.where(good[:, None], fitted, np.nan)
    return _Quadratics(
        slope=fitted[:, 1:3] / radius,
        bend=fitted[:, 3:] / radius**2,
        covariance=inverse[:, 3:, 3:] * np.maximum(scatter, typical)[:, None, None] / radius**4,
    )


def _shift(forms: _Quadratics, points: Floats, sheet: SheetSection) -> tuple[Floats, Floats]:
    """(N,) displacement in mm of the heights of one profile, and its uncertainty.

    points: (N, 3) of the raw surface, whose x and z are those of the head frame.
    """
    camera, apex = np.array(sheet.camera_mm), np.array(sheet.apex_mm)
    kappa = (points[:, 0] - camera[0]) / -camera[1]
    tau = (points[:, 2] - camera[2]) / camera[1]
    to_apex = apex[[0, 2]] - points[:, [0, 2]]
    slope_x, slope_y = forms.slope.T
    rise = kappa * slope_x + slope_y + tau
    facing = to_apex[:, 1] - slope_x * to_apex[:, 0]  # cosine of incidence, but for lengths
    upright = 1 + slope_x**2 + slope_y**2
    # (ln c)' = by_x * (slope_x)' + by_y * (slope_y)', the primes along (kappa, 1).
    by_x = -to_apex[:, 0] / facing - slope_x / upright
    by_y = -slope_y / upright
    zero, one = np.zeros_like(kappa), np.ones_like(kappa)
    curving = np.stack([kappa**2, 2 * kappa, one], axis=-1)  # zeta'' of the bend
    darkening = by_x[:, None] * np.stack([kappa, one, zero], axis=-1)
    darkening += by_y[:, None] * np.stack([zero, kappa, one], axis=-1)
    gain = (sheet.thickness_mm / 2) ** 2 * (1.5 * curving + rise[:, None] * darkening)
    shift = (gain * forms.bend).sum(axis=1)
    variance = np.einsum("ni,nij,nj->n", gain, forms.covariance, gain)
    folds = rise < sheet.thickness_mm * np.abs((curving * forms.bend).sum(axis=1))
    return shift, np.sqrt(variance + np.where(folds, shift**2, 0.0))


# The spectrum of a relief as a thick sheet shows it, and what that tells of the relief.
#
# A relief of the spectrum S, shown with the gain H (sheetresponse.py) and white noise of the
# spectrum N, is measured with the spectrum H² S + N.  Where that clearly exceeds N it gives S; in
# between, and beyond, S follows the power law of its neighbours, as natural beds do.  Then the
# filter
#
#     G = H S / ((H² + D²) S + N)
#
# gives from what was measured the relief with the least mean square error (Wiener), D being the
# standard uncertainty of H, from that of the sheet's thickness.


SEGMENT = 64  # rows of which a spectrum is taken
FEWEST = 12  # segments, of which the mean is known to a third
CLEAR = 1.5  # times the noise: what exceeds it by less may be chance
LEAST_GAIN = 0.15  # of H, beneath which its zero blurs with its neighbours
THICKNESS_DOUBT = 0.1
"""Relative standard uncertainty of the sheet's thickness, which is measured by ruler or by eye."""

STEEPNESS = (2.0, 6.0)
"""Power law of S: sand and rough beds have 2 to 4 (Jackson & Richardson 2007, ch. 6), smooth
surfaces more."""


@dataclass(frozen=True)
class ReliefSpectrum:
    """Spectra of a relief along d, one-sided wavenumbers, K of them.

    Attributes
    ----------
    wavenumber_per_mm : (K,) array, 1/mm, from 0 on
    relief : (K,) array, mm³, S, two-sided; infinite at 0, where nothing is held back
    noise : float, mm³, N
    gain, doubt : (K,) array, H and its standard uncertainty D
    sigma_mm : float, mm, standard deviation of the sheet's irradiance
    """

    wavenumber_per_mm: Floats
    relief: Floats
    noise: float
    gain: Floats
    doubt: Floats
    sigma_mm: float

    @property
    def filter(self) -> Floats:
        """(K,) Wiener's filter G, which gives the relief from what was measured."""
        found = np.ones_like(self.gain)
        gain, relief = self.gain[1:], self.relief[1:]
        power = (gain**2 + self.doubt[1:] ** 2) * relief + self.noise
        found[1:] = gain * relief / np.maximum(power, np.finfo(float).tiny)
        return found

    @property
    def correction_variance(self) -> float:
        """Variance in mm² by which a height that is corrected with G errs, less its own noise.

        A height h is measured as (H + D) h + n and corrected by (H - 1) G times that; it is left
        with ((H - 1) (1 - G H) + (1 + (1 - H) G) D) h and (1 + (1 - H) G) n.
        """
        gain, found = self.gain[1:], self.filter[1:]
        lost = ((1 - gain) * (1 - found * gain)) ** 2
        lost = self.relief[1:] * (lost + ((1 + (1 - gain) * found) * self.doubt[1:]) ** 2)
        noisy = self.noise * ((1 + (1 - gain) * found) ** 2 - 1)
        step = self.wavenumber_per_mm[1]
        return float(max(2 * step * (lost + noisy).sum(), 0.0))

    @property
    def series_variance(self) -> float:
        """Variance in mm² of what the series' first term leaves of the relief.

        The second derivative of the quadratic that fits best within a circle of radius r shows a
        wave of x = 2 pi k r with the gain 48 J3(x) / x³, J3 being a Bessel function (derived here,
        from the Zernike polynomials of second order).
        """
        wavenumber, gain = self.wavenumber_per_mm[1:], self.gain[1:]
        q = (2 * np.pi * wavenumber * self.sigma_mm) ** 2
        x = 2 * np.pi * wavenumber * REACH_IN_SIGMAS * self.sigma_mm
        seen = gain * 48 * jv(3, x) / x**3
        left = (1 - gain - 1.5 * q * seen) ** 2 + self.doubt[1:] ** 2
        return float(2 * self.wavenumber_per_mm[1] * (self.relief[1:] * left).sum())

    @property
    def left_variance(self) -> float:
        """Variance in mm² of what was measured less what the filtered relief would show."""
        gain, relief = self.gain[1:], self.relief[1:]
        measured = gain**2 * relief + self.noise
        step = self.wavenumber_per_mm[1]
        return float(2 * step * (measured * (1 - gain * self.filter[1:]) ** 2).sum())

    @property
    def resolved_mm(self) -> float:
        """The shortest wave in mm of which, and of all longer ones, more than half is recovered."""
        held = np.flatnonzero(self.filter * self.gain < 0.5)
        last = held[0] - 1 if len(held) else len(self.gain) - 1
        return float(1 / self.wavenumber_per_mm[max(last, 1)])


def spectrum_of(
    segments: Floats, row_mm: float, sigma_mm: float, noise_mm: float
) -> ReliefSpectrum:
    """The spectra of a relief from M segments of what was measured.

    Parameters
    ----------
    segments : (SEGMENT, M) array, mm, heights along d, FEWEST or more
    row_mm : float, mm, from row to row
    sigma_mm : float, mm, standard deviation of the sheet's irradiance
    noise_mm : float, mm, standard deviation of each height's own noise

    References
    ----------
    P. D. Welch, IEEE Trans. Audio Electroacoust. 15 (1967) 70, for the spectrum; N. Wiener,
    Extrapolation, Interpolation and Smoothing of Stationary Time Series (1949), for the filter.
    """
    window = np.hanning(SEGMENT)[:, None]
    rows = np.arange(SEGMENT, dtype=float)
    level = np.vander(rows - rows.mean(), 2)
    rest = segments - level @ (np.linalg.pinv(level) @ segments)
    power = np.abs(np.fft.rfft(rest * window, axis=0)) ** 2 * row_mm / (window**2).sum()
    measured = power.mean(axis=1)
    wavenumber: Floats = np.fft.rfftfreq(SEGMENT, row_mm).astype(np.float64)
    gain, noise = transfer(wavenumber, sigma_mm), noise_mm**2 * row_mm
    clear = (wavenumber > 0) & (measured > CLEAR * noise) & (np.abs(gain) > LEAST_GAIN)
    relief = np.full_like(gain, np.inf)
    relief[clear] = (measured[clear] - noise) / gain[clear] ** 2
    relief[1:] = np.where(clear[1:], relief[1:], _power_law(wavenumber, relief, clear))
    per_percent = transfer(wavenumber, sigma_mm * 1.01) - gain
    doubt = np.abs(per_percent) * 100 * THICKNESS_DOUBT
    return ReliefSpectrum(wavenumber, relief, noise, gain, doubt, sigma_mm)


def _power_law(wavenumber: Floats, relief: Floats, clear: np.ndarray) -> Floats:
    """(K - 1,) the power law through the upper part of what is clear; 0 if nothing is."""
    known = np.flatnonzero(clear)
    if len(known) == 0:
        return np.zeros(len(wavenumber) - 1)
    upper = known[wavenumber[known] >= wavenumber[known[-1]] / 3]
    x, y = np.log(wavenumber[upper]), np.log(relief[upper])
    steepness = -np.polyfit(x, y, 1)[0] if len(upper) > 2 else STEEPNESS[1]
    steepness = float(np.clip(steepness, *STEEPNESS))
    level = np.mean(y + steepness * x)
    return np.asarray(np.exp(level) * wavenumber[1:] ** -steepness)
