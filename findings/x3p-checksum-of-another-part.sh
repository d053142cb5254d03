#!/usr/bin/env bash
# Versions: SurfaceTopography 1.27.1, surfalize 0.19.2, x3pio 2.0.0, verity_x3p 0.2.0 (PyPI),
# Python 3.11.
#
# What is done: SurfaceTopography writes 12 heights to an X3P file (ISO 25178-72), and others read it.
#
# What happens: md5checksum.hex, which is to hold the checksum of main.xml, holds that of the heights,
# bindata/data.bin, and names that.  surfalize and x3pio compare it and refuse the file; verity_x3p
# reads it.
#
#     md5checksum.hex   3A8A...477E *bindata/data.bin
#     surfalize         CorruptedFileError: Checksum of main.xml file does not match expected ...
#     x3pio             X3pChecksumError: The MD5 checksum of main.xml does not match its content
#     verity_x3p        reads it
#
# What would help: x3pio.read(file, verify=False).
#
# Exits with 1 where this has changed.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check \
    SurfaceTopography==1.27.1 surfalize==0.19.2 x3pio==2.0.0 verity-x3p==0.2.0

"$folder/venv/bin/python" -W ignore - "$folder/heights.x3p" <<'PYTHON'
import hashlib
import sys
import zipfile

import numpy as np
import surfalize
import verity_x3p
import x3pio
from SurfaceTopography import Topography
from SurfaceTopography.IO.X3P import write_x3p

file = sys.argv[1]
write_x3p(Topography(np.arange(12.0).reshape(4, 3) * 1e-6, (4e-3, 3e-3), unit="m"), file)
with zipfile.ZipFile(file) as archive:
    stated = archive.read("md5checksum.hex").decode()
    heights = hashlib.md5(archive.read("bindata/data.bin")).hexdigest()
said = []
for read in (surfalize.Surface.load, x3pio.read, verity_x3p.read_x3p):
    try:
        read(file)
        said.append("reads it")
    except Exception as error:
        said.append(f"{type(error).__name__}: {error}")
print("md5checksum.hex  ", stated.strip())
for name, words in zip(("surfalize", "x3pio", "verity_x3p"), said, strict=True):
    print(f"{name:17}", words)
same = (
    stated.lower() == f"{heights} *bindata/data.bin\n"
    and [words.split(":")[0] for words in said]
    == ["CorruptedFileError", "X3pChecksumError", "reads it"]
)
sys.exit(0 if same else "the behaviour has changed")
PYTHON
