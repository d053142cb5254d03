"""Tables that lie beside the modules of this package, as TOML."""

import tomllib
from importlib.resources import files
from typing import Any


def packaged_table(package: str, name: str) -> Any:
    """The table of a TOML file of a package.

    Parameters
    ----------
    package : str, dotted name of the package
    name : str, of the file, such as "topics.toml"
    """
    return tomllib.loads(files(package).joinpath(name).read_text(encoding="utf-8"))
