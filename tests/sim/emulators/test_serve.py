"""The tank as hardware: pictures true to the head, clients apart, everything closed at the end."""

import os
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helper_spies import calls_made
from served import Viewer, hurry, quick_rig, small_scene, snapshot, stalled, threads_of_hardware

from lscan.acquisition.scan import open_devices, scan
from lscan.config.documents import check
from lscan.config.rig import load_rig, parse_rig
from lscan.errors import InputError
from lscan.records import Bytes, Floats
from sim.devices import SimCamera, SimTrack, TrackOptions
from sim.emulators import EmulatedHardware, ServeOptions
from sim.emulators.webcam import SNAPSHOT_S, Shot, _Client
from sim.scene import Scene
from sim.sensor.webcam import from_jpeg, jpeg_bytes

pytestmark = pytest.mark.xdist_group("serve")  # one worker: they share a fixture

PATIENCE_S = 120.0
FPS = 100.0  # no test waits long for pictures this small


@pytest.fixture(scope="module")
def scene() -> Scene:
    return small_scene()


@pytest.fixture(scope="module")
def hardware(scene: Scene) -> Iterator[EmulatedHardware]:
    with EmulatedHardware(scene, ServeOptions(prepare=True, fps=FPS)) as hardware:
        hurry(hardware)
        yield hardware


def references(
    scene: Scene, places_mm: list[float], pictures: int = 2
) -> dict[float, list[Floats]]:
    """Pictures of the sim camera from each place, with different noise."""
    track = SimTrack(TrackOptions())
    camera = SimCamera(scene, track)
    found = {}
    for place_mm in places_mm:
        track.move_to(place_mm)
        found[place_mm] = [camera.grab().image.astype(float) for _ in range(pictures)]
    return found


def nearest(image: Bytes, seen: dict[float, list[Floats]]) -> float:
    """The place whose picture is most like this one."""
    return min(seen, key=lambda place: rms(image - seen[place][0]))


def rms(difference: Floats) -> float:
    return float(np.sqrt(np.mean(difference**2)))


# ---- the same scan ----------------------------------------------------------------------


def test_a_scan_by_the_real_drivers_is_the_simulated_one_within_jpeg_and_noise(
    scene: Scene, hardware: EmulatedHardware, tmp_path: Path
) -> None:
    """|J(a') - a| <= |J(a') - a'| + |a' - a|, J: the coding, a and a': one view, other noise.

    Both terms are measured on the sim camera's pictures: over 57,600 numbers an rms is known
    to 1/sqrt(2 * 57600) = 0.3 %, six of which are allowed.
    """
    run = scan(quick_rig(hardware), tmp_path / "run")
    plan = scene.rig.plan.positions_mm()
    seen = references(scene, plan, pictures=3)
    assert [frame.commanded_mm for frame in run.frames()] == plan
    for frame in run.frames():
        one, other, third = seen[frame.commanded_mm]
        coded = from_jpeg(jpeg_bytes(third.astype(np.uint8), 95, "4:4:4"))
        allowed = rms(coded - third) + rms(other - one)
        assert abs(frame.position_mm - frame.commanded_mm) <= 0.002  # half a motor step of 4 um
        assert rms(frame.image - one) <= 1.018 * allowed
        assert nearest(frame.image, seen) == frame.commanded_mm


# ---- pictures after a move --------------------------------------------------------------


def test_after_a_move_the_driver_gives_the_new_place(
    scene: Scene, hardware: EmulatedHardware
) -> None:
    """Whatever is handed out while the head rests is true, so only what was on its way when
    the head came to rest can be old: with one picture dropped, none is."""
    places = [20.0, 95.0]
    seen = references(scene, places)
    rig_file = quick_rig(hardware, {"flush_frames": 1}, settle_s=0.0, approach_mm=0.0)
    with open_devices(rig_file) as (camera, track):
        for move in range(6):
            place = places[move % 2]
            track.move_to(place)
            assert nearest(camera.grab().image, seen) == place


def test_every_picture_sent_while_the_head_rests_shows_where_it_rests(scene: Scene) -> None:
    """At the server itself, without any flushing: also of places that must be rendered first."""
    places = [20.0, 95.0, 45.0, 95.0, 20.0]
    seen = references(scene, sorted(set(places)))
    with EmulatedHardware(scene) as hardware:
        hurry(hardware)
        rig_file = quick_rig(hardware, settle_s=0.0)
        with open_devices(rig_file) as (_, track), hardware._camera.watched():
            for place in places:
                track.move_to(place)
                shot = hardware._camera.newest(0, PATIENCE_S)
                assert shot is not None
                assert nearest(from_jpeg(shot.jpeg), seen) == place


@pytest.mark.slow
def test_a_long_move_is_seen_as_it_goes_on(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of the second half of a way of two seconds are those of the place that the head was
    passing, within coding and noise, as in the first test; no other place is handed out.  Another
    process takes pictures too, once it is ready."""
    helpers, made = [], calls_made(monkeypatch)

    @contextmanager
    def sharing() -> Iterator[list[dict[str, str]]]:
        yield [{"LSCAN_THREADS": "2"}]

    monkeypatch.setattr("sim.emulators.webcam.sharing", sharing)
    with EmulatedHardware(scene) as hardware:
        hurry(hardware)
        rig_file = quick_rig(hardware, feed_mm_min=2250.0, settle_s=0.0, approach_mm=0.0)
        with open_devices(rig_file) as (_, track), hardware._camera.watched():
            for place in (20.0, 95.0) * 15:
                track.move_to(place)  # until the other process is ready
                if made:
                    break
            track.move_to(20.0)
            helpers += hardware._camera._helpers or ()
            made.clear()
            before = hardware._camera.count + 1  # one may be on its way
            mover = threading.Thread(target=track.move_to, args=(95.0,))
            mover.start()
            shots: list[Shot] = []
            while mover.is_alive():
                shot = hardware._camera.newest(shots[-1].number if shots else before, 0.1)
                if shot is not None and shot.head.position_mm is None:
                    shots.append(shot)
            mover.join()
    assert len(helpers) == 1 and len(made) > 2
    for helper in helpers:
        with pytest.raises(ProcessLookupError):
            os.kill(helper._process.pid, 0)
    taken = [shot.head.now_mm for shot in shots]
    assert taken == sorted(taken)
    late = [shot for shot in shots if shot.head.now_mm > 60.0]
    assert len(late) >= 2
    for shot in late[::5]:
        [(one, other, third)] = references(scene, [shot.head.now_mm], pictures=3).values()
        coded = from_jpeg(jpeg_bytes(third.astype(np.uint8), 95, "4:4:4"))
        allowed = rms(coded - third) + rms(other - one)
        assert rms(from_jpeg(shot.jpeg) - one) <= 1.018 * allowed


def test_a_picture_that_was_begun_before_the_one_shown_is_dropped(scene: Scene) -> None:
    """Processes that render side by side need not end in the order in which they began."""
    with EmulatedHardware(scene) as hardware:
        camera, head = hardware._camera, hardware._head_state()
        for begun_s, jpeg in ((1.0, b"first"), (3.0, b"third"), (2.0, b"second")):
            camera._show(jpeg, head, begun_s)
        assert camera.count == 2
        shot = camera.newest(0, 0.0)
        assert shot is not None and shot.jpeg == b"third"


def test_a_frozen_camera_shows_one_picture_whoever_took_the_next(scene: Scene) -> None:
    with EmulatedHardware(scene) as hardware:
        camera, head = hardware._camera, hardware._head_state()
        for begun_s, level in enumerate((0, 100, 200)):
            camera._publish(np.full((8, 8, 3), level, np.uint8), head, float(begun_s))
            camera.fault = "frozen"
        shot = camera.newest(0, 0.0)
        assert camera.count == 3
        assert shot is not None and from_jpeg(shot.jpeg).max() == 0


def test_no_two_pictures_of_a_resting_head_are_alike(hardware: EmulatedHardware) -> None:
    viewer = Viewer(hardware.url)
    pictures = [viewer.picture() for _ in range(10)]
    viewer.close()
    assert len(set(pictures)) == len(pictures)


# ---- clients ----------------------------------------------------------------------------


def test_a_client_that_does_not_read_holds_up_nobody(scene: Scene) -> None:
    """More is sent to the one that reads than any socket buffer could hold for the other."""
    with EmulatedHardware(scene, ServeOptions(fps=240)) as hardware:
        client, viewer = stalled(hardware.url), Viewer(hardware.url)
        sent = sum(len(viewer.picture()) for _ in range(150))
        before = hardware._camera.count
        for _ in range(20):
            viewer.picture()
        assert sent > 0 and hardware._camera.count >= before + 20
        viewer.close()
        client.close()


def test_without_anyone_watching_no_picture_is_taken(hardware: EmulatedHardware) -> None:
    viewer = Viewer(hardware.url)
    viewer.picture()
    viewer.close()
    deadline_s = time.monotonic() + PATIENCE_S
    while (count := hardware._camera.count) and time.monotonic() < deadline_s:
        time.sleep(0.3)
        if hardware._camera.count == count:
            return
    pytest.fail("pictures are taken for nobody")


def test_a_snapshot_is_of_now_and_other_addresses_are_refused(hardware: EmulatedHardware) -> None:
    assert snapshot(hardware).shape == (120, 160, 3)
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(hardware.url + "x", timeout=PATIENCE_S)


# ---- the laser --------------------------------------------------------------------------


def test_a_switched_laser_is_lit_by_m3_and_dark_after_m5(scene: Scene) -> None:
    """Dark: only the ambient layer, which this scene has none of: black level and noise.

    2 DN and six times the dark noise, 53 e of 15,000 e a full scale, 0.9 DN.
    """
    options = ServeOptions(switched_laser=True, fps=FPS)
    with EmulatedHardware(scene, options) as hardware:
        hurry(hardware)
        with open_devices(quick_rig(hardware)) as (camera, track):
            assert camera.grab().image.max() < 2 + 6 * 0.9
            track.laser_on()  # type: ignore[attr-defined]
            assert camera.grab().image.max() > 100
            track.laser_off()  # type: ignore[attr-defined]
            assert camera.grab().image.max() < 2 + 6 * 0.9


# ---- what it writes, and what it leaves --------------------------------------------------


def test_the_rig_file_loads_and_is_the_scene_without_its_tank(
    scene: Scene, hardware: EmulatedHardware, tmp_path: Path
) -> None:
    hardware.write_rig(tmp_path / "rig.toml")
    loaded = load_rig(tmp_path / "rig.toml")
    ours, theirs = loaded.rig.model_dump(), scene.rig.model_dump()
    for kind, driver in (("camera", "opencv"), ("track", "grbl")):
        assert ours[kind].pop("driver") == driver
        for section in (ours, theirs):
            section[kind].pop("options")
        theirs[kind].pop("driver")
    assert theirs.pop("sheet") is None and ours.pop("sheet") is not None  # a user's by ruler
    assert ours == theirs
    assert "lens" not in loaded.document


@pytest.mark.parametrize(("start_mm", "step_mm", "frames"), [(-130.3, -0.7, 40), (5000.0, 1.0, 1)])
def test_the_travel_holds_the_plan_wherever_it_lies(
    start_mm: float, step_mm: float, frames: int
) -> None:
    """The controller's soft limits let the driver wake, home, and go to both ends."""
    plan = {"start_mm": start_mm, "step_mm": step_mm, "frames": frames}
    with EmulatedHardware(small_scene(plan=plan)) as hardware:
        hurry(hardware)
        with open_devices(quick_rig(hardware)) as (_, track):
            for place in (start_mm, start_mm + (frames - 1) * step_mm):
                assert track.move_to(place) == pytest.approx(place, abs=0.003)
                assert hardware.position_mm == pytest.approx(place, abs=0.003)


def test_marlin_is_served_too(scene: Scene, tmp_path: Path) -> None:
    with EmulatedHardware(scene, ServeOptions(dialect="marlin", fps=FPS)) as hardware:
        hurry(hardware)
        run = scan(quick_rig(hardware), tmp_path / "run")
    assert len(run) == 4


def test_nothing_is_left_behind(scene: Scene, tmp_path: Path) -> None:
    link = tmp_path / "track"
    before = threads_of_hardware()
    with EmulatedHardware(scene, ServeOptions(link=link)) as hardware:
        url, port = hardware.snapshot_url, link.readlink()
        client, viewer = stalled(hardware.url), Viewer(hardware.url)
        assert threads_of_hardware() - before
    hardware.close()
    viewer.close()
    client.close()
    assert not os.path.lexists(link) and not port.exists()
    assert threads_of_hardware() <= before  # a client of another test may end meanwhile
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(url, timeout=5.0)


def test_closing_waits_for_every_client(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that is slow to end, and one that asks for a snapshot of a camera that hangs."""
    before = threads_of_hardware()
    slow = _Client._hung_up

    def hung_up(client: _Client) -> bool:
        gone = slow(client)
        time.sleep(0.2 * gone)
        return gone

    monkeypatch.setattr(_Client, "_hung_up", hung_up)
    with EmulatedHardware(scene) as hardware:
        hardware._camera.fault = "hang"
        clients = [stalled(hardware.url), stalled(hardware.snapshot_url)]
        while hardware._camera._watchers < len(clients):
            time.sleep(0.01)
        begun_s = time.monotonic()
    assert time.monotonic() - begun_s < SNAPSHOT_S / 2
    assert threads_of_hardware() <= before  # a client of another test may end meanwhile
    for client in clients:
        client.close()


def test_a_link_left_by_one_that_was_killed_is_replaced(scene: Scene, tmp_path: Path) -> None:
    link = tmp_path / "track"
    link.symlink_to(tmp_path / "gone")
    with EmulatedHardware(scene, ServeOptions(link=link)):
        assert link.exists()


# ---- what cannot be served ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"quality": 0}, r"quality: must be a whole number of 1 to 100 \(got 0\)"),
        ({"fps": 0.0}, r"fps: must be a number of 0\.1 to 240"),
        ({"dialect": "gcode"}, "dialect: must be 'grbl' or 'marlin'"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        check(ServeOptions, options, where="command line")
    with pytest.raises(ValueError, match=next(iter(options))):
        ServeOptions(**options)


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [("head", "speed_mm_s", 5.0), ("camera", "options", {"auto_exposure": True})],
)
def test_scenes_that_kept_pictures_cannot_show_are_refused(
    section: str, key: str, value: object
) -> None:
    before = threads_of_hardware()
    with pytest.raises(InputError, match=rf"{section}\.{key}.*cannot be served"):
        EmulatedHardware(small_scene(**{section: {key: value}}))
    assert threads_of_hardware() <= before  # a client of another test may end meanwhile


def test_a_taken_port_or_link_is_a_clear_error(
    scene: Scene, hardware: EmulatedHardware, tmp_path: Path
) -> None:
    taken = int(hardware.url.split(":")[2].split("/")[0])
    with pytest.raises(InputError, match=f"--http-port: cannot listen there: .*{taken}"):
        EmulatedHardware(scene, ServeOptions(http_port=taken))
    for link in (tmp_path, tmp_path / "no" / "folder"):
        with pytest.raises(InputError, match="--link"):
            EmulatedHardware(scene, ServeOptions(link=link))


def test_a_document_of_the_rig_needs_no_scene(hardware: EmulatedHardware) -> None:
    """Nothing of the tank is in it, so a reader that owns no tank takes every section."""
    document = hardware.rig_document()
    assert parse_rig(document, source="served").rig.camera.driver == "opencv"
