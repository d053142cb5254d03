"""Mesh files of other programs: faces of many corners, formats' variants, colours."""

import codecs
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from lscan.errors import InputError
from lscan.files.meshes import TWICE, UNREAD, load_mesh
from lscan.files.polygonfiles import PolygonMesh, triangles_of
from lscan.records import Floats, Ints

U = [(0, 0), (60, 0), (60, 40), (50, 40), (50, 10), (10, 10), (10, 40), (0, 40)]
U_MM2 = 60 * 10 + 2 * 10 * 30
# Corners on straight edges, as a neighbour's corner leaves them.
SPLIT_U = [*U[:1], (30, 0), *U[1:3], (55, 40), *U[3:4], (50, 25), *U[4:5], (30, 10), *U[5:]]
FRAME = [(0, 0), (60, 0), (60, 40), (0, 40), (20, 10), (20, 30), (40, 30), (40, 10)]
# Around the outline, over a bridge, around the hole the other way, and back over the bridge.
FRAME_RING = [0, 1, 2, 3, 0, 4, 5, 6, 7, 4]
FRAME_MM2 = 60 * 40 - 20 * 20
HEAD = "ply\nformat {kind} 1.0\n{more}element vertex {n}\n{props}element face {m}\n"
HEAD += "property list uchar int vertex_indices\nend_header\n"
XYZ = "property float x\nproperty float y\nproperty float z\n"


def turned(outline: list[tuple[int, int]]) -> Floats:
    """Corners in a plane that leans to all axes, mm."""
    plan = np.column_stack([outline, np.zeros(len(outline))])
    turn = trimesh.transformations.rotation_matrix(1.0, [1.0, 2.0, 3.0])[:3, :3]
    return np.asarray(plan @ turn.T + 5.0)


def areas(vertices: Floats, faces: Ints) -> Floats:
    return np.asarray(trimesh.triangles.area(vertices[faces]))


def prism(outline: list[tuple[int, int]], height: float) -> tuple[Floats, list[list[int]]]:
    """Corners and faces of an outline drawn out along z: two ends, and quadrangles between."""
    n = len(outline)
    plan = np.array(outline, dtype=float)
    vertices = np.vstack([np.column_stack([plan, np.full(n, z)]) for z in (0.0, height)])
    sides = [[k, (k + 1) % n, n + (k + 1) % n, n + k] for k in range(n)]
    return vertices, [list(range(n))[::-1], list(range(n, 2 * n)), *sides]


def written(path: Path, vertices: Floats, faces: list[list[int]]) -> Path:
    """The mesh in a file of the path's kind."""
    listed = "\n".join(" ".join(map(str, vertex)) for vertex in vertices.tolist()) + "\n"
    rings = "\n".join(" ".join(map(str, [len(face), *face])) for face in faces) + "\n"
    counts = {"n": len(vertices), "m": len(faces), "props": XYZ, "more": ""}
    if path.suffix == ".obj":
        listed = "".join(f"v {line}\n" for line in listed.splitlines())
        rings = "".join(f"f {' '.join(str(k + 1) for k in face)}\n" for face in faces)
        path.write_text(listed + rings)
    elif path.suffix == ".off":
        path.write_text(f"OFF\n{len(vertices)} {len(faces)} 0\n{listed}{rings}")
    elif path.stem == "text":
        path.write_text(HEAD.format(kind="ascii", **counts) + listed + rings)
    else:
        order = "<" if path.stem == "little" else ">"
        head = HEAD.format(kind=f"binary_{path.stem}_endian", **counts)
        packed = [struct.pack(f"{order}B{len(f)}i", len(f), *f) for f in faces]
        path.write_bytes(head.encode() + vertices.astype(f"{order}f4").tobytes() + b"".join(packed))
    return path


@pytest.mark.parametrize("name", ["a.obj", "a.off", "text.ply", "little.ply", "big.ply"])
@pytest.mark.parametrize("outline", [U, SPLIT_U], ids=["U", "split"])
def test_concave_faces_have_their_own_area(
    tmp_path: Path, name: str, outline: list[tuple[int, int]]
) -> None:
    """A block of U section, quadrangles beside octagons: volume and area in closed form."""
    mesh = load_mesh(written(tmp_path / name, *prism(outline, 7.0)))
    length = 2 * (60 + 40) + 2 * 30
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(U_MM2 * 7, rel=1e-9)
    assert mesh.area == pytest.approx(2 * U_MM2 + length * 7, rel=1e-9)


@pytest.mark.parametrize(
    ("outline", "ring", "area"),
    [
        (U, range(8), U_MM2),
        (U, range(7, -1, -1), U_MM2),
        (SPLIT_U, range(12), U_MM2),
        (FRAME, FRAME_RING, FRAME_MM2),
        ([*FRAME, (30, 0)], [0, 8, *FRAME_RING[1:]], FRAME_MM2),
        ([(0, 0), (9, 9), (0, 18), (3, 9)], range(4), 54.0),
        # Two triangles that touch in the corner they share.
        ([(0, 0), (4, 0), (2, 2), (0, 4), (4, 4)], [0, 1, 2, 4, 3, 2], 8.0),
    ],
    ids=["U", "clockwise", "collinear", "hole", "hole-collinear", "arrow", "touching"],
)
def test_a_face_is_covered_once(outline: list[tuple[int, int]], ring: list[int], area: int) -> None:
    """In the face's direction, and every corner keeps its place."""
    vertices, corners = turned(outline), np.array(ring)
    mesh = PolygonMesh(vertices, corners, np.array([len(corners)]))
    faces, owner = triangles_of(mesh)
    assert areas(vertices, faces).sum() == pytest.approx(area, rel=1e-12)
    assert areas(vertices, faces).min() > 1e-9
    assert not owner.any()
    assert set(faces.ravel()) == set(corners)
    ring_points = vertices[corners] - vertices[corners[0]]
    normal = np.cross(ring_points, np.roll(ring_points, -1, axis=0)).sum(axis=0)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    assert (np.cross(b - a, c - a) @ normal > 0).all()


def test_many_random_faces_are_covered_once() -> None:
    """Closed forms: the area of the outline, seen along the mean normal; bent by 0.1 mm."""
    rng = np.random.default_rng(3)
    for count in rng.integers(5, 30, 60):
        angle = (np.arange(count) + rng.uniform(-0.4, 0.4, count)) * 2 * np.pi / count
        radius = rng.uniform(10, 50, count)
        plan = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
        bent = np.column_stack([plan, rng.uniform(-0.05, 0.05, count)])
        faces, _ = triangles_of(PolygonMesh(bent, np.arange(count), np.array([count])))
        normal = np.cross(bent, np.roll(bent, -1, axis=0)).sum(axis=0)
        a, b, c = np.moveaxis(bent[faces], 1, 0)
        each = np.cross(b - a, c - a) @ normal / np.linalg.norm(normal)
        assert len(faces) == count - 2
        assert each.min() > 0
        assert each.sum() == pytest.approx(np.linalg.norm(normal), rel=1e-9)


@pytest.mark.parametrize("name", ["a.obj", "a.off", "text.ply", "little.ply"])
def test_a_face_that_crosses_itself_is_refused(tmp_path: Path, name: str) -> None:
    vertices = np.array([[0.0, 0, 0], [10, 10, 0], [10, 0, 0], [0, 20, 0]])
    file = written(tmp_path / name, vertices, [[0, 1, 2], [0, 1, 2, 3]])
    with pytest.raises(InputError, match=r"\w+\.\w+: face 2: crosses itself"):
        load_mesh(file)


def test_a_ply_file_of_an_old_program_is_read(tmp_path: Path) -> None:
    """A Latin-1 comment, DOS line ends, an element of another kind, lists before the corners."""
    head = [b"ply", b"format binary_little_endian 1.0", b"comment Gr\xf6\xdfe in mm"]
    head += [b"element camera 1", b"property float focus"]
    head += [b"element vertex 4", b"property float x", b"property float y", b"property double z"]
    head += [b"element face 2", b"property uchar flags", b"property list uchar float texcoord"]
    head += [b"property list uchar uint vertex_index", b"end_header"]
    corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
    body = struct.pack("<f", 5.0) + b"".join(struct.pack("<ffd", x, y, 2.0) for x, y in corners)
    body += struct.pack("<BB6fB3I", 7, 6, *range(6), 3, 0, 1, 2)
    body += struct.pack("<BBB3I", 7, 0, 3, 0, 2, 3)
    (tmp_path / "old.ply").write_bytes(b"\r\n".join(head) + b"\r\n" + body)
    mesh = load_mesh(tmp_path / "old.ply")
    assert mesh.area == pytest.approx(1.0)
    np.testing.assert_array_equal(mesh.vertices[:, 2], 2.0)


@pytest.mark.parametrize("kind", ["obj", "off", "ply"])
def test_a_byte_order_mark_is_no_part_of_a_mesh(tmp_path: Path, kind: str) -> None:
    plain = written(tmp_path / f"text.{kind}", *prism([(0, 0), (2, 0), (0, 1)], 3.0))
    marked = tmp_path / f"marked.{kind}"
    marked.write_bytes(codecs.BOM_UTF8 + plain.read_bytes())
    one, other = load_mesh(plain), load_mesh(marked)
    np.testing.assert_array_equal(one.vertices, other.vertices)
    np.testing.assert_array_equal(one.faces, other.faces)


def test_rows_of_nothing_take_no_memory(tmp_path: Path) -> None:
    plain = written(tmp_path / "text.ply", *prism([(0, 0), (2, 0), (0, 1)], 3.0))
    text = plain.read_bytes()
    many = tmp_path / "many.ply"
    many.write_bytes(text.replace(b"end_header", b"element junk 1000000000000\nend_header", 1))
    np.testing.assert_array_equal(load_mesh(many).faces, load_mesh(plain).faces)


def test_an_obj_file_counts_back_from_where_it_is(tmp_path: Path) -> None:
    """-1 is the last vertex so far, not the file's last."""
    (tmp_path / "a.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nf -3 -2 \\\n-1\n"
        "v 0 0 9\nv 2 0 9\nv 2 2 9\nf -3//1 -2//1 -1//1\n"
    )
    heights = load_mesh(tmp_path / "a.obj").triangles[:, :, 2]
    np.testing.assert_array_equal(heights, [[0, 0, 0], [9, 9, 9]])


def coloured_ply(kind: str, names: str, colour: str) -> str:
    """A triangle whose corners have three more properties, all of one colour."""
    props = "".join(f"property {kind} {name}\n" for name in names.split())
    corners = "".join(f"{place} 0 {colour}\n" for place in ("0 0", "1 0", "0 1"))
    head = HEAD.format(kind="ascii", n=3, m=1, more="", props=XYZ + props)
    return f"{head}{corners}3 0 1 2\n"


COLOURED = {
    "rgb.ply": coloured_ply("uchar", "r g b", "128 64 0"),
    "float.ply": coloured_ply("float", "red green blue", ".501 .25 0"),
    "wide.ply": coloured_ply("ushort", "red green blue", "32896 16448 0"),
    "face.ply": "ply\nformat ascii 1.0\nelement vertex 3\n" + XYZ + "element face 1\n"
    "property list uchar int vertex_indices\nproperty uchar red\nproperty uchar green\n"
    "property uchar blue\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 128 64 0\n",
    "bytes.obj": "".join(f"v {x} {y} 0 128 64 0\n" for x, y in U[:3]) + "f 1 2 3\n",
    "shares.obj": "".join(f"v {x} {y} 0 .502 .251 0\n" for x, y in U[:3]) + "f 1 2 3\n",
    "vertex.off": "COFF 3 1 0\n0 0 0 128 64 0 255\n1 0 0 128 64 0 255\n0 1 0 128 64 0 255\n3 0 1 2",
    "face.off": "OFF\n3 1 0\n0 0 0 # a comment\n1 0 0\n0 1 0\n3 0 1 2 .502 .251 0.0\n",
    "normals.off": "CNOFF\n3 1 0\n0 0 0 0 0 1 128 64 0\n1 0 0 0 0 1 128 64 0\n"
    "0 1 0 0 0 1 128 64 0\n3 0 1 2\n",
}


@pytest.mark.parametrize("name", COLOURED)
def test_colours_are_read_wherever_a_format_keeps_them(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(COLOURED[name])
    mesh = load_mesh(tmp_path / name)
    np.testing.assert_array_equal(mesh.visual.vertex_colors[:, :3], [[128, 64, 0]] * 3)


@pytest.mark.parametrize("name", ["plain.stl", "coloured.ply"])
def test_a_triangle_that_stands_in_a_file_again_is_left_out(tmp_path: Path, name: str) -> None:
    """Whichever corner it begins with; the other way round it is the back of a sheet."""
    triangle = np.eye(3)
    three = np.vstack([triangle, triangle[[1, 2, 0]], triangle[::-1]])
    mesh = trimesh.Trimesh(three, np.arange(9).reshape(3, 3), process=False)
    if name == "coloured.ply":
        mesh.visual.vertex_colors = [128, 64, 0, 255]
    mesh.export(tmp_path / name)
    found = load_mesh(tmp_path / name)
    assert found.metadata[TWICE] == "repeats triangles, which count once: 1"
    np.testing.assert_array_equal(found.triangles, three.reshape(3, 3, 3)[[0, 2]])
    assert found.visual.kind == mesh.visual.kind


UNREAD_FILES = {
    "material.obj": "usemtl steel\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "intensity.ply": HEAD.format(
        kind="ascii", n=3, m=1, more="", props=XYZ + "property float intensity\n"
    )
    + "0 0 0 .5\n1 0 0 .5\n0 1 0 .5\n3 0 1 2\n",
    "picture.ply": HEAD.format(
        kind="ascii", n=3, m=1, more="comment TextureFile a.png\n", props=XYZ
    )
    + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
    "map.off": "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 7\n",
}


@pytest.mark.parametrize("name", UNREAD_FILES)
def test_a_reflectance_that_is_not_read_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(UNREAD_FILES[name])
    unread = load_mesh(tmp_path / name).metadata[UNREAD]
    words = {"material": "usemtl steel", "intensity": "'intensity'", "picture": "a.png"}
    assert words.get(name.split(".")[0], "colour map") in unread


def test_colours_of_an_stl_file_are_named(tmp_path: Path) -> None:
    file = tmp_path / "a.stl"
    trimesh.creation.box().export(file)
    assert UNREAD not in load_mesh(file).metadata
    content = bytearray(file.read_bytes())
    content[84 + 48 : 84 + 50] = struct.pack("<H", 0x8000 | 31)
    file.write_bytes(bytes(content))
    assert load_mesh(file).metadata[UNREAD] == "colours of an STL file"


def test_a_colour_out_of_range_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0 1 2 300\nv 1 0 0 1 2 3\nv 0 1 0 1 2 3\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"a\.obj: has a colour out of range \(got 300\.0; .*255"):
        load_mesh(tmp_path / "a.obj")
