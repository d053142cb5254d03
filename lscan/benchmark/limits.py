"""What every method must keep to, whoever wrote it, and which figures of a row do not.

The limits are no record to beat: each says what a method must do to be of any use, and the
simplest methods, the brightest pixel and the paper's own, keep to all of them.
"""

from lscan.benchmark.boards import BOARDS
from lscan.benchmark.extractors import ExtractorRow
from lscan.benchmark.maps import MapRow

LEAST_FOUND = 0.95
"""Share of columns: each holds a line, 12 standard deviations of the noise above the threshold."""

MOST_BIAS_PX = 0.5
"""Who names the right pixel and no more errs by up to half of it."""

MOST_SCATTER = 1.0
"""In standard deviations of the line's width: one photon alone determines the centre to that."""

MOST_OUTLIERS = 0.01
"""Share of centres beyond three standard deviations of the width, where 0.3 % of the light is."""

LEAST_WITHIN = 8 / 9
"""Share of errors within three stated sigmas, whatever their law, by Chebyshev's inequality."""

LEAST_WITHIN_OF_MAP = 0.5
"""The same of a map, whose errors at all places go together: one draw of the marks' noise that is
unlucky puts many beyond three sigmas, but not most."""

LEAST_COVERED = 0.95
"""Share of the board between its outermost marks; noise moves its border by less than a pixel."""

MOST_RMS_MM = 0.5
"""Half a pixel, which sees 1 mm, on boards of PITCH_MM; where marks are wider apart, more by the
square of their pitch, as is the error of interpolation along straight lines between them."""

PITCH_MM = 50.0

STANDARD_BOARD = "paper"
"""On it every map must be solved, with an honest sigma.  On others a map may be refused, and the
paper's maps, made for rulers, state what the marks' noise does to them alone."""


def failed_of_extractor(row: ExtractorRow) -> list[str]:
    """The figures of a row that are out of their limits, by name; none where all are kept.

    A line that is clipped is judged by scatter and outliers alone, over what was found of it:
    to withhold it, or to give a value of lesser quality, is an extractor's right (Status).
    """
    nothing = row.found == 0
    spread = {
        "scatter": nothing or row.scatter_px <= MOST_SCATTER * row.case.sigma_px,
        "outliers": nothing or row.outliers <= MOST_OUTLIERS,
    }
    if row.case.saturated:
        return _failed(spread)
    of_line = {
        "found": row.found >= LEAST_FOUND,
        "bias": nothing or abs(row.bias_px) <= MOST_BIAS_PX,
        "sigma": nothing or row.within_3_sigma >= LEAST_WITHIN,
    }
    return _failed({**of_line, **spread})


def failed_of_map(row: MapRow) -> list[str]:
    """The figures of a row that are out of their limits, by name; none where all are kept."""
    standard = row.board == STANDARD_BOARD
    if row.refused:
        return ["refused"] if standard else []
    wider = max(1.0, BOARDS[row.board].grid.pitch_mm / PITCH_MM)
    nothing = row.covered == 0
    return _failed(
        {
            "covered": row.covered >= LEAST_COVERED,
            "rms": nothing or row.rms_mm <= MOST_RMS_MM * wider**2,
            "sigma": nothing or not standard or row.within_3_sigma >= LEAST_WITHIN_OF_MAP,
        }
    )


def _failed(kept: dict[str, bool]) -> list[str]:
    return [name for name, within in kept.items() if not within]
