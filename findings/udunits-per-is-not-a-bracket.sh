#!/usr/bin/env bash
# Versions: cf-units 3.3.1 with the UDUNITS 2 of its wheel, NumPy 2.2.6 (PyPI), Python 3.11.
#
# What is done: the unit of a relative error of length, "mm per 100 mm", is parsed: what a
# calibration's scale error or an instrument's linearity is stated in.
#
# What happens: it is taken without a word, as an area.  "per" divides by the next factor alone, and
# a blank multiplies, so it is (mm / 100) mm = 1e-8 m2; "mm/100 mm" likewise.  A program that checks
# files after the CF conventions by UDUNITS finds no fault with it, and one that converts units
# offers square metres and refuses "percent".
#
#     mm per 100 mm      1e-08 m2    convertible to 1: False
#     mm/(100 mm)        0.01 1      convertible to 1: True
#
# Exits with 1 where this has changed.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check cf-units==3.3.1 numpy==2.2.6

"$folder/venv/bin/python" - <<'PYTHON'
import sys

from cf_units import Unit

found = {}
for text in ("mm per 100 mm", "mm/100 mm", "mm/(100 mm)"):
    unit = Unit(text)
    found[text] = (unit.is_convertible("m2"), unit.is_convertible("percent"))
    print(f"{text:18} {unit.definition:12} m2: {found[text][0]}, percent: {found[text][1]}")
expected = {
    "mm per 100 mm": (True, False),
    "mm/100 mm": (True, False),
    "mm/(100 mm)": (False, True),
}
sys.exit(0 if found == expected else "the behaviour has changed")
PYTHON
