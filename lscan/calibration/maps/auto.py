"""The map that predicts best: ``auto``.

Every candidate is cross-validated on the reading.  Of those whose error on marks held out
does not differ significantly from the least, the one that states the least uncertainty is
solved from all marks: with as little misfit, it is the one that noise moves least, as it has
the fewest free numbers.  The map keeps the table of all scores.  No variants.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self, cast

from pydantic import model_validator

from lscan.calibration.calibrate import (
    COMPLETE,
    Calibration,
    Score,
    calibration_by,
    try_maps,
    without_outliers,
)
from lscan.calibration.maps.spline import with_hidden_errors
from lscan.calibration.planemap import NOTHING_KNOWN, PlaneMap, SolvedMap, find_solver
from lscan.config.documents import Strict, check
from lscan.config.rig import OpticsSection
from lscan.errors import BoardNotFound, InputError
from lscan.records import BoardReading, Floats, PlanePoints, Progress

CANDIDATES = (
    "refractive",
    "spline",
    *(f"polynomial-{order}" for order in range(2, 8)),
    "graticule-2",
    "projective",
)


class AutoParameters(Strict):
    """What a chosen map is made of, as a file holds it.

    It leaves out the scores' times, which are the machine's and not the map's.
    """

    chosen: str
    parameters: dict[str, Any]
    scores: tuple[Score, ...]

    @model_validator(mode="after")
    def _figures_or_a_reason(self) -> Self:
        for score in self.scores:
            figures = (score.rms_mm, score.max_mm)
            if any((one is None) == (score.refused is None) for one in figures):
                raise ValueError("each of scores must hold either rms_mm and max_mm, or refused")
        return self


@dataclass(frozen=True)
class Auto:
    """The chosen map and why it was chosen.

    Attributes
    ----------
    chosen : PlaneMap, under its own name
    scores : tuple of Score, of all candidates, the best first, those that refused last
    name : str, "auto"
    """

    chosen: PlaneMap
    scores: tuple[Score, ...]
    name: str = "auto"

    def to_plane(self, image_px: Floats, sigma_px: Floats | None = None) -> PlanePoints:
        """Points in the sheet, (N, 2) mm in the plane frame, of pixels, by the chosen map.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        sigma_px : (N,) array, optional, px, standard uncertainty of u and of v; 0 by default
        """
        return self.chosen.to_plane(image_px, sigma_px)

    def parameters(self) -> dict[str, Any]:
        """The chosen map's name and parameters, and the scores, in plain JSON types."""
        content = AutoParameters(
            chosen=self.chosen.name, parameters=self.chosen.parameters(), scores=self.scores
        )
        return content.model_dump(mode="json", exclude={"scores": {"__all__": {"ms"}}})


def with_chosen(plane_map: PlaneMap, change: Callable[[SolvedMap], SolvedMap]) -> PlaneMap:
    """A plane map changed; of ``auto`` the map that was chosen.

    A map of another package stays as it is: it answers for itself.

    Parameters
    ----------
    plane_map : PlaneMap, of any family
    change : callable, of a solved map
    """
    if isinstance(plane_map, Auto):
        return replace(plane_map, chosen=with_chosen(plane_map.chosen, change))
    return change(plane_map) if isinstance(plane_map, SolvedMap) else plane_map


class AutoSolver:
    """Solves the candidate that cross-validation finds best."""

    def check_variant(self, variant: str) -> None:
        """Refuse a variant that there is not; nothing is solved.

        Parameters
        ----------
        variant : str, ""

        Raises
        ------
        InputError
            For any variant.
        """
        if variant:
            what = "no such choice of maps"
            raise InputError(what, where="plane map", value=f"auto-{variant}", allowed="auto")

    def solve(
        self,
        reading: BoardReading,
        variant: str,
        optics: OpticsSection = NOTHING_KNOWN,
        progress: Progress | None = None,
    ) -> Auto:
        """The best candidate solved from the whole reading.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        variant : str, ""
        optics : OpticsSection, what is known of the camera beforehand
        progress : callable, optional, called with the number of candidates tried, and of all

        Raises
        ------
        InputError
            For any variant.
        BoardNotFound
            Where every candidate refuses.
        """
        self.check_variant(variant)
        trials = try_maps(reading, CANDIDATES, optics, progress=progress)
        scores = best_first(tuple(trial.score for trial in trials))
        if scores[0].refused is not None:
            raise BoardNotFound(f"no plane map could be solved: {scores[0].refused}")
        best = scores[0].name
        solved = {trial.score.name: trial.solved for trial in trials}[best]
        chosen = solved or find_solver(best).solve(reading, optics)
        return Auto(with_hidden_errors(chosen, reading, optics), scores)

    def restore(self, variant: str, parameters: dict[str, Any]) -> Auto:
        """The map that parameters came from.

        Parameters
        ----------
        variant : str, ""
        parameters : dict, as ``Auto.parameters`` gave them

        Raises
        ------
        InputError
            Where they do not fit.
        """
        self.check_variant(variant)
        read = check(AutoParameters, parameters, where=None, prefix="parameters")
        if read.chosen.partition("-")[0] == "auto":
            raise InputError("is no candidate", where="parameters.chosen", value=read.chosen)
        chosen = find_solver(read.chosen).restore(read.parameters)
        return Auto(chosen, read.scores)


solver = AutoSolver()


def calibrate_best(
    reading: BoardReading, optics: OpticsSection | None, progress: Progress | None = None
) -> Calibration:
    """What ``calibrate(reading, "auto", optics)`` gives, with progress.

    Parameters
    ----------
    reading : BoardReading, px and mm, the marks of one picture
    optics : OpticsSection or None, what is known of the camera beforehand
    progress : callable, optional, called with the number of candidates tried, and of all

    Raises
    ------
    BoardNotFound
        Where every candidate refuses.
    """
    known, sound = optics or NOTHING_KNOWN, without_outliers(reading)
    plane_map = cast(PlaneMap, solver.solve(sound.reading, "", known, progress))
    return calibration_by(plane_map.name, plane_map, sound, known)


def best_first(scores: tuple[Score, ...]) -> tuple[Score, ...]:
    """The scores, the best first.

    Those tied with the least error come by the uncertainty they state, the others by their rms
    error, then those that value too few marks, then those refused.  Too few: under 95 % of what the
    fullest map values, so that no map wins by leaving out what is hard.

    Parameters
    ----------
    scores : tuple of Score, mm, in any order
    """
    most = max(score.points for score in scores)

    def order(score: Score) -> tuple[bool, bool, bool, float]:
        too_few = score.points < COMPLETE * most
        by = score.sigma_mm if score.tied and score.sigma_mm is not None else score.rms_mm
        return score.rms_mm is None, too_few, not score.tied, by or 0.0

    return tuple(sorted(scores, key=order))
