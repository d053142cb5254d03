"""Another camera behind the same number is known, where the system knows it."""

import json
from pathlib import Path

import pytest
from fake_capture import HEIGHT_PX, WIDTH_PX, World
from fake_devices import FakeCamera, FakeTrack, fake_rig

from lscan.acquisition.run import MANIFEST
from lscan.acquisition.scan import acquire_into
from lscan.acquisition.writer import create_run, resume_run
from lscan.config.rig import CameraSection
from lscan.devices.listing import video_devices
from lscan.devices.opencv_camera import OpencvCamera, OpencvOptions
from lscan.devices.opencv_camera.options import device_identity
from lscan.errors import DeviceError

FIRST, SECOND = "usb-046d_HD_Pro_Webcam_C920_4A5B6C7D", "usb-046d_HD_Pro_Webcam_C920_00000001"


def machine(root: Path, cameras: list[str], model: str = "HD Pro Webcam C920") -> Path:
    """The devices of a Linux machine: each camera has a picture and a metadata node, as UVC
    cameras do, and udev's links to both; one named "" has none."""
    for number, camera in enumerate(cameras):
        for index, node in enumerate((f"video{2 * number}", f"video{2 * number + 1}")):
            (root / "dev").mkdir(parents=True, exist_ok=True)
            (root / "dev" / node).touch()
            (named := root / "sys/class/video4linux" / node).mkdir(parents=True)
            (named / "name").write_text(f"{model}\n")
            (root / "dev/v4l/by-id").mkdir(parents=True, exist_ok=True)
            if camera:
                link = root / "dev/v4l/by-id" / f"{camera}-video-index{index}"
                link.symlink_to(Path("../..") / node)
    return root


def test_a_camera_is_known_by_number_path_and_name(tmp_path: Path) -> None:
    root = machine(tmp_path, [FIRST, SECOND])
    assert device_identity(0, root) == f"{FIRST}-video-index0"
    assert device_identity("/dev/video2", root) == f"{SECOND}-video-index0"
    by_id = f"/dev/v4l/by-id/{SECOND}-video-index0"
    assert device_identity(by_id, root) == f"{SECOND}-video-index0"


def test_without_links_the_model_is_known_and_without_a_system_nothing(tmp_path: Path) -> None:
    assert device_identity(0, machine(tmp_path / "a", [""])) == "HD Pro Webcam C920"
    assert device_identity(0, tmp_path / "none") is None
    assert device_identity(None, tmp_path / "none") is None


@pytest.mark.skipif("sys.platform != 'linux'")
def test_the_list_names_what_stays_when_numbers_change(tmp_path: Path) -> None:
    found = video_devices(World().open, machine(tmp_path, [FIRST]))
    assert [each.by_id for each in found] == [
        (f"/dev/v4l/by-id/{FIRST}-video-index{index}",) for index in (0, 1)
    ]


def test_another_camera_that_comes_back_within_a_scan_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    identities = iter([FIRST, SECOND])
    monkeypatch.setattr(
        "lscan.devices.opencv_camera.camera.device_identity", lambda _: next(identities)
    )
    world = World()
    section = CameraSection(driver="opencv", width_px=WIDTH_PX, height_px=HEIGHT_PX)
    options = OpencvOptions(device=0, retries=0, warm_up_frames=0, reconnect_wait_s=0.0)
    camera = OpencvCamera(section, options, world.open)
    world.faults = dict.fromkeys(range(world.reads, world.reads + 2), "gone")
    with pytest.raises(DeviceError, match=f"another camera \\({SECOND}, before {FIRST}\\)"):
        for _ in range(3):
            camera.grab()
    camera.close()


# ---- a scan that goes on ----------------------------------------------------------------


class NamedCamera(FakeCamera):
    """A camera that says which it is."""

    identity: str | None = FIRST


def scan(path: Path, identity: str | None, frames: int = 5) -> None:
    """A scan by that camera, stopped after ``frames``; one that was begun goes on."""
    track = FakeTrack()
    camera = NamedCamera(track)
    camera.identity = identity
    rig = fake_rig()
    with (resume_run if path.exists() else create_run)(path, rig) as writer:
        acquire_into(writer, camera, track, go_on=lambda: writer.written < frames)


def test_a_run_goes_on_with_its_own_camera_only(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scan(tmp_path / "a", FIRST, frames=2)
    assert json.loads((tmp_path / "a" / MANIFEST).read_text())["camera_identity"] == FIRST
    with pytest.raises(DeviceError, match=f"begun with the camera {FIRST}, this one is {SECOND}"):
        scan(tmp_path / "a", SECOND)
    scan(tmp_path / "a", FIRST)
    assert not caplog.text


@pytest.mark.parametrize(("then", "now"), [(None, FIRST), (FIRST, None), (None, None)])
def test_what_cannot_be_told_is_said(
    tmp_path: Path, then: str | None, now: str | None, caplog: pytest.LogCaptureFixture
) -> None:
    scan(tmp_path / "a", then, frames=2)
    assert not caplog.text
    scan(tmp_path / "a", now)
    said = f"then: {then or 'unknown'}; now: {now or 'unknown'}"
    assert "nothing tells whether this is the camera" in caplog.text and said in caplog.text


def test_a_run_without_a_frame_takes_the_camera_it_gets(tmp_path: Path) -> None:
    scan(tmp_path / "a", FIRST, frames=0)
    scan(tmp_path / "a", SECOND)
    assert json.loads((tmp_path / "a" / MANIFEST).read_text())["camera_identity"] == SECOND
