"""Grids for other programs, as these read them: the right way up, in the right place."""

import hashlib
import re
import struct
import zipfile
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import x3pio
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
        for name, values in {"x": read.x, "y": read.y}.items():  # no longitude, nor latitude
            assert values.attrs["axis"] == name.upper()
            assert values.attrs["standard_name"] == f"projection_{name}_coordinate"
        assert read.z.attrs["units"] == "mm"
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


X3P = "{http://www.opengps.eu/2008/ISO5436_2}ISO5436_2"


def x3p_read(path: Path) -> tuple[dict[str, str], Floats]:
    """Values of main.xml by their places, and the matrix, after ISO 25178-72 alone."""
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        main, sums = archive.read("main.xml"), archive.read("md5checksum.hex").decode()
        assert sums == f"{hashlib.md5(main).hexdigest()} *main.xml\n"
        root = ElementTree.fromstring(main)
        assert root.tag == X3P
        assert [record.tag for record in root] == ["Record1", "Record3", "Record4"]
        values = {
            f"{parent.tag}.{child.tag}": (child.text or "").strip()
            for parent in root.iter()
            for child in parent
        }
        data = archive.read(values["DataLink.PointDataLink"])
    assert hashlib.md5(data).hexdigest() == values["DataLink.MD5ChecksumPointData"].lower()
    assert values["MatrixDimension.SizeZ"] == "1" and values["CZ.DataType"] == "D"
    assert values["CX.AxisType"] == values["CY.AxisType"] == "I" and values["CZ.AxisType"] == "A"
    size = (int(values["MatrixDimension.SizeY"]), int(values["MatrixDimension.SizeX"]))
    matrix = np.frombuffer(data, "<f8").reshape(size)  # x fastest
    return values, matrix * float(values["CZ.Increment"]) + float(values["CZ.Offset"])


def test_x3p_holds_metres_with_y_upwards(tmp_path: Path, grid: HeightGrid) -> None:
    files = save_grid(tmp_path / "grid.x3p", grid, SURFACE)
    assert [file.name for file in files] == ["grid.x3p", "grid-sigma.x3p"]
    for file, expected in zip(files, (grid.z_mm, grid.sigma_z_mm), strict=True):
        values, heights = x3p_read(file)
        np.testing.assert_array_equal(heights, expected / 1000)  # a missing one is NaN in both
        assert np.isnan(heights).any()
        assert values["CX.Increment"] == values["CY.Increment"] == "0.002"
        assert float(values["CX.Offset"]) == grid.x_mm[0] / 1000
        assert float(values["CY.Offset"]) == grid.y_mm[0] / 1000
        # x3pio 2.0.0 compares the checksums too.
        read = x3pio.read(file)
        np.testing.assert_array_equal(read.layers[0].z, expected / 1000)
        np.testing.assert_allclose(
            read.placement.offset, [grid.x_mm[0] / 1000, grid.y_mm[0] / 1000, 0], atol=1e-15
        )
    before = files[0].read_bytes()
    save_grid(tmp_path / "grid.x3p", grid, SURFACE)
    assert files[0].read_bytes() == before


SDF = "<8s10s12s12sHHddddBBB"


def sdf_read(path: Path) -> tuple[float, Floats]:
    """Side of the cells and heights, m, after ISO 25178-71 alone."""
    content = path.read_bytes()
    magic, _, made, changed, columns, rows, *rest = struct.unpack_from(SDF, content)
    x, y, z, resolution, compression, kind, check = rest
    assert magic == b"bISO-1.0" and made == changed == b"0" * 12
    assert x == y and resolution < 0
    assert (compression, kind, check) == (0, 6, 0)  # 32 bits with a sign, neither packed nor summed
    steps = np.frombuffer(content, "<i4", offset=struct.calcsize(SDF)).reshape(rows, columns)
    return x, np.where(steps == -(2**31), np.nan, steps * z)


def test_sdf_holds_nanometres_with_y_upwards(tmp_path: Path, grid: HeightGrid) -> None:
    files = save_grid(tmp_path / "grid.sdf", grid, SURFACE)
    assert [file.name for file in files] == ["grid.sdf", "grid-sigma.sdf"]
    for file, expected in zip(files, (grid.z_mm, grid.sigma_z_mm), strict=True):
        cell, heights = sdf_read(file)
        assert cell == CELL_MM / 1000
        np.testing.assert_allclose(heights, expected / 1000, rtol=0, atol=0.5001e-9)
        np.testing.assert_array_equal(np.isnan(heights), np.isnan(expected))


def test_heights_beyond_2_m_make_the_steps_of_sdf_coarser(tmp_path: Path, grid: HeightGrid) -> None:
    deep = replace(grid, z_mm=grid.z_mm - 2500.0)
    _, heights = sdf_read(save_grid(tmp_path / "deep.sdf", deep, SURFACE)[0])
    np.testing.assert_allclose(heights, deep.z_mm / 1000, rtol=0, atol=0.5001e-8)


def test_a_grid_that_sdf_cannot_count_is_refused(tmp_path: Path, grid: HeightGrid) -> None:
    long = np.zeros((1, 2**16))
    wide = HeightGrid(np.arange(2.0**16), np.zeros(1), 1.0, long, long, long.astype(int), long)
    with pytest.raises(InputError, match=r"65536 x 1.*65535"):
        save_grid(tmp_path / "grid.sdf", wide, SURFACE)
    assert list(tmp_path.iterdir()) == []


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
        (["-o", str(tmp_path / "grid.png")], r"no such kind.*\.nc, \.tif.*\.x3p, \.sdf"),
        (["-o", str(tmp_path / "grid.nc"), "--cell", "0"], "not a size"),
        (["-o", str(tmp_path / "grid.nc"), "--cell", "0.001"], "too many cells"),
    ):
        refused = invoke(app, ["grid", str(surface), *options])
        assert isinstance(refused.exception, InputError)
        assert re.search(words, str(refused.exception))
    assert not (tmp_path / "grid.nc").exists()
