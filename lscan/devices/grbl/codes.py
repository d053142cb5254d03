"""What Grbl 1.1's numbers mean, in words: error:N and ALARM:N, as codes.toml has them."""

from typing import Literal

from lscan.files.packaged import packaged_table

CODES: dict[str, dict[str, str]] = packaged_table("lscan.devices.grbl", "codes.toml")
"""By "error" or "ALARM", then by number."""


def in_words(kind: Literal["error", "ALARM"], code: int) -> str:
    """``error:N, meaning`` or ``ALARM:N, meaning``; of an unknown code, that it is unknown."""
    return f"{kind}:{code}, {CODES[kind].get(str(code), 'which Grbl 1.1 does not document')}"
