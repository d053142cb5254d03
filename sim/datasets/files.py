"""Files of a render and of its truth: pictures, layers and tables."""

import csv
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import numpy as np

from lscan.acquisition.run import Run, require_same_files
from lscan.errors import InputError
from lscan.files.disk import make_folder, write_atomically
from lscan.files.pictures import write_picture
from lscan.records import Progress, Status
from sim.scene import SECTIONS, Scene, at_moment, scene_of
from sim.scene.file import check_samples, is_changing
from sim.truth import board_truth, line_brightness, stripe_truths

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
