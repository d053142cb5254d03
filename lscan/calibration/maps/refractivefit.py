"""Camera, port and pose from the marks of one board picture.

One plane does not determine all parameters; what was known beforehand decides where the marks
leave a choice, and the covariance shows how much choice there was.
"""

import numpy as np

from lscan.calibration.readings import found_on, joined_marks
from lscan.camera.posedboards import CameraPriors, PosedBoards, priors_of
from lscan.camera.resection import (
    MOST_EVALUATIONS,
    TOLERANCE,
    BoardMarks,
    CameraFit,
    best_start,
    fit_boards,
    sound_marks,
    with_covariance,
)
from lscan.config.rig import OpticsSection
from lscan.errors import BoardNotFound
from lscan.records import BoardReading, Mask, select

FEWEST = 10  # control points: 20 equations for the 13 unknowns of lens and pose
MOST_MISSED = 0.1  # of the pitch: how far off the median mark may lie in a view that explains; ours
MOST_WRONG = 0.25  # of all marks; beyond it the fit explains nothing
ROUNDS = 8
MANY, ENOUGH = 1000, 250  # marks: of more than many, enough of them are fitted before all are
POLISH = 25  # evaluations with all of many: what they determine is found in ten; ours


def fit_view(
    reading: BoardReading,
    optics: OpticsSection,
    start: PosedBoards | None = None,
    bare: bool = False,
) -> CameraFit:
    """The camera and the board's pose that explain the marks found, outliers left out.

    The marks are the control points and the rulers' marks that were found, in that order.

    Parameters
    ----------
    reading : BoardReading, px and mm, the marks of one picture
    optics : OpticsSection, what is known of the camera beforehand
    start : PosedBoards, optional, camera and pose near the solution; sought by default
    bare : bool, whether the covariance is left out: its root has no columns then

    Raises
    ------
    InputError
        For a prior out of its range.
    BoardNotFound
        Where fewer than FEWEST control points are found, more than a quarter of the marks fit no
        view, or none fits as the priors are.
    """
    found = int(reading.grid.found.sum())
    if found < FEWEST:
        raise BoardNotFound(f"a refractive map needs {FEWEST} control points, found {found}")
    priors = priors_of(optics, reading.image_size)
    marks = found_on([joined_marks(reading)], [0])
    view, near = start, start is not None
    if view is None:
        few = _some(marks)
        view = best_start(few, priors, optics.port, reading.image_size[0])
        if view is None or not view.axes[0, :, 1] @ view.places_mm[0] > 0:
            raise BoardNotFound("the marks found are no picture of the board's front")
        if few is not marks:
            view, near = _settled(view, few, priors)[0], True
    view, good = _settled(view, marks, priors, near)
    _require_explained(view, marks, reading.pitch_mm)
    if bare:
        return CameraFit(view, np.zeros((len(view.theta), 0)), marks, good)
    return with_covariance(view, marks, priors, good)


def _some(marks: BoardMarks) -> BoardMarks:
    """Marks all over the board, enough to find the solution by; all of them where few are."""
    count = len(marks.sigma_px)
    if count <= MANY:
        return marks
    chosen = np.random.default_rng(count).permutation(count)[:ENOUGH]
    return select(marks, np.sort(chosen))


def _settled(
    view: PosedBoards, marks: BoardMarks, priors: CameraPriors, near: bool = False
) -> tuple[PosedBoards, Mask]:
    """The view of least squares and the mask of the marks it rests on, all but outliers.

    One that is near the solution shows the outliers at once: the search need not follow them first.
    """
    good = sound_marks(marks.lengths(view)) if near else np.ones(len(marks.sigma_px), dtype=bool)
    most = MOST_EVALUATIONS if len(good) <= MANY else POLISH
    for _ in range(ROUNDS):
        view = fit_boards(view, select(marks, good), priors, TOLERANCE, most)
        before, good = good, sound_marks(marks.lengths(view))
        if (good == before).all():
            break
        if np.mean(good) < 1 - MOST_WRONG:
            raise BoardNotFound(
                f"{int((~good).sum())} of the {len(good)} marks found fit no view of the board"
            )
    return view, good


def _require_explained(view: PosedBoards, marks: BoardMarks, pitch_mm: float) -> None:
    """Refuse a view that misses the marks by so much that what was known must be wrong."""
    miss_px = float(np.median(marks.lengths(view) * marks.sigma_px))
    miss_mm = miss_px * float(view.theta[-1])
    if not miss_mm <= MOST_MISSED * pitch_mm:
        raise BoardNotFound(
            f"no camera as [optics] knows it explains the marks: the median one lies {miss_px:.0f} "
            f"px off, {miss_mm:.0f} mm of a pitch of {pitch_mm:g} mm; check what [optics] says"
        )
