"""A scene's numbers by their dotted keys, such as ``head.camera_mm.1``: read, and replaced."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from lscan.config.documents import Strict, check
from lscan.errors import InputError

if TYPE_CHECKING:
    from sim.scene.file import Scene

CAMERA = "camera"  # of the rig; all other sections are the tank's


def number_at(scene: "Scene", key: str) -> float:
    """The number that a key names.

    Parameters
    ----------
    scene : Scene
    key : str, section, field, and where the field holds several, which of them, from 0

    Raises
    ------
    InputError
        No number has that key.
    """
    section, field, *component = key.split(".")
    model = _section(scene, section)
    value = getattr(model, field, None) if field in type(model).model_fields else None
    if component and isinstance(value, tuple):
        index = component[0]
        value = value[int(index)] if index.isdigit() and int(index) < len(value) else None
    elif component:
        value = None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(
            "is the key of no number that can vary",
            where=scene.source,
            value=key,
            allowed=f"a number of [{section}]: {', '.join(_numbers(model))}",
        )
    return float(value)


def with_numbers(scene: "Scene", numbers: Mapping[str, float], where: str) -> "Scene":
    """The scene with some of its numbers replaced, the sections they are in checked anew.

    Parameters
    ----------
    scene : Scene
    numbers : mapping, from keys to numbers
    where : str, what an error names as the place of a number out of range

    Raises
    ------
    InputError
        No number has such a key, or one is out of its range.
    """
    fields: dict[str, dict[str, Any]] = defaultdict(dict)
    for key, number in numbers.items():
        number_at(scene, key)
        section, field, *component = key.split(".")
        value: Any = number
        if component:
            now = fields[section].get(field, getattr(_section(scene, section), field))
            index = int(component[0])
            value = (*now[:index], number, *now[index + 1 :])
        fields[section][field] = value
    checked = {}
    for name, update in fields.items():
        model = _section(scene, name)
        checked[name] = check(type(model), {**dict(model), **update}, where, name)
    rig = scene.rig.model_copy(update={k: v for k, v in checked.items() if k == CAMERA})
    tank = scene.tank.model_copy(update={k: v for k, v in checked.items() if k != CAMERA})
    return replace(scene, rig=rig, tank=tank)


def _section(scene: "Scene", name: str) -> Strict:
    section = scene.rig.camera if name == CAMERA else getattr(scene.tank, name, None)
    if not isinstance(section, Strict):
        named = [key for key in type(scene.tank).model_fields if key != "change"]
        raise InputError(
            "no such section of the scene",
            where=scene.source,
            value=name,
            allowed=", ".join((CAMERA, *named)),
        )
    return section


def _numbers(model: Strict) -> list[str]:
    """The fields of a section that hold a number, or several."""
    found = []
    for name, value in model:
        if isinstance(value, tuple) and value and all(isinstance(part, float) for part in value):
            found.append(f"{name}.0 to .{len(value) - 1}")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            found.append(name)
    return found
