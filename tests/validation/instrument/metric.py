"""The metric route: one grooved block measured in air and in water through a leaning sheet."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from lscan.calibration.metric.solve import MetricCalibration, calibrate_metric
from lscan.calibration.metric.views import load_views, read_views
from lscan.records import Floats
from sim.datasets.files import write_views
from sim.scene import Scene, camera_pose, load_scene
from sim.truth import sheet_of
from tests.validation.instrument.effort import AccuracyEffort
from tests.validation.instrument.workpieces import dimensions
from tests.validation.rows import Row, row

MEDIA = ("air", "water")
HEIGHTS = ("H1", "H2", "H3", "H4")
SEED, SCAN_SEED = 1, 61
BESIDE_MM = 2.0
PLAIN_SAMPLES = 4  # with fewer, a groove of the block is missed


def metric_rows(scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """The laser plane's fit and the block's steps, in air and in water.

    scenes: holds metric/``air``, ``water``, ``block-air`` and ``block-water.toml``.
    """

    def scene(name: str) -> Scene:
        return effort.scene(load_scene(scenes / "metric" / f"{name}.toml"), PLAIN_SAMPLES)

    views = {medium: scene(medium) for medium in MEDIA}
    found = {medium: calibrated(views[medium], effort.poses) for medium in MEDIA}
    errors = {medium: step_errors(scene(f"block-{medium}"), found[medium]) for medium in MEDIA}
    apart = errors["air"] - errors["water"]
    each = ", ".join(f"{name} {mm:+.3f}" for name, mm in zip(HEIGHTS, apart, strict=True))
    beside = sheet_beside(views["water"])
    return [
        *(_plane_row(f"in {medium}", views[medium], found[medium]) for medium in MEDIA),
        row("metric-media", float(np.abs(apart).max()), seed=SCAN_SEED, each=each),
        *(
            row("metric-steps", float(np.abs(errors[m]).max()), seed=SCAN_SEED, medium=m)
            for m in MEDIA
        ),
        _plane_row(
            f"beside a board {BESIDE_MM:g} mm off", beside, calibrated(beside, effort.poses)
        ),
    ]


def step_errors(block: Scene, calibration: MetricCalibration) -> Floats:
    """(4,) mm: errors of the block's HEIGHTS, measured through a calibration's map."""
    lengths = dimensions(block, [SCAN_SEED], [calibration.plane_map])[0]
    return np.array([lengths[name].error_mm for name in HEIGHTS])


def calibrated(scene: Scene, poses: int, seed: int = SEED) -> MetricCalibration:
    """The metric calibration of rendered views, written and read as a user's would be."""
    with TemporaryDirectory() as folder:
        files = write_views(scene, Path(folder), poses, seed)
        document = load_views(files["views"])
        views, size = read_views(document)
    return calibrate_metric(views, document.document.optics, size, document.document.k3)


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


def _plane_row(where: str, scene: Scene, calibration: MetricCalibration) -> Row:
    views = calibration.views
    angle_mrad, distance_mm = sheet_error(scene, calibration.plane_map.view.q_per_mm)
    return row(
        "metric-plane",
        calibration.line_rms_mm,
        seed=SEED,
        where=where,
        used=sum(view.line_used for view in views),
        views=len(views),
        angle_mrad=angle_mrad,
        distance_mm=distance_mm,
    )
