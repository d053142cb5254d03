#!/usr/bin/env bash
# viva-genicam's emulated cameras send values of sixteen bits in unpacked formats of ten, twelve and fourteen.
#
# Seen with viva-genicam 0.10.0 (PyPI), NumPy 2.2.6, Python 3.11, Linux x86_64.
# Input: FakeGigeCamera of 64 by 48 px in Mono10, Mono12, Mono14 and, packed, Mono12p; one frame each.
# Output: largest value 65271 in all three unpacked formats, and 4095 in Mono12p.
# Expected: 1023, 4095 and 16383 at most.  The pixel format naming convention of EMVA (PFNC 2.4) puts
# an unpacked pixel's bits lowest and fills the rest with zeros, and the package's own to_numpy says
# that a pixel of twelve bits is 0 to 4095.  It hands out what came: a real camera is not affected.
# What follows: a program that scales by the format's bits is tested on values up to sixteen times
# too large.  Test it with packed formats and Mono16, whose values are right.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    viva-genicam==0.10.0 numpy==2.2.6

cat >"$folder/show.py" <<'PYTHON'
import sys

import viva_genicam
from viva_genicam.testing import FakeGigeCamera

seen = {}
for name in ("Mono10", "Mono12", "Mono14", "Mono12p"):
    with FakeGigeCamera(width=64, height=48, fps=30, pixel_format=name) as fake:
        with viva_genicam.connect_gige(fake.device_info()) as camera, camera.stream() as frames:
            frame = next(iter(frames))
            seen[name] = int(frame.to_numpy().max())
            print(name, frame.pixel_format, "largest value", seen[name])
unpacked = [seen.pop(name) for name in ("Mono10", "Mono12", "Mono14")]
sys.exit(min(unpacked) < 16384 or seen["Mono12p"] > 4095)
PYTHON
"$folder/venv/bin/python" "$folder/show.py"
