"""The refusal of values for which a published formula was not made."""

from lscan.errors import InputError

Limits = tuple[float, float]


def require(name: str, value: float, allowed: Limits, where: str = "water") -> None:
    """Refuse a value that does not lie within its limits, ends included; NaN does not.

    Parameters
    ----------
    name : str, of the value, for the message
    value : float, in the unit of the limits
    allowed : tuple of float, least and largest
    where : str, what the value belongs to, for the message

    Raises
    ------
    InputError
        Names the value and its limits.
    """
    low, high = allowed
    if not low <= value <= high:
        raise InputError(name, where=where, value=value, allowed=f"{low:g} to {high:g}")
