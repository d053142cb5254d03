"""Blocks of G-code, read and checked as Grbl 1.1 does, with its error codes."""

import re
from dataclasses import dataclass, field

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
        word = _WORD.match(text, at)
        if word is None:
            raise GcodeError(2)
        _take(block, word[1], float(word[2]))
        at = word.end()
    return block


def _take(block: GcodeBlock, letter: str, value: float) -> None:
    if letter in GROUPS and value != int(value):
        raise GcodeError(23 if letter == "M" else 20)
    if letter in GROUPS:
        groups = GROUPS[letter].items()
        group = next((name for name, codes in groups if value in codes), None)
        if group is None:
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
