"""How a cause's number is distributed: its quantiles."""

from math import sqrt
from typing import Annotated, Self

import numpy as np
from pydantic import Field, PositiveFloat, model_validator
from scipy.special import ndtri

from lscan.config.documents import Strict

Pair = tuple[float, float]
KINDS = ("fixed", "normal", "uniform", "triangular", "lognormal", "values")


class Distribution(Strict):
    """One of six distributions of a number; exactly one of its fields says which.

    fixed: one value.  normal: mean and standard deviation.  uniform: the ends.  triangular: lower
    end, mode, upper end.  lognormal: the median and the standard deviation of the logarithm.
    values: one of several, of odds ``weights``.

    Examples
    --------
    >>> Distribution(uniform=(2.0, 4.0)).quantile(0.25)
    2.5
    """

    fixed: float | None = None
    normal: Pair | None = None
    uniform: Pair | None = None
    triangular: tuple[float, float, float] | None = None
    lognormal: tuple[PositiveFloat, float] | None = None
    values: Annotated[tuple[float, ...], Field(min_length=1)] | None = None
    weights: tuple[PositiveFloat, ...] | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if sum(getattr(self, kind) is not None for kind in KINDS) != 1:
            raise ValueError(f"exactly one of {', '.join(KINDS)} says how the number is spread")
        for kind in ("normal", "lognormal"):
            pair = getattr(self, kind)
            if pair is not None and pair[1] < 0:
                raise ValueError(f"{kind}: the standard deviation must not be below 0")
        if self.uniform is not None and self.uniform[0] > self.uniform[1]:
            raise ValueError("uniform: the lower end must not be above the upper one")
        if self.triangular is not None and list(self.triangular) != sorted(self.triangular):
            raise ValueError("triangular: lower end, mode and upper end must rise")
        if self.weights is not None and len(self.weights) != len(self.values or ()):
            raise ValueError("weights goes with values, one for each of them")
        return self

    @property
    def kind(self) -> str:
        """The name of the field that says how the number is distributed."""
        return next(kind for kind in KINDS if getattr(self, kind) is not None)

    @property
    def in_words(self) -> str:
        """The distribution as a page shows it, such as ``uniform 0 to 35``."""
        kind, stated = self.kind, getattr(self, self.kind)
        if kind == "fixed":
            return f"{stated:g}"
        numbers = [f"{number:g}" for number in stated]
        joined = {"normal": " ± ", "uniform": " to ", "triangular": ", ", "lognormal": " ×÷ e^"}
        return f"{kind} {joined.get(kind, ', ').join(numbers)}"

    def quantile(self, share: float) -> float:
        """The number below which a share of all lie.

        Parameters
        ----------
        share : float, in (0, 1)
        """
        if self.fixed is not None:
            return self.fixed
        if self.normal is not None:
            return self.normal[0] + self.normal[1] * float(ndtri(share))
        if self.uniform is not None:
            return self.uniform[0] + (self.uniform[1] - self.uniform[0]) * share
        if self.lognormal is not None:
            return self.lognormal[0] * float(np.exp(self.lognormal[1] * ndtri(share)))
        if self.triangular is not None:
            return _triangular(*self.triangular, share)
        values = self.values or ()
        odds = np.cumsum(self.weights or np.ones(len(values)))
        return values[int(np.searchsorted(odds[:-1] / odds[-1], share, side="right"))]

    @property
    def mean(self) -> float:
        """The expected number."""
        if self.fixed is not None:
            return self.fixed
        if self.normal is not None:
            return self.normal[0]
        if self.lognormal is not None:
            return self.lognormal[0] * float(np.exp(self.lognormal[1] ** 2 / 2))
        if self.values is not None:
            return float(np.average(self.values, weights=self.weights))
        return float(np.mean(self.uniform or self.triangular or ()))

    @property
    def deviation(self) -> float:
        """The standard deviation of the number."""
        if self.normal is not None:
            return self.normal[1]
        if self.uniform is not None:
            return (self.uniform[1] - self.uniform[0]) / sqrt(12)
        if self.triangular is not None:
            a, c, b = self.triangular
            return sqrt(((a - b) ** 2 + (b - c) ** 2 + (c - a) ** 2) / 36)  # never below 0
        if self.lognormal is not None:
            return self.mean * sqrt(float(np.expm1(self.lognormal[1] ** 2)))
        if self.values is not None:
            off = np.array(self.values) - self.mean
            return sqrt(float(np.average(off**2, weights=self.weights)))
        return 0.0

    def scaled(self, factor: float) -> "Distribution":
        """The same distribution, drawn in to its middle by a factor.

        Parameters
        ----------
        factor : float, of all deviations from the mean (of a log-normal one: from the median)
        """
        if self.normal is not None:
            return Distribution(normal=(self.normal[0], factor * self.normal[1]))
        if self.lognormal is not None:
            return Distribution(lognormal=(self.lognormal[0], factor * self.lognormal[1]))
        numbers = self.uniform or self.triangular or self.values
        if numbers is None:
            return self
        drawn = tuple(self.mean + factor * (number - self.mean) for number in numbers)
        return Distribution.model_validate({**self.model_dump(exclude_none=True), self.kind: drawn})


def _triangular(low: float, mode: float, high: float, share: float) -> float:
    if high == low:
        return low
    turn = (mode - low) / (high - low)
    if share < turn:
        return low + sqrt(share * (high - low) * (mode - low))
    return high - sqrt((1 - share) * (high - low) * (high - mode))
