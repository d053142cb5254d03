"""The map by ray tracing: lens, flat port and pose from one board picture, then Snell's law.

A pixel's ray leaves the lens, is bent at the port and meets the plane of the board.  The map
is a physical model, so it needs few numbers and keeps its accuracy between the marks.  It has
no variants; what is known of lens and port beforehand comes from the rig's [optics].
"""

from functools import cached_property, partial
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field

from lscan.calibration.fields import Matrix, NotNegative, Number, Place, check_theta, of_length
from lscan.calibration.marks import covered_region, found_on, joined_marks, without
from lscan.calibration.physical import (
    BoardKnown,
    PhysicalMap,
    SheetGeometry,
    board_modes,
    sheet_of,
    unexplained_mm,
)
from lscan.calibration.planemap import MapSolver
from lscan.camera.posedboards import (
    CAMERA,
    NEWER,
    POSE,
    CameraPriors,
    PortKind,
    PosedBoards,
    priors_of,
)
from lscan.camera.resection import (
    MOST_EVALUATIONS,
    TOLERANCE,
    BoardMarks,
    CameraFit,
    Locate,
    best_start,
    compact_root,
    fit_boards,
    sound_marks,
    with_covariance,
)
from lscan.config.rig import Known, OpticsSection
from lscan.errors import BoardNotFound
from lscan.records import BoardReading, Floats, Mask, select

# Camera, port and pose from the marks of one board picture.
#
# One plane does not determine all parameters; what was known beforehand decides where the marks
# leave a choice, and the covariance shows how much choice there was.


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
        few, count = marks, len(marks.sigma_px)
        if count > MANY:  # some all over the board are enough to find the solution by
            chosen = np.random.default_rng(count).permutation(count)[:ENOUGH]
            few = select(marks, np.sort(chosen))
        view = best_start(few, priors, optics.port, reading.image_size[0])
        if view is None or not view.axes[0, :, 1] @ view.places_mm[0] > 0:
            raise BoardNotFound("the marks found are no picture of the board's front")
        if few is not marks:
            view, near = _fit_sound_marks(view, few, priors)[0], True
    view, good = _fit_sound_marks(view, marks, priors, near)
    _require_explained(view, marks, reading.pitch_mm)
    if bare:
        return CameraFit(view, np.zeros((len(view.theta), 0)), marks, good)
    return with_covariance(view, marks, priors, good)


def _fit_sound_marks(
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


# The map by ray tracing: lens, flat port and pose from one board picture, then Snell's law.


# What one picture does not determine: 0, and not in the file.
OPEN = [CAMERA.index(name) for name in ("k3", *NEWER)]
NAMES = tuple(name for k, name in enumerate((*CAMERA, *POSE)) if k not in OPEN)
COUNT = len(NAMES)


class Refractive(PhysicalMap):
    """A solved refractive map.

    Attributes
    ----------
    port : str, "flat", or "none" for a camera in air
    theta : dict of float, camera, port and pose, by name (NAMES)
    centre_mm : (2,) array, mm, the middle of the marks
    modes : (19, M) array, the covariance of theta is modes @ modes.T
    board_offset_mm : float, mm, standard uncertainty of the board's distance from the laser sheet
        at centre_mm
    board_tilt_deg : float, degrees, standard uncertainty of its tilt about x and about z
    board_bend_mm, board_scale_percent : float, likewise of its bend and of its scale; 0 in older
        files
    outliers_mm : tuple of array, mm, (x, z) of the marks that the map does not rest on
    region : Region, px, where the map holds
    lack_of_fit_mm : (2,) array, mm, of x and of z (calibration/planemap.py)

    References
    ----------
    docs/explanation/physics.md, section 6.
    """

    port: PortKind
    theta: Annotated[dict[str, Number], AfterValidator(partial(check_theta, names=NAMES))]
    centre_mm: Place
    modes: Annotated[Matrix, of_length(COUNT)]
    board_offset_mm: Annotated[float, Field(ge=0, le=100)]
    board_tilt_deg: Annotated[float, Field(ge=0, le=20)]
    board_bend_mm: NotNegative = 0.0
    board_scale_percent: NotNegative = 0.0
    outliers_mm: tuple[Place, ...]

    @cached_property
    def view(self) -> PosedBoards:
        """Camera, port and the one board."""
        return self._view_of(self.vector)

    def _view_of(self, theta: Floats) -> PosedBoards:
        return PosedBoards(np.insert(theta, [OPEN[0]] * len(OPEN), 0.0), self.centre_mm, self.port)

    @cached_property
    def geometry(self) -> SheetGeometry:
        """Camera and board, in whose plane the sheet lies."""
        return sheet_of(self.view)

    @property
    def vector(self) -> Floats:
        """(19,) theta."""
        return np.array(list(self.theta.values()))

    def map_of(self, vector: Floats) -> Locate:
        """The map of other parameters.

        Parameters
        ----------
        vector : (19,) array, as ``vector``
        """
        return self._view_of(vector).locate

    def vector_in_water(self, vector: Floats, index: float) -> Floats:
        """(19,) parameters of the same rig, where it is in space, in water of another index.

        Parameters
        ----------
        vector : (19,) array, as ``vector``
        index : float, of the water, relative to air
        """
        return np.delete(self._view_of(vector).in_water(index).theta, OPEN)

    def _fields_of(self, vector: Floats) -> dict[str, Any]:
        return {"theta": dict(zip(NAMES, vector.tolist(), strict=True))}

    def quantities(self) -> dict[str, Known]:
        """Camera, port and sheet, as of every physical map; the board lay beside the sheet."""
        known = super().quantities()
        beside = {"sheet_distance_mm": self.board_offset_mm, "sheet_angle_deg": self.board_tilt_deg}
        for name, lies in beside.items():
            known[name] = (known[name][0], float(np.hypot(known[name][1], lies)))
        return known

    def error_modes(self, image_px: Floats) -> Floats:
        """(N, 2, M) mm, by which one standard deviation of each error moves the points of pixels.

        Parameters
        ----------
        image_px : (N, 2) array, px, of (u, v)
        """
        lying = board_modes(self.geometry, self, self.region, image_px)
        return np.concatenate([super().error_modes(image_px), lying], axis=2)


class RefractiveSolver(MapSolver[Refractive]):
    """Solves refractive maps by the camera, port and pose that fit all marks best.

    Parameters
    ----------
    start : PosedBoards, optional, camera and pose where the search begins; sought by default
    """

    family, model, what = "refractive", Refractive, "refractive map"

    def __init__(self, start: PosedBoards | None = None) -> None:
        self._start = start

    def near(self, solved: Refractive) -> "RefractiveSolver":
        """The solver whose search begins at a map of almost the same marks.

        Parameters
        ----------
        solved : Refractive, that map
        """
        return RefractiveSolver(solved.view)

    def fit(self, reading: BoardReading, variant: str, optics: OpticsSection) -> Refractive:
        """Camera, port and pose that fit the marks, and the map they make.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        variant : str, ""
        optics : OpticsSection, what is known of camera, port and board beforehand

        Raises
        ------
        InputError, BoardNotFound
            As refractivefit.fit_view.
        """
        fit = fit_view(reading, optics, self._start)
        solved, sound = _points_of(fit, reading, optics)
        return solved.model_copy(
            update={
                "modes": compact_root(np.delete(fit.root, OPEN, axis=0)),
                "all_modes": True,
                # The board's own marks do not show where the sheet is: judged without that.
                "lack_of_fit_mm": unexplained_mm(solved, sound),
                **{name: getattr(optics, name) for name in BoardKnown.__annotations__},
            }
        )

    def fit_points(self, reading: BoardReading, variant: str, optics: OpticsSection) -> Refractive:
        """Camera, port and pose that fit the marks, taken for exact.

        Parameters
        ----------
        reading : BoardReading, px and mm, the marks of one picture
        variant : str, ""
        optics : OpticsSection, what is known of camera, port and board beforehand

        Raises
        ------
        InputError, BoardNotFound
            As refractivefit.fit_view.
        """
        return _points_of(fit_view(reading, optics, self._start, bare=True), reading, optics)[0]


solver = RefractiveSolver()


def _points_of(
    fit: CameraFit, reading: BoardReading, optics: OpticsSection
) -> tuple[Refractive, BoardReading]:
    """The map of a fit without its uncertainty, and the reading without the outliers."""
    outliers = joined_marks(reading).found
    outliers[outliers] = ~fit.good
    sound = without(reading, outliers)
    theta = np.delete(fit.boards.theta, OPEN)
    solved = Refractive(
        port=optics.port,
        theta=dict(zip(NAMES, theta.tolist(), strict=True)),
        centre_mm=fit.boards.centre_mm,
        modes=np.zeros((COUNT, 0)),
        board_offset_mm=0.0,
        board_tilt_deg=0.0,
        outliers_mm=tuple(fit.marks.board_mm[~fit.good]),
        region=covered_region(sound, sound.grid.found),
        lack_of_fit_mm=np.zeros(2),
    )
    return solved, sound
