"""The pictures of one tank with their labels, as the files of one shard."""

import io
import logging
import os
import shutil
import tarfile
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import cv2
import h5py
import numpy as np

from lscan.errors import InputError, LscanError
from lscan.files.datasets import MEMBERS, shard_sha256
from lscan.files.disk import disk_errors, sync_folder, temporary_name, write_atomically
from lscan.files.jsontext import json_text, read_json, write_json
from lscan.files.pictures import encoded
from lscan.files.runlengths import run_lengths
from sim.datasets.datasetspec import POSITION, DatasetSpec
from sim.datasets.labels import Label, label_scene, line_columns, one_step_w_m2_sr
from sim.scene import Scene, at_moment
from sim.truth import stripe_truth

Format = Literal["webdataset", "hdf5", "folders"]
ENDINGS: Mapping[Format, str] = {"webdataset": ".tar", "hdf5": ".h5", "folders": ""}
PNG_FAST = (cv2.IMWRITE_PNG_COMPRESSION, 1)
# Noise hardly repeats: without looking for what does, pictures are smaller, and read faster.
PNG_NOISY = (*PNG_FAST, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY)
ZIP_FAST = 1
MOST_HALF = 65504.0  # that 16 bits of IEEE 754 hold
MOST_RECORD_BYTES = 2**26

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ShardTask:
    """One shard to make.

    folder: of the data set, which all workers see.  first, count: of its pictures.
    """

    spec: DatasetSpec
    folder: Path
    form: Format
    number: int
    first: int
    count: int

    @property
    def file(self) -> str:
        """Its name in the folder."""
        return f"shard-{self.number:06d}{ENDINGS[self.form]}"


@dataclass(frozen=True)
class ShardRecord:
    """What became of a shard.  keys: of its pictures.  failed: by key, why there is none."""

    file: str
    sha256: str
    keys: tuple[str, ...]
    failed: Mapping[str, str]


def make_shard(task: ShardTask) -> ShardRecord:
    """Render a shard and write it, whole or not at all, then its record beside it.

    Parameters
    ----------
    task : ShardTask

    Raises
    ------
    InputError
        The disk refuses.
    """
    pictures: dict[str, dict[str, bytes]] = {}
    failed: dict[str, str] = {}
    for key, found in rendered(task):
        if isinstance(found, str):
            failed[key] = found
        else:
            pictures[key] = found
    path = task.folder / task.file
    WRITERS[task.form](path, pictures)
    record = ShardRecord(task.file, shard_sha256(path), tuple(pictures), failed)
    write_json(record_file(task), asdict(record))
    return record


def record_file(task: ShardTask) -> Path:
    """Where a shard's record lies; it is written last."""
    return task.folder / f"shard-{task.number:06d}.json"


def kept_record(task: ShardTask) -> ShardRecord | None:
    """The record of a shard that is there, whole and as it was written; None where it is not.

    Parameters
    ----------
    task : ShardTask
    """
    try:
        found = read_json(record_file(task), MOST_RECORD_BYTES, within=task.folder)
        record = ShardRecord(
            found["file"], found["sha256"], tuple(found["keys"]), dict(found["failed"])
        )
        whole = shard_sha256(task.folder / task.file) == record.sha256
    except (InputError, ValueError, KeyError, TypeError):
        return None
    numbers = range(task.first, task.first + task.count)
    same = {*record.keys, *record.failed} == {f"{n:09d}" for n in numbers}
    return record if whole and same else None


def rendered(task: ShardTask) -> Iterator[tuple[str, dict[str, bytes] | str]]:
    """Each picture's key, and its files, or in one line why there are none."""
    from sim.render.tank import Tank

    numbers = range(task.first, task.first + task.count)
    try:
        base, drawn = task.spec.tank(task.number)
        tank = Tank(base)
    except Exception as error:  # whatever it is, the other shards are still wanted
        yield from ((f"{number:09d}", _reason(error)) for number in numbers)
        return
    for number in numbers:
        try:
            scene, own = task.spec.picture(base, number)
            yield f"{number:09d}", picture_files(tank, scene, drawn | own)
        except Exception as error:  # a failed scene is a row of the manifest
            yield f"{number:09d}", _reason(error)


def _reason(error: Exception) -> str:
    text = " ".join(str(error).split())
    if isinstance(error, LscanError):
        return text
    _log.exception("a picture of the data set failed")
    return f"error: {type(error).__name__}: {text}"


def picture_files(tank: Any, scene: Scene, drawn: Mapping[str, float]) -> dict[str, bytes]:
    """The files of MEMBERS, by their names, of one picture.

    Parameters
    ----------
    tank : Tank, of the scene or of one that differs in what ``Tank.take`` takes
    scene : Scene, of the picture
    drawn : mapping, its numbers; that of POSITION says where the head stands
    """
    from sim.devices import metered
    from sim.render.surfaces import surfaces_seen
    from sim.sensor import Webcam

    at = at_moment(scene, 0, drawn[POSITION])
    webcam = Webcam(at.scene)
    layers, exposure_ms = metered(at.scene, tank, webcam, at.position_mm)
    image = webcam.expose(layers, exposure_ms, np.random.default_rng([scene.tank.sensor.seed, 1]))
    laser = at.scene.tank.laser
    lines = range(len(laser.sheets) if laser.on else 0)
    truths = [stripe_truth(at.scene, at.position_mm, line) for line in lines]
    labels = label_scene(at.scene, at.position_mm, layers, truths, exposure_ms)
    step = one_step_w_m2_sr(at.scene)
    unit = step if np.isfinite(step) else 1.0
    arrays: dict[str, np.ndarray] = {}
    for name, layer in vars(layers.binned(labels.shape)).items():
        arrays[f"layer_{name}"] = np.minimum(layer / unit, MOST_HALF).astype(np.float16)
    surfaces = surfaces_seen(tank, at.position_mm)
    arrays["depth_mm"] = surfaces.depth_mm.astype(np.float32)
    arrays["normals"] = surfaces.normals.astype(np.float16)
    columns = [line_columns(at.scene, truth, exposure_ms) for truth in truths]
    for name in vars(columns[0]) if columns else ():
        arrays[name] = np.stack([getattr(one, name) for one in columns])
    content = {
        "scene": at.scene.rig.name,
        "drawn": dict(drawn),
        "exposure_ms": exposure_ms,
        "axis": at.scene.rig.stripe.axis,
        "layer_unit_w_m2_sr": unit,
        "camera": at.scene.rig.camera.model_dump(mode="json"),
        "tank": at.scene.tank.model_dump(mode="json"),
        "rle": {label.name: run_lengths(labels == label) for label in Label},
    }
    found = (
        encoded(image, ".png", PNG_NOISY),
        encoded(labels, ".png", PNG_FAST),
        _zipped(arrays),
        json_text(content, compact=True).encode(),
    )
    return dict(zip(MEMBERS, found, strict=True))


def _zipped(arrays: Mapping[str, np.ndarray]) -> bytes:
    """As ``np.savez_compressed`` writes them, but quickly, and the same at any time of day."""
    stream = BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=ZIP_FAST) as file:
        for name, array in arrays.items():
            data = BytesIO()
            np.lib.format.write_array(data, np.ascontiguousarray(array), allow_pickle=False)
            info = zipfile.ZipInfo(f"{name}.npy")
            info.compress_type = zipfile.ZIP_DEFLATED
            file.writestr(info, data.getvalue(), compresslevel=ZIP_FAST)
    return stream.getvalue()


def _flat(pictures: Mapping[str, Mapping[str, bytes]]) -> Iterator[tuple[str, bytes]]:
    for key, files in pictures.items():
        for name, data in files.items():
            yield f"{key}.{name}", data


def _write_tar(path: Path, pictures: Mapping[str, Mapping[str, bytes]]) -> None:
    stream = BytesIO()
    with tarfile.open(fileobj=stream, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for name, data in _flat(pictures):
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))
    write_atomically(path, stream.getvalue())


def _write_hdf5(path: Path, pictures: Mapping[str, Mapping[str, bytes]]) -> None:
    stream = BytesIO()
    with h5py.File(stream, "w") as file:
        for key, files in pictures.items():
            group = file.create_group(key)
            for name, data in files.items():
                group.create_dataset(name, data=np.frombuffer(data, np.uint8), track_times=False)
    write_atomically(path, stream.getvalue())


def _write_folder(path: Path, pictures: Mapping[str, Mapping[str, bytes]]) -> None:
    temporary = path.parent / temporary_name(path.name)
    with disk_errors(path):
        try:
            temporary.mkdir()
            for name, data in _flat(pictures):
                (temporary / name).write_bytes(data)
            for file in temporary.iterdir():
                descriptor = os.open(file, os.O_RDONLY)
                os.fsync(descriptor)
                os.close(descriptor)
            shutil.rmtree(path, ignore_errors=True)  # where a killed writer left it
            temporary.rename(path)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        sync_folder(path.parent)


WRITERS = {"webdataset": _write_tar, "hdf5": _write_hdf5, "folders": _write_folder}
