"""Everything a camera can do wrong: one clear line, and never a wrong picture."""

import os
import subprocess
import sys
import threading
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fake_capture import HEIGHT_PX, WIDTH_PX, World, scene_of

from lscan.config.rig import CameraSection
from lscan.devices.opencv_camera import OpencvCamera, OpencvOptions
from lscan.errors import DeviceError

SECTION = CameraSection(driver="opencv", width_px=WIDTH_PX, height_px=HEIGHT_PX)
ALWAYS = 10**5
"""Reads until a fault that stays would end."""
RETRIES = 5
LOST = RETRIES + 1
"""Failed readings in a row that make a camera lost."""


def camera_in(world: World, **options: Any) -> OpencvCamera:
    given = {
        "device": 0,
        "warm_up_frames": 0,
        "retries": RETRIES,
        "timeout_s": 60.0,
        "reconnect_wait_s": 0.0,
        **options,
    }
    return OpencvCamera(SECTION, OpencvOptions(**given), world.open)


def from_now(world: World, fault: str, reads: int = ALWAYS) -> None:
    """Let a fault begin with the next read."""
    start = world.reads + 1
    world.faults = dict.fromkeys(range(start, start + reads), fault)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("black", r"black picture, brightest pixel 0 DN at 20 ms.*cap off.*6 times"),
        ("same", r"same picture \d+ times; it is stuck: plug it in"),
        ("wrong size", r"20 by 14 px; the rig says 20 by 16 px \(camera.width_px"),
        ("deep", r"uint16 of shape \(16, 20, 3\); allowed: uint8.*pixel_format"),
        ("gone", r"is gone after \d+ pictures; check cable.*opened 2 times anew"),
        ("empty", r"is gone after \d+ pictures; check cable"),
        ("raise", r"failed: .*the driver broke"),
    ],
)
def test_a_fault_that_stays_ends_in_one_line(fault: str, message: str) -> None:
    world = World()
    camera = camera_in(world)
    assert scene_of(camera.grab().image) == 1
    from_now(world, fault)
    with pytest.raises(DeviceError, match=rf"^camera opencv \(device 0\): .*{message}") as caught:
        for _ in range(3):  # a picture that came before the fault may still be given once
            camera.grab()
    assert "\n" not in str(caught.value)
    camera.close()
    assert world.released == world.opened


def test_a_camera_that_hangs_is_given_up_in_time() -> None:
    world = World()
    camera = camera_in(world, timeout_s=0.5, reconnects=1)
    camera.grab()
    from_now(world, "hang")
    with pytest.raises(DeviceError, match=r"no .*picture within 0.5 s; check cable.*1 times anew"):
        camera.grab()
    world.free.set()  # until here the fake hangs
    camera.close()


def test_a_wait_for_a_camera_that_hangs_is_said_at_once(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not after the wait, of up to ``timeout_s``."""
    monkeypatch.setattr("lscan.devices.opencv_camera.reader.QUIET_WAIT_S", 0.05)
    world = World()
    camera = camera_in(world, timeout_s=60.0)
    camera.grab()
    hung = world.reads + 1
    world.faults = dict.fromkeys(range(hung, ALWAYS), "hang")
    while world.reads <= hung:
        time.sleep(0.001)
    closing = threading.Thread(target=camera.close)
    closing.start()
    while "hangs; it is waited for up to 60 s" not in caplog.text:
        time.sleep(0.001)
    assert closing.is_alive()
    world.free.set()
    closing.join()


def test_a_silent_address_is_named_and_no_cable() -> None:
    world = World()
    world.faults = dict.fromkeys(range(ALWAYS), "hang")
    address = "http://127.0.0.1:1/stream"
    known = rf"^camera opencv \({address}\): gave no first picture within 0.5 s; check that pict"
    with pytest.raises(DeviceError, match=known) as caught:
        camera_in(world, device=None, url=address, timeout_s=0.5, reconnects=0)
    world.free.set()
    assert "cable" not in str(caught.value)


@pytest.mark.parametrize("fault", ["gone", "raise", "empty", "hang"])
def test_a_camera_that_comes_back_goes_on(fault: str) -> None:
    world = World()
    camera = camera_in(world, timeout_s=1.0)
    camera.grab()
    from_now(world, fault, reads=1 if fault in ("raise", "hang") else LOST)
    world.scene = 2
    deadline_s = time.monotonic() + 60
    while world.opened < 2 and time.monotonic() < deadline_s:
        assert scene_of(camera.grab().image) == 2
    assert world.opened == 2
    world.free.set()
    camera.close()


@pytest.mark.parametrize("fault", ["gone", "empty"])
def test_readings_that_fail_now_and_then_lose_no_camera(fault: str) -> None:
    world = World()
    camera = camera_in(world)
    for scene in range(2, 6):
        from_now(world, fault, reads=RETRIES)
        world.scene = scene
        assert scene_of(camera.grab().image) == scene
    assert world.opened == 1
    camera.close()


def test_one_that_stays_away_longer_than_it_is_called_is_an_error() -> None:
    world = World(closes=2)
    camera = camera_in(world, reconnects=2)
    camera.grab()
    from_now(world, "gone", reads=LOST)
    with pytest.raises(DeviceError, match=r"cannot be opened.*lscan devices.*2 times anew"):
        for _ in range(3):
            camera.grab()
    camera.close()


def test_one_that_comes_back_set_otherwise_is_refused() -> None:
    """Its pictures would be of another exposure, in the midst of a run."""
    world = World()
    camera = camera_in(world)
    camera.grab()
    world.obeys = lambda key, value: 50.0 if key == cv2.CAP_PROP_EXPOSURE else value
    from_now(world, "gone", reads=LOST)
    with pytest.raises(DeviceError, match=r"other settings \(exposure_ms: .*got 5.0, before 20.0"):
        for _ in range(3):
            camera.grab()
    camera.close()


def test_one_that_comes_back_with_the_old_picture_is_refused() -> None:
    """A server begun anew may send what it sent last, though the head has moved."""
    world = World(period_s=0.05)  # time to plan the next read
    camera = camera_in(world, flush_frames=0, retries=0)
    camera.grab()
    start = world.reads
    world.faults = {start: "gone", **dict.fromkeys(range(start + 1, ALWAYS), "same")}
    with pytest.raises(DeviceError, match="sent the picture of the grab before again"):
        camera.grab()
    camera.close()


def test_a_camera_that_is_not_there() -> None:
    world = World(closes=1, opened=1)
    with pytest.raises(DeviceError, match=r"device 0\): cannot be opened; check .*lscan devices"):
        camera_in(world)


def test_a_real_device_that_is_not_there() -> None:
    options = OpencvOptions(device="/dev/video-none", timeout_s=10)
    with pytest.raises(DeviceError, match=r"/dev/video-none\): cannot be opened"):
        OpencvCamera(SECTION, options)


def test_a_stream_that_is_not_there() -> None:
    options = OpencvOptions(url="http://127.0.0.1:1/none", timeout_s=10)
    with pytest.raises(DeviceError, match=r"127.0.0.1:1/none\): cannot be opened"):
        OpencvCamera(SECTION, options)


SPEECHLESS = """
from lscan.devices.opencv_camera import OpencvOptions, open_capture

url, device = "http://127.0.0.1:1/none", "/dev/video-none"
for source in ({"url": url}, {"device": device}, {"file": __file__}):
    assert not open_capture(OpencvOptions(timeout_s=60, **source)).isOpened()
"""


@pytest.mark.parametrize(
    ("asked", "speaks"),
    [
        ({}, False),
        pytest.param({"OPENCV_LOG_LEVEL": "INFO"}, True, marks=pytest.mark.slow),
    ],
)
def test_the_libraries_write_nothing_of_their_own(
    tmp_path: Path, asked: dict[str, str], speaks: bool
) -> None:
    """Neither OpenCV nor FFmpeg, unless their own variables ask for it."""
    script = tmp_path / "script.py"
    script.write_text(SPEECHLESS)
    plain = {key: value for key, value in os.environ.items() if not key.startswith("OPENCV_")}
    done = subprocess.run(
        [sys.executable, str(script)], env=plain | asked, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert bool(done.stderr) == speaks, done.stderr


@pytest.mark.parametrize("fault", ["wrong size", "deep"])
def test_the_wrong_pictures_from_the_start(fault: str) -> None:
    with pytest.raises(DeviceError, match=r"pixel_format|the rig says"):
        camera_in(World(faults=dict.fromkeys(range(ALWAYS), fault)))


@pytest.mark.parametrize("step_s", [1e9, 1.0], ids=["still", "whole seconds"])
def test_stamps_that_tell_nothing_are_not_believed(
    step_s: float, caplog: pytest.LogCaptureFixture
) -> None:
    """Each picture shows what was there after the call, though all are stamped before it."""
    opened_s = time.monotonic() - 0.1
    world = World(stamps=True, stamp=lambda now_s: now_s - (now_s - opened_s) % step_s)
    camera = camera_in(world, warm_up_frames=5, reconnects=0)
    for scene in range(2, 12):
        world.scene = scene
        began_s = time.monotonic()
        grab = camera.grab()
        assert scene_of(grab.image) == scene
        assert grab.time_s >= began_s  # its arrival
    assert "gives one time stamp to many pictures" in caplog.text
    camera.close()


def test_passing_black_and_repeated_pictures_are_passed_over() -> None:
    world = World()
    camera = camera_in(world, retries=50)
    for fault in ("black", "same"):
        from_now(world, fault, reads=5)
        for _ in range(5):
            assert scene_of(camera.grab().image) == 1
    camera.close()


@pytest.mark.parametrize("way", ["report", "accept", "accept_black"])
def test_black_pictures_that_are_meant(way: str, caplog: pytest.LogCaptureFixture) -> None:
    """Alike to the byte, as dark pictures of many webcams are."""
    world = World(faults=dict.fromkeys(range(ALWAYS), "black"))
    camera = camera_in(world, **({} if way == "accept_black" else {"black": way}))
    if way == "accept_black":
        camera.accept_black()
    for _ in range(10):
        assert camera.grab().image.max() == 0
    assert ("black picture" in caplog.text) == (way == "report")
    camera.close()


def test_repeated_black_pictures_hide_no_old_one() -> None:
    """A camera that repeats a black picture still holds the one it took before: it comes next."""
    world = World(period_s=0.005)
    camera = camera_in(world, retries=20)
    assert scene_of(camera.grab().image) == 1
    black, deadline_s = world.reads + 1, time.monotonic() + 60
    world.faults = dict.fromkeys(range(black, black + 4), "black")
    world.faults |= dict.fromkeys(range(black + 4, black + 12), "same")
    while world.reads < black + 5 and time.monotonic() < deadline_s:
        time.sleep(0.001)
    world.scene = 2
    assert scene_of(camera.grab().image) == 2
    camera.close()


# ---- random sequences of faults ---------------------------------------------------------

KINDS = ("black", "same", "gone", "raise", "empty", "hang", "wrong size", "deep")
SEQUENCES = 300
GRABS = 4


def _random_world(generator: np.random.Generator) -> World:
    """A camera with one to four faults of random kind, place and length.

    Recoverable kinds are likelier, or every sequence would end in an error.
    """
    weights = np.array([4, 4, 2, 2, 2, 0.5, 0.5, 0.5])
    faults: dict[int, str] = {}
    for _ in range(generator.integers(1, 5)):
        start, length = generator.integers(1, 30), generator.choice([1, 2, 3, 8])
        kind = str(generator.choice(KINDS, p=weights / weights.sum()))
        faults |= dict.fromkeys(range(start, start + length), kind)
    return World(faults=faults, closes=int(generator.integers(0, 2)), period_s=0.0002)


def _outcomes(seed: int) -> list[str]:
    """What became of each grab: "picture", each one checked, or "error" at the end."""
    world = _random_world(np.random.default_rng(seed))
    options = {"timeout_s": 0.1, "reconnects": 1, "retries": 4}
    outcomes, images, times_s = [], [], []
    camera = None
    try:
        camera = camera_in(world, **options)
        for _ in range(GRABS):
            world.scene += 1
            grab = camera.grab()
            assert grab.image.shape == (HEIGHT_PX, WIDTH_PX, 3)
            assert grab.image.dtype == np.uint8
            assert scene_of(grab.image) == world.scene
            images.append(grab.image)
            times_s.append(grab.time_s)
            outcomes.append("picture")
    except DeviceError as error:
        line = str(error)
        assert line.startswith("camera opencv (device 0): ")
        assert "\n" not in line
        outcomes.append("error")
    finally:
        world.free.set()
        if camera is not None:
            camera.close()
    assert all(before < after for before, after in pairwise(times_s))
    assert not any(np.array_equal(*pair) for pair in pairwise(images))
    return outcomes


@pytest.mark.slow  # each fault has a test above
def test_random_faults_end_in_a_right_picture_or_a_clear_error() -> None:
    outcomes = [_outcomes(seed) for seed in range(SEQUENCES)]
    errors = sum(each[-1] == "error" for each in outcomes)
    pictures = sum(each.count("picture") for each in outcomes)
    # Neither a camera that always fails nor one without faults would test anything.
    assert SEQUENCES // 10 < errors < SEQUENCES * 9 // 10
    assert pictures > SEQUENCES
