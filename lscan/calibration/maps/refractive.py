"""The map by ray tracing: lens, flat port and pose from one board picture, then Snell's law.

A pixel's ray leaves the lens, is bent at the port and meets the plane of the board.  The map
stands on physics, so it needs few numbers and keeps its accuracy between the marks.  It has
no variants; what is known of lens and port beforehand comes from the rig's [optics].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from lscan.calibration.api import NOTHING_KNOWN
from lscan.calibration.boardview import COUNT, NAMES, BoardView
from lscan.calibration.evaluate import Estimate, to_points
from lscan.calibration.maps.refractivefit import LIMITS, Fit, fit_view, observations
from lscan.calibration.region import Region, covered_region
from lscan.calibration.stored import Matrix, NotNegative, Number, Pair, Vector
from lscan.calibration.unexplained import unexplained_mm
from lscan.config.documents import Strict, check
from lscan.config.rig import OpticsSection
from lscan.errors import InputError
from lscan.records import BoardReading, Floats, Marks, Mask, PlanePoints, Status

KEPT = 0.9999  # of the control points' variance that the stored modes must account for
MODE_STEP = 0.01  # sigmas, for differences along a mode: rounding is 1e-9, curvature less
PIXEL_STEP = 0.01  # px, for differences of the map by the pixel


class RefractiveParameters(Strict):
    """What a refractive map is made of, as a file holds it."""

    port: Literal["flat", "none"]
    theta: dict[str, Number]
    centre_mm: Vector
    modes: Matrix
    board_offset_mm: NotNegative
    board_tilt_deg: Annotated[float, Field(strict=True, ge=0, le=20)]
    outliers_mm: tuple[Vector, ...]
    region: Region
    lack_of_fit_mm: Pair

    @model_validator(mode="after")
    def _sizes(self) -> Self:
        if tuple(self.theta) != NAMES:
            raise ValueError(f"theta must hold {', '.join(NAMES)}")
        for name, (low, high) in LIMITS.items():
            if not low <= self.theta[name] <= high:
                raise ValueError(f"theta.{name} must be {low:g} to {high:g}")
        if self.centre_mm.shape != (2,):
            raise ValueError("centre_mm must be two numbers")
        if len(self.modes) != COUNT:
            raise ValueError(f"modes must hold {COUNT} rows, one for each of theta")
        if any(place.shape != (2,) for place in self.outliers_mm):
            raise ValueError("outliers_mm must be pairs")
        return self


@dataclass(frozen=True)
class Refractive:
    """A solved refractive map.

    view: camera, port and pose.  modes: (19, M), the covariance of view.theta is
        modes @ modes.T, but for what does not move the map.
    board_offset_mm, board_tilt_deg: standard uncertainties of how the board lay against the
        laser sheet: its distance at view.centre_mm, and its tilt about x and about z.
    outliers_mm: (x, z) of the marks that were set aside as wrong.
    lack_of_fit_mm: (2,) of x and of z (unexplained.py).
    """

    view: BoardView
    modes: Floats
    board_offset_mm: float
    board_tilt_deg: float
    outliers_mm: tuple[Floats, ...]
    region: Region
    lack_of_fit_mm: Floats
    name: str = "refractive"

    def to_plane(self, image_px: Floats, sigma_px: Floats | None = None) -> PlanePoints:
        """Points in the sheet, (N, 2) mm, of the pixels (N, 2), as api.PlaneMap promises.

        sigma_mm combines the pixel's uncertainty, the covariance of camera and pose, how the
        board lay in the sheet, and the map's mean lack of fit.
        """
        return to_points(self, image_px, sigma_px)

    def estimate(self, image_px: Floats, variance_px2: Floats) -> Estimate:
        """Points of covered pixels."""
        modes = _displacements(self.view, self.modes, image_px)
        if self.board_offset_mm > 0 or self.board_tilt_deg > 0:
            lying = coplanarity_modes(self, image_px, self.board_offset_mm, self.board_tilt_deg)
            modes = np.concatenate([modes, lying], axis=2)
        slope = self._pixel_slope(image_px)
        noise = variance_px2[:, None] * (slope**2).sum(axis=2) + (modes**2).sum(axis=2)
        sure = np.isfinite(noise)  # not so at the very edge of what the lens can image
        return Estimate(np.where(sure, self.view.locate(image_px), np.nan), noise, modes)

    def _pixel_slope(self, image_px: Floats) -> Floats:
        """(N, 2, 2) mm per px, the last axis by u and v."""
        slopes = [
            (self.view.locate(image_px + step) - self.view.locate(image_px - step))
            / (2 * PIXEL_STEP)
            for step in PIXEL_STEP * np.eye(2)
        ]
        return np.stack(slopes, axis=2)

    def parameters(self) -> dict[str, Any]:
        """Camera and pose by name, their modes, the region and the lack of fit, as JSON types."""
        return RefractiveParameters(
            port=self.view.port,
            theta=dict(zip(NAMES, self.view.theta.tolist(), strict=True)),
            centre_mm=self.view.centre_mm,
            modes=self.modes,
            board_offset_mm=self.board_offset_mm,
            board_tilt_deg=self.board_tilt_deg,
            outliers_mm=self.outliers_mm,
            region=self.region,
            lack_of_fit_mm=self.lack_of_fit_mm,
        ).model_dump(mode="json")


def coplanarity_modes(
    plane_map: Refractive, image_px: Floats, offset_mm: float, tilt_deg: float
) -> Floats:
    """(N, 2, 3) mm that a board beside the laser sheet moves the points of pixels (N, 2).

    The three modes: the sheet off the board by ``offset_mm`` along the board's normal, and
    tilted against it by ``tilt_deg`` about x and about z, both through the centre of the
    marks.  Where the sheet lies y behind the board, a ray of direction d reaches it
    y (d_x, d_z) / d_y further on.
    """
    seen, xz = plane_map.view.sight(image_px), plane_map.view.locate(image_px)
    tilt = np.radians(tilt_deg)
    behind = np.column_stack([np.full(len(xz), offset_mm), tilt * (xz - plane_map.view.centre_mm)])
    across = seen.direction[:, [0, 2]] / seen.direction[:, 1:2]
    return across[:, :, None] * behind[:, None, :]


class RefractiveSolver:
    """Solves refractive maps."""

    def check_variant(self, variant: str) -> None:
        """InputError for a variant that there is not; nothing is solved."""
        if variant:
            raise InputError(
                "no such refractive map",
                where="plane map",
                value=f"refractive-{variant}",
                allowed="refractive",
            )

    def solve(
        self, reading: BoardReading, variant: str, optics: OpticsSection = NOTHING_KNOWN
    ) -> Refractive:
        """The map by the camera, port and pose that fit all marks best (refractivefit.py).

        Raises InputError for any variant and for what is known out of its range,
        BoardNotFound where too few marks are found or too many of them are wrong.
        """
        self.check_variant(variant)
        fit = fit_view(reading, optics)
        sound, outliers = _set_aside(reading, fit.good)
        region = covered_region(sound, sound.grid.found)
        modes = _modes_that_matter(fit, sound.grid.board_mm[sound.grid.found])
        solved = Refractive(fit.view, modes, 0.0, 0.0, outliers, region, np.zeros(2))
        return replace(
            solved,
            # The board's own marks say nothing of where the sheet is: judged without that.
            lack_of_fit_mm=unexplained_mm(solved, sound),
            board_offset_mm=optics.board_offset_mm,
            board_tilt_deg=optics.board_tilt_deg,
        )

    def restore(self, variant: str, parameters: dict[str, Any]) -> Refractive:
        """The map that ``parameters`` came from; InputError where they do not fit."""
        self.check_variant(variant)
        read = check(RefractiveParameters, parameters, where=None, prefix="parameters")
        return Refractive(
            BoardView(np.array(list(read.theta.values())), read.centre_mm, read.port),
            read.modes,
            read.board_offset_mm,
            read.board_tilt_deg,
            read.outliers_mm,
            read.region,
            read.lack_of_fit_mm,
        )


solver = RefractiveSolver()


def _set_aside(reading: BoardReading, good: Mask) -> tuple[BoardReading, tuple[Floats, ...]]:
    """The reading without the marks that are wrong, and their places on the board."""
    outliers = tuple(observations(reading).board_mm[~good])
    several = [reading.grid, *(ruler.marks for ruler in reading.rulers)]
    counts = np.cumsum([marks.found.sum() for marks in several])[:-1]
    grid, *on_rulers = map(_without, several, np.split(~good, counts))
    rulers = zip(reading.rulers, on_rulers, strict=True)
    sound = tuple(replace(ruler, marks=marks) for ruler, marks in rulers)
    return replace(reading, grid=grid, rulers=sound), outliers


def _without(marks: Marks, wrong: Mask) -> Marks:
    """The marks with those of the found that are wrong made NOT_FOUND."""
    lost = np.zeros(len(marks.status), dtype=bool)
    lost[marks.found] = wrong
    return Marks(
        marks.board_mm,
        np.where(lost[:, None], np.nan, marks.image_px),
        np.where(lost, np.nan, marks.sigma_px),
        np.where(lost, Status.NOT_FOUND, marks.status),
    )


def _modes_that_matter(fit: Fit, board_mm: Floats) -> Floats:
    """(19, M) square root of the covariance, less the directions that do not move the map.

    The singular values of what the root's columns do to the control points (N, 2) mm order
    them; those are kept that together make KEPT of the variance there.
    """
    moved = _displacements(fit.view, fit.root, fit.view.project(board_mm))
    moved = moved[np.isfinite(moved).all(axis=(1, 2))].reshape(-1, moved.shape[2])
    _, sizes, directions = np.linalg.svd(moved, full_matrices=False)
    share = np.cumsum(sizes**2) / np.sum(sizes**2)
    count = int(np.searchsorted(share, KEPT)) + 1
    return fit.root @ directions[:count].T


def _displacements(view: BoardView, modes: Floats, image_px: Floats) -> Floats:
    """(N, 2, M) mm by which one standard deviation of each mode (19, M) moves the points."""
    moved = np.zeros((len(image_px), 2, modes.shape[1]))
    for index, mode in enumerate(modes.T):
        after, before = (
            replace(view, theta=view.theta + way * MODE_STEP * mode).locate(image_px)
            for way in (1, -1)
        )
        moved[:, :, index] = (after - before) / (2 * MODE_STEP)
    return moved
