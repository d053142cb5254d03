"""Surface files that other programs have rewritten: the same surface, or refused by name.

The forms are those that nccopy 4.9.0, NCO 5.1.4, CDO 2.1.1, GDAL 3.6.2, xarray 2026.9 and iris
3.14.1 left, see the table in docs/reference/files.md; here they are written without them.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
from netcdf_forms import stumbling_blocks

from lscan.errors import InputError
from lscan.files.containers import NetcdfArray, unpack
from lscan.records import Provenance, Status, Surface
from lscan.surface import load_surface, save_surface
from lscan.surface.files import require_storable

F, N = 4, 4
"""As many columns as profiles: a shape does not tell them apart."""


@pytest.fixture(scope="module")
def surface() -> Surface:
    """With all that a file may hold, and one point missing."""
    rng = np.random.default_rng(5)
    status = np.zeros((F, N), dtype=np.int64)
    status[1, 2], status[0, 3] = Status.NO_PEAK, Status.SATURATED
    xyz, sigma = rng.normal(10, 1, (F, N, 3)), rng.uniform(0.01, 0.02, (3, F, N))
    xyz[1, 2] = sigma[:, 1, 2] = np.nan
    return Surface(
        xyz, sigma[0], sigma[2], status, 1.5 * np.arange(F), "workpiece", sigma_y_mm=sigma[1],
        modes_mm=rng.normal(0, 0.01, (F, N, 3, 2)).astype(np.float32),
        corrections=("blur of 0.7 px", "a sheet 1 mm thick"), yaw_rad=0.02, yaw_sigma_rad=0.001,
        provenance=Provenance("rig of Zoë", F, "ml", "refractive", "ab" * 32),
    )  # fmt: skip


@pytest.fixture(scope="module")
def saved(surface: Surface, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("surface") / "surface.nc"
    save_surface(path, surface)
    return path


@pytest.fixture(scope="module")
def loaded(saved: Path) -> xr.Dataset:
    with xr.open_dataset(saved, engine="h5netcdf") as opened:
        return opened.load()


@pytest.fixture
def data(loaded: xr.Dataset) -> xr.Dataset:
    """The file as xarray reads it, to be written again."""
    return loaded.copy(deep=True)


def assert_same(found: Surface, expected: Surface, atol: float = 0.0) -> None:
    for name, value in vars(expected).items():
        other = getattr(found, name)
        if isinstance(value, np.ndarray):
            assert other.dtype == value.dtype
            np.testing.assert_allclose(other, value, rtol=0, atol=atol, err_msg=name)
        elif isinstance(value, float):
            assert other == pytest.approx(value, rel=1e-15)  # of an angle in degrees: rounding
        else:
            assert other == value, name


def test_our_own_file_has_nothing_that_others_stumble_over(saved: Path, surface: Surface) -> None:
    assert stumbling_blocks(saved) == []
    assert_same(load_surface(saved), surface)


def nc_strings(data: xr.Dataset, path: Path) -> None:
    """As lscan 0.1 wrote texts and nccopy copies them: strings, and numbers, as arrays of one."""
    data.attrs["pictures"] = np.int64(data.attrs["pictures"])
    data.to_netcdf(path, engine="h5netcdf")
    with h5py.File(path, "r+") as file:
        for key, value in dict(file.attrs).items():
            if isinstance(value, str):
                del file.attrs[key]
                file.attrs[key] = np.array([value], dtype=h5py.string_dtype())


def lscan_0_1(data: xr.Dataset, path: Path) -> None:
    data.attrs["pictures"] = np.int64(data.attrs["pictures"])
    data["x"].attrs["ancillary_variables"] = "x_sigma status"
    data.to_netcdf(path, engine="h5netcdf")


def netcdf3(data: xr.Dataset, path: Path) -> None:
    data.to_netcdf(path, engine="scipy")


def netcdf3_offsets(data: xr.Dataset, path: Path) -> None:
    data.to_netcdf(path, engine="scipy", format="NETCDF3_64BIT")


def netcdf3_records(data: xr.Dataset, path: Path) -> None:
    """As ``ncks -3 --mk_rec_dmn frame``: profiles are records, their arrays interleaved."""
    data.to_netcdf(path, engine="scipy", unlimited_dims="frame")


def iris(data: xr.Dataset, path: Path) -> None:
    names = dict(
        zip(("frame", "column", "axis", "mode"), ("dim0", "dim1", "dim2", "dim3"), strict=True)
    )
    data.rename_dims(names).to_netcdf(path, engine="h5netcdf")


def transposed(data: xr.Dataset, path: Path) -> None:
    """As ``ncpdq -a column,frame`` and more."""
    data.transpose("mode", "axis", "column", "frame").to_netcdf(path, engine="h5netcdf")


def iris_transposed(data: xr.Dataset, path: Path) -> None:
    """``cube.transpose()`` turns the array and leaves its coordinates."""
    turned = [name for name in data.data_vars if data[name].ndim == 2]
    iris(data.assign({name: data[name].T for name in turned}), path)


def position_as_dimension(data: xr.Dataset, path: Path) -> None:
    data.swap_dims(frame="position").to_netcdf(path, engine="h5netcdf")


def big_endian(data: xr.Dataset, path: Path) -> None:
    encoding = {name: {"dtype": ">f8"} for name in ("x", "y", "z", "position")}
    data.to_netcdf(path, engine="h5netcdf", encoding=encoding)


EXACT = [
    nc_strings, lscan_0_1, netcdf3, netcdf3_offsets, netcdf3_records, iris, transposed,
    iris_transposed, position_as_dimension, big_endian,
]  # fmt: skip


@pytest.mark.parametrize("form", EXACT, ids=lambda form: form.__name__)
def test_a_form_that_another_program_leaves_is_the_same_surface(
    data: xr.Dataset, surface: Surface, tmp_path: Path, form: Callable[[xr.Dataset, Path], None]
) -> None:
    form(data, tmp_path / "other.nc")
    assert_same(load_surface(tmp_path / "other.nc"), surface)


STEP = 1e-5
PACKED: dict[str, dict[str, Any]] = {
    "int32": {"dtype": "int32", "add_offset": 3.0, "_FillValue": -(2**31) + 1},
    "unsigned": {"dtype": "uint32", "_FillValue": 2**32 - 1},
    "unsigned in NetCDF-3": {"dtype": "int32", "_Unsigned": "true", "_FillValue": -1},
}


@pytest.mark.parametrize("form", PACKED)
def test_packed_numbers_are_unpacked(
    data: xr.Dataset, surface: Surface, tmp_path: Path, form: str
) -> None:
    """Packing rounds to the nearest step, so half a step is lost, and the rounding of float32."""
    names = [name for name in data.variables if data[name].dtype == float]
    packing = {name: {"scale_factor": STEP, **PACKED[form]} for name in names}
    engine = "scipy" if "NetCDF-3" in form else "h5netcdf"
    data.to_netcdf(tmp_path / "packed.nc", engine=engine, encoding=packing)
    assert_same(load_surface(tmp_path / "packed.nc"), surface, atol=0.5001 * STEP)


@pytest.mark.parametrize("unit", ["m", "cm", "micrometers"])
def test_lengths_in_another_unit_are_lengths_in_mm(
    data: xr.Dataset, surface: Surface, tmp_path: Path, unit: str
) -> None:
    """Heights and their uncertainties, and what is displaced; float32 keeps 24 bits."""
    per_mm = {"m": 1e-3, "cm": 0.1, "micrometers": 1000.0}[unit]
    for name in ("z", "z_sigma", "position", "modes"):
        attributes = data[name].attrs | {"units": unit}
        data[name] = (data[name] * per_mm).assign_attrs(attributes)
    data.to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    assert_same(load_surface(tmp_path / "other.nc"), surface, atol=0.05 * 2.0**-23)


def test_a_point_that_was_masked_has_no_data(
    data: xr.Dataset, surface: Surface, tmp_path: Path
) -> None:
    data["z"][0, 0] = np.nan
    data["y"].attrs["valid_max"] = float(data["y"][2:].max()) - 1e-9
    data.to_netcdf(tmp_path / "other.nc", engine="h5netcdf")
    status = load_surface(tmp_path / "other.nc").status
    masked = surface.xyz_mm[..., 1] > data["y"].attrs["valid_max"]
    masked[0, 0] = True
    assert masked.sum() >= 2
    np.testing.assert_array_equal(status, np.where(masked, Status.NO_DATA, surface.status))


def _unknown_mode(data: xr.Dataset) -> xr.Dataset:
    data["modes"][0, 0, 0, 0] = np.nan
    return data


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (lambda data: data.isel(mode=slice(0, 1)), "modes: are not those whose size sigma_cal"),
        (lambda data: data.isel(mode=slice(0, 0)), "modes: "),
        (lambda data: data.assign(modes=0 * data["modes"]), "modes: are not those"),
        (_unknown_mode, "modes: are not known at a point"),
        (lambda data: data.assign(z_sigma=np.inf * data["z_sigma"]), "z_sigma: is infinite"),
    ],
)
def test_what_points_share_is_whole_or_refused(
    data: xr.Dataset, tmp_path: Path, harm: Callable[[xr.Dataset], xr.Dataset], said: str
) -> None:
    """Without a mode heights that it moves together would average as if they erred alone."""
    attributes = {name: dict(data[name].attrs) for name in data.variables}
    harmed = harm(data)
    for name, notes in attributes.items():
        harmed[name].attrs.update(notes)
    harmed.to_netcdf(tmp_path / "harmed.nc", engine="h5netcdf")
    with pytest.raises(InputError, match=said):
        load_surface(tmp_path / "harmed.nc")


def test_a_surface_that_this_program_has_open_is_read(saved: Path, surface: Surface) -> None:
    """As in a notebook: HDF5 refuses to open one file in two ways."""
    with h5py.File(saved, "r"):
        assert_same(load_surface(saved), surface)


def attribute(name: str, key: str, value: Any) -> Callable[[xr.Dataset], xr.Dataset]:
    return lambda data: data.assign({name: data[name].assign_attrs({key: value})})


REFUSED: dict[str, tuple[Callable[[xr.Dataset], xr.Dataset], str]] = {
    "unit unknown": (attribute("z", "units", "furlong"), "z: units: is no unit of length"),
    "unit of an angle": (attribute("position", "units", "degree"), "position: units: is no unit"),
    "unit lost": (lambda data: data.assign(z=data["z"].drop_attrs()), "z: units: is no unit"),
    "depth": (attribute("z", "positive", "down"), "z: positive: of another quantity"),
    "ncra": (attribute("x", "cell_methods", "frame: mean"), "x: cell_methods: of another quantity"),
    "other codes": (
        attribute("status", "flag_values", np.arange(10, dtype=np.int8)[::-1]),
        "status: flag_meanings: are other ones",
    ),
    "modes lost": (lambda data: data.drop_vars("modes"), "modes: are lost"),
    "cdo": (lambda data: data.drop_vars(["x", "y", "position"]), "is not a surface of lscan"),
    "profile without position": (
        lambda data: data.assign_coords(position=data["position"].where(data["position"] > 0)),
        "position: is not known",
    ),
    "averaged codes": (lambda data: data.assign(status=data["status"] + 0.5), "status: holds what"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_numbers_that_mean_something_else_are_refused_by_name(
    data: xr.Dataset, tmp_path: Path, kind: str
) -> None:
    change, message = REFUSED[kind]
    path = tmp_path / "other.nc"
    change(data).to_netcdf(path, engine="scipy")
    with pytest.raises(InputError) as caught:
        load_surface(path)
    assert str(caught.value).startswith(f"{path}: {message}")
    assert "\n" not in str(caught.value)


I2 = np.array([-32767, -1, 100, 200], dtype=np.int16)
NAN = np.nan
UNPACKED: list[tuple[np.ndarray, dict[str, Any], list[float]]] = [
    (I2, {}, [NAN, -1, 100, 200]),  # nothing was written there: the default of NetCDF
    (I2, {"_FillValue": np.int16(100)}, [-32767, -1, NAN, 200]),
    (I2, {"missing_value": np.array([100, 200], np.int16)}, [NAN, -1, NAN, NAN]),
    (I2, {"scale_factor": 0.5, "add_offset": 1.0}, [NAN, 0.5, 51, 101]),
    (I2, {"scale_factor": [0.5], "valid_min": np.int16(0)}, [NAN, NAN, 50, 100]),
    (I2, {"scale_factor": 0.5, "valid_max": 60.0}, [NAN, -0.5, 50, NAN]),  # of what is meant
    (I2, {"valid_range": np.array([-1, 100], np.int16)}, [NAN, -1, 100, NAN]),
    (I2, {"_Unsigned": b"true", "_FillValue": np.int16(-1)}, [32769, NAN, 100, 200]),
    (np.array([1, 2, 9.969209968386869e36]), {}, [1, 2, NAN]),
    (np.array([1, 2, -999.9], ">f4"), {"missing_value": -999.9}, [1, 2, NAN]),
    (np.array([200, 255], np.uint8), {"valid_max": np.uint8(254), "scale_factor": 0.1}, [20, NAN]),
]


@pytest.mark.parametrize("number", range(len(UNPACKED)))
def test_what_numbers_mean_is_what_their_attributes_say(number: int) -> None:
    stored, attributes, meant = UNPACKED[number]
    found = unpack(NetcdfArray((), stored, attributes), "z")
    np.testing.assert_allclose(found, meant, rtol=1e-15)
    assert found.dtype.isnative


@pytest.mark.parametrize(
    "attributes",
    [
        {"_FillValue": np.nan},  # as ncpdq packs an array whose missing points are NaN
        {"scale_factor": "0.1"},
        {"scale_factor": 0.0},
        {"add_offset": np.inf},
        {"valid_range": np.arange(3)},
        {"missing_value": np.arange(2**10)},
    ],
)
def test_an_attribute_that_cannot_be_followed_is_refused(attributes: dict[str, Any]) -> None:
    (name,) = attributes
    with pytest.raises(InputError, match=f"^z: .*{name}"):
        unpack(NetcdfArray((), I2, attributes), "z")


FOUR_FRAMES = b"\0\0\0\x05frame\0\0\0\0\0\0\x04"
HUGE = FOUR_FRAMES[:-4] + (2**31 - 1).to_bytes(4, "big")


def test_netcdf_3_that_is_not_read_or_is_damaged_is_refused_in_one_line(
    data: xr.Dataset, tmp_path: Path
) -> None:
    path = tmp_path / "other.nc"
    netcdf3(data, path)
    whole = path.read_bytes()
    for content, message in (
        (b"CDF\x05" + whole[4:], "CDF-5.*nccopy -k nc4"),
        (whole[:-1000], "cannot be read as NetCDF"),
        (whole[:100], "cannot be read as NetCDF"),
        (b"CDF", "cannot be read as NetCDF"),
        (whole.replace(FOUR_FRAMES, HUGE), "cannot be read as NetCDF"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=rf"other\.nc: .*{message}") as caught:
            load_surface(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("shape", "modes", "message"),
    [
        ((2**13, 2**12 + 1), 0, "the surface has too many points for a file"),
        ((2**10, 2**10), 2**7, "modes: are too many for a file"),
    ],
)
def test_a_surface_larger_than_its_readers_accept_is_not_written(
    tmp_path: Path, shape: tuple[int, int], modes: int, message: str
) -> None:
    """A view of one number, which takes no memory."""
    zeros, codes = np.broadcast_to(0.0, shape), np.broadcast_to(0, shape)
    displaced = np.broadcast_to(np.float32(0), (*shape, 3, modes)) if modes else None
    points = np.broadcast_to(0.0, (*shape, 3))
    large = Surface(points, zeros, zeros, codes, np.zeros(shape[0]), modes_mm=displaced)
    with pytest.raises(InputError, match=message):
        save_surface(tmp_path / "surface.nc", large)
    assert list(tmp_path.iterdir()) == []
    require_storable(tmp_path, 2**13, 2**12)
