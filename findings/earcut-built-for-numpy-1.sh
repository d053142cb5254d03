#!/usr/bin/env bash
# mapbox_earcut 1.0.1 with NumPy 2: wrong triangles, without an error or a warning.
#
# Seen on Debian 12, x86_64, Python 3.11 (all that is installed here has wheels for 3.9 to 3.12).
# The wheels of 1.0.1 were built for NumPy 1, whose
# structures NumPy 2 changed; the package asks for "numpy" of any version, so pip installs the two
# together.  Other packages built for NumPy 1 refuse to be imported (OpenCV 4.10.0.82, shapely
# 2.0.0: "_ARRAY_API not found"); this one is imported, runs, and gives a unit square, corners 0 to
# 3, the triangles 2 2 2 and 2 2 2, which have no area.  A mesh extruded from it by trimesh has a
# volume of 0.  With NumPy 1.26.4 the same wheel gives 2 3 0 and 0 1 2, as 1.0.2 does with NumPy 2.
#
# What follows for others: mapbox_earcut>=1.0.2 where numpy>=2 is allowed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

triangles() { # of the unit square, by NumPy $1 and mapbox_earcut $2
    python3 -m venv "$folder/$1-$2"
    "$folder/$1-$2/bin/python" -m pip install --quiet --disable-pip-version-check \
        --only-binary :all: "numpy==$1" "mapbox_earcut==$2" >&2
    "$folder/$1-$2/bin/python" - <<'PYTHON'
import mapbox_earcut
import numpy as np

square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
print(*mapbox_earcut.triangulate_float64(square, np.array([4], dtype=np.uint32)))
PYTHON
}

verdict=0
expect() {
    local found
    found=$(triangles "$1" "$2")
    echo "numpy $1, mapbox_earcut $2: $found"
    [ "$found" = "$3" ] || { echo "  seen before: $3"; verdict=1; }
}
expect 1.26.4 1.0.1 "2 3 0 0 1 2"
expect 2.0.0 1.0.1 "2 2 2 2 2 2"
expect 2.0.0 1.0.2 "2 3 0 0 1 2"
exit "$verdict"
