"""Messages of ROS 2 and the MCAP files that hold them, as Foxglove, Rerun and ROS 2 read them.

A message is a mapping of its fields' names, nested as its definition is.

References
----------
MCAP: Foxglove, MCAP Format Specification, version 0x30, with its well-known profile "ros2".
CDR: OMG, CORBA 3.0.3, 15.3; the four bytes before it: OMG, DDSI-RTPS 2.5, chapter 10.
Definitions: builtin_interfaces, std_msgs, geometry_msgs, sensor_msgs and tf2_msgs of ROS 2, which
have had these fields from Humble to Lyrical.
"""

import os
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lscan.errors import InputError
from lscan.files.disk import new_file
from lscan.version import __version__

if TYPE_CHECKING:
    from mcap.writer import Writer

# Each field of a message: its type, and its name.  T[] is a sequence, T[n] an array.
DEFINITIONS = {
    "builtin_interfaces/Time": "int32 sec, uint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp, string frame_id",
    "geometry_msgs/Point": "float64 x, float64 y, float64 z",
    "geometry_msgs/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/Quaternion": "float64 x, float64 y, float64 z, float64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position, geometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseStamped": "std_msgs/Header header, geometry_msgs/Pose pose",
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation, geometry_msgs/Quaternion rotation"
    ),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header, string child_frame_id, geometry_msgs/Transform transform"
    ),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "sensor_msgs/CompressedImage": "std_msgs/Header header, string format, uint8[] data",
    "sensor_msgs/RegionOfInterest": (
        "uint32 x_offset, uint32 y_offset, uint32 height, uint32 width, bool do_rectify"
    ),
    "sensor_msgs/CameraInfo": (
        "std_msgs/Header header, uint32 height, uint32 width, string distortion_model, "
        "float64[] d, float64[9] k, float64[9] r, float64[12] p, uint32 binning_x, "
        "uint32 binning_y, sensor_msgs/RegionOfInterest roi"
    ),
    "sensor_msgs/PointField": "string name, uint32 offset, uint8 datatype, uint32 count",
    "sensor_msgs/PointCloud2": (
        "std_msgs/Header header, uint32 height, uint32 width, sensor_msgs/PointField[] fields, "
        "bool is_bigendian, uint32 point_step, uint32 row_step, uint8[] data, bool is_dense"
    ),
}
POINT_FIELD = {"u1": 2, "<f4": 7}
"""PointField.datatype of NumPy's types."""
LAST_S = 2**31 - 1
"""Seconds of the last stamp that a Time holds."""
_FORMATS = {"bool": "?", "uint8": "B", "int32": "i", "uint32": "I", "float64": "d"}
_LITTLE_ENDIAN_CDR = b"\x00\x01\x00\x00"
_RULE = "=" * 80


def definition(kind: str) -> str:
    """The text of a message's definition, with those of all that it holds.

    Parameters
    ----------
    kind : str, such as "std_msgs/Header"
    """
    kinds = [kind]
    for each in kinds:  # grows
        held = [of.partition("[")[0] for of, _ in _fields(each)]
        kinds += [of for of in dict.fromkeys(held) if of in DEFINITIONS and of not in kinds]
    texts = ["".join(f"{of} {name}\n" for of, name in _fields(each)) for each in kinds]
    others = zip(kinds[1:], texts[1:], strict=True)
    return texts[0] + "".join(f"{_RULE}\nMSG: {each}\n{text}" for each, text in others)


def cdr(kind: str, message: Mapping[str, Any]) -> bytes:
    """A message as ROS 2 sends it.

    Parameters
    ----------
    kind : str, such as "std_msgs/Header"
    message : mapping, all its fields

    Examples
    --------
    >>> cdr("builtin_interfaces/Time", time_of(1_500_000_000)).hex(" ", 4)
    '00010000 01000000 0065cd1d'
    """
    written = bytearray()
    _append(written, kind, message)
    return _LITTLE_ENDIAN_CDR + bytes(written)


def time_of(stamp_ns: int) -> dict[str, int]:
    """The message of a time.

    Parameters
    ----------
    stamp_ns : int, ns, since whatever the clock counts from
    """
    return dict(zip(("sec", "nanosec"), divmod(stamp_ns, 10**9), strict=True))


def _fields(kind: str) -> Iterator[tuple[str, str]]:
    """Type and name of each field of a message."""
    for each in DEFINITIONS[kind].split(", "):
        of, _, name = each.partition(" ")
        yield of, name


def _append(written: bytearray, kind: str, value: Any) -> None:
    """Append a value, each number at a multiple of its own size."""
    of, bracket, count = kind.partition("[")
    if bracket:
        if count == "]":
            _append(written, "uint32", len(value))
        if of == "uint8":
            written += value
        else:
            for item in value:
                _append(written, of, item)
    elif of in DEFINITIONS:
        for type_of, name in _fields(of):
            _append(written, type_of, value[name])
    elif of == "string":
        text = value.encode() + b"\0"
        _append(written, "uint32", len(text))
        written += text
    else:
        packed = struct.pack(f"<{_FORMATS[of]}", value)
        written += bytes(-len(written) % len(packed)) + packed


@dataclass
class MessageFile:
    """An MCAP file that messages are written to."""

    _writer: "Writer"
    _channels: dict[str, int] = field(default_factory=dict)

    def write(
        self, topic: str, kind: str, stamp_ns: int, message: Mapping[str, Any], number: int = 0
    ) -> None:
        """Write a message.

        Parameters
        ----------
        topic : str, all of whose messages are of one kind
        kind : str, such as "sensor_msgs/CameraInfo"
        stamp_ns : int, ns, when it was
        message : mapping, all its fields
        number : int, of the message in its topic
        """
        if topic not in self._channels:
            name = kind.replace("/", "/msg/")
            schema = self._writer.register_schema(name, "ros2msg", definition(kind).encode())
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schema)
        self._writer.add_message(
            self._channels[topic], stamp_ns, cdr(kind, message), stamp_ns, number
        )

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Put a whole file beside the messages.

        Parameters
        ----------
        name : str, of the file
        media_type : str, such as "text/csv"
        data : bytes, all that it holds
        """
        self._writer.add_attachment(0, 0, name, media_type, data)


@contextmanager
def message_file(path: Path) -> Iterator[MessageFile]:
    """An MCAP file to write messages to, in its place once the block has ended, and whole.

    It is not compressed: pictures are by themselves.

    Parameters
    ----------
    path : Path, of the file, replaced where it is there

    Raises
    ------
    InputError
        The disk refuses, or the package mcap is missing.
    """
    try:
        from mcap.writer import CompressionType, Writer  # here: it is an extra
    except ModuleNotFoundError as error:
        what = "needs the package mcap: pip install 'lscan[mcap]'"
        raise InputError(what, where=path) from error
    with new_file(path) as descriptor, os.fdopen(descriptor, "wb", closefd=False) as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start(profile="ros2", library=f"lscan {__version__}")
        yield MessageFile(writer)
        writer.finish()
