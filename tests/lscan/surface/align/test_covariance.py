"""The covariance of a scan, from the calibration to grid cells: against redoing everything."""

from dataclasses import replace

import numpy as np
import pytest
from covariance_example import COUNT, surface_modes
from synthetic_scans import Placing, scan

from lscan.config.targets import Sandwave
from lscan.records import Floats, Surface
from lscan.surface import HeightGrid, align_sandwave, apply, grid_cells
from lscan.surface.alignment import displacement, shear

PIECE = Sandwave()
# Many columns and no noise: what is left is the calibration's doing.
PLACING = Placing(yaw_deg=2.2, turn_deg=-4.0, roll_deg=2.0, pitch_deg=-1.5, columns=320, frames=200)
PLACING = replace(PLACING, step_mm=1.0)


@pytest.fixture(scope="module")
def raw() -> Surface:
    bare = scan(PIECE, PLACING)
    modes = surface_modes(bare)
    common = (modes.astype(float) ** 2).sum(axis=-1)
    return replace(
        bare,
        modes_mm=modes,
        sigma_x_mm=np.sqrt(0.01**2 + common[..., 0]),
        sigma_z_mm=np.sqrt(0.02**2 + common[..., 2]),
    )


@pytest.fixture(scope="module")
def aligned(raw: Surface) -> Surface:
    return apply(align_sandwave(raw, PIECE), raw)


def displaced(raw: Surface, amounts: Floats) -> Surface:
    """The scan that a calibration wrong by ``amounts`` of each mode would have given."""
    assert raw.modes_mm is not None
    return replace(raw, xyz_mm=raw.xyz_mm + raw.modes_mm.astype(float) @ amounts)


def test_sigma_is_what_is_own_and_what_is_common(raw: Surface, aligned: Surface) -> None:
    assert aligned.modes_mm is not None
    assert aligned.modes_mm.shape == (*raw.status.shape, 3, COUNT + 7)
    seen = np.isfinite(raw.sigma_z_mm)
    common = (aligned.modes_mm[seen].astype(float) ** 2).sum(axis=-1)
    # The block is tilted by 2.5 degrees: the own parts mix by its sine's square, 0.002.
    own = aligned.sigma_z_mm[seen] ** 2 - common[:, 2]
    np.testing.assert_allclose(own, 0.02**2, rtol=0.005)
    assert np.isnan(aligned.modes_mm[~seen]).all()


@pytest.mark.parametrize("mode", range(COUNT))
def test_each_mode_is_what_redoing_the_alignment_gives(
    raw: Surface, aligned: Surface, mode: int
) -> None:
    """Two scans displaced by plus and minus one standard deviation, both aligned anew."""
    assert aligned.modes_mm is not None
    amounts = np.eye(COUNT)[mode]
    both = [displaced(raw, sign * amounts) for sign in (1.0, -1.0)]
    redone = [apply(align_sandwave(one, PIECE), one).xyz_mm for one in both]
    change = (redone[0] - redone[1]) / 2
    seen = np.isfinite(change).all(axis=-1) & (aligned.xyz_mm[..., 2] > -20)
    stated = aligned.modes_mm[..., mode].astype(float)
    size = np.sqrt(np.mean(stated[seen] ** 2))
    off = (change - stated)[seen]
    # Heights come from least squares and answer to first order in full; x and y hang on edges
    # that columns sample, so that they answer in steps of up to 0.02 mm.
    assert (
        np.sqrt(np.mean(off[:, 2] ** 2)) < 0.15 * np.sqrt(np.mean(stated[seen][:, 2] ** 2)) + 1e-4
    )
    assert np.sqrt(np.mean(off[:, :2] ** 2)) < 0.15 * size + 0.02


def test_what_the_alignment_can_take_out_is_taken_out(raw: Surface) -> None:
    """A calibration wrong by a shift, a tilt in the sheet or a yaw leaves no error at all."""
    x, track, z = np.moveaxis(raw.xyz_mm, -1, 0)
    nought = np.zeros_like(x)
    shift = np.stack([np.ones_like(x), nought, nought], axis=-1)
    height = np.stack([nought, nought, np.ones_like(x)], axis=-1)
    tilt = np.stack([-z, nought, x], axis=-1) / 100
    yaw = np.stack([track, nought, nought], axis=-1) / 100
    modes = np.stack([shift, height, tilt, yaw], axis=-1).astype(np.float32)
    one = replace(raw, modes_mm=np.where(np.isnan(x)[..., None, None], np.nan, modes))
    left = apply(align_sandwave(one, PIECE), one).modes_mm
    assert left is not None
    rest = np.nanmax(np.abs(left[..., :4]), axis=(0, 1, 2))
    # A shift and a height are answered exactly.  A tilt is not quite a rotation once the sheet
    # is yawed, nor is a shear along x one along the yawed track: both to the sine of 2.2 degrees
    # of what they displace, 2 mm at most.  Single precision of 100 mm: 1e-5.
    assert rest[:2].max() < 1e-4
    assert rest[2:].max() < 2.0 * np.sin(np.radians(2.2))


@pytest.mark.parametrize("parameter", range(7))
def test_displacements_are_derivatives_of_the_pose(parameter: int) -> None:
    """Against finite differences of rotation @ shear(yaw) @ raw + shift."""
    rng = np.random.default_rng(parameter)
    rotation = PLACING.rotation().T
    yaw, pivot, shift = 0.04, np.array([75.0, 75.0, 10.0]), np.array([3.0, -7.0, 20.0])
    raw = rng.uniform(-100, 100, (20, 3))
    # The yaw turns about the track position of the pivot: let that be nought.
    shift = pivot - rotation @ shear(yaw) @ np.array([12.0, 0.0, 5.0])
    points = raw @ (rotation @ shear(yaw)).T + shift
    step = 1e-6

    def moved(amount: float) -> Floats:
        if parameter == 3:
            return raw @ (rotation @ shear(yaw + amount)).T + shift
        if parameter > 3:
            return points + amount * np.eye(3)[parameter - 4]
        axis = np.eye(3)[parameter]
        return points + amount * np.cross(axis, points - pivot)

    numeric = (moved(step) - moved(-step)) / (2 * step)
    stated = displacement(points, pivot, rotation, yaw)[..., parameter]
    np.testing.assert_allclose(stated, numeric, atol=1e-6)


def test_own_noise_of_the_alignment_is_what_repeating_the_scan_scatters() -> None:
    """Twelve scans whose noise alone differs: the height and tilts of the base plane."""
    placing = replace(PLACING, noise_mm=0.2, frames=100, step_mm=2.0, columns=160, pitch_mm=1.8)
    found = []
    for seed in range(12):
        one = scan(PIECE, replace(placing, seed=seed))
        alignment = align_sandwave(one, PIECE)
        # Rows 2 of rotation and translation say what becomes of heights.
        corner = alignment.rotation @ shear(alignment.yaw_rad) @ np.array([-80.0, 40.0, 0.0])
        stated = apply(alignment, one).modes_mm
        found.append(corner[2] + alignment.translation_mm[2])
    assert stated is not None
    x, y = one.xyz_mm[..., 0], one.xyz_mm[..., 1]
    near = np.unravel_index(np.nanargmin(np.hypot(x + 80, y - 40)), x.shape)
    sigma = float(np.linalg.norm(stated[near][2]))
    # Twelve values give their standard deviation to 21 %: thrice that either way.
    assert 0.37 < np.std(found, ddof=1) / sigma < 1.63


# Grid cells


def test_cells_are_the_shape_where_it_is_a_quadratic() -> None:
    """A closed form: a quadratic is fitted without error, and weights add up to 1."""
    rng = np.random.default_rng(3)
    x, y = rng.uniform(0, 20, (2, 40, 60))
    z = 3 + 0.2 * x - 0.1 * y + 0.02 * x * x - 0.01 * x * y + 0.03 * y * y
    grid = grid_cells(flat(x, y, z), cell_mm=4.0)
    xs, ys = np.meshgrid(grid.x_mm, grid.y_mm)
    expected = 3 + 0.2 * xs - 0.1 * ys + 0.02 * xs**2 - 0.01 * xs * ys + 0.03 * ys**2
    np.testing.assert_allclose(grid.z_mm, expected, atol=1e-9)
    assert grid.points.sum() == x.size


def flat(x: Floats, y: Floats, z: Floats, sigma: float = 0.1, sigma_x: float = 0.0) -> Surface:
    return Surface(
        xyz_mm=np.stack([x, y, z], axis=-1),
        sigma_x_mm=np.full(x.shape, sigma_x),
        sigma_z_mm=np.full(x.shape, sigma),
        status=np.zeros(x.shape, dtype=np.int64),
        position_mm=np.arange(len(x), dtype=float),
        frame="workpiece",
    )


def test_a_cells_sigma_is_the_scatter_of_its_height() -> None:
    """Monte-Carlo of z and x noise on a slope of 0.5: 400 repeats know a deviation to 3.5 %."""
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.arange(0.25, 6, 0.5), np.arange(0.25, 6, 0.5))
    one = flat(x, y, 0.5 * x, sigma=0.1, sigma_x=0.2)
    heights = []
    for _ in range(400):
        noise = rng.normal(0, 0.1, x.shape) - 0.5 * rng.normal(0, 0.2, x.shape)
        heights.append(grid_cells(flat(x, y, 0.5 * x + noise), 3.0).z_mm)
    scatter = np.std(heights, axis=0, ddof=1)
    np.testing.assert_allclose(scatter / grid_cells(one, 3.0).sigma_z_mm, 1.0, atol=4 * 0.036)


def test_cells_change_by_their_modes_slope_and_all(aligned: Surface) -> None:
    """Displacing every point by a mode, in x and y too, changes heights as the cells state."""
    assert aligned.modes_mm is not None
    before = grid_cells(aligned, 4.0)
    assert before.modes_mm is not None
    for mode in range(COUNT):
        amount = 0.2  # small against the cell, so that points stay in it
        xyz = aligned.xyz_mm + amount * aligned.modes_mm[..., mode]
        after = grid_cells(replace(aligned, xyz_mm=xyz), 4.0)
        inside = (before.points == after.points) & np.isfinite(before.z_mm)
        inside &= waves(before) & np.isfinite(after.z_mm)
        change = (after.z_mm - before.z_mm)[inside] / amount
        stated = before.modes_mm[inside][:, mode]
        size = np.sqrt(np.mean(stated**2))
        assert inside.sum() > 200
        # First order: the slope changes over the displacement, and over the cell.
        assert np.sqrt(np.mean((change - stated) ** 2)) < 0.15 * size


def waves(grid: HeightGrid) -> np.ndarray:
    """Mask (R, C) of the cells that lie in the waves, clear of their border."""
    xs, ys = np.meshgrid(grid.x_mm, grid.y_mm)
    return (np.minimum(xs, ys) > 6) & (np.maximum(xs, ys) < 144)


def test_a_bias_adds_to_sigma_and_does_not_average_out() -> None:
    x, y = np.meshgrid(np.arange(0.25, 6, 0.5), np.arange(0.25, 6, 0.5))
    one = flat(x, y, 0 * x)
    plain, biased = grid_cells(one, 3.0), grid_cells(one, 3.0, bias_mm=np.full(x.shape, 0.3))
    np.testing.assert_allclose(biased.sigma_z_mm**2 - plain.sigma_z_mm**2, 0.3**2, rtol=1e-9)
    doubled = grid_cells(replace(one, sigma_z_mm=2 * one.sigma_z_mm), 3.0)
    np.testing.assert_allclose(doubled.sigma_z_mm, 2 * plain.sigma_z_mm, rtol=1e-9)


def test_without_modes_nothing_is_common() -> None:
    x, y = np.meshgrid(np.arange(0.25, 6, 0.5), np.arange(0.25, 6, 0.5))
    assert grid_cells(flat(x, y, 0 * x), 3.0).modes_mm is None
