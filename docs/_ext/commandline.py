"""The commands of both programs, read from their typer apps."""

from typing import Any

import typer

import lscan.cli.app
import sim.cli.app

APPS = {"lscan": lscan.cli.app.app, "lscan-sim": sim.cli.app.app}


def commands(program: str) -> dict[str, Any]:
    """The commands of a program by their names, groups as ``group command``."""
    found: dict[str, Any] = {}

    def collect(prefix: str, group: Any) -> None:
        for name, command in group.commands.items():
            if command.hidden:
                continue
            if hasattr(command, "commands"):
                collect(f"{prefix}{name} ", command)
            else:
                found[f"{prefix}{name}"] = command

    collect("", typer.main.get_command(APPS[program]))
    return found


def as_markdown(program: str) -> str:
    """Every command: a heading, what it does, and a table of its arguments and options."""
    parts = []
    for name, command in commands(program).items():
        parts += [f"### {program} {name}", "", " ".join((command.help or "").split()), ""]
        shown = [param for param in command.params if not getattr(param, "hidden", False)]
        if shown:
            parts += ["| | | default |", "|---|---|---|"]
            parts += [_row(param) for param in shown if "--help" not in param.opts]
        parts.append("")
    return "\n".join(parts)


def _row(param: Any) -> str:
    if param.param_type_name == "argument":
        names = f"`{param.name.upper()}`"
    else:
        names = ", ".join(f"`{name}`" for name in [*param.opts, *param.secondary_opts])
    text = (getattr(param, "help", None) or "").replace("|", "\\|")
    return f"| {names} | {text} | {_default(param)} |"


def _default(param: Any) -> str:
    if param.required:
        return "required"
    value = param.default
    if value is None or value is False or callable(value) or str(value).startswith("Sentinel"):
        return ""
    return f"`{value}`"
