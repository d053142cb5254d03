#!/usr/bin/env bash
# h5py 3.16.0 (HDF5 2.0.0): the same content has other bytes by path than by a file object.
#
# A file of three groups with one small data set each, without time stamps, is written by its path,
# and into a file object of Python (io.BytesIO; an open file gives the same).  Each way gives the
# same bytes again and again, but the two differ, in size too: 7,088 bytes by path, 5,340 by object.
# The core driver gives what the path does.  So a hash of an HDF5 file says how it was opened, not only what
# it holds: who promises the same bytes has to fix the driver as well as track_times.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet h5py==3.16.0 numpy==2.4.1
cd "$folder"
cat > bytes.py <<'PY'
import hashlib
import io
from pathlib import Path

import h5py
import numpy as np


def fill(file):
    for number in range(3):
        group = file.create_group(f"{number:03d}")
        group.create_dataset("a", data=np.arange(100, dtype=np.uint8), track_times=False)


def by_path(**how):
    with h5py.File("path.h5", "w", **how) as file:
        fill(file)
    return Path("path.h5").read_bytes()


def by_object():
    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        fill(file)
    return stream.getvalue()


def by_open_file():
    with open("open.h5", "w+b") as stream, h5py.File(stream, "w") as file:
        fill(file)
    return Path("open.h5").read_bytes()


path, object_ = by_path(), by_object()
for name, data in (("path", path), ("object", object_)):
    print(name, len(data), hashlib.sha256(data).hexdigest()[:16])
assert path == by_path() == by_path(driver="core")
assert object_ == by_object() == by_open_file()
assert path != object_ and (len(path), len(object_)) == (7088, 5340)
PY
"$folder/venv/bin/python" bytes.py
