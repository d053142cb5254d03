"""Scenes rendered as the cases of a suite: lines, boards and whole scans with their truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lscan.calibration.marks import joined_marks
from lscan.config.documents import Document
from lscan.config.rig import inline_board, parse_rig
from lscan.config.targets import Sandwave
from lscan.errors import InputError
from lscan.files.pictures import eight_bit
from lscan.records import Floats, Ints, Mask, Picture, Status
from lscan.suites import BoardCase, CaseTruth, LightLayers, ScanCase, SuiteCase
from sim.datasets.labels import label_scene, lit_truths, one_step_w_m2_sr
from sim.devices import exposure_of
from sim.render.layers import Layers
from sim.render.tank import Tank
from sim.scene import Scene, at_moment, scene_of
from sim.scene.file import is_changing
from sim.sensor import Webcam
from sim.truth import (
    StripeTruth,
    board_truth,
    line_brightness,
    slice_visibility,
    stripe_truth,
    stripe_truths,
)


def _expose(
    scene: Scene, layers: Layers, *stream: int, exposure_ms: float | None = None
) -> tuple[Picture, float]:
    """What the scene's webcam takes of rendered light, and how long it exposes it, ms.

    stream: of the noise, beside the sensor's seed.  exposure_ms: None: as the scene says.
    """
    webcam = Webcam(scene)
    exposure_ms = exposure_of(scene, webcam, layers) if exposure_ms is None else exposure_ms
    rng = np.random.default_rng([scene.tank.sensor.seed, *stream])
    return webcam.expose(layers, exposure_ms, rng), exposure_ms


# Pictures of the calibration board for a suite, with the truth of marks and map.


PLACES = 25  # of the map, along either side of the board


def board_case(scene: Scene, name: str, axes: Mapping[str, str], layers: Layers) -> BoardCase:
    """The light of one render as the scene's webcam takes it, with the board's truth.

    Parameters
    ----------
    scene : Scene
    name : str, of the case
    axes : mapping, its values
    layers : Layers, rendered at the start of the plan
    """
    pixels, places = _map(scene)
    return BoardCase(
        name,
        axes,
        _expose(scene, layers, 1)[0],
        scene.board(),
        scene.rig.optics,
        joined_marks(board_truth(scene, scene.rig.plan.start_mm).centres),
        pixels,
        places,
    )


def _map(scene: Scene) -> tuple[Floats, Floats]:
    """Places of the picture, and of the sheet that they show, over the board in its own frame."""
    grid, camera = scene.board().grid, scene.rig.camera
    width, height = (grid.columns - 1) * grid.pitch_mm, (grid.rows - 1) * grid.pitch_mm
    x, z = np.meshgrid(np.linspace(0, width, PLACES), np.linspace(0, -height, PLACES))
    places = np.column_stack([x.ravel(), z.ravel()])
    pixels = board_truth(scene, scene.rig.plan.start_mm).sheet_px(places)
    inside = ((pixels >= 0) & (pixels <= np.array(camera.size_px) - 1)).all(axis=1)
    return pixels[inside], places[inside]


# Pictures of a laser line for a suite, with the truth of every column.


def line_truths(scene: Scene) -> list[StripeTruth]:
    """The truth of each of the laser's lines at the start of the plan; of one where it is off.

    Parameters
    ----------
    scene : Scene

    Raises
    ------
    InputError
        As ``sim.truth.stripe_truth``.
    """
    start_mm = scene.rig.plan.start_mm
    return lit_truths(scene, start_mm) or [stripe_truth(scene, start_mm)]


def line_case(
    scene: Scene,
    name: str,
    axes: Mapping[str, str],
    layers: Layers,
    truths: Sequence[StripeTruth],
    *,
    pair: bool = False,
) -> SuiteCase:
    """The light of one render as the scene's webcam takes it, with its truth.

    Parameters
    ----------
    scene : Scene
    name : str, of the case
    axes : mapping, its values
    layers : Layers, rendered at the start of the plan
    truths : sequence, as of ``line_truths``
    pair : bool, whether there is a picture with the laser off besides
    """
    picture, exposure_ms = _expose(scene, layers, 1)
    shown = truths if scene.tank.laser.on else ()
    return SuiteCase(
        name,
        axes,
        picture,
        _expose(scene, layers.without_laser(), 2, exposure_ms=exposure_ms)[0] if pair else None,
        label_scene(scene, scene.rig.plan.start_mm, layers, shown, exposure_ms),
        _truth_of(scene, truths, exposure_ms),
        scene.rig.stripe,
        _layers_in_dn(scene, layers, exposure_ms),
    )


def _layers_in_dn(scene: Scene, layers: Layers, exposure_ms: float) -> LightLayers | None:
    """None where no light reaches the sensor's electrons."""
    step = one_step_w_m2_sr(scene, exposure_ms)
    if not np.isfinite(step):
        return None
    camera = scene.rig.camera
    pixels = layers.binned((camera.height_px, camera.width_px))
    return LightLayers(
        *(layer.astype(float) / step for layer in (pixels.direct, pixels.scattered, pixels.ambient))
    )


def _truth_of(scene: Scene, truths: Sequence[StripeTruth], exposure_ms: float) -> CaseTruth:
    """The line that [stripe] means, column by column: the first or last of several lines."""
    lights = line_brightness(scene, truths, [exposure_ms] * len(truths))
    centres = np.stack([one.centre_px for one in truths])
    shown: Mask = np.stack([one.status == Status.OK for one in truths])
    last = scene.rig.stripe.returns == "last"
    key: Floats = np.where(shown, -centres if last else centres, np.inf)
    meant, along = key.argmin(axis=0), np.arange(centres.shape[1])
    some = shown.any(axis=0)
    status = np.where(some, int(Status.OK), truths[0].status)
    several = (shown.sum(axis=0) > 1) & (scene.rig.stripe.returns == "brightest")
    hidden = np.stack([one.multiple for one in truths]).any(axis=0)  # the truth has one of them

    def of(values: Sequence[Floats]) -> Floats:
        chosen: Floats = np.stack(values)[meant, along]
        return np.where(some, chosen, np.nan)

    return CaseTruth(
        of([one.centre_px for one in truths]),
        of([one.width_px for one in lights]),
        of([one.height_dn for one in lights]),
        of([one.noise_dn for one in lights]),
        (several | hidden).astype(np.int64),
        status.astype(np.int64),
    )


def turned_case(case: SuiteCase) -> SuiteCase:
    """The case as a camera sees it whose columns are the other's rows.

    Parameters
    ----------
    case : SuiteCase, of a line across the columns
    """

    def swap_axes(image: Picture) -> Picture:
        return np.ascontiguousarray(np.swapaxes(image, 0, 1))

    return replace(
        case,
        picture=swap_axes(case.picture),
        dark=None if case.dark is None else swap_axes(case.dark),
        labels=eight_bit(swap_axes(case.labels)),
        layers=None if case.layers is None else case.layers.transpose(),
        settings=case.settings.model_copy(update={"axis": "rows"}),
    )


# One scene rendered as a case: a picture with its truth.


def rendered_case(scene: str, document: Document) -> SuiteCase | BoardCase:
    """The picture that a scene's webcam takes at the start of its plan, with its truth.

    Parameters
    ----------
    scene : str, a name or a path, for errors
    document : Document, of that scene

    Raises
    ------
    InputError
        A key or a value is wrong.
    """
    loaded = scene_of(parse_rig(inline_board(document, source=scene), source=scene))
    layers = Tank(loaded).render(loaded.rig.plan.start_mm)
    name, axes = loaded.rig.name, {"scene": scene}
    if loaded.tank.target.shape == "board":
        return board_case(loaded, name, axes, layers)
    return line_case(loaded, name, axes, layers, line_truths(loaded))


# Whole scans for a suite: board and workpiece by one rig, with the truth of every point.


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
    frames: list[list[tuple[Picture, float]]] = [[] for _ in cases]
    tank = Tank(first.scan)
    for number, position_mm in enumerate(positions):
        moment = at_moment(first.scan, number, position_mm)
        tank.take(moment.scene)
        layers = tank.render(moment.position_mm)
        for case, taken in zip(cases, frames, strict=True):
            of_case = at_moment(case.scan, number, position_mm).scene
            taken.append(_expose(of_case, layers, FRAMES, number))
    truths = _truths(first.scan, positions)
    slices = _slices(first.scan)
    return [
        _case(case, board, taken, truths, slices) for case, taken in zip(cases, frames, strict=True)
    ]


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
    frames: Sequence[tuple[Picture, float]],
    truths: Sequence[StripeTruth],
    slices: tuple[Floats, Ints],
) -> ScanCase:
    lights = line_brightness(case.scan, truths, [exposure_ms for _, exposure_ms in frames])
    return ScanCase(
        case.name,
        case.axes,
        board_case(case.board, case.name, case.axes, board),
        tuple(picture for picture, _ in frames),
        case.scan.rig,
        np.stack([truth.xz_mm for truth in truths]),
        np.stack([light.height_dn for light in lights]),
        np.stack([truth.multiple for truth in truths]).astype(np.int64),
        np.stack([truth.status for truth in truths]).astype(np.int64),
        *slices,
    )
