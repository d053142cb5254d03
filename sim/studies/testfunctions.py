"""Functions whose Sobol' indices are known in closed form, as problems of a study."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from lscan.records import Floats
from sim.studies.problem import Output


@dataclass(frozen=True)
class ClosedForm:
    """A problem of one output with its true indices; it follows ``StudyProblem``.

    Attributes
    ----------
    name : str
    function : callable, from (..., D) numbers in [0, 1) to the error, (...)
    mean, variance : float
    first, total : mapping, name of a cause to its index
    """

    name: str
    function: Callable[[Floats], Floats]
    mean: float
    variance: float
    first: Mapping[str, float]
    total: Mapping[str, float]

    @property
    def causes(self) -> tuple[str, ...]:
        """The names of D causes."""
        return tuple(self.first)

    @property
    def outputs(self) -> tuple[Output, ...]:
        """One scalar."""
        return (Output("error", ""),)

    def evaluate(self, row: Floats) -> Floats:
        """(..., 1) errors.

        Parameters
        ----------
        row : (..., D) array; a NOMINAL number is the median, 0.5
        """
        return self.function(np.where(np.isnan(row), 0.5, row))[..., None]


def ishigami(a: float = 7.0, b: float = 0.1) -> ClosedForm:
    """sin x1 + a sin² x2 + b x3⁴ sin x1, x uniform from -pi to pi.

    Its x3 has no effect of its own, only with x1.

    Parameters
    ----------
    a, b : float

    References
    ----------
    Ishigami & Homma 1990, Proc. ISUMA'90, 398; the indices as in Saltelli et al. 2008, Global
    Sensitivity Analysis: The Primer.
    """

    def function(u: Floats) -> Floats:
        x1, x2, x3 = np.moveaxis(np.pi * (2 * u - 1), -1, 0)
        return np.asarray(np.sin(x1) * (1 + b * x3**4) + a * np.sin(x2) ** 2)

    one, two = (1 + b * np.pi**4 / 5) ** 2 / 2, a**2 / 8
    both = b**2 * np.pi**8 * (1 / 18 - 1 / 50)
    variance = one + two + both
    return ClosedForm(
        "Ishigami",
        function,
        mean=a / 2,
        variance=variance,
        first={"x1": one / variance, "x2": two / variance, "x3": 0.0},
        total={"x1": (one + both) / variance, "x2": two / variance, "x3": both / variance},
    )


def sobol_g(a: tuple[float, ...] = (0.0, 0.5, 3.0, 9.0, 99.0, 99.0)) -> ClosedForm:
    """The product of (|4 x - 2| + a) / (1 + a), x uniform from 0 to 1: the larger a, the less.

    Parameters
    ----------
    a : tuple of float, one for each cause

    References
    ----------
    Saltelli & Sobol' 1995, Reliability Engineering and System Safety 50, 225.
    """
    weights = np.array(a)
    own = 1 / 3 / (1 + weights) ** 2
    variance = float(np.prod(1 + own)) - 1

    def function(u: Floats) -> Floats:
        return np.asarray(np.prod((np.abs(4 * u - 2) + weights) / (1 + weights), axis=-1))

    return ClosedForm(
        "Sobol' G",
        function,
        mean=1.0,
        variance=variance,
        first={f"x{k + 1}": float(v / variance) for k, v in enumerate(own)},
        total={
            f"x{k + 1}": float(v / (1 + v) * (1 + variance) / variance) for k, v in enumerate(own)
        },
    )


def nearly_linear(slopes: tuple[float, ...], curvature: float = 0.0, at: float = 0.0) -> ClosedForm:
    """at + the sum of slope times z + curvature (z1² - 1), z normal: a rig of small causes.

    Parameters
    ----------
    slopes : tuple of float, one for each cause
    curvature, at : float
    """
    weights = np.array(slopes)
    own = weights**2
    own[0] += 2 * curvature**2

    def function(u: Floats) -> Floats:
        z = ndtri(u)
        return np.asarray(at + z @ weights + curvature * (z[..., 0] ** 2 - 1))

    shares = {f"x{k + 1}": float(share) for k, share in enumerate(own / own.sum())}
    return ClosedForm("nearly linear", function, at, float(own.sum()), shares, shares)
