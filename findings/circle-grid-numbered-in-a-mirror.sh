#!/usr/bin/env bash
# OpenCV's findCirclesGrid numbers a turned symmetric grid as its mirror image, and says it was found.
#
# Seen with opencv-python-headless 5.0.0.93 and 4.12.0.88, NumPy 2.2.6 (PyPI), Python 3.11, Linux x86_64.
# Input: a drawn grid of 7 by 5 dots, 60 px apart, without perspective, turned in the picture by 0 to
# 180 degrees; nothing hidden, no noise.
# Output: (first row) x (first column), the sign of its area.  Turned by 0, 20 and 180 degrees it is
# positive, as of a board seen from its front; by 45, -45 and 60 degrees it is negative: rows run up
# where they should run down, or leftwards.  The return value is true each time.
# Expected: one of the two numberings of the front, or false.
# What follows: a pose from these points shows the board from behind, with as small a residual, and a
# calibration from several views mixes both.  Whoever uses it compares that sign, view by view.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

cat >"$folder/show.py" <<'PYTHON'
import sys

import cv2
import numpy as np


def area(degrees):
    """Of the grid's first row and first column as numbered, with its sign; None where not found."""
    picture = np.full((480, 640), 255, np.uint8)
    turn = np.deg2rad(degrees)
    matrix = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    for row in range(5):
        for column in range(7):
            place = matrix @ [(column - 3) * 60, (row - 2) * 60] + [320, 240]
            u, v = (int(round(16 * at)) for at in place)
            cv2.circle(picture, (u, v), 14 * 16, 0, -1, cv2.LINE_AA, 4)
    found, centres = cv2.findCirclesGrid(picture, (7, 5), flags=cv2.CALIB_CB_SYMMETRIC_GRID)
    if not found:
        return None
    centres = centres.reshape(-1, 2)
    (a, b), (c, d) = centres[6] - centres[0], centres[28] - centres[0]
    return float(a * d - b * c)


seen = {degrees: area(degrees) for degrees in (0, 20, 180, 45, -45, 60)}
for degrees, value in seen.items():
    print(cv2.__version__, f"{degrees:4} degrees:", "not found" if value is None else f"{value:.0f} px2")
as_seen = {0: 1, 20: 1, 180: 1, 45: -1, -45: -1, 60: -1}
sys.exit(any(value is None or np.sign(value) != as_seen[d] for d, value in seen.items()))
PYTHON

for version in 5.0.0.93 4.12.0.88; do
    python3 -m venv "$folder/$version"
    "$folder/$version/bin/python" -m pip install --quiet --disable-pip-version-check \
        "opencv-python-headless==$version" numpy==2.2.6
    "$folder/$version/bin/python" "$folder/show.py"
done
