"""Whole scans for a suite: board and workpiece by one rig, with the truth of every point."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lscan.config.targets import Sandwave
from lscan.errors import InputError
from lscan.records import Bytes, Floats, Ints, Status
from lscan.suites import ScanCase
from sim.datasets.boards import board_case
from sim.devices import exposure_of
from sim.render.layers import Layers
from sim.render.tank import Tank
from sim.scene import Scene, at_moment
from sim.scene.file import is_changing
from sim.sensor import Webcam
from sim.truth import StripeTruth, line_brightness, slice_visibility, stripe_truth, stripe_truths

SLICE_STEP_MM = 0.5
FRAMES = 5  # of the generators: other streams than a single picture's


@dataclass(frozen=True)
class ScanScenes:
    """What a scan is made of.  board, scan: scenes of one rig.  axes: the case's values."""

    name: str
    axes: Mapping[str, str]
    board: Scene
    scan: Scene


def scan_cases(first: ScanScenes, cases: Sequence[ScanScenes]) -> list[ScanCase]:
    """Scans that differ in exposure alone: each picture is rendered once for all of them.

    Parameters
    ----------
    first : ScanScenes, that is rendered
    cases : sequence, of those that are wanted

    Raises
    ------
    InputError
        The laser is off or has several lines.
    """
    laser, plan = first.scan.tank.laser, first.scan.rig.plan
    if not laser.on or len(laser.sheets) > 1:
        raise InputError("scans: laser", where=first.scan.source, allowed="one line, that is on")
    board = Tank(first.board).render(first.board.rig.plan.start_mm)
    positions = plan.positions_mm()
    frames: list[list[_Exposed]] = [[] for _ in cases]
    tank = Tank(first.scan)
    for number, position_mm in enumerate(positions):
        moment = at_moment(first.scan, number, position_mm)
        tank.take(moment.scene)
        layers = tank.render(moment.position_mm)
        for case, taken in zip(cases, frames, strict=True):
            taken.append(_exposed(at_moment(case.scan, number, position_mm).scene, layers, number))
    truths = _truths(first.scan, positions)
    slices = _slices(first.scan)
    return [
        _case(case, board, taken, truths, slices) for case, taken in zip(cases, frames, strict=True)
    ]


@dataclass(frozen=True)
class _Exposed:
    """A picture, uint8, and how long it was exposed, ms."""

    picture: Bytes
    exposure_ms: float


def _exposed(scene: Scene, layers: Layers, number: int) -> _Exposed:
    webcam = Webcam(scene)
    exposure_ms = exposure_of(scene, webcam, layers)
    rng = np.random.default_rng([scene.tank.sensor.seed, FRAMES, number])
    return _Exposed(webcam.expose(layers, exposure_ms, rng), exposure_ms)


def _truths(scene: Scene, positions_mm: Sequence[float]) -> list[StripeTruth]:
    if not is_changing(scene):
        return stripe_truths(scene, positions_mm)
    moments = [at_moment(scene, number, place) for number, place in enumerate(positions_mm)]
    return [stripe_truth(moment.scene, moment.position_mm) for moment in moments]


def _slices(scene: Scene) -> tuple[Floats, Ints]:
    """(M, 3) mm of the paper's slices by eq. (4), and (M,) whether they are lit and seen."""
    piece = scene.rig.workpiece
    if not isinstance(piece, Sandwave):
        return np.empty((0, 3)), np.empty(0, np.int64)
    lines = []
    for start, end in piece.slices_mm().values():
        count = round(float(np.linalg.norm(np.subtract(end, start))) / SLICE_STEP_MM) + 1
        lines.append(np.linspace(start, end, count))
    xy = np.concatenate(lines)
    status = np.where(slice_visibility(scene, xy), Status.OK, Status.OCCLUDED)
    return np.column_stack([xy, piece.height_mm(*xy.T)]), status.astype(np.int64)


def _case(
    case: ScanScenes,
    board: Layers,
    frames: Sequence[_Exposed],
    truths: Sequence[StripeTruth],
    slices: tuple[Floats, Ints],
) -> ScanCase:
    lights = line_brightness(case.scan, truths, [frame.exposure_ms for frame in frames])
    return ScanCase(
        case.name,
        case.axes,
        board_case(case.board, case.name, case.axes, board),
        tuple(frame.picture for frame in frames),
        case.scan.rig,
        np.stack([truth.xz_mm for truth in truths]),
        np.stack([light.height_dn for light in lights]),
        np.stack([truth.multiple for truth in truths]).astype(np.int64),
        np.stack([truth.status for truth in truths]).astype(np.int64),
        *slices,
    )
