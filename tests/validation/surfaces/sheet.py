"""The metric route where half of the boards show glare, beside the laser's line or in its place."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lscan.board import read_board
from lscan.calibration.metric.sheet import distance_mm
from lscan.calibration.metric.solve import calibrate_metric, fit_views
from lscan.calibration.metric.views import CalibrationView, line_on_board
from lscan.camera.posedboards import priors_of
from lscan.records import Floats, Marks, Status
from lscan.stripe import extract_stripe
from sim.datasets.files import held_scenes
from sim.devices import metered_layers
from sim.render.layers import Layers
from sim.render.tank import Tank
from sim.scene import Scene, camera_pose, load_scene
from sim.sensor import Webcam
from sim.truth import board_truth, stripe_truth
from tests.validation.rows import Row, row
from tests.validation.surfaces.drawn import FieldEffort, board_pose, in_space

POSES, FEWER, POSES_SEED = 14, 8, 1  # fewer in a quick run
STREAM = 71  # of the generators
SAMPLES = 4  # a pixel; the laser's line is sampled in closed form
BRIGHTNESS = 1.0, 4.0  # of the glare, times the laser's line
SIGMA_PX = 1.0, 4.0  # of its width; that of the laser's line is 1 to 2 px
SLANT_DEG = 30.0  # of the glare against the columns' axis, at most
SHARE = 0.3, 1.2  # of the board's width that glare beside the line covers
NEAR_PX = 1.0  # a point within it of the laser's true line is of that line
MOSTLY = 2 / 3  # of a view's points: with so many off the laser's line, its line is wrong


@dataclass(frozen=True)
class HeldBoard:
    """A board in one pose, rendered, with its truth.

    scene: with the board in that pose.  lamps, lit: what reaches the lens with the lamps alone, and
    with the laser.  exposure_ms: of both.  marks: as read with the lamps alone.  marks_mm: (N, 3)
    where those found truly are, camera frame.  centre_px: (W,) v of the laser's true line in each
    column.  line_mm: (K, 3) its points, camera frame.  middle_px, width_px: of the board in the
    picture.
    """

    scene: Scene
    lamps: Layers
    lit: Layers
    exposure_ms: float
    marks: Marks
    marks_mm: Floats
    centre_px: Floats
    line_mm: Floats
    middle_px: Floats
    width_px: float


@dataclass(frozen=True)
class GlareDraw:
    """One draw.  plane_mm: rms distance of the true lines from the plane found, among the boards.

    wrong, named: of the views whose line is wrong, and of those the ones whose line was left out.
    right, accused: the same of the views without glare.
    """

    plane_mm: float
    wrong: int
    named: int
    right: int
    accused: int


def sheet_rows(scenes: Path, effort: FieldEffort) -> list[Row]:
    """The plane through 14 boards of which 7 show glare, and which lines are named.

    Parameters
    ----------
    scenes : Path, folder of the scene files; holds metric/``water.toml``
    effort : FieldEffort, its seeds draw glare and noise
    """
    poses = FEWER if effort.plain else POSES
    render = {"samples": SAMPLES} | ({"scatter_samples": 0} if effort.plain else {})
    scene = load_scene(scenes / "metric" / "water.toml").with_tank(render=render)
    boards = [_held(pose) for pose in held_scenes(scene, poses, POSES_SEED)]
    lines_mm = _lines_as_seen(boards)
    outcomes = [_outcome(boards, lines_mm, seed) for seed in effort.seeds]
    wrong, right = (sum(getattr(o, key) for o in outcomes) for key in ("wrong", "right"))
    named, accused = (sum(getattr(o, key) for o in outcomes) for key in ("named", "accused"))
    words: dict[str, Any] = {"poses": poses, "glaring": poses // 2, "seeds": effort.seeded}
    plane_mm = max(outcome.plane_mm for outcome in outcomes)
    return [
        row("glare-plane", plane_mm, seed=effort.seeds[0], **words),
        row("glare-named", 100 * named / max(wrong, 1), seed=effort.seeds[0], wrong=wrong, **words),
        row("glare-accused", 100 * accused / max(right, 1), seed=effort.seeds[0], right=right,
            **words),
    ]  # fmt: skip


def _held(scene: Scene) -> HeldBoard:
    webcam, camera = Webcam(scene), camera_pose(scene.tank.head)
    lit, exposure_ms = metered_layers(scene, Tank(scene), webcam, 0.0)
    nothing = np.zeros_like(lit.direct)
    lamps = replace(lit, direct=nothing, scattered=nothing)
    seen = board_truth(scene).centres.grid
    truth = stripe_truth(scene, 0.0)
    shown = truth.status == Status.OK
    points = np.column_stack([truth.xz_mm[:, 0], truth.y_mm, truth.xz_mm[:, 1]])[shown]
    picture = webcam.expose(lamps, exposure_ms, np.random.default_rng([STREAM, POSES_SEED]))
    marks = read_board(picture, scene.board()).grid
    return HeldBoard(
        scene=scene,
        lamps=lamps,
        lit=lit,
        exposure_ms=exposure_ms,
        marks=marks,
        marks_mm=camera.invert(board_pose(scene).apply(in_space(marks.board_mm[marks.found]))),
        centre_px=truth.centre_px,
        line_mm=camera.invert(points),
        middle_px=seen.image_px.mean(axis=0),
        width_px=float(np.ptp(seen.image_px[:, 0])),
    )


def _lines_as_seen(boards: Sequence[HeldBoard]) -> Floats:
    """(K, 3) mm, the laser's true lines on all boards as the calibrated camera has the boards.

    Its frame lies a millimetre off the true camera's, because a shift of the lens's centre looks
    like one of the camera; the boards, and all that is measured, go with it.  The rigid motion is
    that of least squares between the true marks and those of the calibration.
    """
    rig = boards[0].scene.rig
    views = [CalibrationView(f"pose {k}", held.marks) for k, held in enumerate(boards)]
    priors = priors_of(rig.optics, rig.camera.size_px, assume_webcam=False)
    fitted = fit_views(views, rig.optics, priors, rig.camera.size_px).fit.boards
    true = np.vstack([held.marks_mm for held in boards])
    seen = np.vstack([
        fitted.in_camera(held.marks.board_mm[held.marks.found], k) for k, held in enumerate(boards)
    ])  # fmt: skip
    turn = Rotation.align_vectors(seen - seen.mean(axis=0), true - true.mean(axis=0))[0]
    lines = np.vstack([held.line_mm for held in boards])
    return np.asarray(turn.apply(lines - true.mean(axis=0)) + seen.mean(axis=0))


def _outcome(boards: Sequence[HeldBoard], lines_mm: Floats, seed: int) -> GlareDraw:
    """Glare on half of the boards, drawn anew, the calibration, and which lines it names.

    lines_mm: (K, 3) the true lines, as ``_lines_as_seen`` gives them.
    """
    rng = np.random.default_rng([STREAM, seed])
    glaring = rng.permutation(len(boards))[: len(boards) // 2].tolist()
    kinds = {number: place % 2 for place, number in enumerate(glaring)}
    views = [_view(held, kinds.get(k), k, rng) for k, held in enumerate(boards)]
    rig = boards[0].scene.rig
    found = calibrate_metric(views, rig.optics, rig.camera.size_px)
    off_mm = distance_mm(lines_mm, found.plane_map.view.q_per_mm)
    named = np.array([not view.line_used for view in found.views])
    wrong = np.array([_is_wrong(*each) for each in zip(boards, views, strict=True)])
    right = np.array([number not in kinds for number in range(len(boards))])
    return GlareDraw(
        plane_mm=float(np.sqrt(np.mean(off_mm**2))),
        wrong=int(wrong.sum()),
        named=int((wrong & named).sum()),
        right=int(right.sum()),
        accused=int((right & named).sum()),
    )


def _is_wrong(held: HeldBoard, view: CalibrationView) -> bool:
    """Whether most of the points read as the line lie off the laser's true line."""
    assert view.line is not None  # the board shows the laser, or glare
    column, v = view.line.image_px.T
    of_line = np.abs(v - held.centre_px[column.astype(int)]) <= NEAR_PX  # of no line where NaN
    return len(v) > 0 and bool(np.mean(~of_line) >= MOSTLY)


def _view(
    held: HeldBoard, kind: int | None, number: int, rng: np.random.Generator
) -> CalibrationView:
    """The view of a board.  kind: None without glare, 0 glare in the line's place, 1 beside it."""
    scene, lit = held.scene, held.lit
    if kind is not None:
        glare = _streak(held, rng, whole=kind == 0)
        laser = lit.direct if kind else np.zeros_like(lit.direct)
        lit = replace(lit, direct=(laser + glare).astype(laser.dtype))
    webcam, exposure_ms = Webcam(scene), held.exposure_ms
    picture, dark = (webcam.expose(layers, exposure_ms, rng) for layers in (lit, held.lamps))
    stripe = extract_stripe(picture, scene.rig.stripe, dark)
    line = line_on_board(stripe, held.marks)
    return CalibrationView(f"pose {number}", held.marks, line)


def _streak(held: HeldBoard, rng: np.random.Generator, whole: bool) -> Floats:
    """(H, W) radiance of a straight streak of glare somewhere on the board.

    Across it is a Gaussian, along it a Gaussian to the fourth power, which ends softly.
    whole: it runs across all of the board.
    """
    height, width = held.lit.direct.shape
    middle = held.middle_px + rng.uniform(-0.3, 0.3, 2) * held.width_px
    slant = np.radians(rng.uniform(-SLANT_DEG, SLANT_DEG))
    half = held.width_px * (2.0 if whole else rng.uniform(*SHARE) / 2)
    u, v = np.meshgrid(np.arange(width) - middle[0], np.arange(height) - middle[1])
    along = u * np.cos(slant) + v * np.sin(slant)
    across = v * np.cos(slant) - u * np.sin(slant)
    peak = rng.uniform(*BRIGHTNESS) * np.percentile(held.lit.direct.max(axis=0), 90)
    shape = np.exp(-((across / rng.uniform(*SIGMA_PX)) ** 2) / 2 - (along / half) ** 4)
    return np.asarray(peak * shape)
