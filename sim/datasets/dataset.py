"""A data set of labelled pictures: shards on workers, then the manifest and the data card."""

import hashlib
import json
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

from lscan.errors import InputError
from lscan.files.cache import long_work
from lscan.files.datasets import MANIFEST, MOST_PICTURES, VERSION
from lscan.files.disk import list_names, remove_temporaries, write_atomically
from lscan.files.jsonfiles import write_json
from lscan.records import Progress
from lscan.version import __version__
from sim.datasets.datasetshards import (
    Format,
    ShardRecord,
    ShardTask,
    forget_parts,
    kept_record,
    make_shard,
    packed_shard,
    rendered_files,
)
from sim.datasets.datasetspec import DatasetSpec
from sim.datasets.labels import CORE, Label
from sim.studies.executor import in_order, keep_identity, locked_folder, open_workers

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
        identity = _identity(spec, count, form)
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


def _identity(spec: DatasetSpec, count: int, form: Format) -> dict[str, Any]:
    content = {"lscan": __version__, "count": count, "format": form, **spec.document}
    text = json.dumps(content, sort_keys=True)
    # By name for who asks which it was; what they hold is in the scenes' own hashes.
    files = {Path(file).name: sha256 for file, sha256 in spec.files.items()}
    return {"files_sha256": files, **content, "sha256": hashlib.sha256(text.encode()).hexdigest()}


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
