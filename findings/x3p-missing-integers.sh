#!/usr/bin/env bash
# Versions: verity_x3p 0.2.0, x3pio 2.0.0, surfalize 0.19.2 (PyPI), Python 3.11.
#
# What is done: x3pio writes 11 heights and one missing point to an X3P file (ISO 25178-72) of 16-bit
# integers.  Integers have no NaN: bindata/valid.bin says, bit by bit, which points were measured.
#
# What happens: verity_x3p does not look at it, and takes the missing point for a height.  surfalize
# and x3pio read it as missing.
#
#     x3pio       1 missing
#     surfalize   1 missing
#     verity_x3p  0 missing, and its mask says that all are valid
#
# What would help: float types, whose missing points are NaN.
#
# Exits with 1 where this has changed.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    verity-x3p==0.2.0 x3pio==2.0.0 surfalize==0.19.2

"$folder/venv/bin/python" -W ignore - "$folder/heights.x3p" <<'PYTHON'
import sys

import numpy as np
import surfalize
import verity_x3p
import x3pio

file = sys.argv[1]
heights = np.arange(12.0).reshape(3, 4) * 1e-6
heights[1, 1] = np.nan
x3pio.write(file, heights, x_scale=1e-6, y_scale=1e-6, z_type=x3pio.DataType.INT16)
by_verity = verity_x3p.read_x3p(file)
missing = {
    "x3pio": int(np.isnan(x3pio.read(file).layers[0].z).sum()),
    "surfalize": int(np.isnan(surfalize.Surface.load(file).data).sum()),
    "verity_x3p": int(np.isnan(by_verity.data).sum()),
}
for name, number in missing.items():
    print(f"{name:11} {number} missing")
same = missing == {"x3pio": 1, "surfalize": 1, "verity_x3p": 0} and bool(by_verity.mask.all())
sys.exit(0 if same else "the behaviour has changed")
PYTHON
