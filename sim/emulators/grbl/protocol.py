"""G-code and Grbl's settings: blocks read and checked with its error codes, and modes."""

import math
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, Self

from sim.emulators.grbl.motion import Place

# Blocks of G-code, read and checked as Grbl 1.1 does, with its error codes.

LONGEST = 80  # Grbl's LINE_BUFFER_SIZE; a longer line is error 11

_WORD = re.compile(r"([A-Z])([-+]?(?:\d+\.?\d*|\.\d+))")
_COMMENT = re.compile(r"\([^)]*\)|;.*")

GROUPS = {
    "G": {
        "motion": (0, 1, 80),
        "units": (20, 21),
        "distance": (90, 91),
        "feed mode": (94,),
        "plane": (17,),
        "coordinates": (54,),
        "once": (4, 53, 92),
    },
    "M": {"spindle": (3, 4, 5), "coolant": (8, 9)},
}
"""Modal groups of G and of M, and the codes of each that are emulated."""


class GcodeError(Exception):
    """A block that Grbl answers with ``error:code``."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass
class GcodeBlock:
    """A checked block.

    codes: the G and M codes by group.  axes: axis words by letter.  words: all other words by
    letter.
    """

    codes: dict[str, int] = field(default_factory=dict)
    axes: dict[str, float] = field(default_factory=dict)
    words: dict[str, float] = field(default_factory=dict)


def clean(text: str) -> str:
    """The line as Grbl keeps it: no spaces, no comments, capitals."""
    return re.sub(r"\s", "", _COMMENT.sub("", text)).upper()


def parse_block(text: str) -> GcodeBlock:
    """The block of a cleaned line; GcodeError where Grbl would refuse it."""
    block, at = GcodeBlock(), 0
    while at < len(text):
        if not text[at].isalpha():
            raise GcodeError(1)
        if (word := _WORD.match(text, at)) is None:
            raise GcodeError(2)
        _take(block, word[1], float(word[2]))
        at = word.end()
    return block


def _take(block: GcodeBlock, letter: str, value: float) -> None:
    if letter in GROUPS and value != int(value):
        raise GcodeError(23 if letter == "M" else 20)
    if letter in GROUPS:
        groups = GROUPS[letter].items()
        if (group := next((name for name, codes in groups if value in codes), None)) is None:
            raise GcodeError(20)
        if group in block.codes:
            raise GcodeError(21)
        block.codes[group] = int(value)
    elif letter in "XYZFSPNT":
        words = block.axes if letter in "XYZ" else block.words
        if letter in words:
            raise GcodeError(25)
        if value < 0 and letter not in "XYZ":
            raise GcodeError(4)
        words[letter] = value
    else:
        raise GcodeError(20 if letter in "ABCDEHO" else 36)


# What a G-code controller keeps from line to line: its modal state, and how it reads targets.


INCH_MM = 25.4
AXES = "XYZ"


@dataclass(frozen=True)
class Firmware:
    """What a firmware of Grbl's family answers where they differ.

    Attributes
    ----------
    banner : str, what it says when it starts
    tool : how long a T word lasts: for its line, until a reset, over a reset, or until the M6 that
        this emulator lacks never
    keeps_offset : bool, whether G92 lasts over a reset
    modes : str, words of ``$G`` that only this firmware has
    silent_settings : frozenset of int, numbers that ``$$`` does not list
    """

    banner: str
    tool: Literal["line", "session", "always", "never"] = "session"
    keeps_offset: bool = False
    modes: str = ""
    silent_settings: frozenset[int] = frozenset()


GRBL = Firmware("Grbl 1.1h ['$' for help]", tool="line")


@dataclass
class Modes:
    """Grbl's modal state, as ``$G`` lists it.

    distance, units, motion, spindle: the codes of these groups; motion 0 is rapid, 80 none,
    spindle 5 off.  feed_mm_min: F.  speed: S.
    offset_mm: machine coordinates of the work coordinates' origin (G92).
    """

    distance: int = 90
    units: int = 21
    motion: int = 0
    feed_mm_min: float = 0.0
    speed: float = 0.0
    spindle: int = 5
    tool: int = 0
    offset_mm: Place = (0.0, 0.0, 0.0)
    firmware: Firmware = GRBL

    def words(self, inches: bool) -> str:
        """The state as the answer to ``$G``; inches: $13, which F follows."""
        feed = f"{self.feed_mm_min / INCH_MM:.1f}" if inches else f"{self.feed_mm_min:.0f}"
        own, point = self.firmware.modes, "." if self.firmware.modes else ""
        shifted = " G92" if own and any(self.offset_mm) else ""
        return (
            f"[GC:G{self.motion} G54{shifted} G17 G{self.units} G{self.distance} G94{own} "
            f"M{self.spindle} M9 T{self.tool} F{feed} S{self.speed:.0f}{point}]"
        )

    def after_reset(self) -> Self:
        """The state after a reset."""
        kept = type(self)(firmware=self.firmware)
        if self.firmware.tool == "always":
            kept.tool = self.tool
        if self.firmware.keeps_offset:
            kept.offset_mm = self.offset_mm
        return kept

    def unit_mm(self, block: GcodeBlock) -> float:
        """Millimetres in a unit of the block's numbers."""
        return INCH_MM if block.codes.get("units", self.units) == 20 else 1.0

    def feed_of(self, block: GcodeBlock) -> float:
        """The block's feed in mm/min, the modal one where it has none."""
        return block.words["F"] * self.unit_mm(block) if "F" in block.words else self.feed_mm_min

    @property
    def rate_mm_min(self) -> float:
        """The feed of a motion now; a rapid has no limit of its own."""
        return math.inf if self.motion == 0 else self.feed_mm_min

    def take(self, block: GcodeBlock) -> None:
        """Change to what the block says; GcodeError, and no change, where it cannot be."""
        once, motion = block.codes.get("once"), block.codes.get("motion", self.motion)
        moves = bool(block.axes) and once != 92
        if once == 4 and "P" not in block.words:
            raise GcodeError(28)
        if once == 92 and not block.axes:
            raise GcodeError(26)
        if moves and motion == 80:
            raise GcodeError(31)
        feed_mm_min = self.feed_of(block)
        if motion == 1 and (moves or "motion" in block.codes) and not feed_mm_min:
            raise GcodeError(22)
        self.motion, self.feed_mm_min = motion, feed_mm_min
        self.distance = block.codes.get("distance", self.distance)
        self.units = block.codes.get("units", self.units)
        self.spindle = block.codes.get("spindle", self.spindle)
        self.speed = block.words.get("S", self.speed)
        if self.firmware.tool != "never":
            held = 0 if self.firmware.tool == "line" else self.tool
            self.tool = int(block.words.get("T", held))

    def shift(self, block: GcodeBlock, place_mm: Place) -> None:
        """G92: the present machine place gets the block's numbers as work coordinates."""
        unit_mm = self.unit_mm(block)
        self.offset_mm = tuple(
            place - block.axes[axis] * unit_mm if axis in block.axes else zero
            for axis, place, zero in zip(AXES, place_mm, self.offset_mm, strict=True)
        )

    def target_mm(self, block: GcodeBlock, start_mm: Place) -> Place:
        """The block's target in machine coordinates, for a motion from ``start_mm``."""
        unit_mm, machine = self.unit_mm(block), block.codes.get("once") == 53
        absolute = machine or block.codes.get("distance", self.distance) == 90
        target_mm = list(start_mm)
        for letter, value in block.axes.items():
            axis = AXES.index(letter)
            zero_mm = 0.0 if machine else self.offset_mm[axis]
            target_mm[axis] = value * unit_mm + (zero_mm if absolute else target_mm[axis])
        return tuple(target_mm)


# Grbl's ``$`` settings, and numbers as it writes them.


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
