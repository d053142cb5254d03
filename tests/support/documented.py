"""The public functions of lscan and sim, and which of their parameters have no word in a docstring.

Public is what a module outside of its room imports, and the methods of the classes among it.  The
stub of a package is such a module: what it names is public.
"""

import ast
import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from places import ROOT, tracked

Definition = ast.FunctionDef | ast.ClassDef
SPECIAL = ("__init__", "__call__")


@dataclass(frozen=True)
class PublicFunction:
    """A function or method: the module it stands in, its name there, and its syntax."""

    path: Path
    name: str
    node: ast.FunctionDef
    owner: ast.ClassDef | None = None

    def __str__(self) -> str:
        return f"{self.path}:{self.name}"

    def undocumented(self) -> list[str]:
        """The parameters that the docstring, or for ``__init__`` the class's, does not name."""
        documented = {"self", "cls", *documented_parameters(self.node)}
        if self.owner is not None and self.node.name == "__init__":
            documented |= documented_parameters(self.owner)
        every = self.node.args
        taken = [*every.posonlyargs, *every.args, every.vararg, *every.kwonlyargs, every.kwarg]
        return [one.arg for one in taken if one is not None and one.arg not in documented]


def documented_parameters(node: Definition) -> set[str]:
    """The names under numpydoc's heading Parameters; several may share a line."""
    docstring = ast.get_docstring(node) or ""
    _, _, section = docstring.partition("Parameters\n----------\n")
    section = re.split(r"\n\n\w[\w ]*\n-{3,}\n", section)[0]
    heads = re.findall(r"^([*\w][^:\n]*)", section, flags=re.MULTILINE)
    return {name.strip(" *") for head in heads for name in head.split(",")}


class Sources:
    """Every module of lscan and sim beneath ``root``, parsed."""

    def __init__(self, root: Path = ROOT) -> None:
        self._trees = {
            path.relative_to(root): ast.parse(path.read_text(encoding="utf-8"))
            for package, end in itertools.product(("lscan", "sim"), ("py", "pyi"))
            for path in tracked(root / package, f"*.{end}")
        }
        self._modules = {_dotted(path): path for path in self._trees}

    def public(self) -> list[PublicFunction]:
        """All public functions, in the order of their names."""
        found = {str(function): function for function in self._public()}
        return [found[name] for name in sorted(found)]

    def _public(self) -> Iterator[PublicFunction]:
        for importer, module, name in self._imported():
            path, node = self._defined(module, name) or (importer, None)
            if _room(path) == _room(importer):
                continue
            if isinstance(node, ast.FunctionDef):
                yield PublicFunction(path, node.name, node)
            elif isinstance(node, ast.ClassDef):
                yield from _methods(path, node)

    def _imported(self) -> Iterator[tuple[Path, str, str]]:
        """The importing module, the module and the name of each import, also of an attribute."""
        for path, tree in self._trees.items():
            nodes = list(ast.walk(tree))
            modules = {}
            for node in nodes:
                if isinstance(node, ast.ImportFrom):
                    for alias in node.names:
                        yield path, node.module or "", alias.name
                        modules[alias.asname or alias.name] = f"{node.module}.{alias.name}"
            for node in nodes:
                if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                    yield path, modules.get(node.value.id, ""), node.attr

    def _defined(self, module: str, name: str) -> tuple[Path, Definition] | None:
        """Where a name is defined, followed through the rooms that pass it on."""
        path = self._modules.get(module)
        if path is None:
            return None
        for node in self._trees[path].body:
            if isinstance(node, Definition) and node.name == name:
                return path, node
            if isinstance(node, ast.ImportFrom) and name in [alias.name for alias in node.names]:
                return self._defined(node.module or "", name)
        return None


def _methods(path: Path, owner: ast.ClassDef) -> Iterator[PublicFunction]:
    for node in owner.body:
        if isinstance(node, ast.FunctionDef) and (node.name in SPECIAL or node.name[0] != "_"):
            yield PublicFunction(path, f"{owner.name}.{node.name}", node, owner)


def _dotted(path: Path) -> str:
    return ".".join(path.with_suffix("").parts).removesuffix(".__init__")


def _room(path: Path) -> tuple[str, ...]:
    """The folder of lscan or sim that a module lies in; a module without one is its own."""
    return path.parts[:2]
