"""Numbers of a scene by their keys: replaced, and new in every picture (``[[change]]``)."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from math import ceil, exp, log, pi, radians, sin, sqrt
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self
from zlib import crc32

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator
from scipy.special import ndtr

from lscan.config.documents import Strict, check
from lscan.errors import InputError
from sim.scene.instrument import Seed

if TYPE_CHECKING:
    from sim.scene.file import Scene

# A scene's numbers by their dotted keys, such as ``head.camera_mm.1``: read, and replaced.


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
    section, _, name = key.partition(".")
    model = _section(scene, section)
    field, *component = name.split(".")
    value = getattr(model, field, None) if field in type(model).model_fields else None
    if len(component) == 1 and isinstance(value, tuple):
        index = component[0]
        value = value[int(index)] if index.isdecimal() and int(index) < len(value) else None
    elif component:
        value = None
    if isinstance(value, bool) or not isinstance(value, int | float):
        what = "is the key of no number that can vary"
        allowed = f"a number of [{section}]: {', '.join(_numbers(model))}"
        raise InputError(what, where=scene.source, value=key, allowed=allowed)
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
        what = "no such section of the scene"
        raise InputError(what, where=scene.source, value=name, allowed=", ".join((CAMERA, *named)))
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


# Random numbers of a picture: functions of a seed, a name and the picture's number alone.


NEGLIGIBLE = 1e-12  # of a picture's number: what pictures before have on it, left out


def unit_normal(seed: int, name: str, frame: int, correlation: float = 0.0) -> float:
    """The value for a picture of a stationary normal process, of mean 0 and variance 1.

    Values of pictures j apart have the correlation exp(-j / correlation): an autoregressive
    process of the first order, written out as the sum of the white noise it is driven by, so
    that no picture needs the one before.

    Parameters
    ----------
    seed : int
    name : str, of what is drawn: each name has a sequence of its own
    frame : int, number of the picture
    correlation : float, pictures; 0: white

    References
    ----------
    Box and Jenkins, Time series analysis, chapter 3.
    """
    if correlation == 0:
        return _white(seed, crc32(name.encode()), frame)
    kept = exp(-1 / correlation)
    first = max(0, frame - ceil(-correlation * log(NEGLIGIBLE)))
    weights = sqrt(1 - kept**2) * kept ** np.arange(frame - first, -1, -1.0)
    weights[0] /= sqrt(1 - kept**2)  # what came before the first one, summed up
    return float(weights @ [_white(seed, crc32(name.encode()), k) for k in range(first, frame + 1)])


@lru_cache(maxsize=1 << 16)  # neighbouring pictures have nearly all of them in common
def _white(*stream: int) -> float:
    return float(np.random.Generator(np.random.SFC64(stream)).standard_normal())


# ``[[change]]``: a number of the scene that is new in every picture.


ChangingKey = Literal[
    "head.turn_deg.0", "head.turn_deg.1", "head.turn_deg.2",
    "head.shift_mm.0", "head.shift_mm.1", "head.shift_mm.2",
    "head.camera_mm.0", "head.camera_mm.1", "head.camera_mm.2",
    "head.depression_deg", "head.heading_deg", "head.roll_deg",
    "laser.apex_mm.0", "laser.apex_mm.1", "laser.apex_mm.2",
    "laser.aim_deg", "laser.tilt_deg", "laser.skew_deg",
    "laser.power_mw", "laser.wavelength_nm",
    "camera.exposure_ms", "sensor.gain", "light.ambient_w_m2_sr",
]  # fmt: skip
KINDS = ("normal", "uniform", "sine", "values")
FARTHEST_SD = 6.0  # one draw in 5e8 of a normal distribution lies beyond


class Change(Strict):
    """How far a number is off its value in the scene, picture by picture.

    Exactly one of ``normal`` (standard deviation), ``uniform`` (half the range), ``sine``
    (amplitude; of ``period`` pictures or ``period_mm`` of commanded travel, ``phase_deg`` at 0)
    and ``values`` (one of several, of odds ``weights``) says how.  relative: it is a share of the
    number instead of an amount in its unit.  correlation: pictures after which the correlation of
    what is drawn has fallen to 1/e; it is that of the normal distribution that each of the others
    is made from, by its quantiles.
    """

    key: ChangingKey
    normal: NonNegativeFloat | None = None
    uniform: NonNegativeFloat | None = None
    sine: float | None = None
    period: PositiveFloat | None = None
    period_mm: PositiveFloat | None = None
    phase_deg: float = 0.0
    values: Annotated[tuple[float, ...], Field(min_length=1)] | None = None
    weights: tuple[PositiveFloat, ...] | None = None
    relative: bool = False
    correlation: Annotated[float, Field(ge=0, le=1000)] = 0.0
    seed: Seed = 1

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if sum(getattr(self, kind) is not None for kind in KINDS) != 1:
            raise ValueError(f"{self.key}: exactly one of {', '.join(KINDS)} says how it changes")
        periods = (self.period is not None) + (self.period_mm is not None)
        if periods != (self.sine is not None):
            raise ValueError("sine goes with one of period and period_mm, which go with it only")
        if self.sine is not None and self.correlation > 0:
            raise ValueError("correlation goes with what is drawn at random, not with sine")
        if self.weights is not None and len(self.weights) != len(self.values or ()):
            raise ValueError("weights goes with values, one for each of them")
        return self

    @property
    def reach(self) -> tuple[float, float]:
        """The lowest and the highest offset that can be expected."""
        if self.values is not None:
            return min(self.values), max(self.values)
        most = FARTHEST_SD * (self.normal or 0.0) + (self.uniform or 0.0) + abs(self.sine or 0.0)
        return -most, most

    def offset(self, frame: int, position_mm: float) -> float:
        """The number's offset in a picture: in the number's unit, or a share of it.

        Parameters
        ----------
        frame : int, number of the picture
        position_mm : float, mm, commanded position of the track
        """
        if self.sine is not None:
            turns = frame / self.period if self.period else position_mm / (self.period_mm or 1.0)
            return self.sine * sin(2 * pi * turns + radians(self.phase_deg))
        drawn = unit_normal(self.seed, self.key, frame, self.correlation)
        if self.normal is not None:
            return self.normal * drawn
        share = float(ndtr(drawn))
        if self.uniform is not None:
            return self.uniform * (2 * share - 1)
        values = self.values or ()
        odds = np.cumsum(self.weights or np.ones(len(values)))
        return values[int(np.searchsorted(odds[:-1] / odds[-1], share, side="right"))]


def check_changes(scene: "Scene") -> None:
    """Refuse a change that puts its number out of range, or that has nothing to change.

    Parameters
    ----------
    scene : Scene, each change of which is tried alone, at the ends of its reach

    Raises
    ------
    InputError
        Names the change, and what is allowed.
    """
    streams = [(change.key, change.seed) for change in scene.tank.change if change.sine is None]
    if twice := [key for k, (key, seed) in enumerate(streams) if (key, seed) in streams[:k]]:
        what = f"change: {twice[0]} is drawn twice from one seed"
        raise InputError(what, where=scene.source, allowed="another seed for each")
    for change in scene.tank.change:
        for offset in change.reach:
            with_offsets(scene, [(change, offset)], f"{scene.source}, [[change]] of {change.key}")
        if change.key == "light.ambient_w_m2_sr" and scene.tank.light.ambient_w_m2_sr == 0:
            what = f"change: {change.key} is 0, no light is there to change"
            raise InputError(what, where=scene.source, allowed="above 0")


def with_offsets(scene: "Scene", offsets: Iterable[tuple[Change, float]], where: str) -> "Scene":
    """The scene with its numbers changed, the sections they are in checked anew.

    Parameters
    ----------
    scene : Scene
    offsets : iterable of changes, each with the offset of its number
    where : str, what the error names as the place of a number out of range

    Raises
    ------
    InputError
        A number is out of its range.
    """
    numbers: dict[str, float] = {}
    for change, offset in offsets:
        now = numbers.get(change.key, number_at(scene, change.key))
        numbers[change.key] = now * (1 + offset) if change.relative else now + offset
    return with_numbers(scene, numbers, where)
