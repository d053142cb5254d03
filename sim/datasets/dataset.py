"""A data set of labelled pictures: shards on workers, then the manifest and the data card."""

import hashlib
import json
import logging
import os
import shutil
import tarfile
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, replace
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import cv2
import h5py
import numpy as np

from lscan.errors import InputError, LscanError
from lscan.files.cache import long_work
from lscan.files.datasets import (
    MANIFEST,
    MEMBERS,
    MOST_PICTURES,
    VERSION,
    run_lengths,
    shard_sha256,
)
from lscan.files.disk import (
    disk_errors,
    json_text,
    list_names,
    make_folder,
    read_json,
    remove_temporaries,
    sync_folder,
    temporary_name,
    write_atomically,
    write_json,
)
from lscan.files.pictures import encode_picture
from lscan.records import Progress
from lscan.version import __version__
from sim.datasets.datasetspec import POSITION, DatasetSpec
from sim.datasets.labels import CORE, Label, label_scene, line_columns, lit_truths, one_step_w_m2_sr
from sim.scene import Scene, at_moment
from sim.studies.executor import in_order, keep_identity, locked_folder, open_workers

# The pictures of one tank with their labels, as the files of one shard.

Format = Literal["webdataset", "hdf5", "folders"]
ENDINGS: Mapping[Format, str] = {"webdataset": ".tar", "hdf5": ".h5", "folders": ""}
PNG_FAST = (cv2.IMWRITE_PNG_COMPRESSION, 1)
# Noise hardly repeats: without looking for what does, pictures are smaller, and read faster.
PNG_NOISY = (*PNG_FAST, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY)
ZIP_FAST = 1
PICTURE, FAILED = ".tar", ".failed"  # ends of names of what is kept until a shard is whole
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

    @property
    def keys(self) -> list[str]:
        """Of its pictures."""
        return [f"{number:09d}" for number in range(self.first, self.first + self.count)]


@dataclass(frozen=True)
class ShardRecord:
    """What became of a shard.  keys: of its pictures.  failed: by key, why there is none."""

    file: str
    sha256: str
    keys: tuple[str, ...]
    failed: Mapping[str, str]


def make_shard(task: ShardTask) -> ShardRecord:
    """Render a shard and write it, whole or not at all, then its record beside it.

    Each picture is kept in a folder beside the shard as soon as it is made: whatever ends this
    loses the picture under way, and memory holds one at a time.

    Parameters
    ----------
    task : ShardTask

    Raises
    ------
    InputError
        The disk refuses.
    """
    make_folder(_parts(task))
    there = list_names(_parts(task))
    for key, found in rendered_files(task, {Path(name).stem for name in there}):
        failed = isinstance(found, str)
        data = found.encode() if isinstance(found, str) else _tar(key, found)
        write_atomically(_parts(task) / f"{key}{FAILED if failed else PICTURE}", data)
    return packed_shard(task)


def packed_shard(task: ShardTask, missing: str = "was not made") -> ShardRecord:
    """Write a shard of the pictures that have been kept, if any, then its record beside it.

    Parameters
    ----------
    task : ShardTask
    missing : str, why there are no others

    Raises
    ------
    InputError
        The disk refuses.
    """
    parts, path = _parts(task), task.folder / task.file
    make_folder(parts)
    there = list_names(parts)
    keys = tuple(key for key in task.keys if f"{key}{PICTURE}" in there)
    failed = {key: missing for key in task.keys if key not in keys}
    for key in failed:
        if f"{key}{FAILED}" in there:
            failed[key] = (parts / f"{key}{FAILED}").read_text(encoding="utf-8")
    sha256 = ""
    if keys:  # other readers take an archive without a picture for a harmed one
        with _replacing(path) as file:
            WRITERS[task.form](file, _files(parts, keys))
        sha256 = shard_sha256(path)
    record = ShardRecord(task.file, sha256, keys, failed)
    write_json(record_file(task), asdict(record))
    forget_parts(task)
    return record


def forget_parts(task: ShardTask) -> None:
    """Remove the pictures that were kept until their shard was whole.

    Parameters
    ----------
    task : ShardTask
    """
    shutil.rmtree(_parts(task), ignore_errors=True)


def _parts(task: ShardTask) -> Path:
    """The folder of the pictures of a shard that is not whole yet."""
    return task.folder / f"shard-{task.number:06d}.partial"


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
        whole = not record.keys or shard_sha256(task.folder / task.file) == record.sha256
    except (InputError, ValueError, KeyError, TypeError):
        return None
    same = {*record.keys, *record.failed} == set(task.keys)
    return record if whole and same else None


def rendered_files(
    task: ShardTask, but: Set[str] = frozenset()
) -> Iterator[tuple[str, dict[str, bytes] | str]]:
    """Each picture's key, and its files, or in one line why there are none.

    Parameters
    ----------
    task : ShardTask
    but : set of str, keys of pictures that are left out
    """
    from sim.render.tank import Tank

    if not (keys := [key for key in task.keys if key not in but]):
        return
    try:
        base, drawn = task.spec.tank(task.number)
        tank = Tank(base)
    except Exception as error:  # whatever it is, the other shards are still wanted
        yield from ((key, _reason(error)) for key in keys)
        return
    for key in keys:
        try:
            scene, own = task.spec.picture(base, int(key))
            found = picture_files(tank, scene, drawn | own)
        except Exception as error:  # a failed scene is a row of the manifest
            yield key, _reason(error)
        else:
            yield key, found


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
    from sim.devices import take_picture
    from sim.render.tank import surfaces_seen

    at = at_moment(scene, 0, drawn[POSITION])
    image, layers, exposure_ms = take_picture(at.scene, tank, at.position_mm)
    truths = lit_truths(at.scene, at.position_mm)
    labels = label_scene(at.scene, at.position_mm, layers, truths, exposure_ms)
    step = one_step_w_m2_sr(at.scene)
    unit = step if np.isfinite(step) else 1.0
    arrays: dict[str, np.ndarray] = {}
    for name, layer in vars(layers.binned(labels.shape)).items():
        arrays[f"layer_{name}"] = np.minimum(layer / unit, MOST_HALF).astype(np.float16)
    surfaces = surfaces_seen(tank, at.position_mm)
    for name, part in zip(("x_mm", "y_mm", "depth_mm"), surfaces.points_mm.T, strict=True):
        arrays[name] = part.T.astype(np.float32)
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
        encode_picture(image, ".png", PNG_NOISY),
        encode_picture(labels, ".png", PNG_FAST),
        _npz_bytes(arrays),
        json_text(content, compact=True).encode(),
    )
    return dict(zip(MEMBERS, found, strict=True))


def _npz_bytes(arrays: Mapping[str, np.ndarray]) -> bytes:
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


def _tar(key: str, files: Mapping[str, bytes]) -> bytes:
    """The files of one picture as an archive, their names behind its key."""
    stream = BytesIO()
    _write_tar(stream, ((f"{key}.{name}", data) for name, data in files.items()))
    return stream.getvalue()


def _files(parts: Path, keys: Iterable[str]) -> Iterator[tuple[str, bytes]]:
    """Name and content of each file of pictures that have been kept, one picture at a time."""
    for key in keys:
        with tarfile.open(parts / f"{key}{PICTURE}") as tar:
            for member in tar:
                content = tar.extractfile(member)
                assert content is not None  # all are files
                yield member.name, content.read()


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """Where to write a file or a folder that takes a path's place, whole and synced."""
    temporary = path.parent / temporary_name(path.name)
    with disk_errors(path):
        try:
            _remove(temporary)  # what a killed writer left
            yield temporary
            for file in temporary.iterdir() if temporary.is_dir() else [temporary]:
                descriptor = os.open(file, os.O_RDONLY)
                os.fsync(descriptor)
                os.close(descriptor)
            if path.is_dir() or temporary.is_dir():
                _remove(path)
            temporary.rename(path)
            sync_folder(path.parent)
        except BaseException:
            _remove(temporary)
            raise


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _write_tar(to: Path | BytesIO, files: Iterable[tuple[str, bytes]]) -> None:
    where: Any = {"fileobj": to} if isinstance(to, BytesIO) else {"name": to}
    with tarfile.open(**where, mode="w", format=tarfile.USTAR_FORMAT) as tar:
        for name, data in files:
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, BytesIO(data))


def _write_hdf5(to: Path, files: Iterable[tuple[str, bytes]]) -> None:
    # HDF5's own files lay out their metadata otherwise than its files of Python do.
    with to.open("w+b") as stream, h5py.File(stream, "w") as file:
        for name, data in files:
            key, _, member = name.partition(".")
            content = np.frombuffer(data, np.uint8)
            file.require_group(key).create_dataset(member, data=content, track_times=False)


def _write_folder(to: Path, files: Iterable[tuple[str, bytes]]) -> None:
    to.mkdir()
    for name, data in files:
        (to / name).write_bytes(data)


WRITERS = {"webdataset": _write_tar, "hdf5": _write_hdf5, "folders": _write_folder}


# A data set of labelled pictures: shards on workers, then the manifest and the data card.


IDENTITY = "identity.json"
TRIED = 3  # pictures that the estimate is made from; the first may compile

LIMITS = """\
- Pictures of one shard share a tank: its geometry and water are the same, they are not independent.
- Light of higher orders is the tank's own: where camera, sheet or wavelength change from picture to
  picture, its tables stay those of the shard's scene.
- Depth and normals are of the middle of each pixel; of an edge across it one side is lost.
- Layers have 11 significant bits, in units of `layer_unit_w_m2_sr`.
- The brightness of a line leaves out what the water and other surfaces throw onto it.
- Everything is simulated: how far the tank is to be believed, its project's `make validate` says.
"""


def make_dataset(
    spec: DatasetSpec,
    folder: Path,
    count: int,
    *,
    form: Format = "webdataset",
    workers: int | Literal["none"] = 2,
    scheduler: str | None = None,
    resume: bool = False,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Render a data set; the same bytes whatever the workers, and however often it was ended.

    Parameters
    ----------
    spec : DatasetSpec
    folder : Path, to write to; workers of another machine must see it under the same path
    count : int, of pictures
    form : Format, of the shards
    workers : int, processes of this machine; "none": all in this process
    scheduler : str or None, address of the scheduler of another cluster
    resume : bool, go on with what the folder holds
    progress : Progress or None, called with (done, all) pictures
    say : callable or None, called with how long it will take

    Returns
    -------
    The manifest.

    Raises
    ------
    InputError
        The folder holds something else, the disk refuses, or no scheduler answers.
    """
    if count > MOST_PICTURES:
        raise InputError("too many pictures", value=count, allowed=f"{MOST_PICTURES} at most")
    folder = folder.resolve()
    with locked_folder(folder, "data set"):
        remove_temporaries(folder)
        content = {"lscan": __version__, "count": count, "format": form, **spec.document}
        sha256 = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
        # By name for who asks which it was; what they hold is in the scenes' own hashes.
        files = {Path(file).name: its_sha256 for file, its_sha256 in spec.files.items()}
        identity = {"files_sha256": files, **content, "sha256": sha256}
        _keep_identity(folder, identity, resume)
        tasks = _tasks(spec, folder, count, form)
        records = _kept_records(tasks)
        missing = [task for task in tasks if task.number not in records]
        done = sum(task.count for task in tasks if task.number in records)
        if missing and say is not None:
            say(_estimate(missing, 1 if workers == "none" else workers, scheduler))
        with (
            open_workers(workers if missing else "none", scheduler) as able,
            closing(
                in_order(able, make_shard, missing, str, files=spec.files, folder=folder)
            ) as made,
        ):
            for task, found in zip(missing, made, strict=True):
                # Where its workers died time and again, it has what they had made by then.
                record = packed_shard(task, found) if isinstance(found, str) else found
                records[task.number] = record
                done += task.count
                if progress is not None:
                    progress(done, count)
        manifest = _manifest(identity, [records[task.number] for task in tasks])
        write_atomically(folder / "README.md", data_card(manifest, spec).encode())
        write_json(folder / MANIFEST, manifest)
        return manifest


def _kept_records(tasks: Sequence[ShardTask]) -> dict[int, ShardRecord]:
    """The records of the shards that are there, by number, each shard held against its hash."""
    records: dict[int, ShardRecord] = {}
    with long_work("shards checked") as progress:
        for done, task in enumerate(tasks, start=1):
            if record := kept_record(task):
                records[task.number] = record
                forget_parts(task)
            progress(done, len(tasks))
    return records


def _tasks(spec: DatasetSpec, folder: Path, count: int, form: Format) -> list[ShardTask]:
    size = spec.file.tank_pictures
    return [
        ShardTask(spec, folder, form, number, first, min(size, count - first))
        for number, first in enumerate(range(0, count, size))
    ]


def _estimate(tasks: Sequence[ShardTask], workers: int, scheduler: str | None) -> str:
    """How long the shards will take, from the first few pictures."""
    tried = replace(tasks[0], count=min(TRIED, tasks[0].count))
    times = [time.perf_counter(), *(time.perf_counter() for _ in rendered_files(tried))]
    picture_s = min(after - before for before, after in pairwise(times))
    tank_s = max(times[1] - times[0] - picture_s, 0.0)
    count = sum(task.count for task in tasks)
    minutes = (count * picture_s + len(tasks) * tank_s) / workers / 60
    where = "one worker's time" if scheduler else f"{workers} at once"
    return f"{count} pictures in {len(tasks)} shards: about {minutes:.2g} minutes, {where}"


def _keep_identity(folder: Path, identity: dict[str, Any], resume: bool) -> None:
    """Refuse a folder that holds something else; else write what it is to hold."""
    names = list_names(folder)
    begun = not names <= {IDENTITY}  # it is there alone where none of its shards was begun
    if begun and IDENTITY not in names:
        raise InputError("is not empty", where=folder, allowed="a new folder")
    if begun and not resume:
        raise InputError("holds a data set", where=folder, allowed="--resume, or a new folder")
    allowed = "the same spec, scenes, count, format and version of lscan; or a new folder"
    keep_identity(folder / IDENTITY, identity, "another data set", allowed, begun=begun)


def _manifest(identity: dict[str, Any], records: Sequence[ShardRecord]) -> dict[str, Any]:
    return {
        "version": VERSION,
        **identity,
        "classes": {label.name: int(label) for label in Label},
        "pictures": sum(len(one.keys) for one in records),
        "failed": {key: why for one in records for key, why in one.failed.items()},
        "shards": [
            {name: value for name, value in asdict(one).items() if name != "failed"}
            for one in records
            if one.keys
        ],
    }


def data_card(manifest: dict[str, Any], spec: DatasetSpec) -> str:
    """The data card, in Markdown: what the data set is, from what, how much, and its limits.

    Parameters
    ----------
    manifest : mapping, as ``make_dataset`` returns it
    spec : DatasetSpec
    """
    file = spec.file
    rows = "\n".join(
        f"| {name} | `{one.key}` | {one.in_words}"
        f"{', added' if one.off else ' of it, added' if one.relative else ''} | "
        f"{'picture' if one.each_picture else 'tank'} |"
        for name, one in file.drawn.items()
    )
    classes = ", ".join(f"{value} {name}" for name, value in manifest["classes"].items())
    data_files = {"webdataset": "shard-*.tar", "hdf5": "shard-*.h5", "folders": "shard-*/*"}
    return f"""---
configs:
- config_name: default
  data_files: "{data_files[manifest["format"]]}"
---

# {file.name}

Rendered pictures of a laser line scanner under water, with their truth; by lscan {__version__}.

- Pictures: {manifest["pictures"]} of {manifest["count"]}, {len(manifest["failed"])} failed
- Shards: {len(manifest["shards"])} of {file.tank_pictures} at most, each of one tank; \
{manifest["format"]}
- Scenes: {", ".join(file.scenes)}; seed {file.seed}; spec and scenes SHA-256 {manifest["sha256"]}
- Licence: {file.licence}

| drawn | key | distribution | new in each |
|---|---|---|---|
{rows}

Of each picture, behind its number of nine digits:

- `picture.png`: (H, W, 3), as the webcam took it
- `labels.png`: (H, W), class of each pixel: {classes}
- `truth.npz`: `x_mm`, `y_mm`, `depth_mm` (H, W), the point that a pixel sees, from the pinhole in
  the camera frame (x right, y down, depth along the axis), and `normals` (H, W, 3) there; NaN where
  no surface is seen.  Behind a port a point does not lie on the straight line through its pixel:
  take x_mm and y_mm, do not project depth_mm back by the lens.  `layer_direct`, `layer_scattered`,
  `layer_ambient` (H, W), radiance in `layer_unit_w_m2_sr` of scene.json; of L lines in N columns
  `centre_px`, `width_px` (px), `height_dn` (DN), NaN where `status` (codes of lscan.Status) is not
  OK (0), each (L, N)
- a pixel is LINE within {CORE:g} `width_px` and half a pixel of `centre_px`, where laser light from
  the target prevails; where a column has several lit points, all of them
- `scene.json`: numbers drawn, all of the scene, exposure, `rle`: COCO's run lengths by class

Limits:

{LIMITS}"""
