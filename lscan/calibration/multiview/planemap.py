"""The plane map of the metric route: a pixel's ray, through the port, to the laser's plane.

Frame: the sheet's own.  x is the camera's u axis laid into the sheet, y the sheet's normal
away from the camera, z = x cross y, up; the origin is the point of the sheet seen in the middle
of the picture, a pixel, so that no uncertainty of the lens's centre displaces it.  With a camera
that is not rolled against the horizon, x is horizontal.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, NoReturn, Self

import numpy as np
from pydantic import model_validator
from scipy.spatial import ConvexHull, QhullError

from lscan.calibration.api import NOTHING_KNOWN
from lscan.calibration.evaluate import Estimate, to_points
from lscan.calibration.maps.refractivefit import LIMITS
from lscan.calibration.multiview.bundle import COUNT, NAMES, camera_of
from lscan.calibration.multiview.lines import locate
from lscan.calibration.region import Region
from lscan.calibration.stored import Matrix, Number, Vector
from lscan.camera import rays
from lscan.config.documents import Strict, check
from lscan.config.rig import OpticsSection
from lscan.errors import InputError, MeasurementError
from lscan.records import BoardReading, Floats, PlanePoints

KEPT = 0.9999  # of the variance on the region's outline that the stored modes account for
MODE_STEP = 0.01  # sigmas, for differences along a mode
PIXEL_STEP = 0.01  # px, for differences by the pixel


class MetricParameters(Strict):
    """What a metric map is made of, as a file holds it."""

    port: Literal["flat", "none"]
    theta: dict[str, Number]
    q_per_mm: Vector
    origin_px: Vector
    modes: Matrix
    region: Region

    @model_validator(mode="after")
    def _sizes(self) -> Self:
        if tuple(self.theta) != NAMES:
            raise ValueError(f"theta must hold {', '.join(NAMES)}")
        for name, (low, high) in LIMITS.items():
            if not low <= self.theta[name] <= high:
                raise ValueError(f"theta.{name} must be {low:g} to {high:g}")
        if self.q_per_mm.shape != (3,) or not self.q_per_mm.any():
            raise ValueError("q_per_mm must be three numbers, not all 0")
        if self.origin_px.shape != (2,):
            raise ValueError("origin_px must be two numbers")
        if len(self.modes) != COUNT + 3:
            raise ValueError(f"modes must hold {COUNT + 3} rows, one for each of theta and q")
        return self


@dataclass(frozen=True)
class SheetView:
    """A camera and the laser's sheet before it.

    theta: (14,) the camera (bundle.NAMES).  port: "none" in air.  q_per_mm: (3,), the sheet is
    the plane q . X = 1 of the camera frame.  origin_px: (2,) the pixel that sees the origin.
    """

    theta: Floats
    port: Literal["flat", "none"]
    q_per_mm: Floats
    origin_px: Floats

    @property
    def axes(self) -> Floats:
        """(3, 3) the sheet's axes x, y, z as columns, camera frame."""
        away = self.q_per_mm / np.linalg.norm(self.q_per_mm)
        away = away * (1.0 if away[2] >= 0 else -1.0)
        x = np.array([1.0, 0.0, 0.0]) - away[0] * away
        x /= np.linalg.norm(x)
        return np.column_stack([x, away, np.cross(x, away)])

    def locate(self, image_px: Floats) -> Floats:
        """(N, 2) of (x, z) mm where the rays of pixels (N, 2) meet the sheet; NaN where not."""
        axes = self.axes
        foot = self.q_per_mm / (self.q_per_mm @ self.q_per_mm)  # a point of the plane
        pixels = np.vstack([self.origin_px, image_px])
        points = locate(self.theta, self.port, pixels, axes[:, 1], foot)
        return (points[1:] - points[0]) @ axes[:, [0, 2]]

    def slopes(self, image_px: Floats) -> Floats:
        """(N, 2) mm of x and of z that the rays of pixels (N, 2) run for each mm of y."""
        direction = rays(camera_of(self.theta, self.port), image_px).direction @ self.axes
        return direction[:, [0, 2]] / direction[:, 1:2]

    def displacements(self, modes: Floats, image_px: Floats) -> Floats:
        """(N, 2, M) mm by which one standard deviation of each mode (17, M) moves the points."""
        moved = np.zeros((len(image_px), 2, modes.shape[1]))
        for index, mode in enumerate(modes.T):
            after, before = (
                replace(
                    self,
                    theta=self.theta + way * mode[:COUNT],
                    q_per_mm=self.q_per_mm + way * mode[COUNT:],
                ).locate(image_px)
                for way in (MODE_STEP, -MODE_STEP)
            )
            moved[:, :, index] = (after - before) / (2 * MODE_STEP)
        return moved


@dataclass(frozen=True)
class Metric:
    """A solved metric map.

    modes: (17, M), the covariance of camera and sheet (theta, then q) is modes @ modes.T but
    for what does not move the map.
    """

    view: SheetView
    modes: Floats
    region: Region
    name: str = "metric"

    @property
    def lack_of_fit_mm(self) -> Floats:
        """(2,) none: the covariance is already scaled up by all that noise does not explain."""
        return np.zeros(2)

    def to_plane(self, image_px: Floats, sigma_px: Floats | None = None) -> PlanePoints:
        """Points in the sheet, (N, 2) mm, of the pixels (N, 2), as api.PlaneMap promises.

        sigma_mm combines the pixel's uncertainty and the covariance of camera, port and sheet.
        """
        return to_points(self, image_px, sigma_px)

    def estimate(self, image_px: Floats, variance_px2: Floats) -> Estimate:
        """Points of covered pixels."""
        modes = self.view.displacements(self.modes, image_px)
        slope = self._pixel_slope(image_px)
        variance = variance_px2[:, None] * (slope**2).sum(axis=2) + (modes**2).sum(axis=2)
        xz = self.view.locate(image_px)
        return Estimate(np.where(np.isfinite(variance), xz, np.nan), variance, modes)

    def _pixel_slope(self, image_px: Floats) -> Floats:
        """(N, 2, 2) mm per px, the last axis by u and v."""
        moved = [
            self.view.locate(image_px + way * step)
            for step in PIXEL_STEP * np.eye(2)
            for way in (1, -1)
        ]
        return np.stack([moved[0] - moved[1], moved[2] - moved[3]], axis=2) / (2 * PIXEL_STEP)

    def parameters(self) -> dict[str, Any]:
        """Camera, plane, their modes, and the region, as JSON types."""
        return MetricParameters(
            port=self.view.port,
            theta=dict(zip(NAMES, self.view.theta.tolist(), strict=True)),
            q_per_mm=self.view.q_per_mm,
            origin_px=self.view.origin_px,
            modes=self.modes,
            region=self.region,
        ).model_dump(mode="json")


def modes_that_matter(view: SheetView, root: Floats, image_px: Floats) -> Floats:
    """(17, M) square root of the covariance root @ root.T, less what does not move the map.

    image_px: (N, 2), where it counts.  Those directions are kept that together make KEPT of
    the variance there.
    """
    scale = _scale(root)
    u, sizes, _ = np.linalg.svd(root / scale, full_matrices=False)
    compact = scale * (u * sizes)  # (17, 17 at most), the same covariance
    moved = view.displacements(compact, image_px)
    moved = moved[np.isfinite(moved).all(axis=(1, 2))].reshape(-1, compact.shape[1])
    _, sizes, directions = np.linalg.svd(moved, full_matrices=False)
    share = np.cumsum(sizes**2) / max(float(np.sum(sizes**2)), 1e-300)
    return compact @ directions[: int(np.searchsorted(share, KEPT)) + 1].T


def _scale(root: Floats) -> Floats:
    """(17, 1) standard uncertainties, 1 where there is none: parameters of all units alike."""
    sigma = np.linalg.norm(root, axis=1, keepdims=True)
    return np.where(sigma > 0, sigma, 1.0)


def region_around(image_px: Floats) -> Region:
    """The convex hull of pixels (N, 2): where marks and line were seen.

    Raises MeasurementError where they span no area.
    """
    try:
        hull = ConvexHull(image_px)
    except (QhullError, ValueError) as error:
        raise MeasurementError("the marks and the line span no area of the picture") from error
    return Region(image_px[hull.vertices], 0.0)


class MetricSolver:
    """Restores metric maps; they are solved from several pictures, not from one."""

    def check_variant(self, variant: str) -> NoReturn:
        """InputError, whatever the variant: one picture of the board does not give this map."""
        raise InputError(
            "a metric map is solved from pictures of a board in several poses",
            where="plane map",
            value=f"metric-{variant}" if variant else "metric",
            allowed="lscan calibrate-metric VIEWS.toml -o FILE",
        )

    def solve(
        self, reading: BoardReading, variant: str, optics: OpticsSection = NOTHING_KNOWN
    ) -> NoReturn:
        """InputError: one picture of the board does not hold what a metric map needs."""
        self.check_variant(variant)

    def restore(self, variant: str, parameters: dict[str, Any]) -> Metric:
        """The map that ``parameters`` came from; InputError where they do not fit."""
        if variant:
            raise InputError(
                "no such metric map", where="plane map", value=f"metric-{variant}", allowed="metric"
            )
        read = check(MetricParameters, parameters, where=None, prefix="parameters")
        theta = np.array(list(read.theta.values()))
        view = SheetView(theta, read.port, read.q_per_mm, read.origin_px)
        return Metric(view, read.modes, read.region)


solver = MetricSolver()
