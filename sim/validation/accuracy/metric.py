"""The metric route: one grooved block measured in air and in water through a leaning sheet."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from lscan.calibration.multiview import MetricCalibration, calibrate_metric, load_views, read_views
from lscan.records import Floats, Length
from sim.datasets.views import write_views
from sim.scene import Scene, camera_pose, load_scene
from sim.truth import sheet_of
from sim.validation.accuracy.effort import AccuracyEffort
from sim.validation.accuracy.groove import dimensions
from sim.validation.rows import Row, row

MEDIA = ("air", "water")
HEIGHTS = ("H1", "H2", "H3", "H4")
SEED, SCAN_SEED = 1, 61
BESIDE_MM = 2.0
PLAIN_SAMPLES = 4  # with fewer, a groove of the block is missed


@dataclass(frozen=True)
class Finding:
    """Of one medium: the calibration, the sheet's error, and the block's dimensions.

    angle_mrad, distance_mm: of the sheet that was found from the true one, the distance
    where the camera's axis meets it.
    """

    calibration: MetricCalibration
    angle_mrad: float
    distance_mm: float
    lengths: dict[str, Length]


def metric_rows(folder: Path, effort: AccuracyEffort) -> list[Row]:
    """The laser plane's fit and the block's steps, in air and in water.

    folder: of ``air``, ``water``, ``block-air`` and ``block-water.toml``.
    """
    found = {medium: find(folder, medium, effort) for medium in MEDIA}
    rows = [_plane_row(f"in {medium}", finding) for medium, finding in found.items()]
    rows.append(_agreement(found))
    rows += [_nominal_row(medium, finding) for medium, finding in found.items()]
    beside = effort.scene(sheet_beside(load_scene(folder / "water.toml")), PLAIN_SAMPLES)
    finding = calibrated(beside, effort.poses)
    rows.append(_plane_row(f"beside a board {BESIDE_MM:g} mm off", finding))
    return rows


def find(folder: Path, medium: str, effort: AccuracyEffort) -> Finding:
    """The metric calibration of a medium's views, and the block measured through its map."""
    finding = calibrated(
        effort.scene(load_scene(folder / f"{medium}.toml"), PLAIN_SAMPLES), effort.poses
    )
    block = effort.scene(load_scene(folder / f"block-{medium}.toml"), PLAIN_SAMPLES)
    lengths = dimensions(block, [SCAN_SEED], [finding.calibration.plane_map])[0]
    return replace(finding, lengths=lengths)


def calibrated(scene: Scene, poses: int, seed: int = SEED) -> Finding:
    """The metric calibration of rendered views, written and read as a user's would be."""
    with TemporaryDirectory() as folder:
        files = write_views(scene, Path(folder), poses, seed)
        document = load_views(files["views"])
        views, size = read_views(document)
    solved = calibrate_metric(views, document.document.optics, size, document.document.k3)
    angle, distance = sheet_error(scene, solved.plane_map.view.q_per_mm)
    return Finding(solved, angle, distance, lengths={})


def sheet_error(scene: Scene, q_per_mm: Floats) -> tuple[float, float]:
    """Angle in mrad and distance in mm of the sheet q . X = 1 from the true one.

    q_per_mm: (3,) in the camera frame.  The distance is that of the place where the camera's
    axis meets the true sheet.
    """
    sheet, camera = sheet_of(scene).pose, camera_pose(scene.tank.head)
    normal = camera.rotation.T @ sheet.rotation[:, 1]
    place = np.array([0.0, 0.0, (camera.invert(sheet.origin_mm) @ normal) / normal[2]])
    length = float(np.linalg.norm(q_per_mm))
    sine = float(np.linalg.norm(np.cross(normal, q_per_mm))) / length
    return 1e3 * float(np.arcsin(min(sine, 1.0))), abs(float(place @ q_per_mm) - 1) / length


def sheet_beside(scene: Scene) -> Scene:
    """The scene with its sheet 2 mm farther away: a board laid into the old place is 2 mm off."""
    x, y, z = scene.tank.laser.apex_mm
    return scene.with_tank(laser={"apex_mm": (x, y + BESIDE_MM, z)})


def _plane_row(where: str, finding: Finding) -> Row:
    reports = finding.calibration.reports
    return row(
        "metric-plane",
        finding.calibration.line_rms_mm,
        seed=SEED,
        where=where,
        used=sum(report.line_used for report in reports),
        views=len(reports),
        angle_mrad=finding.angle_mrad,
        distance_mm=finding.distance_mm,
    )


def _agreement(found: dict[str, Finding]) -> Row:
    air, water = (found[medium].lengths for medium in MEDIA)
    apart = [air[name].error_mm - water[name].error_mm for name in HEIGHTS]
    each = ", ".join(f"{n} {d:+.3f}" for n, d in zip(HEIGHTS, apart, strict=True))
    return row("metric-media", _largest(apart), seed=SCAN_SEED, each=each)


def _nominal_row(medium: str, finding: Finding) -> Row:
    errors = [finding.lengths[name].error_mm for name in HEIGHTS]
    return row("metric-steps", _largest(errors), seed=SCAN_SEED, medium=medium)


def _largest(errors: Sequence[float]) -> float:
    return max(abs(error) for error in errors)
