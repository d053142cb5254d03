"""Means in a dear tier from few of its runs and many of a cheap one: control variates.

With y a term in the dear tier and x the same in the cheap one, of the same rig, the mean of y over
n rigs is corrected by how far the mean of x over these n is from that over all N:

    y_n + alpha (x_N - x_n).

For a fixed alpha it has no bias, whatever x is.  Its scatter is least where alpha is the slope of y
on x, and then that of what x does not explain.  The slope is found from the same n rigs: that
costs a factor of (n - 2) / (n - 3) of the variance, and a bias that the jackknife removes to first
order.  The products that Sobol' indices are ratios of are such terms.

References
----------
Lavenberg & Welch 1981, Management Science 27, 322: the slope from the same samples.
Peherstorfer, Willcox & Gunzburger 2016, SIAM Journal on Scientific Computing 38, A3163.
Qian, Peherstorfer, O'Malley, Vesselinov & Willcox 2018, SIAM/ASA Journal on Uncertainty
Quantification 6, 683: Sobol' indices.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lscan.records import Floats, Mask
from sim.studies.intervals import pseudo_values, set_sums

Figure = Callable[[Floats], Floats]
"""From (..., q) means of terms to a figure, (...)."""

CONSTANT = 1e-12
"""Variance over mean square of a term that does not vary: what is left of it is rounding."""


@dataclass(frozen=True)
class TermMeans:
    """Means of q terms over a design's samples, and over all of its sets but one.

    Attributes
    ----------
    sums : (SETS, 1 + q) array, number of samples, and sums of the terms over them; of two tiers
        (SETS, 2 + 5 q): that of the cheap one, and of the samples that both have their number and
        sums of x, y, x^2 and x y
    terms : int, q
    """

    sums: Floats
    terms: int

    @property
    def used(self) -> int:
        """The samples that count; of two tiers, those that both have."""
        return int(self.sums[:, self._counted].sum())

    def pseudo_values(self, figure: Figure) -> Floats:
        """(SETS,) pseudo-values of a figure; of two tiers, in the dear one.

        Parameters
        ----------
        figure : callable
        """
        return pseudo_values(self.sums, lambda sums: figure(self._means(sums)))

    @property
    def _counted(self) -> int:
        """Where the number of samples stands that count."""
        return 1 + self.terms if self.sums.shape[1] > 1 + self.terms else 0

    def _cheap(self, sums: Floats) -> Floats:
        means: Floats = sums[..., 1 : 1 + self.terms] / sums[..., :1]
        return means

    def _means(self, sums: Floats) -> Floats:
        if not self._counted:
            return self._cheap(sums)
        paired = sums[..., self._counted + 1 :] / sums[..., self._counted, None]
        x, y, squares, products = np.split(paired, 4, axis=-1)
        varies = squares - x**2 > CONSTANT * squares
        alpha = np.where(varies, (products - x * y) / np.where(varies, squares - x**2, 1.0), 1.0)
        return y + alpha * (self._cheap(sums) - x)


def term_means(cheap: Floats, dear: Floats | None = None) -> TermMeans:
    """Means of terms; of two tiers, those in the dear one.

    Parameters
    ----------
    cheap : (N, q) array, of samples in the order of a design's block; NaN where a run failed
    dear : (N, q) array, optional, of the same rigs; NaN where there is none
    """
    kept: Mask = np.asarray(np.isfinite(cheap).all(axis=1))
    samples = [kept[:, None], _zeroed(cheap, kept)]
    if dear is not None:
        both: Mask = np.asarray(kept & np.isfinite(dear).all(axis=1))
        x, y = _zeroed(cheap, both), _zeroed(dear, both)
        samples += [both[:, None], x, y, x**2, x * y]
    return TermMeans(set_sums(np.hstack(samples)), cheap.shape[1])


def _zeroed(terms: Floats, kept: Mask) -> Floats:
    return np.where(kept[:, None], terms, 0.0)
