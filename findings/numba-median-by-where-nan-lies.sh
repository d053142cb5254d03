#!/usr/bin/env bash
# A compiled median of values with one NaN among them is NaN or a number, by where the NaN stands.
#
# Seen with numba 0.68.1 and 0.61.2, NumPy 2.2.6 (PyPI), Python 3.11, Linux x86_64.
# Input: the widths of a laser line in four columns, one of which has no line (NaN), in every order
# of the four.
# Output: NumPy's median is NaN for each of the 24 orders.  numba's np.median, compiled, is NaN for 14
# of them and a number for 10, such as 2.5 for NaN, 1, 2, 3: the mean of 2 and 3.
# Expected: NaN in all, as without numba.
# What follows: loops over columns that may hold no line look for NaN before they take a median.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

cat >"$folder/show.py" <<'PYTHON'
import sys
from itertools import permutations

import numba
import numpy as np


@numba.njit
def compiled(values):
    return np.median(values)


orders = [np.array(order) for order in permutations([1.0, 2.0, 3.0, np.nan])]
by_numpy = [np.median(order) for order in orders]
by_numba = [compiled(order) for order in orders]
numbers = np.count_nonzero(np.isfinite(by_numba))
first = compiled(np.array([np.nan, 1.0, 2.0, 3.0]))
print(numba.__version__, np.__version__, numbers, "of", len(orders), "are numbers;", first)
sys.exit(not (np.isnan(by_numpy).all() and 0 < numbers < len(orders) and first == 2.5))
PYTHON

for version in 0.61.2 0.68.1; do
    python3 -m venv "$folder/$version"
    "$folder/$version/bin/python" -m pip install --quiet --disable-pip-version-check \
        --only-binary :all: "numba==$version" numpy==2.2.6
    "$folder/$version/bin/python" "$folder/show.py"
done
