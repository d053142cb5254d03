"""Data sets that ``lscan-sim dataset`` wrote, read picture by picture; the tank is not needed."""

import hashlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import h5py
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lscan.errors import InputError
from lscan.files.containers import Place, hdf5_array, npz_arrays, open_hdf5, tar_places
from lscan.files.disk import (
    MOST_TEXT_BYTES,
    list_names,
    open_regular,
    read_bytes,
    reading_errors,
    require_within,
)
from lscan.files.headers import read_header
from lscan.files.jsontext import parse_json, read_json
from lscan.files.pictures import MOST_BYTES, MOST_PX, read_png
from lscan.records import Bytes

MANIFEST = "manifest.json"
VERSION = 1
MEMBERS = ("picture.png", "labels.png", "truth.npz", "scene.json")
"""What each picture of a data set is made of, in the order in which it is written."""
MOST_PICTURES = 2**21
"""Of a data set."""
MOST_MANIFEST_BYTES = 32 * MOST_PICTURES
MOST_PX_BYTES = 64
"""Of labels, truth and scene of a picture, for each of its pixels; lscan writes a third of them."""
MOST_SHARD_BYTES = 2**44
"""As large as file systems let files be: of a shard only members are read."""
KNOWN_SHARDS = 512


class ShardEntry(BaseModel):
    """What a manifest says of a shard.  keys: of its pictures."""

    model_config = ConfigDict(strict=True)
    file: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$")]
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    keys: list[Annotated[str, Field(pattern="^[0-9]{9}$")]]


class DatasetContent(BaseModel):
    """What reading a data set takes from its manifest, and what its users count on."""

    model_config = ConfigDict(strict=True)
    version: Annotated[int, Field(ge=VERSION, le=VERSION)]
    shards: list[ShardEntry]
    classes: dict[str, int] = {}
    failed: dict[str, str] = {}


@dataclass(frozen=True)
class DatasetPicture:
    """One picture of a data set; each part of it is decoded when it is asked for.

    Attributes
    ----------
    key : str, number of the picture, nine digits
    members : mapping, bytes of the files of MEMBERS, by their names
    """

    key: str
    members: Mapping[str, bytes]

    @property
    def picture(self) -> Bytes:
        """(H, W, 3) RGB, as the webcam took it."""
        image = self._decoded("picture.png")
        return image if image.ndim == 3 else np.repeat(image[..., np.newaxis], 3, axis=2)

    @property
    def labels(self) -> Bytes:
        """(H, W) classes, numbered as the manifest's ``classes`` say."""
        return self._decoded("labels.png")

    @cached_property
    def truth(self) -> dict[str, np.ndarray]:
        """Arrays by name: depth, normals, layers, and the line's columns; see the data card."""
        data = self._member("truth.npz")
        return npz_arrays(data, _most_bytes(self._member("picture.png")), self._where("truth.npz"))

    @cached_property
    def scene(self) -> dict[str, Any]:
        """Scene, numbers drawn for it, exposure, units, and the classes' run lengths (``rle``)."""
        found = parse_json(self._member("scene.json"), self._where("scene.json"))
        if not isinstance(found, dict):
            raise InputError("is no scene", where=self._where("scene.json"))
        return found

    def _decoded(self, name: str) -> Bytes:
        return read_png(self._member(name), self._where(name))

    def _member(self, name: str) -> bytes:
        if name not in self.members:
            raise InputError("is missing", where=self._where(name))
        return self.members[name]

    def _where(self, name: str) -> str:
        return f"picture {self.key}: {name}"


class PictureDataset:
    """A data set in a folder: a sequence of ``DatasetPicture``.

    Pictures whose scene failed are left out; the manifest's ``failed`` lists them.

    Attributes
    ----------
    folder : Path
    manifest : mapping, what the data set holds

    Examples
    --------
    >>> from pathlib import Path
    >>> Path("dataset").mkdir()
    >>> text = '{"version": 1, "shards": []}'
    >>> _ = (Path("dataset") / "manifest.json").write_text(text, encoding="utf-8")
    >>> len(PictureDataset("dataset"))
    0
    """

    def __init__(self, folder: Path | str) -> None:
        """Read the manifest.

        Parameters
        ----------
        folder : Path or str

        Raises
        ------
        InputError
            There is no manifest of a data set of this version.
        """
        self.folder = Path(folder)
        where = self.folder / MANIFEST
        self.manifest: dict[str, Any] = read_json(where, MOST_MANIFEST_BYTES, within=self.folder)
        try:
            self._shards = DatasetContent.model_validate(self.manifest).shards
        except ValidationError as error:
            first = error.errors()[0]
            key, value = ".".join(map(str, first["loc"])) or "document", first["input"]
            what = f"is no manifest of a data set: {key}: {first['msg']}"
            raise InputError(
                f"is of another {key}" if key == "version" else what,
                where=where,
                value=value if isinstance(value, str | int) else None,
            ) from error
        self._places = [(shard.file, key) for shard in self._shards for key in shard.keys]

    def __len__(self) -> int:
        """How many pictures there are."""
        return len(self._places)

    def __getitem__(self, number: int) -> DatasetPicture:
        """The picture of that number, from 0; IndexError beyond the last."""
        file, key = self._places[number]
        path = self.folder / file
        require_within(path, self.folder)
        return DatasetPicture(key, _read_members(path, key))

    def verify(self) -> None:
        """Hold every shard against its hash; InputError names the first that differs."""
        for shard in self._shards:
            path = self.folder / shard.file
            require_within(path, self.folder)
            if shard_sha256(path) != shard.sha256:
                raise InputError("was changed: its hash differs", where=path)


def shard_sha256(path: Path) -> str:
    """SHA-256 of a shard in hexadecimal: of the file, or of a folder's names and files in order.

    Parameters
    ----------
    path : Path
    """
    digest, whole = hashlib.sha256(), path.is_dir()
    for name in sorted(list_names(path)) if whole else [""]:
        file = path / name
        with open_regular(file, MOST_SHARD_BYTES, path) as stream, reading_errors(file):
            if whole:
                digest.update(f"{name}\0{os.fstat(stream.fileno()).st_size}\0".encode())
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def _read_members(path: Path, key: str) -> dict[str, bytes]:
    """The files of one picture, from a shard of any format."""
    if path.suffix == ".tar":
        # A file of its own: processes and threads read side by side.
        with open_regular(path, MOST_SHARD_BYTES) as stream, reading_errors(path):
            state = os.fstat(stream.fileno())
            places = _places(path, state.st_mtime_ns, state.st_size)
            return _each_member(partial(_in_tar, stream, places, path, key))
    if path.suffix == ".h5":
        with open_hdf5(path, MOST_SHARD_BYTES) as file:
            return _each_member(partial(_in_hdf5, file, path, key))
    return _each_member(lambda name, most: read_bytes(path / f"{key}.{name}", most, within=path))


def _each_member(read: Callable[[str, int], bytes]) -> dict[str, bytes]:
    """The files by name, the picture first: its size says how large the others may be."""
    members: dict[str, bytes] = {}
    for name in MEMBERS:
        picture = members.get(MEMBERS[0])
        members[name] = read(name, MOST_BYTES if picture is None else _most_bytes(picture))
    return members


def _most_bytes(picture: bytes) -> int:
    """Of each file that belongs to a picture, and of what it unpacks to."""
    header = read_header(picture)
    pixels = header.width_px * header.height_px if header is not None else 0
    return MOST_TEXT_BYTES + MOST_PX_BYTES * min(pixels, MOST_PX)


def _in_tar(
    stream: BinaryIO, places: Mapping[str, Place], path: Path, key: str, name: str, most: int
) -> bytes:
    begin, size = places.get(f"{key}.{name}", (0, most + 1))
    if size > most:
        what, allowed = f"lacks the picture's {name}, or it is too large", f"{most} bytes at most"
        raise InputError(what, where=path, value=key, allowed=allowed)
    stream.seek(begin)
    return stream.read(size)


def _in_hdf5(file: h5py.File, path: Path, key: str, name: str, most: int) -> bytes:
    array = hdf5_array(file, f"{key}/{name}", most, path)
    if array.dtype != np.uint8 or array.ndim != 1:
        raise InputError(f"{key}/{name}: is no row of bytes", where=path)
    return bytes(array[()])


@lru_cache(maxsize=KNOWN_SHARDS)
def _places(path: Path, _mtime_ns: int, _size: int) -> dict[str, Place]:
    """Where the members of a tar file, as it is at that time, begin and how long they are."""
    return tar_places(path, MOST_BYTES)
