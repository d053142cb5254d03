#!/usr/bin/env bash
# A JPEG file with a hole in its middle is a picture like any other to OpenCV and to Pillow.
#
# 400 bytes are cut out of the coded data of a JPEG of 640 by 480 px, as a lost packet of a camera
# leaves it: all markers are there, SOI first and EOI last.
#
# Seen with opencv-python-headless 4.12.0.88, Pillow 11.3.0, NumPy 2.2.6 (Linux, Python 3.11):
#   cv2.imdecode returns a picture of the full size; 6,519 of its pixels are wrong by more
#     than 30 of 255, since all blocks after the hole are shifted, and the end is
#     filled with grey.  "Corrupt JPEG data" goes to the process's standard error, not to the caller.
#   Pillow, with ImageFile.LOAD_TRUNCATED_IMAGES at its default False, which promises an error for
#     truncated files, returns the same pixels without error and without warning.
# So neither result, exception nor warning tells a caller that a picture came damaged.
#
# Exits non-zero where this changes.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet opencv-python-headless==4.12.0.88 pillow==11.3.0 numpy==2.2.6
"$folder/venv/bin/python" - <<'PYTHON'
import io
import warnings

import cv2
import numpy as np
from PIL import Image, ImageFile

warnings.simplefilter("error")
rows, columns = np.arange(480)[:, None], np.arange(640)
line = 200 * np.exp(-0.5 * ((rows - 240 - 40 * np.sin(columns / 60)) / 2.5) ** 2)
grey = np.clip(20 + line + np.random.default_rng(1).normal(0, 3, line.shape), 0, 255)
whole = cv2.imencode(".jpg", grey.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()
middle = len(whole) // 2
holed = whole[:middle] + whole[middle + 400 :]

right = cv2.imdecode(np.frombuffer(whole, np.uint8), cv2.IMREAD_GRAYSCALE).astype(int)
by_opencv = cv2.imdecode(np.frombuffer(holed, np.uint8), cv2.IMREAD_GRAYSCALE)
assert by_opencv is not None and by_opencv.shape == right.shape, "OpenCV refuses it"
assert ImageFile.LOAD_TRUNCATED_IMAGES is False
by_pillow = np.asarray(Image.open(io.BytesIO(holed)))
wrong = int((np.abs(by_opencv - right) > 30).sum())
print(f"{len(whole)} bytes, 400 cut out; pixels wrong by more than 30: {wrong}")
print("OpenCV and Pillow alike:", np.array_equal(by_opencv, by_pillow))
assert wrong > 2000 and np.array_equal(by_opencv, by_pillow)
PYTHON
echo "as described"
