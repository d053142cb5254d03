"""The package as its users get it: built, and installed in an environment of its own."""

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

from places import ROOT

SOURCES = ("lscan", "sim", "scenes")
FILES = ("pyproject.toml", "setup.py", "MANIFEST.in", "README.md", "LICENSE", "CHANGELOG.md")
TANK = ("mitsuba", "drjit", "rtree", "shapely")
"""How the names of what only ``lscan[tank]`` installs begin."""


def build_wheel(folder: Path) -> Path:
    """The wheel built from a source distribution, without network; all of it in ``folder``."""
    checkout = folder / "checkout"
    for name in SOURCES:
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, checkout / name, ignore=ignored)
    for name in (*FILES, "requirements.lock"):
        shutil.copy(ROOT / name, checkout)
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, checkout]
    subprocess.run(command, cwd=folder, env=clean(), check=True, capture_output=True, text=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


def install(wheel: Path, folder: Path, tank: bool = True) -> Path:
    """The folder of the programs of an environment that has the wheel, without this checkout.

    Its other packages are those that run here; tank: those of ``lscan[tank]`` too.
    """
    venv.create(folder, symlinks=True)
    python = folder / "bin" / "python"
    ask = [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    packages = Path(subprocess.run(ask, check=True, capture_output=True, text=True).stdout.strip())
    left_out = ("lscan", "__editable__", *(() if tank else TANK))
    for entry in Path(sysconfig.get_path("purelib")).iterdir():
        if not entry.name.lower().startswith(left_out) and entry.suffix != ".pth":
            (packages / entry.name).symlink_to(entry)
    command = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet"]
    subprocess.run([*command, "--no-deps", "--no-index", wheel], check=True, env=clean())
    return python.parent


def clean() -> dict[str, str]:
    """This environment without what leads Python back to the checkout, and as a user's own."""
    names = (name for name in os.environ if not name.startswith("PYTHON") and name != "CI")
    return {name: os.environ[name] for name in names}
