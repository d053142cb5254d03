"""Data sets that ``lscan-sim dataset`` wrote, read picture by picture; the tank is not needed."""

import hashlib
import json
import tarfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np

from lscan.errors import InputError
from lscan.files.disk import disk_errors, read_bytes, read_text, require_within
from lscan.files.pictures import decode
from lscan.records import Bytes

MANIFEST = "manifest.json"
VERSION = 1
MEMBERS = ("picture.png", "labels.png", "truth.npz", "scene.json")
"""What each picture of a data set is made of, in the order in which it is written."""
MOST_BYTES = 1 << 28
KNOWN_SHARDS = 16


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
        image = self._decoded("picture.png", cv2.IMREAD_COLOR)
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)

    @property
    def labels(self) -> Bytes:
        """(H, W) classes, numbered as the manifest's ``classes`` say."""
        return self._decoded("labels.png", cv2.IMREAD_UNCHANGED)

    @cached_property
    def truth(self) -> dict[str, np.ndarray]:
        """Arrays by name: depth, normals, layers, and the line's columns; see the data card."""
        try:
            with np.load(BytesIO(self.members["truth.npz"]), allow_pickle=False) as arrays:
                return dict(arrays)
        except (ValueError, KeyError, OSError, EOFError, zipfile.BadZipFile) as error:
            raise InputError("truth.npz cannot be read", where=self.key) from error

    @cached_property
    def scene(self) -> dict[str, Any]:
        """Scene, numbers drawn for it, exposure, units, and the classes' run lengths (``rle``)."""
        try:
            found: dict[str, Any] = json.loads(self.members["scene.json"])
        except ValueError as error:
            raise InputError("scene.json cannot be read", where=self.key) from error
        return found

    def _decoded(self, name: str, flags: int) -> Bytes:
        image = decode(self.members[name], flags)
        if image is None:
            raise InputError(f"{name} cannot be read", where=self.key)
        return image


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
        try:
            self.manifest = json.loads(read_text(where, MOST_BYTES))
            if self.manifest["version"] != VERSION:
                version = self.manifest["version"]
                raise InputError("of another version", where=where, value=version, allowed=VERSION)
            self._places = [
                (shard["file"], key) for shard in self.manifest["shards"] for key in shard["keys"]
            ]
        except (ValueError, KeyError, TypeError) as error:
            raise InputError("is no manifest of a data set", where=where) from error

    def __len__(self) -> int:
        """How many pictures there are."""
        return len(self._places)

    def __getitem__(self, number: int) -> DatasetPicture:
        """The picture of that number, from 0; IndexError beyond the last."""
        file, key = self._places[number]
        path = self.folder / file
        require_within(path, self.folder)
        with disk_errors(path):
            members = _members(path, key)
        return DatasetPicture(key, members)

    def verify(self) -> None:
        """Hold every shard against its hash; InputError names the first that differs."""
        for shard in self.manifest["shards"]:
            path = self.folder / shard["file"]
            require_within(path, self.folder)
            if shard_sha256(path) != shard["sha256"]:
                raise InputError("was changed: its hash differs", where=path)


def shard_sha256(path: Path) -> str:
    """SHA-256 of a shard in hexadecimal: of the file, or of a folder's names and files in order.

    Parameters
    ----------
    path : Path
    """
    digest = hashlib.sha256()
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if path.is_dir():
            digest.update(f"{file.name}\0{file.stat().st_size}\0".encode())
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def _members(path: Path, key: str) -> dict[str, bytes]:
    """The files of one picture, from a shard of any format."""
    names = [f"{key}.{name}" for name in MEMBERS]
    try:
        if path.suffix == ".tar":
            state = path.stat()
            places, found = _places(path, state.st_mtime_ns, state.st_size), {}
            with path.open("rb") as stream:  # of its own: processes and threads read side by side
                for name in names:
                    begin, size = places[name]
                    stream.seek(begin)
                    found[name] = stream.read(size)
        elif path.suffix == ".h5":
            with h5py.File(path, "r") as file:
                found = {name: bytes(file[key][name[len(key) + 1 :]][()]) for name in names}
        else:
            found = {name: read_bytes(path / name, MOST_BYTES) for name in names}
    except (KeyError, tarfile.TarError) as error:
        raise InputError("lacks a picture, or is damaged", where=path, value=key) from error
    return {name[len(key) + 1 :]: data for name, data in found.items()}


@lru_cache(maxsize=KNOWN_SHARDS)
def _places(path: Path, _mtime_ns: int, _size: int) -> dict[str, tuple[int, int]]:
    """Where the members of a tar file, as it is at that time, begin and how long they are."""
    with tarfile.open(path, mode="r:") as tar:
        return {member.name: (member.offset_data, member.size) for member in tar}
