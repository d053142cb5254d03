#!/usr/bin/env bash
# Versions: SurfaceTopography 1.27.1, surfalize 0.19.2 (PyPI), Python 3.11.
#
# What is done: surfalize writes 11 heights and one missing point to a binary SDF file (ISO 25178-71,
# double precision, as it does by default), and to one in text; SurfaceTopography reads both.
#
# What happens: a missing point of the binary form is the least number of its type.  Of whole numbers
# SurfaceTopography takes that for missing, of real ones it does not: the point becomes a height of
# -1.8e308 steps, -inf once it is scaled.  That in text, BAD, is read as missing.
#
#     binary   undefined data: False, least height -inf
#     text     undefined data: True, least height 0.0
#
# What would help: SDF of 32-bit integers, which Gwyddion 2.62 and surfalize read alike (Gwyddion
# stops at the first BAD of a text file: "End of file reached when reading sample #0").
#
# Exits with 1 where this has changed.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    SurfaceTopography==1.27.1 surfalize==0.19.2

"$folder/venv/bin/python" -W ignore - "$folder" <<'PYTHON'
import sys

import numpy as np
import surfalize
from SurfaceTopography import read_topography

heights = np.arange(12.0).reshape(3, 4)
heights[1, 1] = np.nan
surface = surfalize.Surface(heights, 1.0, 1.0)
found = {}
for form, binary in (("binary", True), ("text", False)):
    file = f"{sys.argv[1]}/{form}.sdf"
    surface.save(file, binary=binary)
    read = read_topography(file)
    found[form] = bool(read.has_undefined_data), float(np.ma.min(read.heights()))
    print(f"{form:8} undefined data: {found[form][0]}, least height {found[form][1]}")
same = found == {"binary": (False, -np.inf), "text": (True, 0.0)}
sys.exit(0 if same else "the behaviour has changed")
PYTHON
