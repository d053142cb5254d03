"""Sphinx settings: `make docs` builds ``out/docs``, and a warning is an error there."""

import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
sys.path[:0] = [str(HERE / "_ext"), str(ROOT)]

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import lscan

project = "lscan"
author = "The lscan developers"
copyright = author
release = version = lscan.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "lscan_docs",
]
exclude_patterns = ["_ext"]
source_suffix = {".md": "myst-nb"}

html_theme = "furo"
html_title = f"lscan {release}"

myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
