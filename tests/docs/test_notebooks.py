"""The pages whose code runs when they are built are notebooks that other programs open too."""

from pathlib import Path

import nbformat
import pytest
import yaml
from myst_nb.core.read import read_myst_markdown_notebook
from places import ROOT, tracked

PAGES = [
    page
    for page in tracked(ROOT / "docs", "*.md")
    if page.read_text(encoding="utf-8").startswith("---\nfile_format: mystnb\n")
]
FIRST = {"from-python", "picture-to-line", "surface-to-figure"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_is_a_notebook(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    notebook = read_myst_markdown_notebook(text)
    nbformat.validate(notebook)
    assert any(cell.cell_type == "code" for cell in notebook.cells)
    # nbformat 4.5 requires both; myst-nb adds what is missing, and jupytext 1.19.6 refuses it.
    kernel = yaml.safe_load(text.split("---\n")[1])["kernelspec"]
    assert kernel == {"name": "python3", "display_name": "Python 3"}


def test_the_first_notebooks_are_at_hand() -> None:
    """Each has a link that downloads it, and is named where the tutorials are listed."""
    index = (ROOT / "docs/tutorials/index.md").read_text(encoding="utf-8")
    assert {page.stem for page in PAGES} >= FIRST
    for name in FIRST:
        page = (ROOT / "docs/tutorials" / f"{name}.md").read_text(encoding="utf-8")
        assert f"{{nb-download}}`This page as a notebook <{name}.ipynb>`" in page
        assert f"{{doc}}`{name}`" in index
