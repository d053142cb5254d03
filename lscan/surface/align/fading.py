"""Straight edges located by how the line's light fades over them.

The laser sheet has a thickness and the lens blurs, so the line does not end at an edge: its
light falls off as a blurred step (stripe/blurredstep.py), and where half is left the sheet's
middle lies on the edge.  Where light that misses the edge falls on a lower face in view, the line
found in the picture changes over to that one at about half; only samples before that are used.
The share of a wall between them is that of both faces of an edge, where it pulls in opposite
directions: with samples of one face alone it could not be distinguished from the edge's place.  The
level is linear over each face; the width is shared by the edges of a group.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lscan.records import Floats, Mask
from lscan.stripe.blurredstep import StepLimits, StepSamples, fit_steps
from lscan.surface.align.edges import EdgeFit

REACH_MM = 9.0
"""How far from the edge samples are used: to find the level, a few times the width."""

FIRST_WIDTH_MM = 1.0
PLACE_SIGMA_MM, LEAN_SIGMA = 1.0, 0.02
"""How well edges are known from their crossings: to a column and the sheet's thickness."""

LIMITS = StepLimits(least_t=0.3, most_mm=REACH_MM, widths_mm=(0.1, 2.5), step_mm=1.0)
"""At 0.3 widths a face has 62 % of its light and the other 38 %, which noise of 15 % a column
confuses once in a hundred times."""


@dataclass(frozen=True)
class FaceSamples:
    """The K samples on the faces beside one edge.

    Attributes
    ----------
    slope : float, its nominal dx/dy
    side : int, +1 where the upper face lies at smaller x, else -1
    group : int, edges of one group fade over the same width; counted from 0
    plan : (K, 2) array, mm, (x, y)
    brightness : (K,) array, DN
    lower : (K,) mask, of the samples on the lower face; none where it is out of sight
    """

    slope: float
    side: int
    group: int
    plan: Floats
    brightness: Floats
    lower: Mask


def fit_fading(
    edges: Sequence[FaceSamples], start: EdgeFit, weight: Floats | None = None
) -> EdgeFit:
    """The edges that share one lean, each at x = at + (slope + lean) (y - pivot), mm.

    Parameters
    ----------
    edges : sequence of FaceSamples, mm and DN
    start : EdgeFit, the edges as found before, in the same order, good to about the width
    weight : (K,) array, optional, how much each sample counts, of all edges in their order, where
        that is decided

    Raises
    ------
    MeasurementError
        Where the samples do not determine the edges.
    """
    place = np.array([start.lean, *start.at_mm])
    width = np.full(1 + max(edge.group for edge in edges), FIRST_WIDTH_MM)
    sigma = np.array([LEAN_SIGMA, *np.full(len(edges), PLACE_SIGMA_MM)])
    fit = fit_steps(_samples(edges, start.pivot_mm), place, sigma, width, LIMITS, weight)
    return EdgeFit(
        at_mm=fit.place[1:],
        slope=np.array([edge.slope for edge in edges]),
        lean=float(fit.place[0]),
        pivot_mm=start.pivot_mm,
        covariance=fit.covariance,
        weight=fit.weight,
    )


def _samples(edges: Sequence[FaceSamples], pivot_mm: float) -> StepSamples:
    """All samples; the places are the lean and the x of each edge."""
    count = [len(edge.plan) for edge in edges]
    plan = np.concatenate([edge.plan for edge in edges])
    lower = np.concatenate([edge.lower for edge in edges])
    which = np.repeat(np.arange(len(edges)), count)
    y = plan[:, 1] - pivot_mm
    x = plan[:, 0] - np.repeat([edge.slope for edge in edges], count) * y
    towards = np.repeat([float(edge.side) for edge in edges], count) * np.where(lower, -1, 1)
    faces, face = np.unique(2 * which + lower, return_inverse=True)
    edge = faces // 2
    walled = np.array([edge.lower.any() for edge in edges])
    return StepSamples(
        stretch=face,
        brightness=np.concatenate([edge.brightness for edge in edges]),
        level=np.stack([np.ones_like(y), (x - x.mean()) / REACH_MM, y / REACH_MM]),
        by_place=towards * np.stack([y, np.ones_like(y)])[None],
        offset=(towards * x)[None],
        places=np.column_stack([np.zeros_like(edge), 1 + edge]),
        group=np.array([edge.group for edge in edges])[edge],
        wall=np.where(walled, np.cumsum(walled) - 1, -1)[edge],
    )
