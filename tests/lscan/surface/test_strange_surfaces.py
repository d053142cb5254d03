"""Surface files of strangers: HDF5 that leads elsewhere, explodes or is broken is refused."""

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
from drawn_examples import examples
from hypothesis import given, strategies as st
from peak_memory import refused_within

from lscan.errors import InputError
from lscan.records import Provenance, Status, Surface
from lscan.surface import load_surface, save_surface
from lscan.surface.files import MOST_POINTS

SHAPE = (3, 6)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    ones = np.ones(SHAPE)
    surface = Surface(np.ones((*SHAPE, 3)), ones, ones, np.zeros(SHAPE, int), np.arange(3.0))
    surface = replace(surface, provenance=Provenance("rig", 3, "ml", "refractive", "ab" * 32))
    path = tmp_path_factory.mktemp("surface") / "surface.nc"
    save_surface(path, surface)
    return path


def hidden(path: Path) -> Path:
    """What a stranger wants to have read: a file of numbers beside the surface."""
    secret = path.with_name("secret.h5")
    with h5py.File(secret, "w") as file:
        file["z"] = np.full(SHAPE, 42.0)
    return secret


def external_link(file: h5py.File, secret: Path) -> None:
    file["z"] = h5py.ExternalLink(str(secret), "z")


def soft_link(file: h5py.File, secret: Path) -> None:
    file["z"] = h5py.SoftLink("/z")


def external_storage(file: h5py.File, secret: Path) -> None:
    file.create_dataset("z", SHAPE, float, external=[(str(secret), 0, h5py.h5f.UNLIMITED)])


def virtual(file: h5py.File, secret: Path) -> None:
    layout = h5py.VirtualLayout(SHAPE, float)
    layout[:] = h5py.VirtualSource(str(secret), "z", SHAPE)
    file.create_virtual_dataset("z", layout)


def terabytes(file: h5py.File, secret: Path) -> None:
    """8 TB of nothing: no chunk is stored, and the file stays as small as it was."""
    file.create_dataset("z", (10**6, 10**6), float, chunks=(10, 10), compression="gzip")


def huge_chunk(file: h5py.File, secret: Path) -> None:
    chunks = (2**14, 2**14)
    file.create_dataset("z", SHAPE, float, chunks=chunks, maxshape=(None, None), compression="gzip")


def a_group(file: h5py.File, secret: Path) -> None:
    file.create_group("z")


def of_type(kind: Any, shape: tuple[int, ...] = SHAPE) -> Callable[[h5py.File, Path], None]:
    def make(file: h5py.File, secret: Path) -> None:
        file.create_dataset("z", shape, kind).attrs["units"] = "mm"

    return make


NOT_HERE = "z: is not an array in this file"
NOT_NUMBERS = "z: is not an array of numbers"
ATTACKS: dict[str, tuple[Callable[[h5py.File, Path], None], str]] = {
    "external link": (external_link, NOT_HERE),
    "soft link to itself": (soft_link, NOT_HERE),
    "external storage": (external_storage, NOT_HERE),
    "virtual dataset": (virtual, NOT_HERE),
    "group": (a_group, NOT_HERE),
    "text": (of_type(h5py.string_dtype()), NOT_NUMBERS),
    "references": (of_type(h5py.ref_dtype), NOT_NUMBERS),
    "lists of numbers": (of_type(h5py.vlen_dtype(float)), NOT_NUMBERS),
    "records": (of_type(np.dtype([("a", float)])), NOT_NUMBERS),
    "complex numbers": (of_type(complex), NOT_NUMBERS),
    "one number": (of_type(float, ()), NOT_NUMBERS),
    "cube": (of_type(float, (2, 2, 2)), NOT_NUMBERS),
    "other shape": (of_type(float, (3, 5)), "z: wrong shape"),
    "terabytes": (terabytes, "z: is too large"),
    "huge chunk": (huge_chunk, "z: is too large"),
}


@pytest.mark.parametrize("kind", ATTACKS)
def test_an_array_that_is_none_is_refused(saved: Path, tmp_path: Path, kind: str) -> None:
    attack, message = ATTACKS[kind]
    path = Path(shutil.copy(saved, tmp_path))
    secret = hidden(path)
    with h5py.File(path, "r+") as file:
        del file["z"]
        attack(file, secret)
    with pytest.raises(InputError) as caught:
        load_surface(path)
    assert str(caught.value).startswith(f"{path}: {message}")
    assert "\n" not in str(caught.value)


def test_terabytes_of_nothing_take_no_memory(saved: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(saved, tmp_path))
    with h5py.File(path, "r+") as file:
        del file["z"]
        terabytes(file, path)
    said, most_mib = refused_within(
        "from pathlib import Path\nfrom lscan.surface import load_surface",
        f"load_surface(Path({str(path)!r}))",
    )
    assert f"z: is too large (got (1000000, 1000000); allowed: {MOST_POINTS} numbers" in said
    assert most_mib < 20


@pytest.mark.parametrize("frame", ["moon", 1, [1.0, 2.0], b"moon", ["head", "head"]])
def test_an_attribute_that_is_no_frame_is_refused(saved: Path, tmp_path: Path, frame: Any) -> None:
    path = Path(shutil.copy(saved, tmp_path))
    with h5py.File(path, "r+") as file:
        del file.attrs["frame"]
        file.attrs["frame"] = np.bytes_(frame) if isinstance(frame, bytes) else frame
    with pytest.raises(InputError, match="frame: is none of a surface"):
        load_surface(path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("yaw_deg", "east"),
        ("yaw_deg", 2),
        ("yaw_sigma_deg", np.inf),
        ("pictures", "many"),
        ("rig", 1),
    ],
)
def test_an_attribute_of_another_kind_is_refused(
    saved: Path, tmp_path: Path, name: str, value: Any
) -> None:
    path = Path(shutil.copy(saved, tmp_path))
    with h5py.File(path, "r+") as file:
        file.attrs[name] = value
    with pytest.raises(InputError) as caught:
        load_surface(path)
    assert str(caught.value).startswith(f"{path}: ")
    words = "is no angle" if name.startswith("yaw") else "must be"
    assert f"{name}: {words}" in str(caught.value)


def test_a_status_that_is_none_is_refused(saved: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(saved, tmp_path))
    with h5py.File(path, "r+") as file:
        file["status"][0, 0] = 1 + max(Status)
    with pytest.raises(InputError, match="status: holds what is no status"):
        load_surface(path)


@pytest.mark.parametrize("name", ["x_sigma", "y_sigma", "z_sigma"])
@pytest.mark.parametrize("value", [-1.0, np.nan])
def test_a_point_without_an_uncertainty_is_refused(
    saved: Path, tmp_path: Path, name: str, value: float
) -> None:
    """One without a value has none."""
    path = tmp_path / "surface.nc"
    surface = load_surface(saved)
    save_surface(path, replace(surface, sigma_y_mm=np.ones(SHAPE)))
    with h5py.File(path, "r+") as file:
        file["status"][0, 0] = Status.NO_PEAK
        file[name][0, 0] = value
    assert load_surface(path).status[0, 0] == Status.NO_PEAK
    with h5py.File(path, "r+") as file:
        file[name][1, 2] = value
    with pytest.raises(InputError, match=f"surface.nc: {name}: is no uncertainty at a point"):
        load_surface(path)


def test_a_fifo_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "surface.nc")
    with pytest.raises(InputError, match=r"surface\.nc: cannot be read: it is a FIFO"):
        load_surface(tmp_path / "surface.nc")


def text_places(content: bytes) -> list[int]:
    """Where the file keeps the sizes of its first texts: a heap's header and each object's."""
    begin = content.index(b"GCOL")
    places = [begin + 16]
    for _ in range(3):
        size = int.from_bytes(content[places[-1] + 8 : places[-1] + 16], "little")
        places.append(places[-1] + 16 + -(-size // 8) * 8)
    return places


@pytest.mark.parametrize("number", [0, 1, 2, 3])
@pytest.mark.parametrize("size", [0, 8, 2**32, 2**63, 2**64 - 16, 2**64 - 1])
def test_a_text_whose_size_leads_nowhere_is_refused(
    saved: Path, tmp_path: Path, number: int, size: int
) -> None:
    """HDF5 goes from each text of a heap to the next by its size: some lead it back to itself.

    Free space (number 0) of less than its own header, and a size that, with its header, is 0 in
    64 bits, did so.
    """
    content = bytearray(saved.read_bytes())
    place = text_places(bytes(content))[number]
    content[place + 8 : place + 16] = size.to_bytes(8, "little")
    if size <= 8:
        content[place : place + 2] = bytes(2)
    path = tmp_path / "surface.nc"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"surface\.nc: cannot be read as NetCDF .*damaged texts"):
        load_surface(path)


def test_a_heap_within_a_heap_is_refused(saved: Path, tmp_path: Path) -> None:
    content = bytearray(saved.read_bytes())
    place = text_places(bytes(content))[1] + 16
    content[place : place + 16] = b"GCOL\x01\0\0\0" + (16).to_bytes(8, "little")
    path = tmp_path / "surface.nc"
    path.write_bytes(content)
    with pytest.raises(InputError, match="damaged texts"):
        load_surface(path)


def test_numbers_that_look_like_a_heap_are_read(saved: Path, tmp_path: Path) -> None:
    z = load_surface(saved).xyz_mm.copy()
    z[0, 0, 2] = np.frombuffer(b"GCOL\x01\0\0\0")[0]
    z[0, 1, 2] = np.frombuffer((2**20).to_bytes(8, "little"))[0]
    path = tmp_path / "surface.nc"
    save_surface(path, replace(load_surface(saved), xyz_mm=z))
    assert np.array_equal(load_surface(path).xyz_mm, z)


@pytest.fixture(scope="module")
def classic(saved: Path) -> Path:
    """The same as NetCDF-3."""
    path = saved.with_name("classic.nc")
    with xr.open_dataset(saved, engine="h5netcdf") as data:
        data.to_netcdf(path, engine="scipy")
    return path


@examples(75)
@pytest.mark.parametrize("kind", ["saved", "classic"])
@given(data=st.data())
def test_a_mutated_surface_is_read_or_refused(
    request: pytest.FixtureRequest,
    tmp_path_factory: pytest.TempPathFactory,
    kind: str,
    data: st.DataObject,
) -> None:
    changed = bytearray(request.getfixturevalue(kind).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
    end = data.draw(st.just(len(changed)) | st.integers(0, len(changed)))
    path = tmp_path_factory.getbasetemp() / "mutated.nc"
    path.write_bytes(bytes(changed[:end]))
    try:
        assert load_surface(path).status.shape == SHAPE
    except InputError as error:
        assert path.name in str(error)
        assert "\n" not in str(error)
