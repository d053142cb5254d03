#!/usr/bin/env bash
# Rerun's check of MCAP files finds chunks out of order in every recording of two clouds and more.
#
# Seen with rerun-sdk 0.41.0 (PyPI), file by rosbags 0.10.11, Python 3.11, Linux x86_64.
# Input: an MCAP file of three sensor_msgs/PointCloud2 of two points, one second apart, written in the
# order of their stamps; and one of three geometry_msgs/PointStamped, likewise.
# Output: `rerun mcap check` says ok of both; `rerun mcap check --full` says ok of the second and
# PROBLEM of the first: "3 unordered chunks on message_log_time", and on the other two time lines.
# Expected: ok, for messages, chunks and stamps are in order.  Of clouds the decoder hands out one chunk
# with all frames first, and then a chunk for each cloud's positions: it judges its own order.
# What follows: the verdict of --full says nothing about how a recording with clouds was written.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT

python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
    rerun-sdk==0.41.0 rosbags==0.10.11 numpy==2.2.6

cat >"$folder/write.py" <<'PYTHON'
import sys
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS2_JAZZY)
types = store.types
Header, Time = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
Field, Cloud = types["sensor_msgs/msg/PointField"], types["sensor_msgs/msg/PointCloud2"]
Point, Stamped = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/PointStamped"]
fields = [Field(name=name, offset=4 * n, datatype=7, count=1) for n, name in enumerate("xyz")]
data = np.arange(6, dtype=np.float32).view(np.uint8)


def cloud(header):
    return Cloud(
        header=header, height=1, width=2, fields=fields, is_bigendian=False, point_step=12,
        row_step=24, data=data, is_dense=True,
    )


def point(header):
    return Stamped(header=header, point=Point(x=0.0, y=0.0, z=0.0))


for name, make in {"clouds": cloud, "points": point}.items():
    with Writer(Path(sys.argv[1]) / name, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        kind = make(Header(stamp=Time(sec=0, nanosec=0), frame_id="a")).__msgtype__
        topic = writer.add_connection("/topic", kind, typestore=store)
        for sec in (1, 2, 3):
            message = make(Header(stamp=Time(sec=sec, nanosec=0), frame_id="a"))
            writer.write(topic, sec * 10**9, store.serialize_cdr(message, kind))
PYTHON
"$folder/venv/bin/python" "$folder/write.py" "$folder"

# The status of the one topic: the first word of the last line.
status() {
    ("$folder/venv/bin/rerun" mcap check "$@" 2>&1 || true) | tail -n 1 | tee -a /dev/stderr | cut -d ' ' -f 1
}
[ "$(status "$folder/points/points.mcap")" = ok ]
[ "$(status --full "$folder/points/points.mcap")" = ok ]
[ "$(status "$folder/clouds/clouds.mcap")" = ok ]
[ "$(status --full "$folder/clouds/clouds.mcap")" = PROBLEM ]
