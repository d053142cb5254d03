"""The files of the live page: which there are, and that none is missing or left over."""

import re
import tomllib
from pathlib import Path

from places import tracked

import lscan
from lscan.live.server import FOLDER, page_files


def test_what_is_hidden_or_of_another_kind_is_not_listed(tmp_path: Path) -> None:
    for name in ("index.html", "main.js", ".main.js", "main.js~", "secret.txt", ".env", "js"):
        (tmp_path / name).write_text(name)
    (tmp_path / "folder.js").mkdir()
    assert page_files(tmp_path) == {
        "/": (tmp_path / "index.html", "text/html"),
        "/live/main.js": (tmp_path / "main.js", "text/javascript"),
    }


def test_every_module_that_is_asked_for_is_there_and_every_one_there_is_asked_for() -> None:
    asked = {"main.js", "style.css", "index.html"}
    files = tracked(FOLDER)
    for file in files:
        asked.update(re.findall(r'from "\./([^"]+)"', file.read_text(encoding="utf-8")))
        asked.update(re.findall(r'="/live/([^"]+)"', file.read_text(encoding="utf-8")))
    assert asked == {file.name for file in files}


def test_the_page_is_packed_with_the_package() -> None:
    package = Path(lscan.__file__).parent
    with (package.parent / "pyproject.toml").open("rb") as file:
        patterns = tomllib.load(file)["tool"]["setuptools"]["package-data"]["lscan"]
    packed = {path for pattern in patterns for path in package.glob(pattern)}
    assert set(tracked(FOLDER)) <= packed
