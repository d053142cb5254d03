"""A scan goes on after its devices are reached in another way, and with no other rig."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fake_devices import HEIGHT, WIDTH, FakeCamera, FakeTrack, fake_rig, folder_bytes

from lscan.acquisition.run import require_same_rig
from lscan.acquisition.scan import acquire_into
from lscan.acquisition.writer import create_run, resume_run
from lscan.config.rig import RigFile, parse_rig
from lscan.devices.grbl import SerialTrackOptions, track_driver as grbl
from lscan.devices.opencv_camera import OpencvOptions, camera_driver as opencv
from lscan.errors import DeviceError, InputError

CAMERA = {"url": "http://bench:8080/stream", "flush_frames": 1}
TRACK = {"port": "/dev/ttyUSB0", "min_mm": 0, "max_mm": 180}
LATER = {
    "camera": {
        "url": "http://bench:9090/stream",
        "timeout_s": 60.0,
        "retries": 3,
        "reconnects": 5,
        "reconnect_wait_s": 2.0,
    },
    "track": {
        "port": "/dev/ttyUSB1",
        "baud": 9600,
        "boot_s": 9.0,
        "answer_s": 9.0,
        "homing_s": 90.0,
    },
}


def real_rig(camera: dict[str, Any] | None = None, track: dict[str, Any] | None = None) -> RigFile:
    document = {
        "camera": {
            "driver": "opencv",
            "width_px": WIDTH,
            "height_px": HEIGHT,
            "options": CAMERA if camera is None else camera,
        },
        "track": {"driver": "grbl", "options": TRACK if track is None else track},
        "plan": {"frames": 4, "step_mm": 0.1},
    }
    return parse_rig(document, source="rig.toml")


def stop_after_two(path: Path) -> None:
    track = FakeTrack()
    with pytest.raises(DeviceError), create_run(path, real_rig()) as writer:
        acquire_into(writer, FakeCamera(track, fail_at=2), track)


def finish(path: Path, rig_file: RigFile) -> None:
    track = FakeTrack()
    with resume_run(path, rig_file) as writer:
        acquire_into(writer, FakeCamera(track), track)


def test_a_scan_goes_on_over_another_connection_to_the_same_bytes(tmp_path: Path) -> None:
    for name in ("same", "other"):
        stop_after_two(tmp_path / name)
    finish(tmp_path / "same", real_rig())
    finish(tmp_path / "other", real_rig(CAMERA | LATER["camera"], TRACK | LATER["track"]))
    assert folder_bytes(tmp_path / "other") == folder_bytes(tmp_path / "same")


@pytest.mark.parametrize(
    ("rig_file", "line"),
    [
        (
            real_rig(camera=CAMERA | {"flush_frames": 2}),
            "begun with camera.options.flush_frames = 1, "
            "this rig comes with camera.options.flush_frames = 2",
        ),
        (
            real_rig(track=TRACK | {"zero_mm": -1.0}),
            "begun without track.options.zero_mm, this rig comes with track.options.zero_mm = -1.0",
        ),
        (
            real_rig(camera={"url": CAMERA["url"]}),
            "begun with camera.options.flush_frames = 1, "
            "this rig comes without camera.options.flush_frames",
        ),
        (
            replace(real_rig(), document=real_rig().document | {"tank": {}}),
            "begun without tank, this rig comes with tank = {}",
        ),
        (
            real_rig(camera={"file": "video.avi", "flush_frames": 1}),
            "begun without camera.options.file, "
            "this rig comes with camera.options.file = 'video.avi'",
        ),
    ],
)
def test_any_other_difference_is_reported_with_both_values(
    tmp_path: Path, rig_file: RigFile, line: str
) -> None:
    stop_after_two(tmp_path / "a")
    before = folder_bytes(tmp_path / "a")
    with pytest.raises(InputError) as refused:
        resume_run(tmp_path / "a", rig_file)
    what_to_do = "restore it in rig.toml, or begin a new scan"
    assert f"{line}; {what_to_do}" in str(refused.value)
    assert folder_bytes(tmp_path / "a") == before


def test_connection_options_are_options() -> None:
    """A name spelt wrongly would let nothing differ."""
    assert opencv.connection_options <= set(OpencvOptions.model_fields)
    assert grbl.connection_options <= set(SerialTrackOptions.model_fields)


def test_options_where_there_were_none_are_reported(tmp_path: Path) -> None:
    """A driver that is not installed names no connection: whatever differs is refused."""
    plain = fake_rig()
    camera = plain.document["camera"]
    bare = {key: value for key, value in camera.items() if key != "options"}
    rigs = [
        parse_rig({**plain.document, "camera": section}, source="rig.toml", trusted=True)
        for section in (bare, {**bare, "options": {}}, {**bare, "options": {"url": "x"}})
    ]
    require_same_rig(rigs[0], rigs[1], tmp_path)
    for one, other, line in (
        (0, 2, "begun without camera.options.url, this rig comes with camera.options.url = 'x'"),
        (2, 1, "begun with camera.options.url = 'x', this rig comes without camera.options.url"),
    ):
        with pytest.raises(InputError, match=line):
            require_same_rig(rigs[one], rigs[other], tmp_path)


def test_a_table_that_is_filled_is_not_said_to_be_missing(tmp_path: Path) -> None:
    """As is the key path of the whole table, where it is empty on one side."""
    filled = fake_rig()
    empty = replace(filled, document=filled.document | {"water": {}})
    with pytest.raises(InputError, match=r"with water = {}, this rig comes with entries in water"):
        require_same_rig(empty, filled, tmp_path)
