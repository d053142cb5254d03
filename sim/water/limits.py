"""The refusal of values for which a published formula was not made."""

from lscan.errors import InputError

Limits = tuple[float, float]


def require(name: str, value: float, allowed: Limits, where: str = "water") -> None:
    """InputError unless ``value`` lies within ``allowed``, ends included; NaN does not."""
    low, high = allowed
    if not low <= value <= high:
        raise InputError(name, where=where, value=value, allowed=f"{low:g} to {high:g}")
