"""A camera closed while another thread waits for its picture: the wait ends at once."""

import threading
import time
from collections.abc import Callable

import pytest
from device_contract import PATIENCE_S
from fake_capture import HEIGHT_PX, WIDTH_PX, World

from lscan.config.rig import CameraSection
from lscan.devices.opencv_camera import OpencvCamera, OpencvOptions
from lscan.errors import DeviceError

FOREVER_S = 600.0
"""The longest timeout a rig may ask for: no test waits for it to pass."""


def fake_camera(world: World, **options: float) -> OpencvCamera:
    section = CameraSection(driver="opencv", width_px=WIDTH_PX, height_px=HEIGHT_PX)
    quick = {"device": 0, "warm_up_frames": 1, "timeout_s": FOREVER_S, **options}
    return OpencvCamera(section, OpencvOptions(**quick), world.open)


def error_of(call: Callable[[], object], meanwhile: Callable[[], object]) -> str:
    """What ``call`` raises, in a thread of its own, while ``meanwhile`` runs; "" for nothing."""
    said: list[str] = []

    def run() -> None:
        try:
            call()
            said.append("")
        except DeviceError as error:
            said.append(str(error))

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    meanwhile()
    thread.join(PATIENCE_S)
    assert not thread.is_alive(), "still waits"
    return said[0]


@pytest.mark.parametrize("call", ["grab", "preview"])
def test_waiting_for_a_hung_camera_ends_when_it_is_closed(call: str) -> None:
    world = World(faults=dict.fromkeys(range(3, 100), "hang"))
    camera = fake_camera(world)
    while world.reads <= 3:  # it hangs from the fourth picture on
        time.sleep(0.001)
    camera.preview()

    def close() -> None:
        closing = threading.Thread(target=camera.close)  # itself waits for the hung capture
        closing.start()
        time.sleep(0.05)
        assert closing.is_alive()
        closers.append(closing)

    closers: list[threading.Thread] = []
    line = error_of(getattr(camera, call), close)
    assert "camera opencv (device 0)" in line
    assert "is closed" in line
    world.free.set()
    closers[0].join(PATIENCE_S)
    assert world.released == world.opened == 1


def test_a_camera_closed_while_it_is_opened_anew_is_not_opened_again() -> None:
    """Between the attempts of a grab whose camera was unplugged lies a wait of ten minutes."""
    world = World(faults=dict.fromkeys(range(2, 100), "gone"))
    camera = fake_camera(world, retries=0, reconnects=5, reconnect_wait_s=FOREVER_S)

    def close() -> None:
        time.sleep(0.05)  # until the grab has found it gone
        camera.close()

    assert error_of(camera.grab, close).endswith("is closed")
    assert world.released == world.opened == 1
