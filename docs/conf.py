"""Sphinx settings: `make docs` builds ``out/docs``, and a warning is an error there.

All that a build writes lies in the folder that it is told to write.
"""

import os
import sys
from importlib.metadata import version as installed
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parent / "_ext"))

import workspace
from sphinx.application import Sphinx

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Tables of scattered light from all photons are half an hour's work, which no small picture shows.
os.environ.setdefault("LSCAN_PHOTONS", "131072")

project = "lscan"
author = "The lscan developers"
copyright = author
release = version = installed("lscan")

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "lscan_docs"]
exclude_patterns = ["_ext"]
source_suffix = {".md": "myst-nb"}

html_theme = "furo"
html_title = f"lscan {release}"

myst_enable_extensions = ["attrs_inline", "colon_fence", "dollarmath"]
myst_heading_anchors = 3

nb_execution_mode = "cache"
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_merge_streams = True

napoleon_google_docstring = False
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
nitpick_ignore_regex = [  # names of Python and of other packages, whose pages are not at hand
    ("py:.*", r"(numpy|np|pathlib|collections|typing|annotated_types|pydantic)\..*"),
    ("py:.*", r"(array|callable|mapping|float64|int64|optional|uint8)"),
    ("py:.*", r"(Ge|Gt|Le|Lt|FieldInfo|NoneType|[\d.]+)"),  # limits in the types of fields
]


def setup(app: Sphinx) -> None:
    """Say where the code of pages runs, and where what it gave is kept."""
    work = Path(app.doctreedir) / "work"
    workspace.prepare(work)
    app.config.nb_execution_cache_path = workspace.cache(work)
