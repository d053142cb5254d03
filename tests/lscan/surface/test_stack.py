"""Stacking profiles, and the files of a surface."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import xarray as xr

from lscan.errors import InputError
from lscan.records import PlanePoints, Profile, Status, Surface, has_value
from lscan.surface import load_surface, save_points, save_surface, stack


def profile(position_mm: float, count: int = 6, missing: int = 2) -> Profile:
    x = np.arange(count, dtype=float)
    xz = np.column_stack([x, 10 * x + position_mm])
    sigma = np.column_stack([np.full(count, 0.01), np.full(count, 0.02)])
    status = np.full(count, int(Status.OK))
    status[missing] = Status.NO_PEAK
    xz[missing], sigma[missing] = np.nan, np.nan
    return Profile(position_mm, PlanePoints(xz, sigma, status), np.full(count, 100.0))


@pytest.fixture
def surface() -> Surface:
    return stack([profile(s) for s in (3.0, 3.5, 4.5)])


def test_stack_puts_each_value_where_it_belongs(surface: Surface) -> None:
    assert surface.frame == "head"
    assert surface.xyz_mm.shape == (3, 6, 3)
    np.testing.assert_array_equal(surface.position_mm, [3.0, 3.5, 4.5])
    np.testing.assert_array_equal(surface.xyz_mm[1, 4], [4.0, 3.5, 43.5])
    assert surface.sigma_x_mm[0, 0] == 0.01
    assert surface.sigma_z_mm[0, 0] == 0.02


def test_points_without_value_keep_their_status_and_hold_no_number(surface: Surface) -> None:
    assert (surface.status[:, 2] == Status.NO_PEAK).all()
    assert np.isnan(surface.xyz_mm[:, 2]).all()
    np.testing.assert_array_equal(has_value(surface.status), np.isfinite(surface.xyz_mm[..., 1]))


def with_modes(one: Profile, count: int = 2) -> Profile:
    modes = np.arange(len(one.brightness) * 2 * count, dtype=float).reshape(-1, 2, count)
    modes[np.isnan(one.points.xz_mm[:, 0])] = np.nan
    return replace(one, points=replace(one.points, modes_mm=modes))


def test_stack_carries_modes_on_with_nothing_along_the_track() -> None:
    profiles = [with_modes(profile(s)) for s in (0.0, 1.0)]
    modes = stack(profiles).modes_mm
    assert modes is not None
    assert modes.shape == (2, 6, 3, 2)
    assert modes.dtype == np.float32
    np.testing.assert_array_equal(modes[1][:, [0, 2]], profiles[1].points.modes_mm)
    np.testing.assert_array_equal(modes[0, [0, 1, 3, 4, 5], 1], 0.0)
    assert np.isnan(modes[:, 2]).all()
    assert stack([profiles[0], profile(1.0)]).modes_mm is None
    with pytest.raises(InputError, match="number of modes"):
        stack([profiles[0], with_modes(profile(1.0), count=3)])


def test_netcdf_keeps_the_modes_and_states_the_common_part_of_sigma(tmp_path: Path) -> None:
    surface = stack([with_modes(profile(s)) for s in (0.0, 1.0)])
    save_surface(tmp_path / "surface.nc", surface)
    with xr.open_dataset(tmp_path / "surface.nc", engine="h5netcdf") as data:
        assert "sigma_calibration" in data["z"].attrs["ancillary_variables"].split()
        common = data["sigma_calibration"]
        assert common.attrs["units"] == "mm"
        # Point 1 has the modes (6, 7) of z in both profiles: their root of squares.
        np.testing.assert_allclose(common[:, 1], np.hypot(6.0, 7.0))
        np.testing.assert_array_equal(np.isnan(common), np.isnan(data["z"]))
    again = load_surface(tmp_path / "surface.nc")
    assert_same(again, surface)
    np.testing.assert_array_equal(again.modes_mm, surface.modes_mm)


def test_netcdf_keeps_what_was_corrected_for(surface: Surface, tmp_path: Path) -> None:
    for done in ((), ("blur of 0.7 px", "sheet thickness of 1.5 mm")):
        save_surface(tmp_path / "surface.nc", replace(surface, corrections=done))
        assert load_surface(tmp_path / "surface.nc").corrections == done


@pytest.mark.parametrize(
    ("profiles", "words"),
    [
        ([], "no profiles"),
        ([profile(0.0), profile(1.0, count=7)], "differ in length"),
        ([profile(0.0), profile(float("nan"))], "profile 1"),
    ],
)
def test_stack_refuses(profiles: list[Profile], words: str) -> None:
    with pytest.raises(InputError, match=words):
        stack(profiles)


def assert_same(one: Surface, other: Surface) -> None:
    for name in ("xyz_mm", "sigma_x_mm", "sigma_z_mm", "status", "position_mm"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert one.frame == other.frame


def test_netcdf_round_trip_is_exact(surface: Surface, tmp_path: Path) -> None:
    save_surface(tmp_path / "surface.nc", surface)
    assert_same(load_surface(tmp_path / "surface.nc"), surface)
    assert [entry.name for entry in tmp_path.iterdir()] == ["surface.nc"]


def test_netcdf_says_units_uncertainty_and_status(surface: Surface, tmp_path: Path) -> None:
    save_surface(tmp_path / "surface.nc", surface)
    with xr.open_dataset(tmp_path / "surface.nc", engine="h5netcdf") as data:
        assert data.attrs["Conventions"].startswith("CF-")
        assert data["z"].attrs["units"] == "mm"
        for name in data["z"].attrs["ancillary_variables"].split():
            assert data[name].dims == data["z"].dims
        meanings = data["status"].attrs["flag_meanings"].split()
        values = [int(value) for value in data["status"].attrs["flag_values"]]
        assert dict(zip(meanings, values, strict=True))["no_peak"] == Status.NO_PEAK


def test_files_of_the_same_surface_are_the_same_bytes(surface: Surface, tmp_path: Path) -> None:
    modes = np.ones((*surface.status.shape, 3, 2), dtype=np.float32)
    for name in ("first", "second"):
        save_surface(tmp_path / f"{name}.nc", replace(surface, modes_mm=modes))
        save_points(tmp_path / f"{name}.ply", surface)
        time.sleep(1.1)  # a time stamp inside a file would show
    for kind in ("nc", "ply"):
        first, second = (tmp_path / f"{name}.{kind}" for name in ("first", "second"))
        assert first.read_bytes() == second.read_bytes()


def test_ply_holds_every_point_that_has_a_value(surface: Surface, tmp_path: Path) -> None:
    save_points(tmp_path / "points.ply", surface)
    points = np.asarray(trimesh.load(tmp_path / "points.ply").vertices)
    np.testing.assert_allclose(points, surface.xyz_mm[has_value(surface.status)], rtol=1e-6)
    assert b"property float sigma_mm" in (tmp_path / "points.ply").read_bytes()[:400]


def test_what_is_not_a_surface_file_is_refused(surface: Surface, tmp_path: Path) -> None:
    (tmp_path / "noise.nc").write_bytes(b"no such thing")
    with pytest.raises(InputError, match=r"noise\.nc"):
        load_surface(tmp_path / "noise.nc")
    with pytest.raises(InputError, match=r"absent\.nc"):
        load_surface(tmp_path / "absent.nc")
    xr.Dataset({"z": ("frame", [1.0])}).to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    with pytest.raises(InputError, match="is not a surface"):
        load_surface(tmp_path / "other.nc")
    with pytest.raises(InputError, match="cannot be written"):
        save_surface(tmp_path / "no folder" / "surface.nc", surface)
