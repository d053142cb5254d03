"""Data sets that ``lscan-sim dataset`` wrote, read picture by picture; the tank is not needed."""

import hashlib
import os
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from math import prod
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal

import h5py
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lscan.errors import InputError
from lscan.files.containers import Place, hdf5_array, npz_arrays, open_hdf5, tar_places
from lscan.files.disk import (
    MOST_TEXT_BYTES,
    list_names,
    open_regular,
    parse_json,
    read_bytes,
    read_json,
    reading_errors,
    require_within,
)
from lscan.files.pictures import MOST_BYTES, MOST_PX, eight_bit, read_header, read_png
from lscan.records import Bytes, Mask, Picture, Status

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
MOST_MEMBER_BYTES = MOST_TEXT_BYTES + MOST_PX_BYTES * MOST_PX
KNOWN_SHARDS = 512
DIMENSIONS = dict.fromkeys(("status", "centre_px", "width_px", "height_dn"), "LN")
DIMENSIONS |= dict.fromkeys(("x_mm", "y_mm", "depth_mm"), "HW") | {"normals": "HW3"}
DIMENSIONS |= dict.fromkeys(("layer_direct", "layer_scattered", "layer_ambient"), "HW")
"""Of the truth's arrays: L lines in N columns, or rows; height and width of the picture."""
Key = Annotated[str, Field(pattern="^[0-9]{9}$")]


class ShardEntry(BaseModel):
    """What a manifest says of a shard.  keys: of its pictures."""

    model_config = ConfigDict(strict=True)
    file: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$")]
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    keys: list[Key]


class DatasetContent(BaseModel):
    """What reading a data set takes from its manifest, and what its users count on."""

    model_config = ConfigDict(strict=True)
    version: Annotated[int, Field(ge=VERSION, le=VERSION)]
    shards: list[ShardEntry]
    classes: dict[str, Annotated[int, Field(ge=0, le=255)]] = {}
    failed: dict[Key, str] = {}
    pictures: int | None = None
    count: int | None = None
    format: Literal["webdataset", "hdf5", "folders"] | None = None


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
    def size_px(self) -> tuple[int, int]:
        """Width and height of the picture, as its file states them."""
        if (header := read_header(self._member("picture.png"))) is None:
            where = self._where("picture.png")
            raise InputError("is not an 8- or 16-bit grey or RGB picture", where=where)
        return header.width_px, header.height_px

    @property
    def picture(self) -> Picture:
        """(H, W, 3) RGB, as the webcam took it, uint8, or uint16 of a camera of more bits."""
        image = read_png(self._member("picture.png"), self._where("picture.png"), depth_bits=None)
        return image if image.ndim == 3 else np.repeat(image[..., np.newaxis], 3, axis=2)

    @property
    def labels(self) -> Bytes:
        """(H, W) classes, numbered as the manifest's ``classes`` say."""
        where, allowed = self._where("labels.png"), f"grey, {self.size_px[::-1]}"
        labels = eight_bit(read_png(self._member("labels.png"), where))
        if labels.shape != self.size_px[::-1]:
            what = "is of another shape"
            raise InputError(what, where=where, value=labels.shape, allowed=allowed)
        return labels

    @cached_property
    def truth(self) -> dict[str, np.ndarray]:
        """Arrays by name: depth, normals, layers, and the line's columns; see the data card."""
        where, size_px = self._where("truth.npz"), self.size_px
        arrays = npz_arrays(self._member("truth.npz"), _most_bytes(size_px), where)
        _check_truth(arrays, size_px, where)
        return arrays

    @cached_property
    def scene(self) -> dict[str, Any]:
        """Scene, numbers drawn for it, exposure, units, and the classes' run lengths (``rle``)."""
        found = parse_json(self._member("scene.json"), self._where("scene.json"))
        if not isinstance(found, dict):
            raise InputError("is no scene", where=self._where("scene.json"))
        return found

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
            content = DatasetContent.model_validate(self.manifest)
        except ValidationError as error:
            first = error.errors()[0]
            key, value = ".".join(map(str, first["loc"])) or "document", first["input"]
            what = f"is no manifest of a data set: {key}: {first['msg']}"
            what = "is of another version" if key == "version" else what
            raise InputError(what, where=where, value=value) from error
        self._shards = content.shards
        self._places = [(shard.file, key) for shard in self._shards for key in shard.keys]
        keys = [*content.failed, *(key for _, key in self._places)]
        if twice := [key for key, times in Counter(keys).items() if times > 1]:
            raise InputError("names a picture twice", where=where, value=twice[0])
        if content.pictures not in (None, len(self)):
            what, allowed = "pictures: is not how many it names", len(self)
            raise InputError(what, where=where, value=content.pictures, allowed=allowed)

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
        """Hold every shard against its hash; InputError names the first that differs.

        Or is larger than its pictures make it: a hole of any size costs nothing but the reading.
        """
        for shard in self._shards:
            path = self.folder / shard.file
            require_within(path, self.folder)
            members = (one for key in shard.keys for one in _read_members(path, key).values())
            most = sum(len(data) + MOST_TEXT_BYTES for data in members)  # tables of tar and HDF5
            if shard_sha256(path, most) != shard.sha256:
                raise InputError("was changed: its hash differs", where=path)


def shard_sha256(path: Path, most: int = MOST_SHARD_BYTES) -> str:
    """SHA-256 of a shard in hexadecimal: of the file, or of a folder's names and files in order.

    Parameters
    ----------
    path : Path
    most : int, its largest size, bytes, known before it is read

    Raises
    ------
    InputError
        It cannot be read, or is larger.
    """
    digest, whole = hashlib.sha256(), path.is_dir()
    for name in sorted(list_names(path)) if whole else [""]:
        file = path / name
        with open_regular(file, most, path) as stream, reading_errors(file):
            size = os.fstat(stream.fileno()).st_size
            most -= size
            if whole:
                digest.update(f"{name}\0{size}\0".encode())
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
            return _each_member(key, partial(_read_in_tar, stream, places, path, key))
    if path.suffix == ".h5":
        with open_hdf5(path, MOST_SHARD_BYTES) as file:
            return _each_member(key, partial(_in_hdf5, file, path, key))
    return _each_member(key, lambda name, most: read_bytes(path / f"{key}.{name}", most, path))


def _each_member(key: str, read: Callable[[str, int], bytes]) -> dict[str, bytes]:
    """The files by name, the picture first: its size says how large the others may be."""
    picture, *others = MEMBERS
    members = {picture: read(picture, MOST_BYTES)}
    most = _most_bytes(DatasetPicture(key, members).size_px)
    return members | {name: read(name, most) for name in others}


def _most_bytes(size_px: tuple[int, int]) -> int:
    """Of each file that belongs to a picture of that size, and of what it unpacks to."""
    return MOST_TEXT_BYTES + MOST_PX_BYTES * min(prod(size_px), MOST_PX)


def _check_truth(arrays: Mapping[str, np.ndarray], size_px: tuple[int, int], where: str) -> None:
    """Refuse arrays of a shape, type or values that the picture's truth cannot have."""
    width, height = size_px
    status = np.atleast_1d(arrays.get("status", np.empty((0, width))))
    columns = height if status.shape[1:] == (height,) else width
    sizes = {"L": len(status), "N": columns, "H": height, "W": width, "3": 3}
    for name in [name for name in DIMENSIONS if name in arrays]:
        found, shape = arrays[name], tuple(sizes[letter] for letter in DIMENSIONS[name])
        kind = np.integer if name == "status" else np.floating
        if found.shape != shape or not np.issubdtype(found.dtype, kind):
            value, allowed = f"{found.dtype} {found.shape}", f"{kind.__name__} {shape}"
            raise InputError(f"{name}: is no such array", where=where, value=value, allowed=allowed)
        if name == "status" and not np.isin(found, list(Status)).all():
            raise InputError("status: is no code of Status", where=where, value=int(found.max()))
        if "L" in DIMENSIONS[name] and not np.isfinite(found[status == Status.OK]).all():
            raise InputError(f"{name}: is not finite where status is OK", where=where)


def _read_in_tar(
    stream: BinaryIO, places: Mapping[str, Place], path: Path, key: str, name: str, most: int
) -> bytes:
    if (place := places.get(f"{key}.{name}")) is None:
        raise InputError(f"lacks the picture's {name}", where=path, value=key)
    begin, size = place
    if size > most:
        what, allowed = f"member {key}.{name} is too large: bytes", f"{most} at most"
        raise InputError(what, where=path, value=size, allowed=allowed)
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
    return tar_places(path, MOST_MEMBER_BYTES)


# Masks as run lengths, as the data set COCO has them.
#
# References ---------- Lin et al., Microsoft COCO: Common Objects in Context, ECCV 2014; its
# uncompressed run lengths.


def run_lengths(mask: Mask) -> dict[str, Any]:
    """The mask as COCO's uncompressed run lengths, of JSON types.

    Parameters
    ----------
    mask : (H, W) array of bool

    Returns
    -------
    mapping
        "size", [H, W]; "counts", pixels column by column: how many are outside, how many of the
        next inside, and so on; the first is 0 where the mask begins inside.

    Examples
    --------
    >>> run_lengths(np.array([[False, True], [True, True]]))
    {'size': [2, 2], 'counts': [1, 3]}
    """
    flat = np.asarray(mask, dtype=bool).ravel(order="F")
    turns = np.flatnonzero(np.diff(flat)) + 1
    begin = [0, 0] if flat[:1].any() else [0]
    counts = np.diff(np.concatenate([begin, turns, [flat.size]]).astype(int))
    return {"size": list(mask.shape), "counts": counts.tolist()}
