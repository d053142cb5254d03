"""Messages of ROS 2 as rosbags, which shares no code with them, defines and reads them."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from lscan.errors import InputError
from lscan.files.rosmessages import DEFINITIONS, cdr, definition, message_file, time_of

DISTRIBUTIONS = (Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY, Stores.ROS2_KILTED)
HEADER = {"stamp": time_of(1_700_000_000_123_456_789), "frame_id": "world"}


@pytest.mark.parametrize("kind", DEFINITIONS)
def test_definitions_are_those_of_ros(kind: str) -> None:
    name = kind.replace("/", "/msg/")
    ours = get_types_from_msg(definition(kind), name)[name][1]
    for distribution in DISTRIBUTIONS:
        assert ours == get_typestore(distribution).fielddefs[name][1], distribution


def image(frame: str, encoding: str) -> dict[str, Any]:
    return {"header": HEADER | {"frame_id": frame}, "format": encoding, "data": b"\x01\x02\x03"}


def cloud(frame: str, name: str) -> dict[str, Any]:
    """Numbers of all sizes after texts of any length: each is aligned to its own size."""
    field = {"name": name, "offset": 4, "datatype": 7, "count": 1}
    return {
        "header": HEADER | {"frame_id": frame}, "height": 1, "width": 2, "fields": [field, field],
        "is_bigendian": False, "point_step": 3, "row_step": 6, "data": bytes(range(6)),
        "is_dense": True,
    }  # fmt: skip


def transform(frame: str, child: str) -> dict[str, Any]:
    turn = {"x": 0.5, "y": -0.5, "z": 0.5, "w": 0.5}
    moved = {"translation": {"x": 1.25, "y": -2.5, "z": 1e-3}, "rotation": turn}
    one = {"header": HEADER | {"frame_id": frame}, "child_frame_id": child, "transform": moved}
    return {"transforms": [one, one]}


def as_read(value: Any) -> Any:
    """What rosbags reads, as the mapping that was written."""
    if hasattr(value, "__msgtype__"):
        # Constants of a definition, which no message holds, are in capitals.
        return {name: as_read(v) for name, v in vars(value).items() if name[0].islower()}
    if isinstance(value, list):
        return [as_read(each) for each in value]
    return value.tobytes() if isinstance(value, np.ndarray) and value.dtype == np.uint8 else value


@pytest.mark.parametrize("length", range(9))
@pytest.mark.parametrize(
    ("kind", "make"),
    [("sensor_msgs/CompressedImage", image), ("sensor_msgs/PointCloud2", cloud),
     ("tf2_msgs/TFMessage", transform)],
)  # fmt: skip
def test_another_reader_finds_what_was_written(kind: str, make: Any, length: int) -> None:
    message = make("ä" + "f" * length, "n" * (length // 2))
    store = get_typestore(Stores.ROS2_JAZZY)
    read: Any = store.deserialize_cdr(cdr(kind, message), kind.replace("/", "/msg/"))
    assert as_read(read) == message
    # And the other way round: no byte but the last ones' padding may differ.
    theirs = bytes(store.serialize_cdr(read, kind.replace("/", "/msg/")))
    ours = cdr(kind, message)
    assert theirs[: len(ours)] == ours and len(theirs) - len(ours) < 4


def test_a_recording_says_what_it_is(tmp_path: Path) -> None:
    with message_file(tmp_path / "a.mcap") as file:
        file.write("/a", "std_msgs/Header", 5_000_000_001, HEADER, 7)
        file.write("/a", "std_msgs/Header", 5_000_000_002, HEADER, 8)
        file.attach("note.txt", "text/plain", b"words")
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        assert reader.get_header().library.startswith("lscan ")
        read = [(s, c, m) for s, c, m in reader.iter_messages()]
        assert [(m.log_time, m.publish_time, m.sequence) for _, _, m in read] == [
            (5_000_000_001, 5_000_000_001, 7), (5_000_000_002, 5_000_000_002, 8)
        ]  # fmt: skip
        schema, channel, message = read[0]
        assert schema is not None and schema.name == "std_msgs/msg/Header"
        assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
        assert message.data == cdr("std_msgs/Header", HEADER)
        assert [(a.name, a.data) for a in reader.iter_attachments()] == [("note.txt", b"words")]


def test_what_ends_in_an_error_leaves_the_file_that_was_there(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"old")
    with pytest.raises(RuntimeError), message_file(tmp_path / "a.mcap") as file:
        file.write("/a", "std_msgs/Header", 0, HEADER)
        raise RuntimeError
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"old"]


def test_without_the_package_one_line_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    with pytest.raises(InputError, match=r"lscan\[mcap\]"), message_file(tmp_path / "a.mcap"):
        pass
    assert not [*tmp_path.iterdir()]
