"""What the scanner ought to measure: float64 NumPy that shares no formula with what it judges.

projection, dome: where a point of the water is seen.  sheet, bow: where the laser's light is.
surfaces, wave, mesh, chains, section: the target cut by it.  visibility: what is lit and seen.
stripe, shutter, board: the truth of a picture.  reflection, radiance, brightness: how bright its
line is.
"""

from sim.truth.board import BoardTruth, board_truth
from sim.truth.brightness import LineBrightness, line_brightness
from sim.truth.projection import entry_points, project
from sim.truth.section import Section, section_at, surfaces_of
from sim.truth.sheet import Sheet, sheet_of
from sim.truth.shutter import stripe_truth, stripe_truths
from sim.truth.stripe import StripeTruth
from sim.truth.visibility import slice_visibility

__all__ = [
    "BoardTruth",
    "LineBrightness",
    "Section",
    "Sheet",
    "StripeTruth",
    "board_truth",
    "entry_points",
    "line_brightness",
    "project",
    "section_at",
    "sheet_of",
    "slice_visibility",
    "stripe_truth",
    "stripe_truths",
    "surfaces_of",
]
