"""Errors that a campaign of injected faults found to say too little: each now says what to do."""

import errno
import os
import sys
from pathlib import Path
from typing import Any

import cv2
import pytest
import typer
from fake_capture import HEIGHT_PX, WIDTH_PX, FakeCapture, World, scene_of
from grbl_line import DirectLine, SimulatedTime

from lscan.cli.console import run_command_line
from lscan.config.rig import CameraSection
from lscan.devices.grbl import SerialTrackOptions, open_track
from lscan.devices.opencv_camera import OpencvCamera, OpencvOptions
from lscan.errors import DeviceError, InputError
from lscan.files.disk import disk_errors, read_bytes, write_atomically
from sim.emulators.grbl import Faults, GrblEmulator

SECTION = CameraSection(driver="opencv", width_px=WIDTH_PX, height_px=HEIGHT_PX)


class SetBack(FakeCapture):
    """A camera whose clock is set back by 30 s after its third picture."""

    def get(self, property_id: int) -> float:
        value = super().get(property_id)
        late = property_id == cv2.CAP_PROP_POS_MSEC and self._world.reads > 3
        return value - 30_000 if late else value


def opened(world: World, capture: type[FakeCapture], **options: Any) -> OpencvCamera:
    given = {"device": 0, "warm_up_frames": 0, "reconnect_wait_s": 0.0, **options}
    return OpencvCamera(SECTION, OpencvOptions(**given), lambda _: capture(world))


def test_a_camera_clock_set_back_is_distinguished_from_a_silent_camera() -> None:
    world = World(stamps=True)
    camera = opened(world, SetBack, timeout_s=2.0, reconnects=0)
    pattern = r"stamped \d+(\.\d+)? s before .*its clock was set back.*plug it in anew"
    with pytest.raises(DeviceError, match=pattern):
        for _ in range(4):
            camera.grab()
    camera.close()


def test_one_old_picture_before_silence_is_silence() -> None:
    """The picture that was under way at the call is old by right: the camera then hung."""
    world = World(stamps=True, delay=3, period_s=0.01)
    camera = opened(world, FakeCapture, timeout_s=2.0, reconnects=0)
    assert scene_of(camera.grab().image) == 1
    world.faults = dict.fromkeys(range(world.reads + 1, 10**5), "hang")
    with pytest.raises(DeviceError, match=r"sent no new picture within 2 s; check cable"):
        for _ in range(3):
            camera.grab()
    world.free.set()
    camera.close()


def test_a_driver_that_breaks_says_what_to_check() -> None:
    world = World()
    camera = opened(world, FakeCapture, reconnects=0)
    camera.grab()
    world.faults = dict.fromkeys(range(world.reads, 10**5), "raise")
    with pytest.raises(DeviceError, match=r"the driver broke in two lines; check cable and power"):
        for _ in range(3):
            camera.grab()
    camera.close()


def test_pictures_that_turn_grey_name_the_setting() -> None:
    world = World()
    camera = opened(world, FakeCapture)
    camera.grab()
    world.grey = True
    with pytest.raises(DeviceError, match=r"change from shape .*set camera.options.pixel_format"):
        for _ in range(3):
            camera.grab()
    camera.close()


@pytest.mark.parametrize(
    ("faults", "pattern"),
    [
        (Faults(stuck=True), r"'\$H' did not come .*jam on the way to the switch"),
        (Faults(silent=True), r"no Grbl banner .*check the port"),
    ],
)
def test_a_track_that_does_not_home(faults: Faults, pattern: str) -> None:
    time = SimulatedTime()
    emulator = GrblEmulator(clock=time)
    emulator.inject(faults)
    options = SerialTrackOptions(port="here", min_mm=0, max_mm=40, zero_mm=-190)
    with pytest.raises(DeviceError, match=pattern):
        open_track(options, DirectLine(emulator, time), time, time.sleep)


def test_a_refusal_that_noise_made_sends_to_the_cable() -> None:
    time = SimulatedTime()
    emulator = GrblEmulator({22: 0, 20: 0}, clock=time)  # homing is off, so $H is error:5
    options = SerialTrackOptions(port="here", min_mm=0, max_mm=40)
    with pytest.raises(DeviceError, match=r"refuses '\$H': error:5, .*check the cable"):
        open_track(options, DirectLine(emulator, time), time, time.sleep)


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.ENOSPC, "make room on the disk"),
        (errno.EROFS, "make it writable"),
        (errno.EACCES, "make it writable"),
        (errno.ENOENT, "bring it back"),
        (errno.EFBIG, "ulimit -f"),
        (errno.EIO, "check the disk"),
        (errno.ENAMETOOLONG, "choose another place"),
    ],
)
def test_a_disk_that_refuses_says_what_to_do(tmp_path: Path, number: int, remedy: str) -> None:
    with (
        pytest.raises(InputError, match=f"a: cannot be written: .*; .*{remedy}"),
        disk_errors(tmp_path / "a"),
    ):
        raise OSError(number, os.strerror(number))


def test_a_write_into_a_folder_that_is_gone(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"No such file or directory; make its folder, or bring"):
        write_atomically(tmp_path / "gone" / "a", b"x")
    with pytest.raises(InputError, match=r"No such file or directory; check its name"):
        read_bytes(tmp_path / "gone", most=10)


def test_the_command_line_prints_an_error_and_its_notes_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    app = typer.Typer()

    @app.command()
    def fail() -> None:
        error = DeviceError("camera: is gone")
        error.add_note("3 of 5 frames are kept in runs/a; go on with --resume")
        raise error

    monkeypatch.setattr(sys, "argv", ["lscan"])
    with pytest.raises(SystemExit) as stopped:
        run_command_line(app, "lscan")
    assert stopped.value.code == DeviceError.exit_code
    line = "lscan: camera: is gone; 3 of 5 frames are kept in runs/a; go on with --resume\n"
    assert capsys.readouterr().err == line
