"""Containers of strangers: data sets, suites and surfaces in tar, HDF5, zip, NPZ and folders.

No link is followed out of the folder that was asked for, no FIFO waited for, and memory is not
taken for what is only declared.  What is wrong with any single file is in
tests/system/test_strange_files.py.
"""

import io
import json
import os
import shutil
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import strange
import suite_cases
from png_files import grey_png
from strange import moved_elsewhere, refusal

from lscan.files import datasets
from lscan.files.datasets import MEMBERS, PictureDataset
from lscan.files.pictures import encode_picture
from lscan.records import Provenance, Status, Surface
from lscan.suites import open_suite, pack_suite, verify_suite
from lscan.suites.content import MANIFEST, manifest_bytes, member_sum
from lscan.surface import load_surface, save_surface

KEY = "000000000"
SHARDS = {"webdataset": "shard-000000.tar", "hdf5": "shard-000000.h5", "folders": "shard-000000"}
Harm = Callable[[Path, Path], None]
"""What harms a copy of what is whole: its path, and that of a FIFO outside."""


pytestmark = pytest.mark.usefixtures("little_memory_and_time")
little_memory_and_time = strange.little_memory_and_time


# ---- data sets ------------------------------------------------------------------------------


def members() -> dict[str, bytes]:
    """The files of one picture, 4 by 3 px."""
    picture = np.full((3, 4, 3), 9, np.uint8)
    truth = io.BytesIO()
    np.savez(truth, depth_mm=np.ones((3, 4), np.float32))
    found = (
        encode_picture(picture, ".png"),
        encode_picture(picture[..., 0], ".png"),
        truth.getvalue(),
        b"{}",
    )
    return dict(zip(MEMBERS, found, strict=True))


def dataset(folder: Path, form: str, **changed: bytes) -> Path:
    """A data set of one picture, some of whose files are others; its shard."""
    shard = folder / SHARDS[form]
    files = {f"{KEY}.{name}": data for name, data in (members() | changed).items()}
    if form == "webdataset":
        with tarfile.open(shard, "w", format=tarfile.USTAR_FORMAT) as tar:
            for name, data in files.items():
                info = tarfile.TarInfo(name)
                info.size = len(data)
                tar.addfile(info, io.BytesIO(data))
    elif form == "hdf5":
        with h5py.File(shard, "w") as file:
            for name, data in files.items():
                file[name.replace(".", "/", 1)] = np.frombuffer(data, np.uint8)
    else:
        shard.mkdir()
        for name, data in files.items():
            (shard / name).write_bytes(data)
    entry = {"file": shard.name, "sha256": "0" * 64, "keys": [KEY]}
    manifest = {"version": 1, "shards": [entry]}
    (folder / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
    return shard


def read_whole(folder: Path) -> None:
    picture = PictureDataset(folder)[0]
    assert picture.picture.shape == (3, 4, 3)
    assert picture.labels.shape == (3, 4)
    assert picture.truth["depth_mm"].tolist() == np.ones((3, 4)).tolist()
    assert picture.scene == {}


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    """A FIFO that nobody writes to, beside the folder that is read."""
    (tmp_path / "set").mkdir()
    os.mkfifo(tmp_path / "outside")
    return tmp_path / "outside"


@pytest.mark.parametrize("form", SHARDS)
def test_what_is_whole_is_read(outside: Path, form: str) -> None:
    """And what the reader of a stranger's archive must put up with: times, and folders in it."""
    dataset(outside.parent / "set", form)
    read_whole(outside.parent / "set")


def test_a_truth_may_be_larger_than_a_picture_s_file(
    outside: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a picture of 8 Mpx lscan writes more than pictures may have: 24 bytes a pixel."""
    monkeypatch.setattr(datasets, "MOST_BYTES", len(members()["picture.png"]))
    dataset(outside.parent / "set", "webdataset")
    read_whole(outside.parent / "set")


def test_a_tar_file_of_other_programs_is_read(outside: Path) -> None:
    """With pax headers, as GNU tar and bsdtar write for times to a nanosecond, and a folder."""
    shard = dataset(outside.parent / "set", "webdataset")
    with tarfile.open(shard, "w", format=tarfile.PAX_FORMAT) as tar:
        folder = tarfile.TarInfo("folder")
        folder.type = tarfile.DIRTYPE
        tar.addfile(folder)
        for name, data in members().items():
            info = tarfile.TarInfo(f"{KEY}.{name}")
            info.size, info.mtime = len(data), 1.5
            tar.addfile(info, io.BytesIO(data))
    read_whole(shard.parent)


def tar_member(kind: bytes, **fields: Any) -> Harm:
    """The first file of the picture is something else."""

    def harm(shard: Path, outside: Path) -> None:
        info = tarfile.TarInfo(f"{KEY}.{MEMBERS[0]}")
        info.type, info.linkname = kind, str(outside)
        if kind == tarfile.REGTYPE:
            info.size = len(members()[MEMBERS[0]])
        for name, value in fields.items():
            setattr(info, name, value)
        head = info.tobuf(tarfile.GNU_FORMAT)
        shard.write_bytes(head + shard.read_bytes()[len(head) :])

    return harm


def tar_hole(shard: Path, outside: Path) -> None:
    tar_member(tarfile.REGTYPE, size=2**34)(shard, outside)
    os.truncate(shard, 2**35)


def tar_of_a_twin(shard: Path, outside: Path) -> None:
    with tarfile.open(shard, "a") as tar:
        tar.addfile(tarfile.TarInfo(f"{KEY}.{MEMBERS[0]}"))


def tar_packed(shard: Path, outside: Path) -> None:
    shard.write_bytes(zlib.compress(shard.read_bytes()))


def tar_cut(shard: Path, outside: Path) -> None:
    os.truncate(shard, 700)


def in_hdf5(make: Callable[[h5py.Group, str, tuple[int, ...], Path], None]) -> Harm:
    def harm(shard: Path, outside: Path) -> None:
        with h5py.File(shard, "r+") as file:
            del file[KEY][MEMBERS[0]]
            make(file[KEY], MEMBERS[0], (9,), outside)

    return harm


def of_type(kind: Any) -> Callable[[h5py.Group, str, tuple[int, ...], Path], None]:
    """An array of other things than are expected there."""

    def make(group: h5py.Group, name: str, shape: tuple[int, ...], outside: Path) -> None:
        group.create_dataset(name, shape, kind).attrs["units"] = "mm"

    return make


def group_elsewhere(shard: Path, outside: Path) -> None:
    with h5py.File(shard, "r+") as file:
        del file[KEY]
        file[KEY] = h5py.ExternalLink(str(outside), "/")


def first_file(place: Callable[[Path, Path], None]) -> Harm:
    def harm(shard: Path, outside: Path) -> None:
        file = shard / f"{KEY}.{MEMBERS[0]}"
        file.unlink()
        place(file, outside)

    return harm


def link_out(file: Path, outside: Path) -> None:
    file.symlink_to(outside)


def shard_is_a_fifo(shard: Path, outside: Path) -> None:
    shutil.rmtree(shard) if shard.is_dir() else shard.unlink()
    os.mkfifo(shard)


LINK = "a member is a link, or no file"
NOT_HERE = f"{KEY}/{MEMBERS[0]}: is not an array in this file"
SHARD_HARMS: dict[str, list[tuple[Harm, str]]] = {
    "webdataset": [
        (tar_member(tarfile.SYMTYPE), LINK),
        (tar_member(tarfile.SYMTYPE, name="a\nb"), LINK),
        (tar_member(tarfile.LNKTYPE), LINK),
        (tar_member(tarfile.FIFOTYPE), LINK),
        (tar_member(tarfile.CHRTYPE), LINK),
        (tar_member(tarfile.GNUTYPE_LONGNAME), LINK),
        (tar_member(tarfile.GNUTYPE_SPARSE), LINK),
        (tar_member(tarfile.REGTYPE, size=-512), "too large, or not there"),
        (tar_member(tarfile.REGTYPE, size=2**40), "too large, or not there"),
        (tar_member(tarfile.REGTYPE, size=9999), ""),
        (tar_member(tarfile.XHDTYPE, size=2**40), "too large, or not there"),
        (tar_member(tarfile.REGTYPE, name="other"), "lacks the picture's picture.png"),
        (tar_hole, "too large, or not there"),
        (tar_of_a_twin, "has a member twice"),
        (tar_packed, "is damaged, or no tar file"),
        (tar_cut, "lacks the picture's labels.png"),
        (moved_elsewhere, "is a link that leads out"),
        (shard_is_a_fifo, "cannot be read: it is a FIFO"),
    ],
    "hdf5": [
        *((in_hdf5(make), NOT_HERE) for make in strange.NOT_IN_THE_FILE),
        (group_elsewhere, NOT_HERE),
        *((in_hdf5(make), "is too large") for make in strange.TOO_LARGE),
        (in_hdf5(of_type(float)), "is no row of bytes"),
        (in_hdf5(of_type(h5py.string_dtype())), "is no row of bytes"),
        (tar_cut, "cannot be read as HDF5"),
        (moved_elsewhere, "is a link that leads out"),
        (shard_is_a_fifo, "cannot be read: it is a FIFO"),
    ],
    "folders": [
        (first_file(link_out), "is a link that leads out"),
        (first_file(lambda file, _: os.mkfifo(file)), "cannot be read: it is a FIFO"),
        (first_file(lambda file, _: file.mkdir()), "cannot be read: it is a folder"),
        (first_file(lambda file, _: strange.a_large_hole(file)), "is too large"),
        (moved_elsewhere, "is a link that leads out"),
        (shard_is_a_fifo, "cannot be read"),
    ],
}  # fmt: skip


@pytest.mark.parametrize(
    ("form", "number"), [(form, k) for form in SHARD_HARMS for k in range(len(SHARD_HARMS[form]))]
)
def test_a_hostile_shard_is_refused(outside: Path, form: str, number: int) -> None:
    harm, said = SHARD_HARMS[form][number]
    shard = dataset(outside.parent / "set", form)
    harm(shard, outside)
    refusal(lambda: read_whole(shard.parent), "shard-000000" if said else KEY, said)


@pytest.mark.parametrize("form", SHARDS)
def test_nothing_is_waited_for_or_followed_to_verify_a_shard(outside: Path, form: str) -> None:
    for harm in (shard_is_a_fifo, moved_elsewhere):
        folder = outside.parent / harm.__name__
        folder.mkdir()
        harm(dataset(folder, form), folder / "outside")
        refusal(PictureDataset(folder).verify, "shard-000000")


@pytest.mark.parametrize("form", SHARDS)
def test_a_shard_larger_than_its_pictures_is_not_hashed(outside: Path, form: str) -> None:
    """400 GB, none of them written; its pictures are read as ever."""
    shard = dataset(outside.parent / "set", form)
    hole = shard / "hole" if shard.is_dir() else shard
    hole.touch()
    os.truncate(hole, 400 * 10**9)
    said = "is too large: bytes (got 400000000000; allowed: "
    refusal(PictureDataset(shard.parent).verify, str(hole), said)
    read_whole(shard.parent)


@pytest.mark.parametrize("form", SHARDS)
def test_the_member_at_fault_is_named(outside: Path, form: str) -> None:
    """The one that is too large, or the picture whose header cannot say how large others may be."""
    folder = outside.parent / "set"
    large = bytes(2**20 + 64 * 12 + 1)
    for changed, said in (
        ({"truth.npz": large}, "truth.npz"),
        (
            {"labels.png": large, "picture.png": b"GIF89a"},
            "picture.png: is not an 8- or 16-bit",
        ),
        ({"labels.png": large, "scene.json": large}, "labels.png"),
    ):
        shard = dataset(folder, form, **changed)
        refusal(lambda: read_whole(folder), KEY, said)
        shutil.rmtree(shard) if shard.is_dir() else shard.unlink()
    if form == "webdataset":
        for name in MEMBERS:
            dataset(folder, form)
            with tarfile.open(folder / SHARDS[form], "w", format=tarfile.USTAR_FORMAT) as tar:
                for other, data in members().items():
                    info = tarfile.TarInfo(f"{KEY}.{other}")
                    info.size = len(data)
                    if other != name:
                        tar.addfile(info, io.BytesIO(data))
            refusal(lambda: read_whole(folder), KEY, f"lacks the picture's {name} (got '{KEY}')")


def npz(name: str = "depth_mm.npy", data: bytes = b"", how: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", how) as file:
        file.writestr(name, data)
    return stream.getvalue()


def npy(shape: tuple[int, ...], dtype: str = "<f4", data: bytes = b"") -> bytes:
    stream = io.BytesIO()
    header = {"descr": dtype, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, header)
    return stream.getvalue() + data


def stating(size: int) -> bytes:
    """An NPZ file whose list of members states another size than the member has."""
    data = bytearray(npz(data=npy((1,), data=b"four")))
    place = data.index(b"PK\x01\x02") + 24
    data[place : place + 4] = struct.pack("<I", size)
    return bytes(data)


def truth(**arrays: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


LINE = {"status": np.array([[0, 7, 0, 0]]), "centre_px": np.array([[1.0, np.nan, 2.0, 2.0]])}
MEMBER_HARMS: list[tuple[str, bytes, str]] = [
    ("picture.png", grey_png(60_000, 60_000, zlib.compress(b"")), "or too large"),
    ("picture.png", b"GIF89a", "is not an 8- or 16-bit grey or RGB picture"),
    ("picture.png", encode_picture(np.zeros((3, 4), np.uint8), ".jpg"), "is not an 8- or 16-bit"),
    ("labels.png", grey_png(30_000, 30_000, zlib.compress(b"")), "or too large"),
    ("labels.png", b"", "is not an 8-bit grey or RGB picture"),
    (
        "labels.png",
        encode_picture(np.zeros((4, 3), np.uint8), ".png"),
        "another shape (got (4, 3); allow",
    ),
    ("labels.png", encode_picture(np.zeros((3, 4, 3), np.uint8), ".png"), "allowed: grey, (3, 4))"),
    ("truth.npz", npz(data=npy((2**38,))), "cannot be read as arrays"),
    ("truth.npz", npz(data=npy((2, -3), data=bytes(24))), "cannot be read as arrays"),
    ("truth.npz", npz(data=npy((1,), "|O", bytes(8))), "cannot be read as arrays"),
    ("truth.npz", npz(data=b"\x93NUMPY\x03\0" + bytes(9)), "cannot be read as arrays"),
    ("truth.npz", npz(data=npy((1,), data=b"four"), how=zipfile.ZIP_BZIP2), "cannot be read as"),
    ("truth.npz", stating(2**31), "unpacks to too much: bytes (got 2147483648"),
    ("truth.npz", stating(5), "cannot be read as arrays"),
    ("truth.npz", b"", "cannot be read as arrays"),
    *(
        ("truth.npz", truth(**arrays), said)
        for arrays, said in (
            (
                {"x_mm": np.ones((4, 3))},
                "x_mm: is no such array (got 'float64 (4, 3)'; allowed: float",
            ),
            ({"normals": np.ones((3, 4))}, "allowed: floating (3, 4, 3))"),
            ({"depth_mm": np.ones((3, 4), int)}, "depth_mm: is no such array (got 'int64 (3, 4)'"),
            ({"layer_direct": np.full((3, 4), "far")}, "layer_direct: is no such array (got '<U3"),
            ({"x_mm": np.zeros((3, 4), [("a", "f4")])}, "x_mm: is no such array"),
            ({"centre_px": np.ones((1, 4))}, "centre_px: is no such array"),
            ({"status": np.int64(0)}, "status: is no such array (got 'int64 ()'"),
            ({"status": np.zeros((1, 5), int)}, "status: is no such array (got 'int64 (1, 5)'"),
            ({"status": np.zeros((1, 4))}, "status: is no such array (got 'float64 (1, 4)'"),
            (
                {"status": np.array([[0, 7, 8, 99]])},
                "status: is no code of Status (got 99)",
            ),
            (
                LINE | {"width_px": np.ones((2, 4))},
                "width_px: is no such array (got 'float64 (2, 4)'",
            ),
            (
                LINE | {"height_dn": np.array([[1, 1, np.nan, 1.0]])},
                "height_dn: is not finite where",
            ),
        )
    ),
    ("scene.json", b"[" * 100_000, "is not valid JSON"),
    ("scene.json", b"[" * 60 + b"]" * 60, "too deep in one another"),
    ("scene.json", b'{"a": NaN}', "is not valid JSON"),
    ("scene.json", b"[]", "is no scene"),
    ("scene.json", b"\xff", "is not valid JSON"),
]


@pytest.mark.parametrize("number", range(len(MEMBER_HARMS)))
def test_a_hostile_file_of_a_picture_is_refused(outside: Path, number: int) -> None:
    name, data, said = MEMBER_HARMS[number]
    dataset(outside.parent / "set", "webdataset", **{name: data})
    refusal(lambda: read_whole(outside.parent / "set"), f"picture {KEY}: {name}", said)


ENTRY = {"file": "shard-000000.tar", "sha256": "0" * 64, "keys": [KEY]}
MANIFESTS: list[Any] = [
    None, [], "text", 7, {}, {"version": 1}, {"version": "1", "shards": []},
    {"version": True, "shards": []}, {"version": 2, "shards": []}, {"version": 1, "shards": None},
    {"version": 1, "shards": {}}, {"version": 1, "shards": "text"}, {"version": 1, "shards": [1]},
    *({"version": 1, "shards": [{**ENTRY, **harm}]} for harm in (
        {"file": "../outside"}, {"file": "/outside"}, {"file": "a/b.tar"}, {"file": ".hidden"},
        {"file": ""}, {"file": 1}, {"file": None}, {"file": "a\nb"}, {"sha256": 1}, {"sha256": ""},
        {"keys": KEY}, {"keys": None}, {"keys": [1]}, {"keys": [[KEY]]}, {"keys": {KEY: 1}},
        {"keys": ["../../outside"]}, {"keys": [""]},
    )),
    {"version": 1, "shards": [], "classes": []}, {"version": 1, "shards": [], "failed": [1]},
    *({"version": 1, "shards": [ENTRY], **harm} for harm in (
        {"shards": [{**ENTRY, "keys": [KEY, KEY]}]}, {"failed": {KEY: "why"}},
        {"failed": {"1": ""}}, {"pictures": 2}, {"pictures": "1"}, {"count": 1.5},
        {"format": "zip"}, {"classes": {"LINE": -1}}, {"classes": {"LINE": 256}},
    )),
]  # fmt: skip


@pytest.mark.parametrize("number", range(len(MANIFESTS)))
def test_a_manifest_of_other_types_is_refused(outside: Path, number: int) -> None:
    folder = outside.parent / "set"
    dataset(folder, "webdataset")
    (folder / "manifest.json").write_text(json.dumps(MANIFESTS[number]), encoding="utf-8")
    refusal(lambda: PictureDataset(folder), "manifest.json: ")


# ---- suites ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a suite of one line and, in another suite beside it, of a scan."""
    folder = tmp_path_factory.mktemp("suites")
    for name, make in (("lines", suite_cases.drawn_suite), ("scans", suite_cases.scan_suite)):
        (folder / name).mkdir()
        make(folder / name, 1)
    return folder


def replaced(folder: Path, member: str, change: Callable[[bytes], bytes]) -> None:
    """Change a member as who knows the format does: with the right checksum."""
    content = open_suite(folder).content
    data = change((folder / member).read_bytes())
    (folder / member).write_bytes(data)
    members = {**content.members, member: member_sum(data)}
    (folder / MANIFEST).write_bytes(manifest_bytes(content.model_copy(update={"members": members})))


@pytest.mark.parametrize(
    ("kind", "member"), [("lines", "case-000/stripe.json"), ("scans", "scan-000/rig.json")]
)
def test_a_suite_that_names_code_is_refused(
    suite: Path, tmp_path: Path, kind: str, member: str
) -> None:
    """Nothing of it is imported, either from its folder or from its archive."""
    folder = Path(shutil.copytree(suite / kind, tmp_path / kind))

    def named(data: bytes) -> bytes:
        content = json.loads(data)
        content.get("stripe", content)["extractor"] = "code_of_a_stranger:function"
        return json.dumps(content).encode()

    replaced(folder, member, named)
    pack_suite(folder, tmp_path / "packed.zip")
    for path in (folder, tmp_path / "packed.zip"):
        said = "stripe.extractor: names code, which would be run (got 'code_of_a_stranger"
        refusal(lambda path=path: verify_suite(path), f"{path}: member {member}", said)


def list_of_a_gigabyte(file: Path) -> None:
    """The end of the archive states a list of members that is a hole."""
    size = 2**30
    end = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 1, 1, size, 0, 0)
    file.touch()
    os.truncate(file, size)
    with file.open("ab") as stream:
        stream.write(end)


def member_of_gigabytes(file: Path) -> None:
    data = bytearray(file.read_bytes())
    place = data.index(b"PK\x01\x02")
    data[place + 20 : place + 28] = struct.pack("<2I", 2**31, 2**31)
    file.write_bytes(data)


def repacked(file: Path) -> None:
    with zipfile.ZipFile(file) as archive:
        names = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in names.items():
            archive.writestr(name, data)


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (list_of_a_gigabyte, "is no suite: neither folder nor archive"),
        (member_of_gigabytes, "is compressed or too large"),
        (repacked, "is compressed or too large"),
    ],
)
def test_a_hostile_archive_is_refused(
    suite: Path, tmp_path: Path, harm: Callable[[Path], None], said: str
) -> None:
    pack_suite(suite / "lines", tmp_path / "packed.zip")
    harm(tmp_path / "packed.zip")
    refusal(lambda: verify_suite(tmp_path / "packed.zip"), "packed.zip", said)


@pytest.mark.parametrize("place", [link_out, lambda file, _: os.mkfifo(file)])
def test_a_suites_folder_leads_nowhere(
    suite: Path, tmp_path: Path, place: Callable[[Path, Path], None]
) -> None:
    folder = Path(shutil.copytree(suite / "lines", tmp_path / "lines"))
    os.mkfifo(tmp_path / "outside")
    (folder / "case-000" / "truth.csv").unlink()
    place(folder / "case-000" / "truth.csv", tmp_path / "outside")
    refusal(lambda: verify_suite(folder), "truth.csv")


# ---- surfaces -------------------------------------------------------------------------------

SHAPE = (3, 6)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    ones, status = np.ones(SHAPE), np.zeros(SHAPE, int)
    surface = Surface(
        np.ones((*SHAPE, 3)), ones, ones, status, np.arange(3.0), sigma_y_mm=ones,
        provenance=Provenance("rig", 3, "ml", "refractive", "ab" * 32),
    )  # fmt: skip
    path = tmp_path_factory.mktemp("surface") / "surface.nc"
    save_surface(path, surface)
    return path


@pytest.fixture
def surface_file(saved: Path, tmp_path: Path) -> Path:
    """A good surface, to be harmed."""
    return Path(shutil.copy(saved, tmp_path))


def shaped(*shape: int) -> Callable[[h5py.Group, str, tuple[int, ...], Path], None]:
    return lambda group, name, _, outside: of_type(float)(group, name, shape, outside)


NOT_NUMBERS = "z: is not an array of numbers"
ARRAYS: list[tuple[Callable[[h5py.Group, str, tuple[int, ...], Path], None], str]] = [
    *((make, "z: is not an array in this file") for make in strange.NOT_IN_THE_FILE),
    *((make, "z: is too large") for make in strange.TOO_LARGE),
    (of_type(h5py.string_dtype()), NOT_NUMBERS),
    (of_type(h5py.ref_dtype), NOT_NUMBERS),
    (of_type(h5py.vlen_dtype(float)), NOT_NUMBERS),
    (of_type(np.dtype([("a", float)])), NOT_NUMBERS),
    (of_type(complex), NOT_NUMBERS),
    (shaped(), NOT_NUMBERS),
    (shaped(2, 2, 2), NOT_NUMBERS),
    (shaped(3, 5), "z: wrong shape"),
]


@pytest.mark.parametrize("number", range(len(ARRAYS)))
def test_an_array_that_is_none_is_refused(surface_file: Path, number: int) -> None:
    """What a stranger wants to have read lies in another file of numbers beside the surface."""
    secret = surface_file.with_name("secret.h5")
    with h5py.File(secret, "w") as file:
        file["z"] = np.full(SHAPE, 42.0)
    make, said = ARRAYS[number]
    with h5py.File(surface_file, "r+") as file:
        del file["z"]
        make(file, "z", SHAPE, secret)
    refusal(lambda: load_surface(surface_file), f"{surface_file}: {said}")


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        *(("frame", frame, "frame: is none of a surface") for frame in
          ("moon", 1, [1.0, 2.0], np.bytes_(b"moon"), ["head", "head"])),
        ("yaw_deg", "east", "yaw_deg: is no angle"),
        ("yaw_deg", 2, "yaw_deg: is no angle"),
        ("yaw_sigma_deg", np.inf, "yaw_sigma_deg: is no angle"),
        ("pictures", "many", "pictures: must be"),
        ("rig", 1, "rig: must be"),
    ],
)  # fmt: skip
def test_an_attribute_of_another_kind_is_refused(
    surface_file: Path, name: str, value: Any, said: str
) -> None:
    with h5py.File(surface_file, "r+") as file:
        file.attrs.pop(name, None)
        file.attrs[name] = value
    refusal(lambda: load_surface(surface_file), f"{surface_file}: ", said)


def test_a_status_that_is_none_is_refused(surface_file: Path) -> None:
    with h5py.File(surface_file, "r+") as file:
        file["status"][0, 0] = 1 + max(Status)
    refusal(lambda: load_surface(surface_file), "status: holds what is no status")


@pytest.mark.parametrize("name", ["x_sigma", "y_sigma", "z_sigma"])
def test_a_point_without_an_uncertainty_is_refused(surface_file: Path, name: str) -> None:
    """One without a value has none."""
    for value in (-1.0, np.nan):
        with h5py.File(surface_file, "r+") as file:
            file["status"][0, 0], file[name][0, 0] = Status.NO_PEAK, value
        assert load_surface(surface_file).status[0, 0] == Status.NO_PEAK
        with h5py.File(surface_file, "r+") as file:
            file[name][1, 2] = value
        refusal(lambda: load_surface(surface_file), f"surface.nc: {name}: is no uncertainty at a")
        with h5py.File(surface_file, "r+") as file:
            file[name][1, 2] = 1.0


def text_places(content: bytes) -> list[int]:
    """Where the file keeps the sizes of its first texts: a heap's header and each object's."""
    begin = content.index(b"GCOL")
    places = [begin + 16]
    for _ in range(3):
        size = int.from_bytes(content[places[-1] + 8 : places[-1] + 16], "little")
        places.append(places[-1] + 16 + -(-size // 8) * 8)
    return places


@pytest.mark.parametrize("number", [0, 1, 2, 3])
def test_a_text_whose_size_leads_nowhere_is_refused(
    saved: Path, tmp_path: Path, number: int
) -> None:
    """HDF5 goes from each text of a heap to the next by its size: some lead it back to itself.

    Free space (number 0) of less than its own header, and a size that, with its header, is 0 in
    64 bits, did so.
    """
    whole, file = saved.read_bytes(), tmp_path / "surface.nc"
    place = text_places(whole)[number]
    for size in (0, 8, 2**32, 2**63, 2**64 - 16, 2**64 - 1):
        content = bytearray(whole)
        content[place + 8 : place + 16] = size.to_bytes(8, "little")
        if size <= 8:
            content[place : place + 2] = bytes(2)
        file.write_bytes(content)
        refusal(lambda: load_surface(file), "surface.nc: cannot be read as NetCDF", "damaged texts")


def test_a_heap_within_a_heap_is_refused(surface_file: Path) -> None:
    content = bytearray(surface_file.read_bytes())
    place = text_places(bytes(content))[1] + 16
    content[place : place + 16] = b"GCOL\x01\0\0\0" + (16).to_bytes(8, "little")
    surface_file.write_bytes(content)
    refusal(lambda: load_surface(surface_file), "surface.nc", "damaged texts")


def test_numbers_that_look_like_a_heap_are_read(saved: Path, tmp_path: Path) -> None:
    z = load_surface(saved).xyz_mm.copy()
    z[0, 0, 2] = np.frombuffer(b"GCOL\x01\0\0\0")[0]
    z[0, 1, 2] = np.frombuffer((2**20).to_bytes(8, "little"))[0]
    save_surface(tmp_path / "surface.nc", replace(load_surface(saved), xyz_mm=z))
    assert np.array_equal(load_surface(tmp_path / "surface.nc").xyz_mm, z)
