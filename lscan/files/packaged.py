"""Tables that lie beside the modules of this package, as TOML."""

import tomllib
from importlib.resources import files
from typing import Any


def packaged_table(package: str, name: str) -> Any:
    """The table of the file ``name`` of a package, such as "topics.toml"."""
    return tomllib.loads(files(package).joinpath(name).read_text(encoding="utf-8"))
