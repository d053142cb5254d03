"""The greatest sharpness at the head's present position, the reference of the others."""

MOVED_MM = 0.1
"""A head within this of where it stood looks at the same place: a track may report it so often
that its readings scatter, and a line does not change within a tenth of a millimetre."""


class BestFocus:
    """The greatest sharpness since the head last moved.

    Another place of the target may be nearer or lit in another way: a best from there is not
    to be reached here, whatever is done to the lens.
    """

    def __init__(self) -> None:
        self._best, self._position_mm = 0.0, None  # type: float, float | None

    def forget(self) -> None:
        """Begin anew."""
        self._best = 0.0

    def among(self, focus: float, position_mm: float | None) -> float:
        """The best up to this picture, taken at ``position_mm``, None where that is not known."""
        if self._has_moved_to(position_mm):
            self._best, self._position_mm = 0.0, position_mm
        self._best = max(self._best, focus)
        return self._best

    def _has_moved_to(self, position_mm: float | None) -> bool:
        if position_mm is None or self._position_mm is None:
            return position_mm is not self._position_mm
        return abs(position_mm - self._position_mm) > MOVED_MM
