#!/usr/bin/env bash
# trimesh 5.2.0 (NumPy 2.4.6, Pillow 12.0.0, Python 3.11): a PLY mesh whose header names its texture in the way MeshLab
# writes it, "comment TextureFile skin.png", is read from an open file.  The mesh is right, three vertices and one
# triangle, but its log gets the warning "unable to load image!" with the traceback of
# "AttributeError: 'NoneType' object has no attribute 'get'", which a program without handlers of its own shows on
# standard error: where a mesh comes from a stream nothing can look for the picture, and that case is not asked for.
# skip_materials=True, which reads no picture, keeps it quiet.  Without Pillow nothing is said either way.
#
# Exits 0 where all that is so still, 1 where it has changed.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet trimesh==5.2.0 numpy==2.4.6 pillow==12.0.0

cat > "$folder/look.py" <<'PYTHON'
import io
import sys

import trimesh

PLY = """ply
format ascii 1.0
comment TextureFile skin.png
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
3 0 1 2
"""
mesh = trimesh.load_mesh(
    io.BytesIO(PLY.encode()), file_type="ply", skip_materials=sys.argv[1] == "skip"
)
assert mesh.vertices.shape == (3, 3) and mesh.faces.tolist() == [[0, 1, 2]]
PYTHON

"$folder/venv/bin/python" "$folder/look.py" read 2> "$folder/read.txt"
"$folder/venv/bin/python" "$folder/look.py" skip 2> "$folder/skip.txt"
grep -q "unable to load image!" "$folder/read.txt"
grep -q "AttributeError: 'NoneType' object has no attribute 'get'" "$folder/read.txt"
test ! -s "$folder/skip.txt"
echo "as before: a traceback on standard error for a texture that a stream cannot have"
