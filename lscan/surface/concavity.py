"""What the sheet's thickness does to a line on a smoothly curved target: a series.

Light that falls a little before or behind the sheet's middle plane meets the target at
another height, and the camera, which looks at the sheet askew, sees it displaced even where
the target is level.  In a column of the picture, which follows the direction d = (kappa, 1)
in plan, light at the distance y from the middle plane appears in the sheet at the height

    zeta(y) = h(kappa y, y) + tau y,      kappa = r_x / r_y,  tau = -r_z / r_y

where h is the target's height about the point and r the line of sight.  A matt target lit by
a sheet of Gaussian irradiance, standard deviation sigma, returns c(y) exp(-y²/2 sigma²), c
being the cosine of incidence, and the picture stretches it by zeta'.  The centroid of
zeta(y) under the weight c zeta' exp(-y²/2 sigma²) is displaced, to the second order in
sigma, by

    sigma² (3/2 zeta'' + zeta' (ln c)')

(derived here: half of zeta'' is the mean of the parabola, one zeta'' the stretching).  The
first term follows the concavity across the sheet, the second slope times concavity.
Profiles of neighbouring track positions give both, for the target stands still.  Relief as fine
as the sheet is thick has higher terms: relief.py.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lscan.config.rig import SheetSection
from lscan.records import Floats, Ints, Surface, has_value
from lscan.surface.align.levelling import shear

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
    count = true.shape[1]
    beside = np.arange(count)[:, None] + _around(columns)
    outside = (beside < 0) | (beside >= count)
    beside = np.clip(beside, 0, count - 1)
    for f in range(len(true)):
        near = f + _around(frames)
        near = near[(near >= 0) & (near < len(true))][:, None, None]
        offset = true[near, beside] - true[f][:, None]
        offset[:, outside] = np.nan
        noise = surface.sigma_z_mm[near, beside]
        yield f, _fit(_flat(offset, count), _flat(noise, count), radius)


def _around(reach: int) -> Ints:
    """Offsets from -reach to reach, evenly picked, 0 among them."""
    step = -(-reach // MOST_BESIDE)
    return np.arange(-(reach // step) * step, reach + 1, step)


def _spacing(coordinate: Floats, axis: int) -> float:
    """Median distance of neighbours along an axis, mm; 1 where there are none."""
    steps = np.abs(np.diff(coordinate, axis=axis))
    steps = steps[np.isfinite(steps) & (steps > 0)]
    return float(np.median(steps)) if len(steps) else 1.0


def _flat(window: np.ndarray, count: int) -> np.ndarray:
    """(frames, N, columns, ...) as (N, frames x columns, ...)."""
    turned = np.moveaxis(window, 0, 1)
    return turned.reshape(count, -1, *window.shape[3:])


def _fit(offset: Floats, noise: Floats, radius: float) -> _Quadratics:
    """The quadratics through (N, K, 3) offsets in mm of standard uncertainty (N, K)."""
    x, y = offset[..., 0] / radius, offset[..., 1] / radius
    used = np.isfinite(offset).all(axis=-1) & (np.hypot(x, y) <= 1)
    terms = np.stack([np.ones_like(x), x, y, x**2 / 2, x * y, y**2 / 2], axis=-1)
    count = used.sum(axis=1)
    variance = np.maximum(noise**2, NO_BETTER_MM**2)
    total = np.where(used, variance, 0.0).sum(axis=1, keepdims=True)
    typical = total / np.maximum(count, 1)[:, None]
    weight = np.where(used, typical / np.maximum(variance, 1e-3 * typical), 0.0)
    design = np.where(used[..., None], terms, 0.0)
    height = np.where(used, offset[..., 2], 0.0)
    turned = np.swapaxes(design * weight[..., None], 1, 2)
    normal = turned @ design
    good = (count >= FEWEST_POINTS) & (np.linalg.eigvalsh(normal)[:, 0] > 1e-4)
    inverse = np.linalg.inv(np.where(good[:, None, None], normal, np.eye(6)))
    fitted = (inverse @ (turned @ height[..., None]))[..., 0]
    residual = height - (design @ fitted[..., None])[..., 0]
    scatter = (weight * residual**2).sum(axis=1) / np.maximum(count - 6, 1)
    fitted = np.where(good[:, None], fitted, np.nan)
    return _Quadratics(
        slope=fitted[:, 1:3] / radius,
        bend=fitted[:, 3:] / radius**2,
        covariance=inverse[:, 3:, 3:]
        * np.maximum(scatter, typical[:, 0])[:, None, None]
        / radius**4,
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
