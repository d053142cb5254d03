"""What the scanner ought to measure: float64 NumPy that shares no formula with what it judges.

projection: where a point of the water is seen.  surfaces, wave, section: the target cut by
the laser sheet.  visibility: what is lit and seen.  stripe, board: the truth of a picture.
"""

from sim.truth.board import BoardTruth, board_truth
from sim.truth.projection import entry_points, project
from sim.truth.section import Section, section_at, surfaces_of
from sim.truth.stripe import StripeTruth, stripe_truth, stripe_truths
from sim.truth.visibility import slice_visibility

__all__ = [
    "BoardTruth",
    "Section",
    "StripeTruth",
    "board_truth",
    "entry_points",
    "project",
    "section_at",
    "slice_visibility",
    "stripe_truth",
    "stripe_truths",
    "surfaces_of",
]
