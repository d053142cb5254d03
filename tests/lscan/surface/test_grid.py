"""What a grid refuses, leaves empty, and does not depend on."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.errors import InputError, MeasurementError
from lscan.records import Status, Surface
from lscan.surface import grid_cells


def plain(seed: int = 0, size: float = 30.0) -> Surface:
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, size, (2, 30, 50))
    z = rng.normal(0, 0.1, x.shape) + np.sin(x / 10)
    return Surface(
        xyz_mm=np.stack([x, y, z], axis=-1),
        sigma_x_mm=np.full(x.shape, 0.05),
        sigma_z_mm=np.full(x.shape, 0.1),
        status=np.zeros(x.shape, dtype=np.int64),
        position_mm=np.arange(30.0),
        frame="workpiece",
        modes_mm=rng.normal(0, 0.02, (*x.shape, 3, 2)).astype(np.float32),
    )


@given(st.integers(0, 50), st.integers(-40, 40), st.integers(-40, 40), st.floats(-500, 500))
@examples(25)
def test_whole_cells_of_shift_move_the_grid(seed: int, i: int, j: int, dz: float) -> None:
    one = plain(seed)
    here = grid_cells(one, 3.0)
    there = grid_cells(replace(one, xyz_mm=one.xyz_mm + np.array([3.0 * i, 3.0 * j, dz])), 3.0)
    # A point on a boundary may change its cell by rounding; none of these lies on one.
    np.testing.assert_allclose(there.x_mm, here.x_mm + 3.0 * i, atol=1e-9)
    np.testing.assert_array_equal(there.status, here.status)
    np.testing.assert_allclose(there.z_mm, here.z_mm + dz, atol=1e-7)
    np.testing.assert_allclose(there.sigma_z_mm, here.sigma_z_mm, rtol=1e-6)


@given(st.integers(0, 50))
@examples(20)
def test_the_order_of_the_points_is_of_no_account(seed: int) -> None:
    one = plain(seed)
    assert one.modes_mm is not None
    turned = replace(one, xyz_mm=one.xyz_mm[::-1, ::-1], modes_mm=one.modes_mm[::-1, ::-1])
    here, there = grid_cells(one, 4.0), grid_cells(turned, 4.0)
    np.testing.assert_allclose(there.z_mm, here.z_mm, atol=1e-9)
    np.testing.assert_allclose(there.sigma_z_mm, here.sigma_z_mm, rtol=1e-6)


@given(st.floats(1.0, 5.0), st.integers(0, 20))
@examples(20)
def test_sigma_grows_with_the_points(factor: float, seed: int) -> None:
    one = plain(seed)
    here = grid_cells(one, 4.0)
    there = grid_cells(replace(one, sigma_z_mm=factor * one.sigma_z_mm), 4.0)
    known = np.isfinite(here.sigma_z_mm)
    assert (there.sigma_z_mm[known] >= here.sigma_z_mm[known]).all()


def test_a_number_stands_exactly_where_the_status_says_so() -> None:
    one = plain()
    hole = np.hypot(one.xyz_mm[..., 0] - 15, one.xyz_mm[..., 1] - 15) < 6
    status = np.where(hole, int(Status.NO_PEAK), one.status)
    grid = grid_cells(replace(one, status=status), 3.0)
    assert grid.modes_mm is not None
    for values in (grid.z_mm, grid.sigma_z_mm, grid.modes_mm[..., 0]):
        np.testing.assert_array_equal(np.isfinite(values), grid.status == Status.OK)
    assert set(np.unique(grid.status)) == {Status.OK, Status.NO_DATA}
    xs, ys = np.meshgrid(grid.x_mm, grid.y_mm)
    assert (grid.status[np.hypot(xs - 15, ys - 15) < 3] == Status.NO_DATA).all()


def test_points_on_one_side_of_a_cell_give_it_no_height() -> None:
    one = plain()
    away = np.mod(one.xyz_mm[..., 0], 3.0) > 0.6
    status = np.where(away, int(Status.NO_PEAK), one.status)
    assert (grid_cells(replace(one, status=status), 3.0).status == Status.NO_DATA).all()


@pytest.mark.parametrize("cell", [0.0, -1.0, np.nan, np.inf])
def test_a_cell_without_size_is_refused(cell: float) -> None:
    with pytest.raises(InputError, match="cell_mm"):
        grid_cells(plain(), cell)


def test_what_cannot_be_gridded_is_refused() -> None:
    one = plain()
    with pytest.raises(InputError, match="too many cells"):
        grid_cells(one, 0.001)
    with pytest.raises(InputError, match="bias_mm"):
        grid_cells(one, 3.0, bias_mm=np.zeros(5))
    empty = replace(one, status=np.full_like(one.status, int(Status.NO_PEAK)))
    with pytest.raises(MeasurementError, match="no measured point"):
        grid_cells(empty, 3.0)
