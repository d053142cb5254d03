"""Grids for other programs, as these read them: the right way up, in the right place."""

import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from PIL.TiffImagePlugin import ImageFileDirectory_v2
from typer.testing import CliRunner

from lscan.cli.app import app
from lscan.errors import InputError, MeasurementError
from lscan.records import Floats, Status, Surface
from lscan.surface import fitting_cell_mm, grid_cells, save_grid, save_surface
from lscan.surface.grid import HeightGrid

CELL_MM = 2.0
HOLE = (-20.0, 15.0)  # x and y of the middle, mm
TAGS = {"scale": 33550, "tie": 33922, "keys": 34735, "names": 42112, "nothing": 42113}


def height(x: Floats, y: Floats) -> Floats:
    """A plane, so that a grid holds it exactly, with another slope along each axis."""
    return np.asarray(12.0 + 0.1 * x - 0.03 * y)


def scanned() -> Surface:
    """A quarter of a mm apart along x, half a mm along y, with a hole, and modes."""
    x, y = np.meshgrid(np.arange(-40.0, 30.0, 0.25), np.arange(3.0, 45.0, 0.5))
    hole = np.hypot(x - HOLE[0], y - HOLE[1]) < 6
    status = np.where(hole, int(Status.NO_PEAK), int(Status.OK))
    xyz = np.stack([x, y, height(x, y)], axis=-1)
    xyz[hole] = np.nan
    sigma = np.full(x.shape, 0.05)
    modes = np.zeros((*x.shape, 3, 1), np.float32)
    modes[..., 2, 0] = 0.01
    return Surface(xyz, sigma, sigma, status, y[:, 0], modes_mm=modes, corrections=("blur",))


SURFACE = scanned()


@pytest.fixture(scope="module")
def grid() -> HeightGrid:
    return grid_cells(SURFACE, CELL_MM)


def test_netcdf_is_a_grid_with_axes_of_its_own(tmp_path: Path, grid: HeightGrid) -> None:
    assert save_grid(tmp_path / "grid.nc", grid, SURFACE) == [tmp_path / "grid.nc"]
    with xr.open_dataset(tmp_path / "grid.nc", engine="h5netcdf") as read:
        assert read.z.dims == ("y", "x")
        np.testing.assert_allclose(np.diff(read.x), CELL_MM)
        here = read.z.sel(x=11.0, y=31.0).item()
        assert here == pytest.approx(height(11.0, 31.0), abs=1e-9)
        assert np.isnan(read.z.sel(x=HOLE[0], y=HOLE[1], method="nearest"))
        assert read.x.attrs["axis"] == "X" and read.z.attrs["units"] == "mm"
        known = np.isfinite(read.z.values)
        # 32 points of .05 mm each; calibration's part does not average out.
        assert read.z_sigma.values[known].min() > 0.01
        np.testing.assert_allclose(read.sigma_calibration.values[known], 0.01, rtol=1e-6)
        assert read.points.sum() == np.count_nonzero(SURFACE.status == Status.OK)
        assert read.attrs["frame"] == "head" and read.attrs["corrections"] == "blur"


def test_geotiff_lies_where_it_is_and_north_is_up(tmp_path: Path, grid: HeightGrid) -> None:
    save_grid(tmp_path / "grid.tif", grid, SURFACE)
    with (tmp_path / "grid.tif").open("rb") as file:
        directory = ImageFileDirectory_v2(file.read(8))
        directory.load(file)
    tags = {name: directory[tag] for name, tag in TAGS.items()}
    columns, rows, begins = directory[256], directory[257], directory[273]
    assert tags["scale"][:2] == (CELL_MM, CELL_MM)
    assert tags["tie"] == (0, 0, 0, grid.x_mm[0] - 1.0, grid.y_mm[-1] + 1.0, 0)
    assert tags["keys"][:4] == (1, 1, 1, 3) and tags["keys"][8:12] == (1025, 0, 1, 1)
    assert tags["nothing"] == "nan"
    for name in ("height z, mm", "standard uncertainty of z, mm", "points of the cell"):
        assert name in tags["names"]
    data = (tmp_path / "grid.tif").read_bytes()
    assert len(data) == begins[-1] + 8 * rows * columns
    bands = [np.frombuffer(data, "<f8", rows * columns, at).reshape(rows, columns) for at in begins]
    np.testing.assert_array_equal(bands[0][::-1], grid.z_mm)
    np.testing.assert_array_equal(bands[1][::-1], grid.sigma_z_mm)
    np.testing.assert_array_equal(bands[2][::-1], grid.points)
    column, row = (11.0 - tags["tie"][3]) / CELL_MM, (tags["tie"][4] - 31.0) / CELL_MM
    assert bands[0][int(row), int(column)] == pytest.approx(height(11.0, 31.0), abs=1e-9)


def test_ascii_grids_hold_heights_and_their_uncertainties(tmp_path: Path, grid: HeightGrid) -> None:
    files = save_grid(tmp_path / "grid.asc", grid, SURFACE)
    assert [file.name for file in files] == ["grid.asc", "grid-sigma.asc"]
    for file, expected in zip(files, (grid.z_mm, grid.sigma_z_mm), strict=True):
        lines = file.read_text().splitlines()
        head = {name: float(value) for name, value in map(str.split, lines[:6])}
        assert head == {
            "ncols": len(grid.x_mm), "nrows": len(grid.y_mm), "cellsize": CELL_MM,
            "xllcorner": grid.x_mm[0] - 1, "yllcorner": grid.y_mm[0] - 1, "NODATA_value": -9999,
        }  # fmt: skip
        values = np.array([[float(value) for value in line.split()] for line in lines[6:]])
        values[values == -9999] = np.nan
        np.testing.assert_allclose(values[::-1], expected, atol=5.1e-7)


def test_a_fitting_cell_is_the_least_that_few_lack_points_of() -> None:
    assert fitting_cell_mm(SURFACE) == 2.0  # 8 points in a cell of 1 mm, 9 are asked for
    sparse = Surface(
        SURFACE.xyz_mm[:1, :5], SURFACE.sigma_x_mm[:1, :5], SURFACE.sigma_z_mm[:1, :5],
        SURFACE.status[:1, :5], SURFACE.position_mm[:1],
    )  # fmt: skip
    with pytest.raises(MeasurementError, match="too few points for a grid: 5"):
        fitting_cell_mm(sparse)


def test_the_command_writes_and_refuses(tmp_path: Path) -> None:
    surface = tmp_path / "surface.nc"
    save_surface(surface, SURFACE)
    invoke = CliRunner().invoke
    done = invoke(app, ["grid", str(surface), "-o", str(tmp_path / "grid.tif")])
    assert "35 x 22 cells of 2 mm" in done.output and (tmp_path / "grid.tif").exists()
    for options, words in (
        (["-o", str(tmp_path / "grid.png")], r"no such kind.*\.nc, \.tif"),
        (["-o", str(tmp_path / "grid.nc"), "--cell", "0"], "not a size"),
        (["-o", str(tmp_path / "grid.nc"), "--cell", "0.001"], "too many cells"),
    ):
        refused = invoke(app, ["grid", str(surface), *options])
        assert isinstance(refused.exception, InputError)
        assert re.search(words, str(refused.exception))
    assert not (tmp_path / "grid.nc").exists()
