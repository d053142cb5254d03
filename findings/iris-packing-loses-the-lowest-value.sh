#!/usr/bin/env bash
# Versions: scitools-iris 3.14.1, netCDF4 1.7.4, xarray 2025.6.1, NumPy 2.2.6 (PyPI), Python 3.11.
#
# What is done: a cube of the heights 9, 10, 11 mm and one masked point is saved by
# iris.save(cube, file, packing=np.int16), and the file is read again.
#
# What happens: the lowest height is lost.  iris spreads the values over -32767 ... 32767, and
# -32767 is also what it stores for masked points: netCDF's default fill value of 16-bit integers.
# It writes no _FillValue.  So iris and netCDF4 read both the lowest height and the masked point as
# masked, and xarray, which knows no default fill value, reads both as 9:
#
#     stored   [-32767, 0, 32767, -32767]
#     iris     [masked, 10.0, 11.0, masked]
#     xarray   [9.0, 10.0, 11.0, 9.0]
#
# Without a masked point all values come back.  What would help: 2^16 - 3 steps, from -32766 on, or
# fill_value= stated with packing=.
#
# Exits with 1 where this has changed.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    scitools-iris==3.14.1 netCDF4==1.7.4 xarray==2025.6.1 numpy==2.2.6 'xxhash<4'

"$folder/venv/bin/python" -W ignore - "$folder/packed.nc" <<'PYTHON'
import sys

import iris
import netCDF4
import numpy as np
import xarray
from iris.cube import Cube

file = sys.argv[1]
heights = np.ma.masked_array([9.0, 10.0, 11.0, 0.0], mask=[False, False, False, True])
iris.save(Cube(heights, long_name="height", units="mm"), file, packing=np.int16)

with netCDF4.Dataset(file) as data:
    height = data["height"]
    names = height.ncattrs()
    height.set_auto_maskandscale(False)
    stored = height[:].tolist()
by_iris = iris.load_cube(file).data
by_xarray = xarray.open_dataset(file).height.values

print("stored  ", stored, "attributes", names)
print("iris    ", by_iris)
print("xarray  ", by_xarray)
same = (
    stored == [-32767, 0, 32767, -32767]
    and "_FillValue" not in names
    and np.ma.getmaskarray(by_iris).tolist() == [True, False, False, True]
    and np.allclose(by_xarray, [9.0, 10.0, 11.0, 9.0], atol=1e-4)
)
sys.exit(0 if same else "the behaviour has changed")
PYTHON
