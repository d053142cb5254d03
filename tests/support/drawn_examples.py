"""How many examples a property test draws: of the number it states, the profile's share."""

from typing import Any

from hypothesis import settings

ALL = 100  # Hypothesis' own number, which the profiles "full" and "soak" keep
LEAST = 4


def examples(number: int, **others: Any) -> settings:
    """Settings of a test that draws ``number`` examples, or by the profile "quick" a quarter.

    others: what else ``hypothesis.settings`` takes.
    """
    share = settings.default.max_examples / ALL
    return settings(max_examples=max(min(number, LEAST), round(share * number)), **others)
