"""Where the tests find the repository, its scenes and what they share."""

import shutil
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SCENES = ROOT / "scenes"
PAPER_BOARD = SCENES / "paper" / "calibration-board.toml"
SUPPORT = ROOT / "tests" / "support"


def tracked(folder: Path, pattern: str = "*") -> list[Path]:
    """The files beneath a folder that git tracks, all that there are where it tracks none.

    What else lies in a checkout, a log, a copy, a page begun, is no test's to judge.
    """
    names = ""
    if shutil.which("git"):
        command = ["git", "-C", str(folder), "ls-files", "-z"]
        names = subprocess.run(command, capture_output=True, text=True).stdout
    paths = [folder / name for name in names.split("\0") if name] or folder.rglob("*")
    return sorted(path for path in paths if path.match(pattern) and path.is_file())
