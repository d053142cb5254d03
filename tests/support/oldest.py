"""The oldest packages that pyproject.toml allows, as constraints for pip: ``make oldest``.

Each requirement of the project and its extras at its lower bound, and what those ask for in turn no
newer than in requirements.lock.
"""

import itertools
import re
import tomllib

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from places import ROOT


def constraints() -> list[str]:
    """A line for each package of the lock file."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = itertools.chain(*project["optional-dependencies"].values())
    asked = map(Requirement, (*project["dependencies"], *extras))
    oldest = {
        canonicalize_name(requirement.name): lower_bound(requirement) for requirement in asked
    }
    locked = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    pins = re.findall(r"^([\w.-]+)==(\S+)", locked, re.MULTILINE)
    return [
        f"{name}=={oldest[name]}" if name in oldest else f"{name}<={pinned}"
        for name, pinned in pins
    ]


def lower_bound(requirement: Requirement) -> str:
    """The oldest version that serves; ValueError where none is said."""
    bounds = [bound.version for bound in requirement.specifier if bound.operator in (">=", "==")]
    if len(bounds) != 1:
        raise ValueError(f"pyproject.toml: {requirement}: has no lower bound")
    return bounds[0]


if __name__ == "__main__":
    print("\n".join(constraints()))
