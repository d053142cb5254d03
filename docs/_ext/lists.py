"""Tables of what the code enumerates or registers: status codes, scenes, methods, drivers."""

import re
from collections.abc import Callable
from importlib.metadata import entry_points

from lscan.config.userfiles import descriptions
from lscan.records import Status

TEXTS = descriptions()


def statuses() -> str:
    """Code, name and meaning of every status."""
    lines = ["| code | name | meaning |", "|---|---|---|"]
    lines += [
        f"| {status.value} | `{status.name}` | {TEXTS['status'][status.name]} |"
        for status in Status
    ]
    return "\n".join(lines)


def _plugins(group: str) -> str:
    names = [entry.name for entry in entry_points(group=group) if _ours(entry.value)]
    texts = TEXTS[group]
    missing = sorted(set(names) - {re.split(r"[- ]", name)[0] for name in texts} - set(texts))
    if missing:
        raise KeyError(f"lscan/config/keys.toml, [{group}]: {', '.join(missing)}")
    lines = ["| name | what it is |", "|---|---|"]
    return "\n".join([*lines, *(f"| `{name}` | {text} |" for name, text in texts.items())])


def _ours(value: str) -> bool:
    return value.startswith(("lscan.", "sim."))


GROUPS = ("lscan.extractors", "lscan.planemaps", "lscan.cameras", "lscan.tracks")
TABLES: dict[str, Callable[[], str]] = {
    "status": statuses,
    "extractors": lambda: _plugins("lscan.extractors"),
    "planemaps": lambda: _plugins("lscan.planemaps"),
    "cameras": lambda: _plugins("lscan.cameras"),
    "tracks": lambda: _plugins("lscan.tracks"),
}
