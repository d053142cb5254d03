"""Grbl's ``$`` settings, and numbers as it writes them."""

import re
from collections.abc import Collection, Iterable, Mapping

from sim.emulators.grbl.gcode import GcodeError

DEFAULTS: Mapping[int, float] = {
    **{0: 10, 1: 255, 2: 0, 3: 0, 4: 0, 5: 0, 6: 0, 10: 1, 11: 0.01, 12: 0.002, 13: 0},
    **{20: 1, 21: 0, 22: 1, 23: 0, 24: 25, 25: 500, 26: 250, 27: 1, 30: 1000, 31: 0, 32: 0},
    **{100: 250, 101: 250, 102: 250, 110: 3000, 111: 3000, 112: 3000},
    **{120: 200, 121: 200, 122: 200, 130: 200, 131: 200, 132: 200},
}
_WHOLE = frozenset(range(7)) | {10, 13, 20, 21, 22, 23, 26, 30, 31, 32}


def setting_lines(settings: Mapping[int, float], silent: Collection[int] = ()) -> list[str]:
    """The answer to ``$$``, without the numbers that the firmware is silent on."""
    return [
        f"${number}={value:.0f}" if number in _WHOLE else f"${number}={value:.3f}"
        for number, value in sorted(settings.items())
        if number not in silent
    ]


def change_setting(settings: dict[int, float], name: str, text: str) -> None:
    """Carry out ``$name=text``; GcodeError where Grbl would refuse it."""
    if not name.isdecimal() or int(name) not in settings:
        raise GcodeError(3)
    if not re.fullmatch(r"[-+]?(?:\d+\.?\d*|\.\d+)", text):
        raise GcodeError(2)
    value = float(text)
    if value < 0:
        raise GcodeError(4)
    if int(name) == 20 and value and not settings[22]:
        raise GcodeError(10)
    settings[int(name)] = value


def coordinates(numbers: Iterable[float], unit: float = 1.0) -> str:
    """Coordinates as Grbl writes them, without a minus before zero."""
    return ",".join(f"{round(number * unit, 3) + 0.0:.3f}" for number in numbers)
