"""What the live page refuses beyond bad input."""

from __future__ import annotations

from lscan.errors import LscanError


class NotNow(LscanError):
    """A command that is right but cannot be carried out as things stand."""

    exit_code = 1
