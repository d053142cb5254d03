#!/usr/bin/env bash
# SciPy's median filter leaves the median of few values unset, and says nothing.
#
# Seen with scipy 1.15.3 and 1.16.0, NumPy 2.0.2 (PyPI), Python 3.11, Linux x86_64; right with scipy
# 1.16.1 and 1.17.0.  (1.15.0 to 1.15.2 end the process on some such rows: known to SciPy.)
# Input: eight values, as of a laser line over eight columns, in a window of 31, mode "nearest".
# Output: with output=... none of its eight places is written; without, they hold what the memory
# held.  The same values as a picture of one row have the right medians in all four versions, and a
# window of 17 or less is right with a single axis too.
# Expected: the medians, for mode "nearest" says what lies beyond the ends.
# What follows: whoever smooths rows of varying length hands one row of a picture, not an array of
# one axis.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

cat >"$folder/show.py" <<'PYTHON'
import sys

import numpy as np
import scipy
from scipy.ndimage import median_filter

row = np.array([3.0, 1, 2, 5, 4, 7, 6, 8])
medians = np.array([3.0, 3, 3, 4, 5, 6, 7, 8])  # the ends repeat, so the middle one of 31 leads
written = np.full(8, -1.0)
median_filter(row, 31, mode="nearest", output=written)
print(scipy.__version__, written)
in_a_picture = median_filter(row[None], (1, 31), mode="nearest")[0]
expected = np.full(8, -1.0) if scipy.__version__ in ("1.15.3", "1.16.0") else medians
sys.exit(not (np.array_equal(written, expected) and np.array_equal(in_a_picture, medians)))
PYTHON

for version in 1.15.3 1.16.0 1.16.1 1.17.0; do
    python3 -m venv "$folder/$version"
    "$folder/$version/bin/python" -m pip install --quiet --disable-pip-version-check \
        "scipy==$version" numpy==2.0.2
    "$folder/$version/bin/python" "$folder/show.py"
done
