"""Files of a render and of its truth, and of views of a board: pictures, layers and tables."""

import csv
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lscan.acquisition.run import Run, require_same_files
from lscan.board.chessboard import charuco_board
from lscan.calibration.metric.views import Charuco, Chessboard, Dots, HeldBoard
from lscan.camera.optics import CameraModel, undistort
from lscan.config.board import Board, Grid, Plate, load_board
from lscan.config.documents import Document, Strict, check, read_document, write_toml
from lscan.config.rig import BENDS
from lscan.errors import InputError
from lscan.files.disk import make_folder, write_atomically
from lscan.files.pictures import write_picture
from lscan.records import Bytes, Floats, Mask, Picture, Progress, Status
from sim.scene import (
    SECTIONS,
    PlanePort,
    Scene,
    at_moment,
    camera_pose,
    rotation,
    scene_of,
    sheet_pose,
)
from sim.scene.file import check_samples, is_changing
from sim.scene.matter import Texture
from sim.truth import board_truth, line_brightness, project, stripe_truths
from sim.water import water_optics

Row = tuple[Any, ...]  # of a table: numbers and words
STRIPE_COLUMNS: Row = (
    "frame", "position_mm", "column", "centre_px", "x_mm", "y_mm", "z_mm", "lit", "seen",
    "multiple", "edge_px", "height_dn", "height_sigma_dn", "noise_dn", "snr", "status",
)  # fmt: skip
BOARD_COLUMNS: Row = ("frame", "position_mm", "kind", "x_mm", "z_mm", "u_px", "v_px", "status")
AT_ONCE = 20  # pictures between two reports of progress: surfaces are made anew for each lot

FARTHEST_MM = 1e5  # beyond, single precision no longer carries a hundredth of a millimetre


def write_render(
    scene: Scene, position_mm: float, folder: Path, samples: int | None = None
) -> dict[str, Path]:
    """Write picture and labels (PNG), and the layers of light (NumPy .npz).

    The layers are float32 radiances in W/(m2 sr) in the air behind the port, (H, W) as the
    picture whatever the render's fineness.  labels.png has a class for each pixel
    (sim.datasets.labels.Label), labels-colour.png the same to look at.

    Parameters
    ----------
    scene, position_mm
        The tank, and the head's track position.
    folder
        To write to; it is made.
    samples
        A pixel, a square number; the scene's if None.

    Returns
    -------
    The files by their names.

    Raises
    ------
    InputError
        Where position or samples are out of range, or the disk refuses.
    """
    from sim.datasets.labels import check_sampling, colour_labels, label_scene
    from sim.devices import take_picture
    from sim.render.tank import Tank

    _check_place(position_mm)
    if samples is not None:
        check_samples(samples, scene.tank.render.fineness, where="--samples")
    at = at_moment(scene, 0, position_mm)
    if samples is not None:
        check_sampling(at.scene, at.position_mm, samples, where="--samples")
    image, layers, exposure_ms = take_picture(at.scene, Tank(scene), at.position_mm, samples)
    make_folder(folder)
    files = {
        "picture": folder / "picture.png",
        "layers": folder / "layers.npz",
        "labels": folder / "labels.png",
        "labels in colour": folder / "labels-colour.png",
    }
    labels = label_scene(at.scene, at.position_mm, layers, exposure_ms=exposure_ms)
    write_picture(files["picture"], image)
    write_picture(files["labels"], labels)
    write_picture(files["labels in colour"], colour_labels(labels))
    stream = BytesIO()
    np.savez_compressed(stream, **vars(layers.binned(image.shape[:2])))
    write_atomically(files["layers"], stream.getvalue())
    return files


@dataclass(frozen=True)
class Taken:
    """When a picture is taken, and where.

    Attributes
    ----------
    frame : int, number of the picture, from 0
    position_mm : float, mm, of the track
    exposure_ms : float, ms
    """

    frame: int
    position_mm: float
    exposure_ms: float


def taken_at(scene: Scene, positions_mm: Sequence[float]) -> list[Taken]:
    """Pictures of the scene at track positions, each with the rig's exposure.

    Parameters
    ----------
    scene : Scene, its rig gives the exposure
    positions_mm : sequence, mm, along the track

    Raises
    ------
    InputError
        A position lies beyond reach.
    """
    for position_mm in positions_mm:
        _check_place(position_mm)
    moments = [at_moment(scene, frame, place) for frame, place in enumerate(positions_mm)]
    exposures = [moment.scene.rig.camera.exposure_ms for moment in moments]
    return [Taken(k, *pair) for k, pair in enumerate(zip(positions_mm, exposures, strict=True))]


def taken_in(run: Run) -> tuple[Scene, list[Taken]]:
    """The scene that a run was made of, from its own rig document, and its recorded pictures.

    Parameters
    ----------
    run : Run, made with camera and track of driver "sim"

    Raises
    ------
    InputError
        The run was not made in the tank, holds no picture, or a mesh or texture that it was made
        with was changed since.
    """
    if not set(run.rig_file.document) & SECTIONS:
        raise InputError(
            "was not made in the tank: its rig document describes none, so nobody knows the truth",
            where=run.path,
            allowed='a run of camera and track with driver = "sim"',
        )
    if len(run) == 0:
        raise InputError("holds no frame yet", where=run.path)
    require_same_files(run.files, run.path)
    taken = [Taken(row.index, row.position_mm, row.exposure_ms) for row in run.rows]
    return scene_of(run.rig_file), taken


@dataclass(frozen=True)
class TruthTable:
    """A table of the truth that has been written.  statuses: its entries of each status."""

    file: Path
    statuses: Mapping[str, int]


def write_truth(
    scene: Scene, taken: Sequence[Taken], folder: Path, progress: Progress | None = None
) -> dict[str, TruthTable]:
    """Write one table for each line of the laser, and one for the board.

    stripe.csv with the laser on, stripe-0.csv, stripe-1.csv ... where it has several lines;
    board.csv where the target is the board.  Each holds all the pictures, one after the other.

    Parameters
    ----------
    scene, taken
        The scene, and when its pictures are taken.
    folder
        To write to; it is made.
    progress
        Called with how many pictures' tables are done, and how many there are.

    Returns
    -------
    The tables by their names.

    Raises
    ------
    InputError
        Where there is neither line nor board.
    """
    laser = scene.tank.laser
    makers: dict[str, Callable[[Sequence[Taken]], Iterator[Row]]] = {}
    tables: dict[str, list[Row]] = {}
    for line in range(len(laser.sheets) if laser.on else 0):
        name = f"stripe-{line}" if len(laser.sheets) > 1 else "stripe"
        makers[name], tables[name] = partial(_stripe_rows, scene, line), [STRIPE_COLUMNS]
    if scene.tank.target.shape == "board":
        makers["board"], tables["board"] = partial(_board_rows, scene), [BOARD_COLUMNS]
    if not makers:
        what = "no truth to write: the laser is off and the target is no board"
        raise InputError(what, where=scene.source)
    for first in range(0, len(taken), AT_ONCE):
        for name, rows in makers.items():
            tables[name] += rows(taken[first : first + AT_ONCE])
        if progress is not None:
            progress(min(first + AT_ONCE, len(taken)), len(taken))
    make_folder(folder)
    return {name: _table_in_file(folder / f"{name}.csv", rows) for name, rows in tables.items()}


def _table_in_file(file: Path, rows: Sequence[Row]) -> TruthTable:
    """The table in a file; rows: its head first, the status last in each."""
    stream = StringIO()
    csv.writer(stream, lineterminator="\n").writerows(rows)
    write_atomically(file, stream.getvalue().encode())
    return TruthTable(file, dict(Counter(row[-1] for row in rows[1:]).most_common()))


def _check_place(position_mm: float) -> None:
    if not abs(position_mm) <= FARTHEST_MM:  # also refuses NaN
        allowed = f"+-{FARTHEST_MM:g} mm"
        raise InputError("out of range", where="--position", value=position_mm, allowed=allowed)


def _stripe_rows(scene: Scene, line: int, taken: Sequence[Taken]) -> Iterator[Row]:
    moments = [at_moment(scene, picture.frame, picture.position_mm) for picture in taken]
    if is_changing(scene) and len(taken) > 1:
        for picture in taken:
            yield from _stripe_rows(scene, line, [picture])
        return
    here = moments[0].scene
    truths = stripe_truths(here, [moment.position_mm for moment in moments], line)
    lights = line_brightness(here, truths, [picture.exposure_ms for picture in taken])
    for picture, truth, light in zip(taken, truths, lights, strict=True):
        columns = (
            np.arange(len(truth.status)), truth.centre_px,
            truth.xz_mm[:, 0], truth.y_mm, truth.xz_mm[:, 1],
            truth.lit.astype(int), truth.seen.astype(int), truth.multiple.astype(int),
            truth.edge_px, light.height_dn, light.height_sigma_dn, light.noise_dn, light.snr,
        )  # fmt: skip
        names = [Status(status).name for status in truth.status]
        for row in zip(*(column.tolist() for column in columns), names, strict=True):
            yield picture.frame, picture.position_mm, *row


def _board_rows(scene: Scene, taken: Sequence[Taken]) -> Iterator[Row]:
    for picture in taken:
        at = at_moment(scene, picture.frame, picture.position_mm)
        reading = board_truth(at.scene, at.position_mm).centres
        kinds = {"grid": reading.grid}
        kinds |= {f"ruler-{k}": ruler.marks for k, ruler in enumerate(reading.rulers)}
        for kind, marks in kinds.items():
            places = np.column_stack([marks.board_mm, marks.image_px]).tolist()
            for place, status in zip(places, marks.status, strict=True):
                yield picture.frame, picture.position_mm, kind, *place, Status(status).name


# Pictures of a board held into the laser sheet in many poses: what the metric route is fed.


MOST_DEG = 35.0, 25.0  # turned about the head's z and about the board's x
MOST_DISTANCE_MM = 60.0  # of the board's middle from the sheet
TRIED = 6000  # poses drawn, of which those that serve are kept; some 2 % do
LEAST_CROSSING_DEG = 15.0  # between board and sheet; the line is four times as wide as the sheet
LEAST_GRAZE_DEG = 12.0  # at which the light meets the board; a fifth of it is left there
MOST_ASLANT_DEG = 50.0  # at which the board is seen; dots are two thirds as high as wide
CROSSED = 0.7  # of the dots' lesser half side: how near to the middle the line runs
STEEPEST = 1.5  # of the line in the picture: it is looked for column by column, or row by row
MARGIN_PX = 3.0  # that the board keeps from the picture's border
SIDE_POINTS = 9  # of the outline that are looked for in the picture, a side
RIM = 2.0  # squares that a chessboard's plate reaches beyond its inner corners, if not stated
SQUARE_PX = 200  # of the print of a square: its edges are as sharp as 1/200 of it
MOST_PX = 8000  # of the print's squares, a side
INK_DN = 20  # of 255, the paper: reflectance 0.08 of its
UNSEEN_MM = 1e-3  # of a dot


@dataclass(frozen=True)
class Poses:
    """K poses of a board in the head frame: x right, y away from the camera, z up.

    middle_mm: (K, 3) of the middle of its dots.  rotation: (K, 3, 3), board to head frame.
    features: (K, 5) turn, tilt, distance from the sheet and place in the picture, each
        counted in its own range, from -1 to 1.
    """

    middle_mm: Floats
    rotation: Floats
    features: Floats

    def only(self, wanted: Any) -> "Poses":
        """Those of a mask or of indices."""
        return Poses(self.middle_mm[wanted], self.rotation[wanted], self.features[wanted])


class BoardDocument(Strict):
    """A file that says which board is held, as the ``[board]`` of a views file does."""

    board: HeldBoard


def load_held_board(path: Path) -> HeldBoard:
    """The board in a TOML file whose one section is the ``[board]`` of a views file.

    Parameters
    ----------
    path : Path

    Raises
    ------
    InputError
        Names the key that is wrong.
    """
    return check(BoardDocument, read_document(path), where=path).board


def write_views(
    scene: Scene, folder: Path, count: int = 10, seed: int = 1, board: HeldBoard | None = None
) -> dict[str, Path]:
    """Write ``views.toml``, ``board.toml``, and two pictures for each pose.

    The pictures of a pose, ``pose-0.png`` with the lamps alone and ``pose-0-laser.png`` with lamps
    and laser, are what ``lscan calibrate-metric folder/views.toml`` takes.  Of a chessboard or a
    ChArUco board there is its print, ``board.png``, in place of ``board.toml``.

    Parameters
    ----------
    scene
        A board, lamps and laser; the board's own pose is not used.
    folder
        To write to; it is made.
    count, seed
        Of the poses; of the poses and of all noise.
    board
        Another board than the scene's, which then may have any target.

    Returns
    -------
    The files by their names.

    Raises
    ------
    InputError
        Where the scene lacks board, lamps or laser, or where too few poses serve.
    """
    if board is not None:
        board, plate = _plate_of(board)
        target = {"shape": "board", "file": None, "texture": None, "sand": None, "rough": None}
        scene = replace(scene, rig=scene.rig.model_copy(update={"board": plate}))
        scene = scene.with_tank(target=target)
    held = held_scenes(scene, count, seed)
    make_folder(folder)
    if board is None or isinstance(board, Dots):
        files = {"board": folder / "board.toml"}
        write_toml(files["board"], scene.board().model_dump(mode="json", exclude_none=True))
        margin = None if board is None else board.margin_mm
        board = Dots(kind="dots", file="board.toml", margin_mm=margin)
    else:
        files = {"board": folder / "board.png"}
        texture, printed = _print_of(board, files["board"])
        write_picture(files["board"], printed)
        held = [pose.with_tank(target={"texture": texture}) for pose in held]
    for number, pose in enumerate(held):
        dark, lit = photograph(pose, np.random.default_rng([seed, number]))
        for name, image in ((f"pose-{number}", dark), (f"pose-{number}-laser", lit)):
            files[name] = folder / f"{name}.png"
            write_picture(files[name], image)
    files["views"] = folder / "views.toml"
    write_toml(files["views"], _views(scene, board, count))
    return files


def _plate_of(held: HeldBoard) -> tuple[HeldBoard, Board]:
    """The board with its margin stated, and as one of dots: those of squares too small to be seen.

    The tank knows boards of dots: a chessboard is a plate with a picture on it.
    """
    if isinstance(held, Dots):
        return held, load_board(Path(held.file))
    square = held.square_mm
    margin = RIM * square if held.margin_mm is None else held.margin_mm
    if margin < square:
        what = "board.margin_mm: less than the outer squares"
        raise InputError(what, value=margin, allowed=f"square_mm = {square:g} or more")
    if isinstance(held, Charuco):
        _charuco(held)  # refuses what is none, before anything is written
    grid = Grid(columns=held.columns, rows=held.rows, pitch_mm=square, dot_diameter_mm=UNSEEN_MM)
    plate = Board(grid=grid, plate=Plate(margin_mm=margin))
    return held.model_copy(update={"margin_mm": margin}), plate


def _print_of(board: Chessboard | Charuco, file: Path) -> tuple[Texture, Bytes]:
    """How the print lies on the plate, its picture in ``file``, and that picture, (H, W)."""
    across, down, square = board.columns + 1, board.rows + 1, board.square_mm
    side = min(SQUARE_PX, MOST_PX // max(across, down))
    if isinstance(board, Charuco):
        squares = np.asarray(_charuco(board).generateImage((across * side, down * side)))
    else:
        bright = np.add.outer(np.arange(down), np.arange(across)) % 2 * 255
        squares = np.kron(bright, np.ones((side, side), int))
    rim_px = round(((board.margin_mm or square) / square - 1) * side)
    printed = np.pad(np.maximum(squares, INK_DN), rim_px, constant_values=255).astype(np.uint8)
    height, width = (pixels * square / side for pixels in printed.shape)
    beyond = square * (1 + rim_px / side)
    corner = (-beyond, beyond - height)
    return Texture(file=str(file), corner_mm=corner, size_mm=(width, height)), printed


def _charuco(board: Charuco) -> cv2.aruco.CharucoBoard:
    sizes = board.columns, board.rows, board.square_mm, board.marker_mm
    return charuco_board(*sizes, board.dictionary)


def photograph(scene: Scene, generator: np.random.Generator) -> tuple[Picture, Picture]:
    """Two pictures, (H, W, 3) RGB: with the lamps alone, and with lamps and laser.

    The head stands at track position 0.  Light adds up, so one render serves both, and so does
    the exposure of the second.
    """
    from sim.devices import metered_layers
    from sim.render.tank import Tank
    from sim.sensor import Webcam

    webcam = Webcam(scene)
    layers, exposure_ms = metered_layers(scene, Tank(scene), webcam, 0.0)
    dark = webcam.expose(layers.without_laser(), exposure_ms, generator)
    return dark, webcam.expose(layers, exposure_ms, generator)


def held_scenes(scene: Scene, count: int = 10, seed: int = 1) -> list[Scene]:
    """The scene with its board in ``count`` poses, as different as can be.

    Turned by up to 35 degrees about z and leant by up to 25 about x, its middle within 60 mm
    of the sheet, anywhere in the picture.  The whole plate is in view, and the sheet crosses
    it near its middle, lights it and is not nearly parallel to it.  Of poses drawn at random
    those are taken one by one that differ most from all taken before.

    Parameters
    ----------
    scene : Scene, with board, lamps and laser; the board's own pose is not used
    count : int, of the poses
    seed : int, of the draws

    Raises
    ------
    InputError
        The scene lacks board, lamps or laser, or too few poses serve.
    """
    tank, board = scene.tank, scene.board()
    if tank.light.ambient_w_m2_sr == 0:
        raise InputError("light: there is none to see the board by", where=scene.source)
    if not tank.laser.on:
        raise InputError("laser.on: is false, no line to see", where=scene.source)
    drawn = _draw(scene, np.random.default_rng([seed, TRIED]))
    drawn = drawn.only(_lit_and_seen(scene, board, drawn))
    drawn = drawn.only(_across_axis(scene, drawn))
    drawn = drawn.only(_in_picture(scene, board, drawn))
    if count < 1 or len(drawn.middle_mm) < count:
        found = f"1 to {len(drawn.middle_mm)}, the poses found that serve"
        raise InputError("poses of the board", where=scene.source, value=count, allowed=found)
    chosen = drawn.only(_most_different(drawn.features, count))
    return [_scene_of_pose(scene, board, chosen, number) for number in range(count)]


def _draw(scene: Scene, generator: np.random.Generator) -> Poses:
    """Poses at random, their middles seen all over the picture.

    Rays near the axis are those of a pinhole with the water's index times the focal length,
    near enough for a place to try; behind a dome, of one in air.
    """
    drawn = generator.uniform(-1, 1, (TRIED, 5))
    camera, lens = camera_pose(scene.tank.head), scene.tank.lens
    size = np.array(scene.rig.camera.size_px)
    pixel = (drawn[:, 3:] + 1) / 2 * (size - 1)
    places = (pixel - np.array(lens.centre_px)) / lens.focal_px
    if lens.model != "brown":
        bends = {name: getattr(lens, name) for name in BENDS}
        fisheye = lens.model == "fisheye"
        places = undistort(CameraModel(1.0, (0.0, 0.0), **bends, fisheye=fisheye), places)
    if isinstance(scene.tank.port, PlanePort):
        places /= water_optics(scene.tank.water, scene.tank.laser.wavelength_nm).index
    ahead = np.column_stack([places, np.ones(TRIED)])
    ray = ahead @ camera.rotation.T
    laser = scene.tank.laser
    sheet = sheet_pose(laser, laser.sheets[0])
    normal = sheet.rotation[:, 1]
    distance = (sheet.origin_mm - camera.origin_mm) @ normal + MOST_DISTANCE_MM * drawn[:, 2]
    middle = camera.origin_mm + (distance / (ray @ normal))[:, np.newaxis] * ray
    return Poses(middle, rotation("ZX", drawn[:, :2] * MOST_DEG), drawn)


def _lit_and_seen(scene: Scene, board: Board, poses: Poses) -> Mask:
    """(K,) whether the sheet crosses and lights the board, and the camera sees its face."""
    laser, face = scene.tank.laser, -poses.rotation[:, :, 1]
    sheet = sheet_pose(laser, laser.sheets[0])
    normal = sheet.rotation[:, 1]
    off = sheet.invert(poses.middle_mm)[:, 1]
    across = normal - (face @ normal)[:, np.newaxis] * face  # in the board, across the line
    sine = np.linalg.norm(across, axis=1)
    crossing = np.abs(off) <= CROSSED * _half_sides_mm(board).min() * sine
    crossing &= sine >= np.sin(np.radians(LEAST_CROSSING_DEG))
    foot = poses.middle_mm - (off / np.maximum(sine, 1e-9) ** 2)[:, np.newaxis] * across
    light = foot - sheet.origin_mm
    lit = _cosine(light, -face) >= np.sin(np.radians(LEAST_GRAZE_DEG))
    x, _, z = sheet.invert(foot).T
    lit &= np.degrees(np.arctan2(np.abs(x), -z)) <= laser.fan_half_angle_deg
    sight = poses.middle_mm - np.array(scene.tank.head.camera_mm)
    return crossing & lit & (_cosine(sight, -face) >= np.cos(np.radians(MOST_ASLANT_DEG)))


def _cosine(first: Floats, second: Floats) -> Floats:
    """(K,) of the angles between vectors (K, 3)."""
    lengths = np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1)
    return (first * second).sum(axis=1) / lengths


def _across_axis(scene: Scene, poses: Poses) -> Mask:
    """(K,) whether the line runs across the columns, or rows, that it is looked for in."""
    laser = scene.tank.laser
    normal = sheet_pose(laser, laser.sheets[0]).rotation[:, 1]
    along = np.cross(poses.rotation[:, :, 1], normal)
    ends = [project(scene, poses.middle_mm + way * along) for way in (-1, 1)]
    du, dv = np.abs(ends[1] - ends[0]).T
    run, rise = (du, dv) if scene.rig.stripe.axis == "columns" else (dv, du)
    return rise <= STEEPEST * run


def _in_picture(scene: Scene, board: Board, poses: Poses) -> Mask:
    """(K,) whether the plate's whole outline shows, by the truth's own projection."""
    local = _outline_mm(board) - _middle_mm(board)
    head = poses.middle_mm[:, np.newaxis] + local @ poses.rotation.transpose(0, 2, 1)
    pixels = project(scene, head.reshape(-1, 3)).reshape(*head.shape[:2], 2)
    size = np.array(scene.rig.camera.size_px)
    inside = (pixels >= MARGIN_PX) & (pixels <= size - 1 - MARGIN_PX)
    return np.asarray(inside.all(axis=(1, 2)))


def _outline_mm(board: Board) -> Floats:
    """(4 SIDE_POINTS, 3) points around the plate, board frame."""
    left, right, bottom, top = board.outline_mm()
    corners = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    part = np.linspace(0, 1, SIDE_POINTS, endpoint=False)[:, np.newaxis, np.newaxis]
    x, z = (corners + part * (np.roll(corners, -1, axis=0) - corners)).reshape(-1, 2).T
    return np.column_stack([x, np.zeros_like(x), z])


def _half_sides_mm(board: Board) -> Floats:
    """(2,) half the width and half the height of the grid of dots."""
    grid = board.grid
    return np.array([grid.columns - 1, grid.rows - 1]) * grid.pitch_mm / 2


def _middle_mm(board: Board) -> Floats:
    """(3,) the middle of the dots, board frame."""
    width, height = _half_sides_mm(board)
    return np.array([width, 0.0, -height])


def _most_different(features: Floats, count: int) -> list[int]:
    """Indices of ``count`` rows of (K, F), each as far as can be from all before it."""
    chosen = [0]
    nearest = np.linalg.norm(features - features[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return chosen


def _scene_of_pose(scene: Scene, board: Board, poses: Poses, number: int) -> Scene:
    """The scene with its board in one of the poses."""
    corner = poses.middle_mm[number] - poses.rotation[number] @ _middle_mm(board)
    turn, tilt = (poses.features[number, :2] * MOST_DEG).tolist()
    update = {"turn_deg": turn, "tilt_x_deg": tilt, "tilt_y_deg": 0.0}
    return scene.with_tank(target={"position_mm": tuple(corner.tolist()), **update})


def _views(scene: Scene, board: HeldBoard, count: int) -> Document:
    """The views file, in the words of ``lscan calibrate-metric``."""
    rig = scene.rig
    return {
        "board": board.model_dump(mode="json", exclude_none=True),
        "optics": rig.optics.model_dump(mode="json", exclude_unset=True, exclude_none=True),
        "stripe": rig.stripe.model_dump(mode="json", exclude_unset=True, exclude_none=True),
        "view": [
            {
                "picture": f"pose-{number}.png",
                "laser": f"pose-{number}-laser.png",
                "background": f"pose-{number}.png",
            }
            for number in range(count)
        ],
    }
