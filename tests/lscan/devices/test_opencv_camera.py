"""The opencv driver: options, settings read back, fresh pictures, files and streams."""

import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from device_contract import CameraContract
from drawn_examples import examples
from fake_capture import HEIGHT_PX, WIDTH_PX, World, scene_of
from hypothesis import given, strategies as st

from lscan.acquisition.scan import scan
from lscan.config.rig import CameraSection, parse_rig
from lscan.devices.api import Previewing
from lscan.devices.opencv_camera import OpencvCamera, OpencvOptions, Setting, camera_driver
from lscan.devices.opencv_camera.options import fourcc_text
from lscan.errors import DeviceError, InputError
from lscan.records import Bytes

VIDEO_PX = (64, 48)
FRAMES = 12


def section(width_px: int = WIDTH_PX, height_px: int = HEIGHT_PX, **values: Any) -> CameraSection:
    return CameraSection(driver="opencv", width_px=width_px, height_px=height_px, **values)


def fake_camera(world: World, exposure_ms: float = 20.0, **options: Any) -> OpencvCamera:
    quick = {"device": 0, "warm_up_frames": 1, "reconnect_wait_s": 0.0, **options}
    return OpencvCamera(section(exposure_ms=exposure_ms), OpencvOptions(**quick), world.open)


def video_pictures() -> list[Bytes]:
    """RGB pictures, no two alike."""
    generator = np.random.default_rng(8)
    shape = (VIDEO_PX[1], VIDEO_PX[0], 3)
    return [generator.integers(0, 256, shape, dtype=np.uint8) for _ in range(FRAMES)]


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A lossless video of :func:`video_pictures`."""
    path = tmp_path_factory.mktemp("video") / "a.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), 10, VIDEO_PX)
    assert writer.isOpened()
    for picture in video_pictures():
        writer.write(np.ascontiguousarray(picture[..., ::-1]))
    writer.release()
    return path


class _MjpegHandler(BaseHTTPRequestHandler):
    """Sends noisy JPEG pictures without end, 100 a second."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        generator = np.random.default_rng(3)
        try:
            while True:
                size = (VIDEO_PX[1], VIDEO_PX[0], 3)
                image = generator.integers(0, 256, size, dtype=np.uint8)
                data = cv2.imencode(".jpg", image)[1].tobytes()
                head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                self.wfile.write(head.encode() + data + b"\r\n")
                time.sleep(0.01)
        except OSError:
            pass  # the reader has gone

    def log_message(self, format: str, *args: Any) -> None:
        pass


@pytest.fixture(scope="module")
def stream_url() -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), _MjpegHandler)
    server.daemon_threads = True
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}/stream.mjpg"
    server.shutdown()
    server.server_close()


# ---- the contract -----------------------------------------------------------------------


class TestVideoFile(CameraContract):
    size_px = VIDEO_PX
    name = "camera opencv"
    live = False

    @pytest.fixture
    def camera(self, video: Path) -> Iterator[OpencvCamera]:
        camera = OpencvCamera(section(*VIDEO_PX), OpencvOptions(file=str(video)))
        yield camera
        camera.close()


class TestStream(CameraContract):
    size_px = VIDEO_PX
    name = "camera opencv"

    @pytest.fixture
    def camera(self, stream_url: str) -> Iterator[OpencvCamera]:
        camera = OpencvCamera(section(*VIDEO_PX), OpencvOptions(url=stream_url, timeout_s=120))
        yield camera
        camera.close()


class TestDevice(CameraContract):
    size_px = (WIDTH_PX, HEIGHT_PX)
    name = "camera opencv"

    @pytest.fixture
    def camera(self) -> Iterator[OpencvCamera]:
        camera = fake_camera(World())
        yield camera
        camera.close()


class TestDeepDevice(CameraContract):
    size_px = (WIDTH_PX, HEIGHT_PX)
    name = "camera opencv"
    bits = 12

    @pytest.fixture
    def camera(self) -> Iterator[OpencvCamera]:
        camera = deep_camera(World(bits=12, grey=True))
        yield camera
        camera.close()


def deep_camera(world: World, bits: int = 12, **options: Any) -> OpencvCamera:
    quick = {"device": 0, "warm_up_frames": 1, "reconnect_wait_s": 0.0, **options}
    return OpencvCamera(section(bits=bits), OpencvOptions(**quick), world.open)


def test_a_deep_picture_has_its_camera_s_bits_uppermost() -> None:
    camera = deep_camera(World(scene=77, bits=12, grey=True), black="accept")
    image = camera.grab().image
    assert (image[:4, :4] // 256 == 77).all() and (image % 16 == 0).all()
    assert len(np.unique(image[:4, :4])) > 4  # the bits beneath are kept
    camera.close()


def test_pictures_averaged_are_finer_than_the_camera_s_steps() -> None:
    camera = deep_camera(World(bits=12, grey=True), average_frames=4)
    assert (camera.grab().image % 16 != 0).any()
    camera.close()


@pytest.mark.parametrize(
    ("sent", "stated", "said"),
    [
        (8, 12, "uint8 of shape .* allowed: uint16 for camera.bits = 12"),
        (12, 10, "too large a grey value .*allowed: 1023 at most, of 10 bits"),
    ],
)
def test_a_camera_of_other_bits_than_stated_is_refused(sent: int, stated: int, said: str) -> None:
    with pytest.raises(DeviceError, match=said):
        deep_camera(World(scene=200, bits=sent, grey=True), stated).grab()


# ---- fresh pictures ---------------------------------------------------------------------


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_a_picture_shows_the_scene_after_the_call(delay: int) -> None:
    world = World(delay=delay)
    camera = fake_camera(world, flush_frames=delay + 1)
    for scene in range(2, 12):
        world.scene = scene
        assert scene_of(camera.grab().image) == scene
    camera.close()


def test_without_flushing_an_old_picture_would_pass() -> None:
    """The test above can fail: a delay of 5 pictures and none dropped shows the old scene."""
    world = World(delay=5, period_s=0.02)
    camera = fake_camera(world, flush_frames=0)
    world.scene = 2
    assert scene_of(camera.grab().image) == 1
    camera.close()


def test_flush_ms_waits_for_what_is_under_way() -> None:
    world = World(delay=5, period_s=0.002)
    camera = fake_camera(world, flush_frames=0, flush_ms=1000)
    world.scene = 2
    began_s = time.monotonic()
    grab = camera.grab()
    assert scene_of(grab.image) == 2
    assert grab.time_s >= began_s + 1.0
    camera.close()


def test_a_camera_that_stamps_its_pictures_is_believed() -> None:
    """Five pictures under way and none dropped by count: their stamps give them away."""
    world = World(delay=5, stamps=True)
    camera = fake_camera(world, flush_frames=0)
    for scene in range(2, 12):
        world.scene = scene
        began_s = time.monotonic()
        grab = camera.grab()
        assert scene_of(grab.image) == scene
        assert grab.time_s > began_s
    camera.close()


def test_the_first_pictures_are_dropped() -> None:
    world = World(faults=dict.fromkeys(range(6), "black"))
    camera = fake_camera(world, warm_up_frames=6, retries=0)
    assert scene_of(camera.grab().image) == 1
    camera.close()


def test_an_average_is_the_rounded_mean(video: Path) -> None:
    """Closed form: four known pictures; a lossless file gives them back to the byte."""
    camera = OpencvCamera(section(*VIDEO_PX), OpencvOptions(file=str(video), average_frames=4))
    pictures = np.array(video_pictures(), dtype=float)
    for first in (0, 4, 8):
        expected = np.rint(pictures[first : first + 4].mean(axis=0))
        np.testing.assert_array_equal(camera.grab().image, expected)
    with pytest.raises(DeviceError, match=r"a\.avi.*no more pictures than 12"):
        camera.grab()
    camera.close()


def test_a_frame_of_the_scan_names_the_picture_of_a_file(video: Path) -> None:
    """Forwards, backwards and twice: a resumed scan gets what it would have got."""
    camera = OpencvCamera(section(*VIDEO_PX), OpencvOptions(file=str(video)))
    pictures = video_pictures()
    for frame in (0, 1, 5, 5, 2, 11, 0):
        np.testing.assert_array_equal(camera.grab(frame).image, pictures[frame])
    camera.close()


def test_a_picture_of_a_file_is_stamped_when_it_is_asked_for(video: Path) -> None:
    """The first is read when the file is opened, maybe long before a trial of the track is over."""
    camera = OpencvCamera(section(*VIDEO_PX), OpencvOptions(file=str(video)))
    for _ in range(3):
        asked_s = time.monotonic()
        assert camera.grab().time_s >= asked_s
    camera.close()


def test_grey_pictures_stay_grey() -> None:
    camera = fake_camera(World(grey=True))
    assert camera.grab().image.shape == (HEIGHT_PX, WIDTH_PX)
    camera.close()


def test_closing_releases_the_capture() -> None:
    world = World()
    camera = fake_camera(world)
    camera.close()
    assert world.released == 1


# ---- settings ---------------------------------------------------------------------------

ASKED = {
    "pixel_format": "MJPG",
    "fps": 30.0,
    "gain": 5.0,
    "focus": 40.0,
    "white_balance": 4600.0,
}


def test_an_obedient_camera_reports_all_it_was_asked() -> None:
    camera = fake_camera(World(), exposure_ms=12.5, **ASKED)
    asked = {setting.name: setting.asked for setting in camera.settings}
    assert all(setting.obeyed for setting in camera.settings)
    assert asked.items() >= {**ASKED, "exposure_ms": 12.5, "width_px": WIDTH_PX}.items()
    assert camera.grab().exposure_ms == 12.5
    camera.close()


def test_a_camera_that_ignores_a_setting_is_reported(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lscan.devices.opencv_camera.options.AGAIN_WAIT_S", 0.0)

    def keeps_exposure(property_id: int, value: float) -> float:
        return 156.0 if property_id == cv2.CAP_PROP_EXPOSURE else value

    camera = fake_camera(World(obeys=keeps_exposure))
    assert [setting for setting in camera.settings if not setting.obeyed] == [
        Setting("exposure_ms", 20.0, 15.6)
    ]
    assert "exposure_ms: asked 20.0, got 15.6" in caplog.text
    assert camera.grab().exposure_ms == 15.6  # what the camera says, not what was asked
    camera.close()


@pytest.mark.parametrize("refusals", [1, 4])
def test_a_value_refused_while_an_automatic_ends_is_set_again(
    refusals: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lscan.devices.opencv_camera.options.AGAIN_WAIT_S", 0.0)
    held = {cv2.CAP_PROP_FOCUS: 250.0, cv2.CAP_PROP_WB_TEMPERATURE: 6500.0}
    tries: dict[int, int] = {}

    def refuses_first(key: int, value: float) -> float:
        tries[key] = tries.get(key, 0) + 1
        return held[key] if key in held and tries[key] <= refusals else value

    camera = fake_camera(World(obeys=refuses_first), strict_settings=True, **ASKED)
    assert {each.name: each.got for each in camera.settings}.items() >= ASKED.items()
    assert tries[cv2.CAP_PROP_FRAME_WIDTH] == 1  # a size set again would begin the stream anew
    camera.close()


@pytest.mark.parametrize("name", [*ASKED, "exposure_ms"])
def test_strict_settings_refuse_it_by_name(name: str) -> None:
    ids = {
        "pixel_format": cv2.CAP_PROP_FOURCC,
        "fps": cv2.CAP_PROP_FPS,
        "gain": cv2.CAP_PROP_GAIN,
        "focus": cv2.CAP_PROP_FOCUS,
        "white_balance": cv2.CAP_PROP_WB_TEMPERATURE,
        "exposure_ms": cv2.CAP_PROP_EXPOSURE,
    }
    world = World(obeys=lambda key, value: -1.0 if key == ids[name] else value)
    with pytest.raises(DeviceError, match=rf"device 0.*{name}: asked .*, got nothing"):
        fake_camera(world, strict_settings=True, **ASKED)
    assert world.released == 1


@examples(100)
@given(asked=st.floats(0, 1e6), got=st.floats(0, 1e6))
def test_a_number_is_obeyed_within_one_per_cent(asked: float, got: float) -> None:
    assert Setting("gain", asked, got).obeyed == (abs(got - asked) <= 0.01 * asked)
    assert Setting("gain", asked, asked).obeyed
    assert not Setting("gain", asked, None).obeyed


@examples(50)
@given(letters=st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=4, max_size=4))
def test_a_pixel_format_is_read_back_as_it_was_written(letters: str) -> None:
    assert fourcc_text(float(cv2.VideoWriter.fourcc(*letters))) == letters


def test_exposure_can_be_changed_and_is_read_back() -> None:
    world = World()
    camera = fake_camera(world)
    assert camera.can_set_exposure
    assert camera.set_exposure(5.0) == 5.0
    assert camera.grab().exposure_ms == 5.0
    camera.close()


def test_automatic_exposure_is_left_alone() -> None:
    camera = fake_camera(World(), auto_exposure=True)
    names = [setting.name for setting in camera.settings]
    assert "exposure_ms" not in names
    assert not camera.can_set_exposure
    with pytest.raises(DeviceError, match="cannot be set"):
        camera.set_exposure(5.0)
    camera.close()


# ---- options ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "exactly one of device, url and file"),
        ({"device": 0, "url": "http://a/b"}, "exactly one of device, url and file"),
        ({"device": ""}, "camera.options.device"),
        ({"url": "a.avi"}, "camera.options.url"),
        ({"url": "file:///etc/passwd"}, "camera.options.url"),
        ({"file": "missing.avi"}, "camera.options.file: no such file"),
        ({"url": "http://a/b", "gain": 3}, "gain can only be set on a device"),
        ({"device": 0, "pixel_format": "MJPEG"}, "camera.options.pixel_format"),
        ({"device": 0, "flush_frames": -1}, "camera.options.flush_frames"),
        ({"device": 0, "timeout_s": float("inf")}, "camera.options.timeout_s"),
        ({"device": 0, "black_dn": 255}, "camera.options.black_dn"),
        ({"device": 0, "exposure": 5}, "camera.options.exposure: unknown key"),
    ],
)
def test_a_wrong_option_is_refused_before_a_device_is_touched(
    options: dict[str, Any], message: str
) -> None:
    document = {"camera": {"driver": "opencv", "options": options}, "track": {"driver": "replay"}}
    rig_file = parse_rig(document, source="rig.toml", trusted=True)
    with pytest.raises(InputError) as caught:
        camera_driver.validate(rig_file)
    assert message in str(caught.value)
    assert "rig.toml" in str(caught.value)


# ---- a scan -----------------------------------------------------------------------------


class _StandingTrack:
    """A track that is where it is sent."""

    position_mm = 0.0
    sections: frozenset[str] = frozenset()
    moves_left = 10**6

    def open(self, rig_file: object) -> "_StandingTrack":
        return self

    def move_to(self, position_mm: float) -> float:
        self.moves_left -= 1
        if self.moves_left < 0:
            raise DeviceError("track: pulled out")
        self.position_mm = position_mm
        return position_mm

    def close(self) -> None:
        pass


def test_a_stopped_scan_of_a_file_resumes_with_the_same_pictures(
    video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    track = _StandingTrack()
    drivers = {"lscan.tracks": track, "lscan.cameras": camera_driver}
    monkeypatch.setattr("lscan.config.rig.find_plugin", lambda group, name, where: drivers[group])
    camera = {"driver": "opencv", "options": {"file": str(video), "average_frames": 2}}
    size = {"width_px": VIDEO_PX[0], "height_px": VIDEO_PX[1]}
    document = {
        "camera": {**camera, **size},
        "track": {"driver": "standing"},
        "plan": {"frames": 6},
    }
    rig_file = parse_rig(document, source="rig.toml", trusted=True)
    whole = scan(rig_file, tmp_path / "whole")
    track.moves_left = 3
    with pytest.raises(DeviceError, match="pulled out"):
        scan(rig_file, tmp_path / "stopped")
    track.moves_left = 10**6
    resumed = scan(rig_file, tmp_path / "stopped", resume=True)
    assert [row.sha256 for row in resumed.rows] == [row.sha256 for row in whole.rows]


# ---- previews ---------------------------------------------------------------------------


def test_a_preview_is_the_newest_picture_and_waits_for_no_flush():
    world = World(delay=0, period_s=0.02)
    camera = fake_camera(world, flush_frames=100)
    assert isinstance(camera, Previewing)
    world.scene = 2
    shown = [camera.preview() for _ in range(3)]
    assert len({picture.time_s for picture in shown}) == 3
    assert scene_of(shown[-1].image) == 2
    assert world.reads < 100
    camera.close()
    with pytest.raises(DeviceError, match="is closed"):
        camera.preview()


def test_previews_between_grabs_leave_the_grabs_fresh():
    """Two pictures are under way in the camera, and one may just be handed over at the call:
    without the flush a grab would see the old."""
    world = World(delay=2)
    camera = fake_camera(world, flush_frames=3)
    times = []
    for scene in range(1, 21):
        camera.preview()
        world.scene = scene
        grab = camera.grab()
        assert scene_of(grab.image) == scene
        times.append(grab.time_s)
        camera.preview()
    assert times == sorted(set(times))
    camera.close()


def test_previews_from_another_thread_take_no_picture_away() -> None:
    """Every picture of the grabs is fresh, whatever the other thread looks at meanwhile."""
    world, stop = World(delay=2), threading.Event()
    camera = fake_camera(world, flush_frames=3)
    shown: list[float] = []

    def look() -> None:
        while not stop.is_set():
            shown.append(camera.preview().time_s)

    viewer = threading.Thread(target=look)
    viewer.start()
    try:
        for scene in range(1, 31):
            world.scene = scene
            assert scene_of(camera.grab().image) == scene
    finally:
        stop.set()
        viewer.join(120)
        camera.close()
    assert shown == sorted(set(shown))


def test_a_file_is_shown_as_it_stands_and_no_picture_of_it_is_lost(video: Path) -> None:
    camera = OpencvCamera(section(*VIDEO_PX), OpencvOptions(file=str(video)))
    for index, picture in enumerate(video_pictures()):
        camera.preview()
        np.testing.assert_array_equal(camera.grab(index).image, picture)
        camera.preview()
    camera.close()


def test_a_black_preview_is_shown_and_a_black_grab_refused():
    world = World(faults=dict.fromkeys(range(2, 10_000), "black"))
    camera = fake_camera(world)
    assert any(not camera.preview().image.any() for _ in range(3))
    with pytest.raises(DeviceError, match="black picture"):
        camera.grab()
    camera.close()
