"""Mesh files of strangers: whatever they hold, they are read, or refused in one line."""

import os
import re
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.errors import InputError
from lscan.files.meshes import load_mesh

MANY = 1_000_000_000
CORNERS = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]]).tobytes()
KINDS = ("ply", "stl", "obj", "off")


def ply(form: str, vertices: int, faces: int, count: str = "uchar") -> bytes:
    lines = ["ply", f"format {form} 1.0", f"element vertex {vertices}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"element face {faces}", f"property list {count} int vertex_indices", "end_header"]
    return "\n".join(lines).encode() + b"\n"


BINARY = "binary_little_endian"
TEXT = b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
FACE = b"\x03" + struct.pack("<3i", 0, 1, 2)
OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
HEADER = ply("ascii", 3, 1)
REFUSED: dict[str, tuple[bytes, str]] = {
    "binary.obj": (bytes(range(256)), "is no text, or one in UTF-16"),
    "wide.obj": ((OBJ + b"f 1 2 3\n").decode().encode("utf-16"), "is no text, or one in UTF-16"),
    "wide.off": ("OFF\n3 1 0\n".encode("utf-16"), "is no text, or one in UTF-16"),
    "letters.obj": (b"\xff\xd8\xe0" * 99, "holds no triangles"),
    "word.obj": (OBJ + b"v 1 x 2\nf 1 2 3\n", "line without its numbers (got 'v 1 x 2')"),
    "corner.obj": (OBJ + b"f 1 two 3\n", "line without its numbers (got 'f 1 two 3')"),
    "ragged.obj": (OBJ + b"v 1 2\nf 1 2 3\n", "different numbers of values (got [2, 3])"),
    "wide.ply": (HEADER.decode().encode("utf-16"), "has no header from 'ply' to 'end_header'"),
    "huge.ply": (ply(BINARY, 10**30, 1) + CORNERS, f"says (got {10**30}; allowed: 3 by its size)"),
    "long.ply": (ply("ascii", 3, 10**18) + TEXT, f"says (got {10**18}; allowed: 4 by its size)"),
    "word.ply": (HEADER + TEXT.replace(b"1", b"one"), "has a word that is no number"),
    "kind.ply": (HEADER.replace(b"float x", b"real x") + TEXT, "got 'property real x'"),
    "again.ply": (HEADER.replace(b"float y", b"float x") + TEXT, "got 'property float x'"),
    "count.ply": (HEADER.replace(b"face 1", b"face 1.5") + TEXT, "got 'element face 1.5'"),
    "plane.ply": (HEADER.replace(b"float z", b"float w") + TEXT, "no vertices of x, y and z"),
    "list.ply": (HEADER + TEXT.replace(b"3 0 1", b"nan 0 1"), "no PLY, damaged, or cut short"),
    "word.off": (b"OFF\nthree 1 0\n" + TEXT, "no OFF, damaged, or cut short"),
    "cut.stl": (bytes(80) + struct.pack("<I", 9) + bytes(99), "holds no triangles"),
}
MALICIOUS: dict[str, bytes] = {
    "vertices.ply": ply(BINARY, MANY, 1) + CORNERS + FACE,
    "faces.ply": ply(BINARY, 3, MANY) + CORNERS + FACE,
    "corners.ply": ply(BINARY, 3, 1, "uint") + CORNERS + struct.pack("<I3i", MANY, 0, 1, 2),
    "negative.ply": ply(BINARY, -5, 1) + CORNERS + FACE,
    "text.ply": ply("ascii", MANY, 1) + TEXT,
    "index.ply": ply(BINARY, 3, 1) + CORNERS + b"\x03" + struct.pack("<3i", 0, 1, MANY),
    "below.ply": ply(BINARY, 3, 1) + CORNERS + b"\x03" + struct.pack("<3i", 0, 1, -MANY),
    "endless.ply": b"ply\nformat ascii 1.0\n" + b"comment\n" * 1000,
    "faces.stl": bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50),
    "none.stl": b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n",
    "index.obj": OBJ + b"f 1 2 1000000000000\n",
    "below.obj": OBJ + b"f 1 2 -1000000000\n",
    "nan.obj": b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "line.obj": b"v 0\nv 1\nv 2\nf 1 2 3\n",
    "far.obj": b"v 1e30 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "vertices.off": b"OFF\n1000000000 1 0\n" + TEXT,
    "archive.zip": b"PK\x03\x04" + bytes(100),
    "scene.gltf": b'{"buffers": [{"uri": "../../secret", "byteLength": 9}]}',
    "scene.glb": b"glTF" + struct.pack("<II", 2, 2**32 - 1),
    "no-ending": b"",
}


@pytest.mark.parametrize("name", MALICIOUS)
def test_a_mesh_with_a_wrong_header_is_one_clear_error(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(MALICIOUS[name])
    with pytest.raises(InputError) as caught:
        load_mesh(tmp_path / name)
    assert str(caught.value).startswith(str(tmp_path / name))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", REFUSED)
def test_a_mesh_is_refused_in_words_of_ours(tmp_path: Path, name: str) -> None:
    """Not in those of Python, NumPy or trimesh."""
    content, said = REFUSED[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=re.escape(said)) as caught:
        load_mesh(tmp_path / name)
    assert str(caught.value).startswith(f"{tmp_path / name}: ")


@pytest.mark.parametrize("special", ["fifo", "device", "sparse"])
def test_what_is_no_plain_mesh_file_is_refused(tmp_path: Path, special: str) -> None:
    file = tmp_path / "mesh.stl"
    if special == "fifo":
        os.mkfifo(file)
    elif special == "device":
        file.symlink_to("/dev/zero")
    else:
        file.touch()
        os.truncate(file, 2**40)
    with pytest.raises(InputError, match=r"mesh\.stl: (cannot be read: it is a|is too large)"):
        load_mesh(file)


@pytest.mark.parametrize("named", ["m.mtl", "/dev/zero", "../secret.mtl"])
def test_other_files_that_a_mesh_names_are_not_opened(tmp_path: Path, named: str) -> None:
    """The first is a FIFO beside it, which would be waited for."""
    os.mkfifo(tmp_path / "m.mtl")
    file = tmp_path / "mesh.obj"
    file.write_bytes(f"mtllib {named}\nusemtl a\n".encode() + OBJ + b"f 1 2 3\n")
    assert len(load_mesh(file).faces) == 1


@pytest.mark.parametrize("kind", KINDS)
@examples(60)
@given(data=st.data())
def test_a_mutated_mesh_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, kind: str, data: st.DataObject
) -> None:
    whole = trimesh.creation.box().export(file_type=kind)
    changed = bytearray(whole if isinstance(whole, bytes) else whole.encode())
    for _ in range(data.draw(st.integers(0, 4))):
        changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
    end = data.draw(st.just(len(changed)) | st.integers(0, len(changed)))
    file = tmp_path_factory.getbasetemp() / f"mutated.{kind}"
    file.write_bytes(bytes(changed[:end]))
    try:
        assert np.isfinite(load_mesh(file).vertices).all()
    except InputError as error:
        assert file.name in str(error)
        assert "\n" not in str(error)
