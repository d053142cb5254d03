#!/usr/bin/env bash
# One concave face, an octagon in the shape of a U of 1200 mm2, as OBJ, PLY and OFF: what area the
# readers of four mesh libraries make of it.  The three formats allow faces of any simple outline.
#
# Seen on Debian 12, x86_64, Python 3.11:
#
#                             OBJ    PLY    OFF
#   trimesh 5.2.0             2700   2700   2700   a fan from the first corner
#   pymeshlab 2025.7.post1    1200   2700   1200   right, but PLY is fanned
#   libigl 2.6.3              2700   -      2700   fans; of PLY it gives one row of 8 corners, though
#                                                  the function is called read_triangle_mesh
#   vtk 9.7.2                 1200   1200   -      right; it has no reader of OFF
#
# A fan covers the notch of the U, twice in part, and keeps every edge: the mesh still counts as
# watertight, and its volume is right where the ends of a prism are fanned alike.  Within one
# library the same block is right or wrong by its file's ending.
#
# What follows for others: write triangles where the reader is not known; do not take
# "watertight" for "right".
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check \
    numpy==2.4.6 trimesh==5.2.0 pymeshlab==2025.7.post1 libigl==2.6.3 vtk==9.7.2 >&2

venv/bin/python - 2>messages <<'PYTHON' || { cat messages >&2; exit 1; }
import sys
from pathlib import Path

import igl
import numpy as np
import pymeshlab
import trimesh
import vtk
from vtk.util.numpy_support import vtk_to_numpy

corners = [(0, 0), (60, 0), (60, 40), (50, 40), (50, 10), (10, 10), (10, 40), (0, 40)]
points = [f"{x} {y} 0" for x, y in corners]
listed, ring = "\n".join(points), " ".join(map(str, range(8)))
Path("u.obj").write_text("".join(f"v {p}\n" for p in points) + "f 1 2 3 4 5 6 7 8\n")
Path("u.off").write_text(f"OFF\n8 1 0\n{listed}\n8 {ring}\n")
axes = "".join(f"property float {axis}\n" for axis in "xyz")
Path("u.ply").write_text(
    f"ply\nformat ascii 1.0\nelement vertex 8\n{axes}element face 1\n"
    f"property list uchar int vertex_indices\nend_header\n{listed}\n8 {ring}\n"
)


def area(vertices, faces):
    a, b, c = np.moveaxis(np.asarray(vertices, dtype=float)[np.asarray(faces)], 1, 0)
    return round(float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2))


def of_trimesh(file):
    mesh = trimesh.load_mesh(file, process=False)
    return area(mesh.vertices, mesh.faces)


def of_pymeshlab(file):
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(file)
    return area(meshes.current_mesh().vertex_matrix(), meshes.current_mesh().face_matrix())


def of_libigl(file):
    vertices, faces = igl.read_triangle_mesh(file)[:2]
    return area(vertices, faces) if faces.shape[1] == 3 else faces.shape


def of_vtk(file):
    reader = {"obj": vtk.vtkOBJReader, "ply": vtk.vtkPLYReader}[file[-3:]]()
    reader.SetFileName(file)
    triangles = vtk.vtkTriangleFilter()
    triangles.SetInputConnection(reader.GetOutputPort())
    triangles.Update()
    mesh = triangles.GetOutput()
    faces = vtk_to_numpy(mesh.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    return area(vtk_to_numpy(mesh.GetPoints().GetData()), faces)


expected = {
    of_trimesh: (2700, 2700, 2700),
    of_pymeshlab: (1200, 2700, 1200),
    of_libigl: (2700, (1, 8), 2700),
    of_vtk: (1200, 1200),
}
changed = False
for reader, areas in expected.items():
    files = ("u.obj", "u.ply", "u.off")[: len(areas)]
    seen = tuple(reader(file) for file in files)
    print(reader.__name__, dict(zip(files, seen)))
    changed |= seen != areas
sys.exit("this is not what was seen before" if changed else 0)
PYTHON
