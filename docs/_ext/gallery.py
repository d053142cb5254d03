"""A small picture of every scene, rendered once and kept with the build."""

import base64
import hashlib
import os
from pathlib import Path

from lscan.config.documents import read_document
from sim.scene import load_scene
from tests.validation.light.gallery import plate, scene_files

ROOT = Path(__file__).resolve().parents[2]


def picture(path: Path, scenes: Path, folder: Path) -> Path:
    """The scene's picture in ``folder``; rendered where the scene has changed since."""
    document = repr(sorted(read_document(path).items()))
    name = path.relative_to(scenes).with_suffix("").as_posix().replace("/", "-")
    key = hashlib.sha256(document.encode()).hexdigest()[:12]
    kept = folder / f"{name}-{key}.jpg"
    if not kept.exists():
        folder.mkdir(parents=True, exist_ok=True)
        uri = plate(load_scene(path), path.relative_to(scenes)).uri
        kept.write_bytes(base64.b64decode(uri.split(",", 1)[1]))
    return kept


def as_markdown(scenes_folder: str, source: str | Path, folder: Path) -> str:
    """Every scene file beneath ``scenes_folder`` with its picture, by sub-folder."""
    scenes = ROOT / scenes_folder
    parts: list[str] = []
    group = ""
    for path in scene_files(scenes):
        relative = path.relative_to(scenes)
        if relative.parts[0] != group:
            group = relative.parts[0]
            parts += [f"## {group}", ""]
        shown = os.path.relpath(picture(path, scenes, folder), Path(source) / "reference")
        text = read_document(path).get("name", "")
        parts += [f"### `{relative}`", "", f"{text}", "", f"![{text}]({shown}){{width=360px}}", ""]
    return "\n".join(parts)
