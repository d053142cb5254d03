"""Files of a render and of its truth: pictures, layers and tables."""

from __future__ import annotations

from io import BytesIO, StringIO
from pathlib import Path

import numpy as np

from lscan.disk import make_folder, write_atomically
from lscan.errors import InputError
from lscan.pictures import write_picture
from lscan.records import Marks, Status
from sim.scene import Scene
from sim.scene.file import check_samples
from sim.truth import board_truth, stripe_truth

FARTHEST_MM = 1e5  # beyond, single precision no longer carries a hundredth of a millimetre


def write_render(
    scene: Scene, position_mm: float, folder: Path, samples: int | None = None
) -> dict[str, Path]:
    """The files written: picture and labels (PNG), and the layers of light (NumPy .npz).

    The layers are float32 radiances in W/(m2 sr) in the air behind the port, (H, W) as the
    picture whatever the render's fineness.  labels.png has
    a class for each pixel (sim.labels.Label), labels-colour.png the same to look at.
    """
    from sim.devices import metered
    from sim.labels import colour_labels, label_scene
    from sim.sensor import Webcam
    from sim.tank import Tank

    _check_place(position_mm)
    if samples is not None:
        check_samples(samples, scene.tank.render.fineness, where="--samples")
    webcam = Webcam(scene)
    layers, exposure_ms = metered(scene, Tank(scene), webcam, position_mm, samples)
    generator = np.random.default_rng([scene.tank.sensor.seed, 1])
    image = webcam.expose(layers, exposure_ms, generator)
    make_folder(folder)
    names = {"picture": "picture.png", "layers": "layers.npz", "labels": "labels.png"}
    files = {key: folder / name for key, name in names.items()}
    files["labels in colour"] = folder / "labels-colour.png"
    labels = label_scene(scene, position_mm, layers)
    write_picture(files["picture"], image)
    write_picture(files["labels"], labels)
    write_picture(files["labels in colour"], colour_labels(labels))
    pixels, stream = layers.binned(image.shape[:2]), BytesIO()
    np.savez_compressed(
        stream, direct=pixels.direct, scattered=pixels.scattered, ambient=pixels.ambient
    )
    write_atomically(files["layers"], stream.getvalue())
    return files


def write_truth(scene: Scene, position_mm: float, folder: Path) -> dict[str, Path]:
    """The files written: one table for each line of the laser, and one for the board.

    stripe.csv with the laser on, stripe-0.csv, stripe-1.csv ... where it has several lines;
    board.csv where a board stands there.  Raises InputError where there is neither.
    """
    _check_place(position_mm)
    laser = scene.tank.laser
    tables: dict[str, str] = {}
    for line in range(len(laser.sheets) if laser.on else 0):
        name = f"stripe-{line}" if len(laser.sheets) > 1 else "stripe"
        tables[name] = _stripe_table(scene, position_mm, line)
    if scene.tank.target.shape == "board":
        tables["board"] = _board_table(scene, position_mm)
    if not tables:
        raise InputError("no truth to tell: the laser is off and no board stands there")
    make_folder(folder)
    for name, table in tables.items():
        write_atomically(folder / f"{name}.csv", table.encode())
    return {name: folder / f"{name}.csv" for name in tables}


def _check_place(position_mm: float) -> None:
    if not abs(position_mm) <= FARTHEST_MM:  # also refuses NaN
        raise InputError(
            "out of range", where="--position", value=position_mm, allowed=f"+-{FARTHEST_MM:g} mm"
        )


def _stripe_table(scene: Scene, position_mm: float, line: int) -> str:
    truth = stripe_truth(scene, position_mm, line)
    table = StringIO()
    table.write("column,centre_px,x_mm,y_mm,z_mm,lit,seen,status\n")
    points = np.column_stack([truth.centre_px, truth.xz_mm[:, 0], truth.y_mm, truth.xz_mm[:, 1]])
    for column, (centre, x, y, z) in enumerate(points.tolist()):
        flags = f"{int(truth.lit[column])},{int(truth.seen[column])}"
        status = Status(truth.status[column]).name
        table.write(f"{column},{centre!r},{x!r},{y!r},{z!r},{flags},{status}\n")
    return table.getvalue()


def _board_table(scene: Scene, position_mm: float) -> str:
    reading = board_truth(scene, position_mm).centres
    table = StringIO()
    table.write("kind,x_mm,z_mm,u_px,v_px,status\n")
    _write_marks(table, "grid", reading.grid)
    for number, ruler in enumerate(reading.rulers):
        _write_marks(table, f"ruler-{number}", ruler.marks)
    return table.getvalue()


def _write_marks(table: StringIO, kind: str, marks: Marks) -> None:
    rows = zip(marks.board_mm.tolist(), marks.image_px.tolist(), marks.status, strict=True)
    for (x, z), (u, v), status in rows:
        table.write(f"{kind},{x!r},{z!r},{u!r},{v!r},{Status(status).name}\n")
