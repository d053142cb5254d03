"""Errors of the live page: what it refuses beyond bad input, and any error in one line."""

from lscan.errors import LscanError


class NotNow(LscanError):
    """A valid command that the present state of the session does not allow."""

    exit_code = 1


def one_line(error: Exception) -> str:
    """The error as one line.  A thread of the page reports any, for it must not end by it."""
    if isinstance(error, LscanError):
        return str(error)
    return " ".join(f"{type(error).__name__}: {error}".split())
