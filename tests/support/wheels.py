"""Whether requirements.lock has a wheel of each of its packages for every system that it is for.

    python tests/support/wheels.py

Asks pip, which looks into the index of packages and installs nothing: a minute for each system and
Python.  Exit code 1 where a package has no wheel there, or one whose hash the lock has not.
"""

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from packaging.requirements import Requirement
from places import ROOT

PYTHONS = {  # the stock ones
    "3.11.2": "Debian 12",
    "3.12.3": "Ubuntu 24.04",
    "3.13.5": "Debian 13",
    "3.14.0": "Ubuntu 26.04",
}
GLIBC = 36  # 2.36, of Debian 12
MACHINES = "x86_64", "aarch64"


def faults(python: str, machine: str) -> list[str]:
    """What keeps the lock from being installed there: pip's own words, or the packages."""
    lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    lines = re.findall(r"^(\w.*?) *\\$", lock, re.MULTILINE)
    there = {"platform_machine": machine, "python_full_version": python}
    asked = [r for r in map(Requirement, lines) if not r.marker or r.marker.evaluate(there)]
    tags = [f"manylinux_2_{minor}" for minor in range(GLIBC, 4, -1)]
    tags += ["manylinux2014", "manylinux2010", "manylinux1"]
    platforms = [part for tag in tags for part in ("--platform", f"{tag}_{machine}")]
    with tempfile.TemporaryDirectory() as folder:
        wanted, report = Path(folder, "wanted.txt"), Path(folder, "report.json")
        wanted.write_text("".join(f"{one.name}{one.specifier}\n" for one in asked))
        done = subprocess.run(
            [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--no-deps",
             "--ignore-installed", "--only-binary", ":all:", "--target", folder,
             "--python-version", python, *platforms, "--report", report, "-r", wanted],
            capture_output=True, text=True,
        )  # fmt: skip
        if done.returncode:
            return [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
        found = json.loads(report.read_text(encoding="utf-8"))["install"]
    return [
        f"{one['metadata']['name']}: the lock has no hash of {one['download_info']['url']}"
        for one in found
        if one["download_info"]["archive_info"]["hashes"]["sha256"] not in lock
    ]


def main() -> int:
    """The exit code of the program."""
    failed = 0
    for machine in MACHINES:
        for python, system in PYTHONS.items():
            found = faults(python, machine)
            failed += len(found)
            print(f"{machine} Python {python} ({system}):", "; ".join(found) or "all wheels")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
