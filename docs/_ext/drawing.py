"""The rooms of a package and their imports, read from the source and drawn as SVG."""

import os
import tomllib
from html import escape
from pathlib import Path

import grimp

ROOT = Path(__file__).resolve().parents[2]
WIDTH, HEIGHT, GAP, STEP, MARGIN = 118, 30, 22, 62, 20


def layers(package: str) -> list[list[str]]:
    """The rooms from top to bottom, as the import contract of the package lists them."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    for contract in project["tool"]["importlinter"]["contracts"]:
        if contract["type"] == "layers" and contract["containers"] == [package]:
            return [
                [room.strip() for room in layer.replace("|", ":").split(":")]
                for layer in contract["layers"]
            ]
    raise KeyError(package)


def imports(package: str) -> set[tuple[str, str]]:
    """Pairs of rooms of which the first imports the second."""
    graph = grimp.build_graph(package, cache_dir=None)
    found = set()
    for module in graph.modules:
        importer = _room(package, module)
        for other in graph.find_modules_directly_imported_by(module):
            imported = _room(package, other)
            if importer and imported and importer != imported:
                found.add((importer, imported))
    return found


def reduced(pairs: set[tuple[str, str]]) -> set[tuple[str, str]]:
    """The pairs that no chain of others implies."""
    beneath: dict[str, set[str]] = {}
    for importer, imported in pairs:
        beneath.setdefault(importer, set()).add(imported)

    def reached(room: str) -> set[str]:
        return {room}.union(*(reached(other) for other in beneath.get(room, set())))

    return {
        (importer, imported)
        for importer, imported in pairs
        if not any(imported in reached(other) for other in beneath[importer] - {imported})
    }


def _room(package: str, module: str) -> str:
    return module.removeprefix(f"{package}.").split(".")[0] if module != package else ""


def svg(package: str) -> str:
    """The drawing: one row a layer, an arrow for each import that others do not imply."""
    rows = layers(package)
    place: dict[str, tuple[float, float]] = {}
    across = max(len(row) for row in rows)
    width = 2 * MARGIN + 3 * WIDTH + across * (WIDTH + GAP)
    for level, row in enumerate(rows):
        for index, room in enumerate(row):
            offset = (index - (len(row) - 1) / 2) * (WIDTH + GAP)
            # Rows alternate about the middle, so that arrows that skip a row pass beside it.
            shift = (level % 3 - 1) * (WIDTH + GAP) * 0.75
            place[room] = (width / 2 + offset + shift, MARGIN + level * STEP)
    height = 2 * MARGIN + (len(rows) - 1) * STEP + HEIGHT
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" '
        f'width="{width:g}" height="{height:g}" font-family="sans-serif" font-size="13">',
        f'<rect width="{width:g}" height="{height:g}" fill="#ffffff"/>',
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="7" '
        'markerHeight="7" orient="auto"><path d="M0,0 L8,4 L0,8 z" fill="#5577aa"/></marker>'
        "</defs>",
    ]
    drawn = {pair for pair in imports(package) if set(pair) <= place.keys()}
    parts += [
        _arrow(place[importer], place[imported]) for importer, imported in sorted(reduced(drawn))
    ]
    parts += [_box(room, *where) for room, where in place.items()]
    return "\n".join([*parts, "</svg>", ""])


def _arrow(start: tuple[float, float], end: tuple[float, float]) -> str:
    x1, y1 = start[0], start[1] + HEIGHT
    x2, y2 = end
    bend = (y2 - y1) / 2
    return (
        f'<path d="M{x1:g},{y1:g} C{x1:g},{y1 + bend:g} {x2:g},{y2 - bend:g} {x2:g},{y2:g}" '
        'fill="none" stroke="#5577aa" stroke-opacity="0.55" marker-end="url(#tip)"/>'
    )


def _box(room: str, x: float, y: float) -> str:
    return (
        f'<rect x="{x - WIDTH / 2:g}" y="{y:g}" width="{WIDTH}" height="{HEIGHT}" rx="5" '
        'fill="#eef3fa" stroke="#33557f"/>'
        f'<text x="{x:g}" y="{y + HEIGHT / 2 + 4.5:g}" text-anchor="middle" fill="#1a2b40">'
        f"{escape(room)}</text>"
    )


def write(package: str, source: str | Path, folder: Path) -> str:
    """Write the drawing into ``folder``; its path from the folder explanation/ of the source."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"rooms-{package}.svg"
    path.write_text(svg(package), encoding="utf-8")
    return os.path.relpath(path, Path(source) / "explanation")
