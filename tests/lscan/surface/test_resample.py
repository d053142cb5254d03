"""Slices: exact on planes, bounded on curves, no values over holes, correct uncertainty."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.config.targets import Sandwave
from lscan.errors import InputError, MeasurementError
from lscan.measure import compare_slice
from lscan.records import Floats, Status, Surface
from lscan.surface import Slice, resample

PIECE = Sandwave()
LINE = (np.array([5.0, 20.0]), np.array([140.0, 20.0]))


def gridded(height: Floats | None = None, noise_mm: float = 0.0, seed: int = 0) -> Surface:
    """The waves, or a height given on the same grid, every 0.9 by 0.5 mm."""
    y, x = np.meshgrid(np.arange(0, 150.1, 0.5), np.arange(0, 150.1, 0.9), indexing="ij")
    z = PIECE.height_mm(x, y) if height is None else height
    z = z + np.random.default_rng(seed).normal(0, 1, x.shape) * noise_mm
    ones = np.ones_like(x)
    return Surface(
        np.stack([x, y, z], -1),
        0.001 * ones,
        max(noise_mm, 0.01) * ones,
        np.zeros(x.shape, dtype=np.int64),
        y[:, 0],
        "workpiece",
    )


def plane(a: float, b: float, c: float) -> Surface:
    y, x = np.meshgrid(np.arange(0, 150.1, 0.5), np.arange(0, 150.1, 0.9), indexing="ij")
    return gridded(a + b * x + c * y)


@given(st.floats(-50, 50), st.floats(-1, 1), st.floats(-1, 1), st.floats(10, 140))
@examples(20)
def test_planes_are_met_exactly(a: float, b: float, c: float, y: float) -> None:
    cut = resample(plane(a, b, c), (np.array([10.0, y]), np.array([140.0, 145.0 - y])))
    assert (cut.status == Status.OK).all()
    np.testing.assert_allclose(cut.z_mm, a + b * cut.xy_mm[:, 0] + c * cut.xy_mm[:, 1], atol=1e-9)


def test_places_along_the_line() -> None:
    cut = resample(gridded(), LINE, step_mm=0.5)
    assert len(cut.along_mm) == 271
    np.testing.assert_allclose(np.diff(cut.along_mm), 0.5)
    np.testing.assert_allclose(cut.xy_mm[[0, -1]], LINE)


@given(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(20, 130))
@examples(20)
def test_quadratics_are_met_exactly(a: float, b: float, c: float, y: float) -> None:
    def height(x: Floats, y: Floats) -> Floats:
        return a * (x - 75) ** 2 + b * (x - 75) * (y - 75) + c * (y - 75) ** 2

    y_grid, x_grid = np.meshgrid(np.arange(0, 150.1, 0.5), np.arange(0, 150.1, 0.9), indexing="ij")
    ends = (np.array([10.0, y]), np.array([140.0, 150.0 - y]))
    cut = resample(gridded(height(x_grid, y_grid)), ends)
    assert (cut.status == Status.OK).all()
    np.testing.assert_allclose(cut.z_mm, height(*cut.xy_mm.T), atol=1e-8)


def test_crests_are_kept() -> None:
    """A quadratic over K points is off by no more than the third derivative times r³ / 6.

    Taylor's remainder goes with rho³; for points that fill a disc the squares of the weights
    add up to 4 / K and the sixth powers of rho to K r⁶ / 4, so that by Cauchy and Schwarz the
    weighted sum of rho³ is below r³.
    A plane is off by the second derivative times r² / 8 and would not pass on S3.
    """
    turning = np.hypot(PIECE.c_per_mm, PIECE.d_rad * PIECE.e_per_mm)
    for line in PIECE.slices_mm().values():
        cut = resample(gridded(), line)
        errors = compare_slice(cut, PIECE)
        allowed = 8.0 * turning**3 * cut.radius_mm**3 / 6
        assert max(errors.max_mm, -errors.min_mm) < allowed
    assert allowed < 7.5 * turning**2 * cut.radius_mm**2 / 8


def test_errors_in_common_do_not_average_out() -> None:
    """One mode that lifts all by 0.2 mm, and one that shifts all in x by 0.3 mm on a slope."""
    surface, own = plane(0.0, 0.5, 0.0), 0.1
    shape = surface.status.shape
    modes = np.zeros((*shape, 3, 2), dtype=np.float32)
    modes[..., 2, 0], modes[..., 0, 1] = 0.2, 0.3
    known = replace(
        surface,
        sigma_x_mm=np.full(shape, 0.3),
        sigma_z_mm=np.full(shape, np.hypot(own, 0.2)),
        modes_mm=modes,
    )
    cut = resample(known, LINE)
    assert cut.modes_mm is not None
    np.testing.assert_allclose(cut.modes_mm, [[0.2, -0.15]] * len(cut.z_mm), rtol=1e-5)
    alone = replace(surface, sigma_x_mm=np.zeros(shape), sigma_z_mm=np.full(shape, own))
    apart = resample(alone, LINE)
    assert apart.modes_mm is None
    np.testing.assert_allclose(cut.sigma_z_mm**2, apart.sigma_z_mm**2 + 0.2**2 + 0.15**2, rtol=1e-4)


def test_a_plane_that_serves_states_its_lack_of_fit() -> None:
    """Along the surface's border the quadratic is less certain than one measurement."""
    y, _ = np.meshgrid(np.arange(0, 150.1, 0.5), np.arange(0, 150.1, 0.9), indexing="ij")
    bowl = gridded(0.05 * (y - 75) ** 2)
    edge = resample(bowl, (np.array([20.0, 0.0]), np.array([130.0, 0.0])), step_mm=5.0)
    served = edge.status == Status.OK
    error = edge.z_mm[served] - 0.05 * 75.0**2
    assert served.any()
    assert (np.abs(error) < 3 * edge.sigma_z_mm[served]).all()


def test_sigma_is_the_scatter_of_repeated_scans() -> None:
    noise = 0.1
    flat = np.zeros((301, 167))
    cuts = [resample(gridded(flat, noise, seed), LINE, step_mm=5.0) for seed in range(50)]
    scatter = np.std([cut.z_mm for cut in cuts], axis=0)
    # The scatter of 50 draws is known to 1 / sqrt(100) = 10 %; four times that.
    np.testing.assert_allclose(scatter, cuts[0].sigma_z_mm, rtol=0.4)
    assert (cuts[0].sigma_z_mm < noise).all()


def test_holes_are_not_bridged() -> None:
    surface = gridded()
    hole = np.hypot(surface.xyz_mm[..., 0] - 70, surface.xyz_mm[..., 1] - 20) < 6
    status = np.where(hole, int(Status.OCCLUDED), surface.status)
    xyz = np.where(hole[..., None], np.nan, surface.xyz_mm)
    holed = Surface(xyz, surface.sigma_x_mm, surface.sigma_z_mm, status, surface.position_mm)
    cut = resample(holed, LINE)
    inside = np.abs(cut.xy_mm[:, 0] - 70) < 6 - 0.9
    outside = np.abs(cut.xy_mm[:, 0] - 70) > 6 + cut.radius_mm
    assert (cut.status[inside] == Status.NO_DATA).all()
    assert (cut.status[outside] == Status.OK).all()
    np.testing.assert_array_equal(np.isfinite(cut.z_mm), cut.status == Status.OK)
    np.testing.assert_array_equal(np.isfinite(cut.sigma_z_mm), cut.status == Status.OK)
    errors = compare_slice(cut, PIECE)
    assert errors.unseen >= inside.sum()
    assert errors.points + errors.unseen + errors.at_step == len(cut.status)


def test_nothing_is_taken_from_beside_the_surface() -> None:
    cut = resample(gridded(), (np.array([200.0, 20.0]), np.array([240.0, 20.0])))
    assert (cut.status == Status.NO_DATA).all()
    with pytest.raises(MeasurementError, match="none of its 81 points"):
        compare_slice(cut, PIECE)


def test_errors_are_measured_minus_nominal() -> None:
    along = np.arange(10.0, 30.0)
    xy = np.column_stack([along, np.full(20, 50.0)])
    z = PIECE.height_mm(*xy.T) + np.where(np.arange(20) % 2, 0.3, -0.1)
    ok = np.zeros(20, dtype=np.int64)
    errors = compare_slice(Slice(xy, along, z, np.full(20, 0.1), ok, 1.4), PIECE)
    assert errors.as_json() == pytest.approx(
        {"points": 20, "unseen": 0, "rmse_mm": np.sqrt(0.05), "min_mm": -0.1, "max_mm": 0.3}
    )


def test_bad_slices_are_refused() -> None:
    start = np.array([1.0, 1.0])
    with pytest.raises(InputError, match="no length"):
        resample(gridded(), (start, start))
    with pytest.raises(InputError, match="step"):
        resample(gridded(), LINE, step_mm=0.0)
    surface = gridded()
    lost = np.full_like(surface.status, int(Status.NO_PEAK))
    with pytest.raises(MeasurementError, match="no measured point"):
        resample(
            Surface(surface.xyz_mm * np.nan, surface.sigma_z_mm, surface.sigma_z_mm, lost, LINE[0]),
            LINE,
        )
