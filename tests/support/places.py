"""Where the tests find the repository, its scenes, and the photographs where a folder is named."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SCENES = ROOT / "scenes"
PAPER_BOARD = SCENES / "paper" / "calibration-board.toml"
SUPPORT = ROOT / "tests" / "support"
PHOTOGRAPHS = Path(os.environ.get("LSCAN_PHOTOGRAPHS") or ROOT / "photographs")
"""Real photographs, which the repository does not hold; tests skip where they are missing."""
