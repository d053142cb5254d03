"""Slices: exact on planes, bounded on curves, silent over holes, honest about uncertainty."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lscan.errors import InputError, MeasurementError
from lscan.measure import compare_slice
from lscan.records import Floats, Status, Surface
from lscan.surface import Slice, resample
from lscan.targets import Sandwave

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
@settings(max_examples=20, deadline=None, derandomize=True)
def test_planes_are_met_exactly(a: float, b: float, c: float, y: float) -> None:
    cut = resample(plane(a, b, c), (np.array([10.0, y]), np.array([140.0, 145.0 - y])))
    assert (cut.status == Status.OK).all()
    np.testing.assert_allclose(cut.z_mm, a + b * cut.xy_mm[:, 0] + c * cut.xy_mm[:, 1], atol=1e-9)


def test_places_along_the_line() -> None:
    cut = resample(gridded(), LINE, step_mm=0.5)
    assert len(cut.along_mm) == 271
    np.testing.assert_allclose(np.diff(cut.along_mm), 0.5)
    np.testing.assert_allclose(cut.xy_mm[[0, -1]], LINE)


def test_curvature_costs_no_more_than_the_disc_allows() -> None:
    """A plane fitted over a disc of radius r is off by curvature * r² / 8 at its centre."""
    for line in PIECE.slices_mm().values():
        errors = compare_slice(resample(gridded(), line), PIECE)
        slope_factor = 1 + (PIECE.d_rad * PIECE.e_per_mm / PIECE.c_per_mm) ** 2
        curvature = 8.0 * PIECE.c_per_mm**2 * slope_factor
        # Twice: the points do not fill the disc evenly.
        assert max(errors.max_mm, -errors.min_mm) < 2 * curvature * 1.44**2 / 8


def test_sigma_is_the_scatter_of_repeated_scans() -> None:
    noise = 0.1
    flat = np.zeros((301, 167))
    cuts = [resample(gridded(flat, noise, seed), LINE, step_mm=5.0) for seed in range(100)]
    scatter = np.std([cut.z_mm for cut in cuts], axis=0)
    # The scatter of 100 draws is known to 1 / sqrt(200) = 7 %; four times that.
    np.testing.assert_allclose(scatter, cuts[0].sigma_mm, rtol=0.28)
    assert (cuts[0].sigma_mm < noise).all()


def test_holes_are_not_bridged() -> None:
    surface = gridded()
    hole = np.hypot(surface.xyz_mm[..., 0] - 70, surface.xyz_mm[..., 1] - 20) < 6
    status = np.where(hole, int(Status.OCCLUDED), surface.status)
    xyz = np.where(hole[..., None], np.nan, surface.xyz_mm)
    holed = Surface(xyz, surface.sigma_x_mm, surface.sigma_mm, status, surface.position_mm)
    cut = resample(holed, LINE)
    inside = np.abs(cut.xy_mm[:, 0] - 70) < 6 - 0.9
    outside = np.abs(cut.xy_mm[:, 0] - 70) > 6 + cut.radius_mm
    assert (cut.status[inside] == Status.NO_DATA).all()
    assert (cut.status[outside] == Status.OK).all()
    np.testing.assert_array_equal(np.isfinite(cut.z_mm), cut.status == Status.OK)
    np.testing.assert_array_equal(np.isfinite(cut.sigma_mm), cut.status == Status.OK)
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
            Surface(surface.xyz_mm * np.nan, surface.sigma_mm, surface.sigma_mm, lost, LINE[0]),
            LINE,
        )
