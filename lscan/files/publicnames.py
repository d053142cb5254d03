"""The public names of a package as its stub file lists them, each loaded when it is asked for."""

import ast
import inspect
from collections.abc import Callable
from functools import cache, wraps
from importlib import import_module
from pathlib import Path
from typing import Any, get_type_hints


def public_names(
    package: str, file: str, checked: bool = False
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a package.

    Parameters
    ----------
    package, file : str
        Its ``__name__`` and ``__file__``.  Beside the file lies the stub, whose imports type
        checkers read too.
    checked : bool
        Whether its functions refuse arguments of another kind.
    """
    stub = Path(file).with_suffix(".pyi").read_text(encoding="utf-8")
    imports = [node for node in ast.parse(stub).body if isinstance(node, ast.ImportFrom)]
    homes = {alias.name: str(node.module) for node in imports for alias in node.names}

    def load(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        found = getattr(import_module(homes[name]), name)
        return _check_arguments(found, package) if checked and inspect.isfunction(found) else found

    return load, lambda: sorted(homes), sorted(homes)


@cache
def _check_arguments(function: Callable[..., Any], package: str) -> Callable[..., Any]:
    """The function, which raises TypeError for an argument that is not of its class of lscan.

    Arguments of other types, such as paths and arrays, are left to the function.
    """
    kinds = {
        name: kind
        for name, kind in get_type_hints(function).items()
        if inspect.isclass(kind) and kind.__module__.startswith("lscan.")
    }
    signature = inspect.signature(function)

    @wraps(function)
    def checked(*arguments: Any, **named: Any) -> Any:
        try:
            bound = signature.bind(*arguments, **named).arguments
        except TypeError:
            bound = {}  # the function's own error names it
        for name, value in bound.items():
            kind = kinds.get(name, object)
            if not isinstance(value, kind):
                given = type(value).__name__
                fields = getattr(value, "__dataclass_fields__", ())
                fitting = [part for part in fields if isinstance(getattr(value, part, None), kind)]
                hint = f"; its .{fitting[0]} is one" if fitting else ""
                what = f"{function.__name__}: {name}: must be a {kind.__name__}, not a {given}"
                raise TypeError(what + hint)
        return function(*arguments, **named)

    checked.__module__ = package  # where pickle finds it again
    return checked
