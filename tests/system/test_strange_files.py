"""Files of strangers, of every format that is read, and what may be wrong with any of them.

Each is refused in one line, or read, and nothing else happens: no FIFO is waited for, no memory
taken for what is only declared, and no code run.  A new format is a line of ``FORMATS`` or, with an
example that is whole, of ``WHOLE``.
"""

import copy
import json
import struct
import sys
import tracemalloc
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import pytest
import strange
import suite_cases
import trimesh
import xarray as xr
from calibrations import drawn_calibration
from drawn_examples import examples
from hypothesis import given, strategies as st
from metricviews import SIZE, known, paper_rig, poses, views_of, with_noise
from places import SCENES
from png_files import chunk, grey_png
from strange import LARGE, refusal

from lscan.acquisition.run import open_run
from lscan.benchmark.suiterun import read_saved
from lscan.calibration.calibrationfile import (
    load_calibration,
    load_camera,
    load_metric,
    load_plane_map,
    save_calibration,
)
from lscan.calibration.metric.solve import calibrate_metric
from lscan.calibration.metric.views import load_views, read_views
from lscan.config.board import load_board
from lscan.config.documents import read_document
from lscan.config.rig import load_rig
from lscan.config.targets import load_shapes
from lscan.errors import InputError, LscanError
from lscan.files.datasets import PictureDataset
from lscan.files.meshes import load_mesh
from lscan.files.pictures import MOST_PX, read_picture
from lscan.records import Provenance, Surface
from lscan.suites import open_suite, pack_suite
from lscan.surface import load_surface, save_surface
from lscan.surface.alignment import load_alignment
from lscan.surface.shaft import load_shaft

Read = Callable[[Path], Any]

FORMATS: dict[str, Read] = {
    "surface.nc": load_surface,
    "calibration.json": load_calibration,
    "map.json": load_plane_map,
    "metric.json": load_metric,
    "camera.json": load_camera,
    "alignment.json": load_alignment,
    "bench.json": read_saved,
    "rig.toml": load_rig,
    "board.toml": load_board,
    "shapes.toml": load_shapes,
    "shaft.toml": load_shaft,
    "views.toml": load_views,
    "picture.png": read_picture,
    "mesh.ply": load_mesh,
    "mesh.stl": load_mesh,
    "mesh.obj": load_mesh,
    "mesh.off": load_mesh,
    "suite.zip": open_suite,
    "suite.json": lambda file: open_suite(file.parent),
    "run.json": lambda file: open_run(file.parent),
    "manifest.json": lambda file: PictureDataset(file.parent),
}


pytestmark = pytest.mark.usefixtures("little_memory_and_time")
little_memory_and_time = strange.little_memory_and_time


# ---- first attack: what is no such file ----------------------------------------------------------


def nothing(file: Path) -> None:
    file.touch()


def deep_brackets(file: Path) -> None:
    file.write_bytes(b"a = " * (file.suffix == ".toml") + b"[" * 100_000)


def a_mark_alone(file: Path) -> None:
    file.write_bytes(b"\xef\xbb\xbf\0")


NO_SUCH_FILE: dict[Callable[[Path], None], str] = {
    strange.a_fifo: "cannot be read: it is a FIFO",
    strange.a_device: "cannot be read: it is a",
    strange.a_loop: "cannot be read: Too many",
    strange.a_socket: "cannot be read: it is a socket",
    strange.a_folder: "cannot be read: it is a folder",
    strange.a_large_hole: f"is too large: bytes (got {LARGE}",
    nothing: "",
    deep_brackets: "",
    a_mark_alone: "",
}


@pytest.mark.parametrize("name", FORMATS)
def test_what_is_no_such_file_is_refused(tmp_path: Path, name: str) -> None:
    for attack, said in NO_SUCH_FILE.items():
        folder = tmp_path / attack.__name__
        folder.mkdir()
        attack(folder / name)
        if attack is strange.a_device and name.endswith(".toml"):
            refusal(lambda: FORMATS[name](folder / name), "/dev/zero")  # noqa: B023
            continue  # a document is anchored to the file that a link leads to
        if (attack is strange.a_device and name in ("run.json", "suite.json", "manifest.json")) or (
            attack is strange.a_folder and name == "suite.zip"
        ):
            said = ""  # a link out of their folder; a suite may be a folder
        refusal(lambda: FORMATS[name](folder / name), str(folder), said)  # noqa: B023


VIEWS = """
board = { kind = "chessboard", columns = 5, rows = 4, square_mm = 10.0 }
view = [{ picture = "PLACE" }]
"""
DEVICES = 'camera.driver = "sim"\ntrack.driver = "sim"\n'


@pytest.mark.parametrize("attack", [one for one in NO_SUCH_FILE if one.__module__ == "strange"])
def test_what_a_document_names_is_a_plain_file(
    tmp_path: Path, attack: Callable[[Path], None]
) -> None:
    attack(tmp_path / "outside")
    (tmp_path / "set").mkdir()
    file = tmp_path / "set" / "given.toml"
    for text, read in (
        ('include = ["../set", "PLACE"]', load_rig),
        (DEVICES + 'board.file = "PLACE"', load_rig),
        (VIEWS, lambda path: read_views(load_views(path))),
    ):
        file.write_text(text.replace("PLACE", "../outside"), encoding="utf-8")
        with pytest.raises(InputError, match=r"cannot be read: (it is a|Too many)|is too large"):
            read(file)


def test_names_with_line_ends_stay_in_one_line(tmp_path: Path) -> None:
    """Of a file, of a key in TOML, of a key in JSON."""
    folder = tmp_path / "a\nset\x1b[31m"
    folder.mkdir()
    refusal(lambda: load_mesh(folder / "mesh.ply"), r"a\nset\x1b[31m")
    (folder / "rig.toml").write_text(DEVICES + '"a\\nb" = 1\n')
    refusal(lambda: load_rig(folder / "rig.toml"), r"a\nb: unknown section")
    manifest = {"version": 1, "shards": [], "classes": {"a\nb": "text"}}
    (folder / "manifest.json").write_text(json.dumps(manifest), encoding="utf-8")
    refusal(lambda: PictureDataset(folder), r"classes.a\nb: ")


# ---- second attack: a good file that was changed ---------------------------------------------

SHAPE = (3, 6)


def write_surface(file: Path) -> None:
    ones = np.ones(SHAPE)
    made_from = Provenance("rig", 3, "ml", "refractive", "ab" * 32)
    points, status = np.ones((*SHAPE, 3)), np.zeros(SHAPE, int)
    save_surface(file, Surface(points, ones, ones, status, np.arange(3.0), provenance=made_from))


def write_classic(file: Path) -> None:
    """The same as NetCDF-3."""
    write_surface(file.with_suffix(".nc4"))
    with xr.open_dataset(file.with_suffix(".nc4"), engine="h5netcdf") as data:
        data.to_netcdf(file, engine="scipy")


def write_picture(file: Path) -> None:
    pixels = np.random.default_rng(1).integers(0, 256, (12, 10, 3), dtype=np.uint8)
    assert cv2.imwrite(str(file), pixels)


def write_mesh(file: Path) -> None:
    trimesh.creation.box().export(file)


def write_scene(file: Path) -> None:
    """A scene of the paper, which includes nothing."""
    texts = [(SCENES / "paper" / name).read_text() for name in ("sandwave.toml", "rig.toml")]
    lines = [line for line in "".join(texts).splitlines() if not line.startswith("include")]
    board = f"{SCENES}/paper/calibration-board"
    file.write_text("\n".join(lines).replace("calibration-board", board))


def write_suite(file: Path) -> None:
    (file.parent / "suite").mkdir()
    suite_cases.drawn_suite(file.parent / "suite", 1)
    pack_suite(file.parent / "suite", file)


def write_map(file: Path) -> None:
    """A calibration by the map that the file is named after."""
    save_calibration(file, drawn_calibration(file.stem))


def write_metric(file: Path) -> None:
    rig, rng = paper_rig(), np.random.default_rng(1)
    views = [with_noise(view, 0.02, rng) for view in views_of(rig, poses(rig, rng))]
    save_calibration(file, calibrate_metric(views, known(rig), SIZE))


def is_whole_surface(read: Surface) -> bool:
    return read.status.shape == SHAPE


def is_finite_mesh(read: Any) -> bool:
    return bool(np.isfinite(read.vertices).all())


def is_picture(read: Any) -> bool:
    return read.dtype == np.uint8 and read.size <= 3 * MOST_PX


MAPS = ("graticule-2", "graticule-bspline", "projective", "polynomial-4", "spline", "auto")
WHOLE: dict[str, tuple[Callable[[Path], None], Read, Callable[[Any], bool], int]] = {
    "surface.nc": (write_surface, load_surface, is_whole_surface, 75),
    "classic.nc": (write_classic, load_surface, is_whole_surface, 75),
    **{
        f"picture.{ending}": (write_picture, read_picture, is_picture, 150)
        for ending in ("png", "jpg", "bmp", "tif", "webp")
    },
    **{
        f"mesh.{ending}": (write_mesh, load_mesh, is_finite_mesh, 60)
        for ending in ("ply", "stl", "obj", "off")
    },
    "rig.toml": (write_scene, load_rig, lambda read: True, 200),
    "suite.zip": (write_suite, open_suite, lambda read: True, 60),
}
"""How a good file is written and read, what holds of whatever is read, how many are drawn."""

CALIBRATIONS: dict[str, Callable[[Path], None]] = dict.fromkeys(MAPS, write_map)
CALIBRATIONS["metric"] = write_metric


@cache
def whole(name: str, write: Callable[[Path], None]) -> bytes:
    """What a good file of that name holds."""
    with TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return (Path(folder) / name).read_bytes()


def changed_bytes(data: st.DataObject, content: bytes) -> bytes:
    """The content with a few bytes changed, then cut short or lengthened."""
    changed = bytearray(content)
    for _ in range(data.draw(st.integers(0, 4))):
        # Headers are at the front, a TIFF's at the end.
        near = st.integers(0, min(80, len(changed) - 1))
        anywhere = st.integers(0, len(changed) - 1)
        place = data.draw(anywhere | near | near.map(lambda at: len(changed) - 1 - at))
        changed[place] = data.draw(st.integers(0, 255))
    end = data.draw(st.just(len(changed)) | st.integers(0, len(changed)))
    return bytes(changed[:end]) + data.draw(st.binary(max_size=8))


@pytest.mark.parametrize("name", WHOLE)
def test_a_changed_file_is_read_or_refused(tmp_path: Path, name: str) -> None:
    write, read, holds, number = WHOLE[name]
    content, file = whole(name, write), tmp_path / name
    file.write_bytes(content)
    assert holds(read(file))

    @examples(number)
    @given(data=st.data())
    def change(data: st.DataObject) -> None:
        file.write_bytes(changed_bytes(data, content))
        try:
            assert holds(read(file))
        except InputError as error:
            assert file.name in str(error)
            assert "\n" not in str(error)

    change()


SIZES = (0, -1, 2.5, 1e308, -1e308, 1e-308, 1e30, -1e9, 10**30, 10**300, True, None)
SHAPES = ("x", "", "a\nb", [], {}, [[]], [1], {"a": 1}, [[1, 2], [3]], [[1e308, None, "x"]])


def change_value(data: st.DataObject, content: Any) -> None:
    """Replace, remove or add one value somewhere in the document."""
    keys = sorted(content) if isinstance(content, dict) else range(len(content))
    key = data.draw(st.sampled_from(keys), label="key")
    inner = content[key]
    if isinstance(inner, dict | list) and inner and data.draw(st.integers(0, 5), label="stop"):
        change_value(data, inner)
        return
    what = data.draw(st.sampled_from(["replace", "replace", "remove", "add"]), label="what")
    value = copy.deepcopy(data.draw(st.sampled_from(SIZES + SHAPES), label="value"))
    if what == "remove":
        del content[key]
    elif what == "add" and isinstance(content, list):
        content.append(value)
    else:
        content[key] = value


@examples(140)
@given(data=st.data())
def test_a_changed_calibration_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    name = data.draw(st.sampled_from(sorted(CALIBRATIONS)), label="map")
    document = json.loads(whole(name, CALIBRATIONS[name]))
    for _ in range(data.draw(st.integers(1, 3), label="changes")):
        change_value(data, document)
    path = tmp_path_factory.getbasetemp() / "changed.json"
    path.write_text(json.dumps(document))
    try:
        load_plane_map(path)
    except LscanError as error:
        assert path.name in str(error)
        assert "\n" not in str(error)


@pytest.mark.parametrize(
    ("name", "keys", "value", "said"),
    [
        ("polynomial-4", ("coefficients",), [[0.0] * 15] * 2, "residuals.mm: do not belong"),
        (
            "projective",
            ("corrections",),
            [{"middle_mm": [0.0, 0.0], "scale": -1.0}],
            "corrections.0.scale: must be ",
        ),
    ],
)
def test_a_map_that_cannot_be_inverted_is_refused(
    tmp_path: Path, name: str, keys: tuple[str, ...], value: Any, said: str
) -> None:
    document = json.loads(whole(name, CALIBRATIONS[name]))
    document["parameters"][keys[0]] = value
    (tmp_path / "c.json").write_text(json.dumps(document))
    refusal(lambda: load_plane_map(tmp_path / "c.json"), "c.json: ", said)


@pytest.mark.parametrize("name", ["of_a_stranger:solver", "of_a_stranger", "os:system"])
def test_a_calibration_names_installed_maps_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    (tmp_path / "of_a_stranger.py").write_text("solver = None\n")
    monkeypatch.syspath_prepend(tmp_path)
    for key, made in (("plane_map", "graticule-2"), ("chosen", "auto")):
        document = json.loads(whole(made, write_map))
        (document["parameters"] if key == "chosen" else document)[key] = name
        (tmp_path / "c.json").write_text(json.dumps(document))
        said = "no such family of plane maps"
        refusal(lambda: load_plane_map(tmp_path / "c.json"), "c.json: plane_map: ", said)
    assert "of_a_stranger" not in sys.modules


# ---- third attack: more is declared than there is, or it makes no sense --------------------------


def ply(form: str, vertices: int, faces: int, count: str = "uchar", comment: str = "") -> bytes:
    lines = ["ply", f"format {form} 1.0", *comment.splitlines(), f"element vertex {vertices}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"element face {faces}", f"property list {count} int vertex_indices", "end_header"]
    return "\n".join(lines).encode() + b"\n"


MANY = 1_000_000_000
CORNERS = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]]).tobytes()
BINARY = "binary_little_endian"
TEXT = b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
FACE = b"\x03" + struct.pack("<3i", 0, 1, 2)
OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
OBJ_OF_ONE = OBJ + b"f 1 2 3\n"
HEADER = ply("ascii", 3, 1)
NO_TEXT = "is no text, or one in UTF-16"

# Refused in words of ours, not in those of Python, NumPy or trimesh; some in words of no matter.
REFUSED: dict[str, tuple[bytes, str]] = {
    "binary.obj": (bytes(range(256)), NO_TEXT),
    "wide.obj": (OBJ_OF_ONE.decode().encode("utf-16"), NO_TEXT),
    "wide.off": ("OFF\n3 1 0\n".encode("utf-16"), NO_TEXT),
    "letters.obj": (b"\xff\xd8\xe0" * 99, "holds no triangles"),
    "word.obj": (OBJ + b"v 1 x 2\nf 1 2 3\n", "line without its numbers (got 'v 1 x 2')"),
    "corner.obj": (OBJ + b"f 1 two 3\n", "line without its numbers (got 'f 1 two 3')"),
    "ragged.obj": (OBJ + b"v 1 2\nf 1 2 3\n", "different numbers of values (got [2, 3])"),
    "index.obj": (OBJ + b"f 1 2 1000000000000\n", ""),
    "below.obj": (OBJ + b"f 1 2 -1000000000\n", ""),
    "nan.obj": (b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", ""),
    "line.obj": (b"v 0\nv 1\nv 2\nf 1 2 3\n", ""),
    "far.obj": (b"v 1e30 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", ""),
    "wide.ply": (HEADER.decode().encode("utf-16"), "has no header from 'ply' to 'end_header'"),
    "huge.ply": (ply(BINARY, 10**30, 1) + CORNERS, f"says (got {10**30}; allowed: 3 by its size)"),
    "long.ply": (ply("ascii", 3, 10**18) + TEXT, f"says (got {10**18}; allowed: 4 by its size)"),
    "word.ply": (HEADER + TEXT.replace(b"1", b"one"), "has a word that is no number"),
    "kind.ply": (HEADER.replace(b"float x", b"real x") + TEXT, "got 'property real x'"),
    "again.ply": (HEADER.replace(b"float y", b"float x") + TEXT, "got 'property float x'"),
    "count.ply": (HEADER.replace(b"face 1", b"face 1.5") + TEXT, "got 'element face 1.5'"),
    "plane.ply": (HEADER.replace(b"float z", b"float w") + TEXT, "no vertices of x, y and z"),
    "list.ply": (HEADER + TEXT.replace(b"3 0 1", b"nan 0 1"), "no PLY, damaged, or cut short"),
    "vertices.ply": (ply(BINARY, MANY, 1) + CORNERS + FACE, ""),
    "faces.ply": (ply(BINARY, 3, MANY) + CORNERS + FACE, ""),
    "corners.ply": (ply(BINARY, 3, 1, "uint") + CORNERS + struct.pack("<I3i", MANY, 0, 1, 2), ""),
    "negative.ply": (ply(BINARY, -5, 1) + CORNERS + FACE, ""),
    "text.ply": (ply("ascii", MANY, 1) + TEXT, ""),
    "index.ply": (ply(BINARY, 3, 1) + CORNERS + b"\x03" + struct.pack("<3i", 0, 1, MANY), ""),
    "below.ply": (ply(BINARY, 3, 1) + CORNERS + b"\x03" + struct.pack("<3i", 0, 1, -MANY), ""),
    "endless.ply": (b"ply\nformat ascii 1.0\n" + b"comment\n" * 1000, ""),
    "word.off": (b"OFF\nthree 1 0\n" + TEXT, "no OFF, damaged, or cut short"),
    "vertices.off": (b"OFF\n1000000000 1 0\n" + TEXT, ""),
    "cut.stl": (bytes(80) + struct.pack("<I", 9) + bytes(99), "holds no triangles"),
    "faces.stl": (bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50), ""),
    "none.stl": (b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n", ""),
    "archive.zip": (b"PK\x03\x04" + bytes(100), ""),
    "scene.gltf": (b'{"buffers": [{"uri": "../../secret", "byteLength": 9}]}', ""),
    "scene.glb": (b"glTF" + struct.pack("<II", 2, 2**32 - 1), ""),
    "no-ending": (b"", ""),
    "lists.json": (b"[" * 10**6, "too deep in one another"),
    "tables.json": (b'{"format":' * 900 + b"1" + b"}" * 900, "format.format.format...: "),
    "digits.json": (b'{"format": 1' + b"0" * 10**6 + b"}", "is not valid JSON"),
    "null.json": (b'{"format": "\\u0000"}', "format: holds a null character"),
    "infinite.json": (b'{"format": 1e999}', "is no calibration file"),
    # 64 kB of it took tomllib 4 GB: memory as the square of the parts.
    "parts.toml": (b"a." * 2**15 + b"b = 1\n", "a.a.a...: tables and lists too deep"),
}
READERS = {".json": load_plane_map, ".toml": read_document}


@pytest.mark.parametrize("name", REFUSED)
def test_what_makes_no_sense_is_refused_in_a_line(tmp_path: Path, name: str) -> None:
    content, said = REFUSED[name]
    file = tmp_path / name
    file.write_bytes(content)
    read = READERS.get(file.suffix, load_mesh)
    with pytest.raises(InputError) as caught:
        read(file)
    line = str(caught.value)
    assert line.startswith(f"{file}: ")
    assert said in line and "\n" not in line
    assert len(line) < 400 + len(str(tmp_path))


@pytest.mark.parametrize("kind", [b"tEXt", b"IDAT", b"IEND"])
def test_a_picture_with_a_huge_chunk_is_not_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: bytes
) -> None:
    """OpenCV takes as many bytes as a PNG's chunk declares, 2 to 4 GiB, before it reads them."""

    def reached(*_: Any) -> None:
        raise AssertionError("it was decoded")

    monkeypatch.setattr(cv2, "imdecode", reached)
    data = grey_png(16, 16, b"", chunk(kind, b"", length=2**31 - 20))
    if kind != b"tEXt":
        data = data[: data.index(kind) + 8]  # the file ends there, too
    (tmp_path / "bomb.png").write_bytes(data)
    said = "is not a picture that can be read"
    refusal(lambda: read_picture(tmp_path / "bomb.png"), "bomb.png: ", said)


def test_json_takes_memory_in_proportion(tmp_path: Path) -> None:
    """Empty lists are what JSON is densest in: 3 bytes of text become 64 of memory.

    An empty list is 56 bytes and its place in the outer list 8; with the text itself, as bytes
    and decoded, that is 24 times the file, to which a fifth is added for the allocator.
    """
    file = tmp_path / "c.json"
    file.write_text("[" + "[]," * 2**15 + "[]]")
    tracemalloc.start()
    refusal(lambda: load_plane_map(file), "c.json: ", "is no calibration file")
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 1.2 * 24 * file.stat().st_size


@pytest.mark.parametrize("named", ["m.mtl", "/dev/zero", "../secret.mtl"])
def test_other_files_that_a_mesh_names_are_not_opened(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, named: str
) -> None:
    """Materials and textures.  The first is a FIFO beside it, which would be waited for."""
    strange.a_fifo(tmp_path / "m.mtl")
    (tmp_path / "mesh.obj").write_bytes(f"mtllib {named}\nusemtl a\n".encode() + OBJ_OF_ONE)
    header = ply(BINARY, 3, 1, comment=f"comment TextureFile {named}")
    (tmp_path / "mesh.ply").write_bytes(header + CORNERS + FACE)
    for name in ("mesh.obj", "mesh.ply"):
        assert len(load_mesh(tmp_path / name).faces) == 1
    assert caplog.text == ""
