"""What one picture of the board gives to the multi-view calibration."""

from dataclasses import dataclass

import numpy as np

from lscan.records import Axis, Floats, Marks


@dataclass(frozen=True)
class LinePoints:
    """The laser line on a board, where it was found.

    Attributes
    ----------
    image_px : (K, 2) array, px, of (u, v)
    sigma_px : (K,) array, px, standard uncertainty across the line
    axis : str, "columns": the line was looked for in each column, its v is what is uncertain;
        "rows": in each row, and its u is
    """

    image_px: Floats
    sigma_px: Floats
    axis: Axis

    @property
    def across(self) -> Floats:
        """(2,) unit vector in the picture along which the points are uncertain."""
        return np.array([0.0, 1.0] if self.axis == "columns" else [1.0, 0.0])


@dataclass(frozen=True)
class CalibrationView:
    """One pose of the board.

    Attributes
    ----------
    name : str, of the picture, for messages
    marks : Marks or None, px and mm, of the board; None where it was not found
    line : LinePoints or None, px, the laser line on it, None where there is none
    fault : str, why marks, or the line that was looked for, are missing; "" where nothing is
    """

    name: str
    marks: Marks | None
    line: LinePoints | None = None
    fault: str = ""

    @property
    def marks_found(self) -> int:
        """How many marks were found."""
        return 0 if self.marks is None else int(self.marks.found.sum())

    @property
    def points_found(self) -> int:
        """How many points of the laser line were found."""
        return 0 if self.line is None else len(self.line.image_px)


@dataclass(frozen=True)
class FittedView(CalibrationView):
    """A view, and what became of it; NaN where there is no number.

    Attributes
    ----------
    used : bool, whether camera and sheet rest on its marks
    marks_used : int, how many of them
    rms_px : float, px, root mean square length of their residuals
    line_used : bool, whether the sheet rests on its line
    line_points_used : int, how many of the line's points
    line_rms_mm : float, mm, root mean square of their distances from the sheet
    reason : str, why the view, or its line, was not used, or what is doubtful about it; "" where
        nothing is
    """

    used: bool = False
    marks_used: int = 0
    rms_px: float = np.nan
    line_used: bool = False
    line_points_used: int = 0
    line_rms_mm: float = np.nan
    reason: str = ""

    @property
    def outcome(self) -> str:
        """Whether it was used, and the reason if there is one, in words."""
        whole = self.used and (self.line is None or self.line_used)
        return "; ".join(filter(None, ("used" if whole else "", self.reason))) or "not used"
