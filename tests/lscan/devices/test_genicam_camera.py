"""The genicam driver on the cameras that viva-genicam itself emulates, GigE and USB3 Vision."""

import logging
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import call
from device_contract import CameraContract
from fake_devices import FakeTrack

import lscan.devices.genicam
from lscan.acquisition.scan import acquire_into
from lscan.acquisition.writer import create_run
from lscan.config.rig import CameraSection, parse_rig
from lscan.devices.genicam import (
    GenicamCamera,
    GenicamOptions,
    camera_driver,
    connect,
    found_cameras,
)
from lscan.errors import DeviceError, InputError

viva_genicam = pytest.importorskip("viva_genicam", reason="it has no wheel for this machine")
from viva_genicam.testing import FakeGigeCamera, FakeU3vCamera  # noqa: E402 - once it is there

# GigE Vision searches on one port, which one camera of a machine can have.
pytestmark = pytest.mark.xdist_group("genicam")

SIZE_PX = (64, 48)
PACKED = {8: "Mono8", 10: "Mono10p", 12: "Mono12p"}


def section(bits: int = 8, size_px: tuple[int, int] = SIZE_PX, **values: Any) -> CameraSection:
    width, height = size_px
    return CameraSection(driver="genicam", width_px=width, height_px=height, bits=bits, **values)


class Bench:
    """Emulated GigE cameras and what was opened of them, all closed at the end."""

    def __init__(self) -> None:
        self.stack = ExitStack()

    def gige(
        self,
        fake: dict[str, Any] | None = None,
        *,
        bits: int = 8,
        size_px: tuple[int, int] = SIZE_PX,
        exposure_ms: float = 20.0,
        **options: Any,
    ) -> GenicamCamera:
        """A camera on the loopback address; fake: what the emulated one is made with."""
        made = {"width": 64, "height": 48, "fps": 100, "pixel_format": PACKED[bits], **(fake or {})}
        self.fake = self.stack.enter_context(FakeGigeCamera(**made))
        known = {"address": "127.0.0.1", "timeout_s": 2.0, **options}
        camera = GenicamCamera(
            section(bits, size_px, exposure_ms=exposure_ms), GenicamOptions(**known)
        )
        self.stack.callback(camera.close)
        return camera


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setattr(lscan.devices.genicam, "SEARCH_MS", 100)  # it is always waited for
    bench = Bench()
    with bench.stack:
        yield bench


class TestGige(CameraContract):
    size_px = SIZE_PX
    name = "camera genicam"

    @pytest.fixture
    def camera(self, bench: Bench) -> GenicamCamera:
        return bench.gige()


class TestDeepGigeWithLostPackets(CameraContract):
    """Twelve bits; every twentieth packet is not sent, and sent again only where it is asked for.

    A picture of 64 by 48 px in twelve bits, packed, is a leader, four packets and a trailer.
    """

    size_px = SIZE_PX
    bits = 12
    name = "camera genicam"

    @pytest.fixture(params=[True, False])
    def camera(self, bench: Bench, request: pytest.FixtureRequest) -> GenicamCamera:
        drops = [(block, 1 + block % 4) for block in range(2, 400, 4)]
        lossy = {"packet_resend": request.param, "drop_packets": drops}
        return bench.gige(lossy, bits=12, timeout_s=5.0)


class TestUsb3(CameraContract):
    size_px = SIZE_PX
    bits = 12
    name = "camera genicam"

    @pytest.fixture
    def camera(self) -> Iterator[GenicamCamera]:
        camera = usb_camera(trigger="off", flush_frames=1)
        yield camera
        camera.close()


def usb_camera(bits: int = 12, **options: Any) -> GenicamCamera:
    fake = FakeU3vCamera(*SIZE_PX, PACKED[bits])
    return GenicamCamera(
        section(bits), GenicamOptions(serial="1", **options), lambda _: fake.connect()
    )


def test_every_picture_is_asked_for(bench: Bench) -> None:
    """The emulated camera counts the triggers that reached it, and the pictures it sent."""
    camera = bench.gige()
    for count in range(1, 6):
        camera.grab()
        assert bench.fake.software_triggers() == bench.fake.blocks_sent() == count


def test_no_picture_that_lost_packets_is_taken(bench: Bench, caplog: Any) -> None:
    """Without packets sent again, two of the first five blocks are short: seven for five."""
    lossy = {"packet_resend": False, "drop_packets": [(2, 1), (4, 1)]}
    camera = bench.gige(lossy)
    assert all((camera.grab().image[-8:] != 0).any() for _ in range(5))
    assert bench.fake.blocks_sent() == 7
    with caplog.at_level(logging.WARNING):
        camera.close()
    assert "2 pictures that lost packets were taken again" in caplog.text


def test_packets_that_are_sent_again_are_counted(bench: Bench, caplog: Any) -> None:
    camera = bench.gige({"drop_packets": [(2, 1), (3, 1)]})
    for _ in range(4):
        camera.grab()
    assert bench.fake.blocks_sent() == 4
    with caplog.at_level(logging.WARNING):
        camera.close()
    assert "0 pictures that lost packets were taken again; 2 packets were sent again" in caplog.text


def test_a_camera_that_always_loses_packets_is_given_up(bench: Bench) -> None:
    lossy = {"packet_resend": False, "drop_packets": [(block, 1) for block in range(1, 9)]}
    camera = bench.gige(lossy, retries=2)
    with pytest.raises(DeviceError, match="a picture lost 1 of its packets, 3 times in a row"):
        camera.grab()


def test_what_is_set_is_read_back_and_stands_in_each_picture(bench: Bench) -> None:
    camera = bench.gige(
        {"width": 128, "height": 96},
        exposure_ms=12.5,
        offset_px=(16, 8),
        gain=3.0,
        features={"BlackLevel": 4, "AcquisitionFrameRateEnable": True},
    )
    grab = camera.grab()
    assert grab.exposure_ms == 12.5 and grab.image.shape == (48, 64)
    assert camera.set_exposure(40.0) == 40.0
    assert camera.grab().exposure_ms == 40.0
    assert camera.identity == "vitavision.dev VivaCam Fake VIVA-FAKE-001"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"pixel_format": "Mono99"}, "PixelFormat has no entry named Mono99"),
        ({"features": {"Nope": 1}}, "node not found: Nope"),
        ({"exposure_ms": 60_000.0}, "is above the maximum"),
        ({"address": "10.9.8.7"}, "no such camera answers; others: 127.0.0.1"),
        ({"size_px": (8000, 48)}, "8000"),
        ({"trigger": "Line9"}, "Line9"),
    ],
)
def test_what_the_camera_does_not_take_is_said(
    bench: Bench, options: dict[str, Any], said: str
) -> None:
    with pytest.raises(DeviceError, match=rf"camera genicam \([0-9.]+\): .*{said}"):
        bench.gige(**options)


def test_another_depth_than_the_rig_says_names_the_formats_there_are(bench: Bench) -> None:
    with pytest.raises(DeviceError, match=r"camera.bits = 12.* it is Mono8; .* Mono8, Mono16"):
        bench.gige({"pixel_format": "Mono8"}, bits=12).grab()


def test_twelve_bits_that_are_more_are_refused(bench: Bench) -> None:
    """Unpacked, the emulated camera fills all 16 bits of what it calls Mono12."""
    with pytest.raises(DeviceError, match=r"Mono12: has too large a grey value .* of 12 bits"):
        bench.gige({"pixel_format": "Mono12"}, bits=12).grab()


def test_a_camera_that_is_gone_is_said(bench: Bench) -> None:
    camera = bench.gige(timeout_s=0.3, retries=0)
    camera.grab()
    bench.fake.stop()
    with pytest.raises(DeviceError, match=r"camera genicam \(127"):
        camera.grab()


def test_a_trigger_that_does_not_come_is_said(bench: Bench) -> None:
    camera = bench.gige(trigger="Line1", timeout_s=0.2, retries=1)
    with pytest.raises(DeviceError, match=r"no picture within 0\.2 s, 2 times in a row.*trigger"):
        camera.grab()


def test_a_camera_that_answers_late_is_waited_for(bench: Bench) -> None:
    """A third of a second to acknowledge its exposure time, longer than a command is repeated."""
    camera = bench.gige({"delay_ack": {FakeGigeCamera.REGISTERS["ExposureTime"]: 0.35}})
    assert camera.set_exposure(30.0) == 30.0
    assert camera.grab().exposure_ms == 30.0
    assert bench.fake.software_triggers() == bench.fake.blocks_sent() == 1


def test_a_scan_of_twelve_bits_loses_no_frame(bench: Bench, tmp_path: Path) -> None:
    """Every frame differs from the one before, as the emulated camera's pattern moves."""
    lossy = {"packet_resend": False, "drop_packets": [(block, 2) for block in range(3, 60, 3)]}
    camera, track = bench.gige(lossy, bits=12), FakeTrack()
    rig = {
        "camera": section(12).model_dump(), "track": {"driver": "manual"}, "plan": {"frames": 8}
    }  # fmt: skip
    with create_run(tmp_path / "run", parse_rig(rig, source="rig.toml", trusted=True)) as writer:
        run = acquire_into(writer, camera, track)
    images = [frame.image for frame in run.frames()]
    assert len(images) == 8 and all(image.dtype == np.uint16 for image in images)
    assert all((one != other).any() for one, other in pairwise(images))
    assert all(image[-1].any() for image in images)  # what is lost is zero


def test_a_camera_without_exposure_has_the_rig_s() -> None:
    camera = usb_camera(trigger="off")
    assert camera.grab().exposure_ms == 20.0
    camera.close()
    with pytest.raises(DeviceError, match="has no trigger source"):
        usb_camera()


@pytest.mark.parametrize("options", [{}, {"address": "10.0.0.1", "serial": "3"}])
def test_one_camera_is_named(options: dict[str, str]) -> None:
    rig = {"camera": {"driver": "genicam", "options": options}, "track": {"driver": "manual"}}
    with pytest.raises(InputError, match="needs exactly one of address and serial"):
        camera_driver.validate(parse_rig(rig, source="rig.toml", trusted=True))


def test_twelve_bits_are_the_uppermost_of_sixteen(bench: Bench) -> None:
    image = bench.gige(bits=12).grab().image
    assert not (image % 16).any()
    assert len(np.unique(image)) > 256 and image.max() > 240 * 256


def test_cameras_that_answer_are_listed(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The emulated one answers on the loopback address alone, which a search leaves out."""
    bench.gige()
    search = partial(viva_genicam.discover, all=True)
    monkeypatch.setattr(viva_genicam, "discover", search)
    assert found_cameras() == {"127.0.0.1": "viva-genicam FakeGigE"}
    code, out, _ = call(capsys, "devices")
    assert code == 0 and "127.0.0.1" in out and "viva-genicam FakeGigE" in out


def test_without_viva_genicam_a_line_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "viva_genicam", None)
    assert found_cameras() is None
    with pytest.raises(DeviceError, match=r"viva-genicam is missing .*pip install 'lscan\[genicam"):
        connect(GenicamOptions(address="10.0.0.1"))
