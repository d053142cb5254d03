"""The paper's whole experiment in the tank: scan, evaluate, compare with the truth, report."""

import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lscan.acquisition.run import MANIFEST, Run
from lscan.acquisition.scan import scan
from lscan.cli.console import progress_bar
from lscan.config.documents import merge
from lscan.config.rig import RigFile, StripeSection, load_rig, parse_rig
from lscan.config.targets import Sandwave
from lscan.files.disk import make_folder
from lscan.measure import compare_slice
from lscan.paper.experiment import ControlPoints, Experiment, GroundTruth, RenderCheck, evaluate
from lscan.paper.report import write_experiment
from lscan.records import Floats, Status
from lscan.stripe import extract_stripe
from sim.render.tank import Tank
from sim.scene import Scene, scene_of
from sim.sensor import Webcam
from sim.truth import board_truth, slice_visibility, stripe_truth

PARTS = ("board", "groove", "sandwave")

# How the noise-free line is read: without noise the span may be wide enough to hold the whole
# line, so that the centroid is not biased by its own window, nor by the black level.
CHECK_STRIPE = StripeSection(extractor="centroid-relative", threshold_dn=20.0, span_px=6)
CHECK_EDGE_PX = 4.0  # columns this near to an end of the line are left out


@dataclass(frozen=True)
class DemoEffort:
    """How much of the demo's work is done.

    frames: of the sandwave; None: the scene's own.  render: what replaces the scenes' own
    settings of rendering.  checks: frames of the sandwave scan that are rendered again without
    noise.  samples, scatter_samples: a pixel in those.
    """

    frames: int | None
    render: Mapping[str, int]
    checks: int
    samples: int
    scatter_samples: int


FULL = DemoEffort(frames=None, render={}, checks=5, samples=64, scatter_samples=8)
# A hundred frames are the fewest from which the sandwave's scan can be aligned.
QUICK = DemoEffort(
    frames=100, render={"samples": 1, "scatter_samples": 0}, checks=1, samples=4, scatter_samples=1
)


def run_demo(
    scenes: Path,
    output: Path,
    frames: int | None = None,
    best: Path | None = None,
    quick: bool = False,
) -> Experiment:
    """The paper's experiment in the tank, compared with the ground truth.

    Progress bars show on a terminal.

    Parameters
    ----------
    scenes : Path
        Folder with board.toml, groove.toml and sandwave.toml.
    output : Path
        Folder for results.json, report.html and the run folders; those of an earlier demo are
        replaced.
    frames : int, optional
        Number of sandwave pictures, else the scene's own; the scan's length is kept.
    best : Path, optional
        Folder with the same three, which say how the best chain reads the same pictures; else
        the folder ``best`` beside ``scenes``, and where there is none, the rigs' own.
    quick : bool
        Everything with the least effort, fewer frames and samples.
    """
    started = time.monotonic()
    effort = QUICK if quick else FULL
    rigs = {part: _rig_of_effort(load_rig(scenes / f"{part}.toml"), effort) for part in PARTS}
    best = scenes.resolve().parent / "best" if best is None else best
    better = (
        {part: load_rig(best / f"{part}.toml").rig for part in PARTS} if best.is_dir() else None
    )
    fewer = effort.frames if frames is None else frames
    if fewer is not None:
        rigs["sandwave"] = thin_out(rigs["sandwave"], fewer)
    seconds: dict[str, float] = {}
    runs: dict[str, Run] = {}
    for part, rig_file in rigs.items():
        with _stopwatch(seconds, part):
            runs[part] = _scan(rig_file, output, part)
    with _stopwatch(seconds, "measure"), progress_bar("measure") as progress:
        experiment = evaluate(**runs, progress=progress, best=better)
    scenes_of = {part: scene_of(rig_file) for part, rig_file in rigs.items()}
    experiment = compare(experiment, scenes_of, effort)
    seconds["total"] = time.monotonic() - started
    experiment = replace(experiment, seconds=seconds, quick=quick)
    write_experiment(output, experiment)
    return experiment


def _rig_of_effort(rig_file: RigFile, effort: DemoEffort) -> RigFile:
    """The scene as this effort renders it; its name, which the page shows, tells of less effort."""
    if not effort.render:
        return rig_file
    name = f"{rig_file.rig.name} (quick run: few frames and samples, no figure to be judged)"
    document = merge(rig_file.document, {"name": name, "render": dict(effort.render)})
    return parse_rig(document, source=rig_file.source, trusted=True)


def thin_out(rig_file: RigFile, frames: int) -> RigFile:
    """The same scan with another number of pictures over the same length of track.

    Parameters
    ----------
    rig_file : RigFile, of the scan
    frames : int, pictures
    """
    plan = rig_file.rig.plan
    step_mm = plan.step_mm * plan.frames / frames
    document = merge(rig_file.document, {"plan": {"frames": frames, "step_mm": step_mm}})
    return parse_rig(document, source=rig_file.source)


def compare(
    experiment: Experiment, scenes: Mapping[str, Scene], effort: DemoEffort = FULL
) -> Experiment:
    """The experiment compared with the ground truth.

    Its slices' errors are then those of the points that are lit and seen.
    """
    truth = GroundTruth(
        control_points=_control_points(experiment, scenes["board"]),
        render_check=_render_check(scenes, effort),
        yaw_deg=scenes["sandwave"].tank.head.yaw_deg,
    )
    visible = _with_visible_errors(experiment, scenes["sandwave"])
    best = experiment.best and _with_visible_errors(experiment.best, scenes["sandwave"])
    return replace(visible, truth=truth, best=best)


def _render_check(scenes: Mapping[str, Scene], effort: DemoEffort) -> RenderCheck:
    """The line in noise-free renders of the groove and of places of the sandwave."""
    positions = scenes["sandwave"].rig.plan.positions_mm()
    inner = np.linspace(0, len(positions) - 1, effort.checks + 2)[1:-1]  # the scan's ends left out
    checks = [("groove", 0.0), *(("sandwave", float(positions[round(k)])) for k in inner)]
    tanks = {part: Tank(scenes[part]) for part in ("groove", "sandwave")}
    errors: list[list[Floats]] = [[], []]
    with progress_bar("compare with the truth") as progress:
        for done, (part, position_mm) in enumerate(checks):
            progress(done, len(checks))
            for kept, scatter_samples in zip(errors, (0, effort.scatter_samples), strict=True):
                kept.append(
                    stripe_errors(tanks[part], position_mm, effort.samples, scatter_samples)
                )
        progress(len(checks), len(checks))
    first, every = (np.concatenate(kept) for kept in errors)
    return RenderCheck(
        stripe_rms_px=float(np.sqrt(np.mean(first**2))),
        stripe_max_px=float(np.abs(first).max()),
        all_orders_rms_px=float(np.sqrt(np.mean(every**2))),
        all_orders_max_px=float(np.abs(every).max()),
    )


def stripe_errors(tank: Tank, position_mm: float, samples: int, scatter_samples: int) -> Floats:
    """Centre of the line in a noise-free render less the truth, px, away from the line's ends.

    (N,) over the columns where exactly one point is lit and seen.  samples: a pixel, a square
    number, in each of its parts.  scatter_samples: 0 leaves out the light of higher orders, which
    moves the line itself: in a valley each side lights the other.
    """
    scene = tank.scene.with_tank(sensor={"noise": False})
    layers = tank.render(position_mm, samples, scatter_samples=scatter_samples)
    exposure_ms = scene.rig.camera.exposure_ms
    image = Webcam(scene).expose(layers, exposure_ms, np.random.default_rng(0))
    found = extract_stripe(image, CHECK_STRIPE)
    truth = stripe_truth(scene, position_mm)
    clear = (truth.status == Status.OK) & ~truth.multiple & (truth.edge_px > CHECK_EDGE_PX)
    clear &= found.status == Status.OK
    return found.centre_px[clear] - truth.centre_px[clear]


def _control_points(experiment: Experiment, scene: Scene) -> ControlPoints:
    """Control points found against those in view, and their distance from the truth."""
    grid, truth = experiment.board.reading.grid, board_truth(scene).centres.grid
    both = grid.found & truth.found
    error = np.hypot(*(grid.image_px[both] - truth.image_px[both]).T)
    expected, rms_px = int(truth.found.sum()), float(np.sqrt(np.mean(error**2)))
    return ControlPoints(
        expected=expected, found=int(both.sum()), rms_px=rms_px, max_px=float(error.max())
    )


def _with_visible_errors(experiment: Experiment, scene: Scene) -> Experiment:
    """The experiment, its slices compared where they are lit and seen as the head passes."""
    sandwave, piece = experiment.sandwave, scene.rig.workpiece
    assert sandwave is not None and isinstance(piece, Sandwave)
    errors = {
        name: compare_slice(cut, piece, visible=slice_visibility(scene, cut.xy_mm))
        for name, cut in sandwave.slices.items()
    }
    return replace(experiment, sandwave=replace(sandwave, errors=errors))


def _scan(rig_file: RigFile, output: Path, part: str) -> Run:
    """A fresh run; an earlier demo's run of the same part is replaced, nothing else is."""
    folder = output / "runs" / part
    if (folder / MANIFEST).exists():
        shutil.rmtree(folder)
    make_folder(folder.parent)
    with progress_bar(f"scan {part}") as progress:
        return scan(rig_file, folder, progress=progress)


@contextmanager
def _stopwatch(seconds: dict[str, float], name: str) -> Iterator[None]:
    started = time.monotonic()
    yield
    seconds[name] = time.monotonic() - started
