"""The live page's session: scans and their states, devices that fail, the same bytes."""

import json
import os
import struct
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_devices import FakeCamera, FakeTrack, LaserTrack, fake_rig, folder_bytes
from live_rig import LONG_S, Bench, GatedTrack, SeeingCamera, live_bench, wait_for

from lscan.acquisition.run import open_run
from lscan.acquisition.scan import acquire_into
from lscan.acquisition.writer import create_run
from lscan.devices.api import LASER_MAY_BE_LIT
from lscan.errors import DeviceError, DiskError, InputError
from lscan.live.analysis import MOVED_MM, BestFocus, Figures, measure_line
from lscan.live.devices import NotNow
from lscan.live.scanning import LiveCalibration, find_unfinished, next_name
from lscan.live.session import Newest, Session
from lscan.records import Floats, PlanePoints, Status


def scan_of(session: Session) -> dict[str, Any]:
    scan: dict[str, Any] = session.state()["scan"]
    return scan


def reaches(session: Session, *states: str) -> dict[str, Any]:
    return wait_for(lambda: (scan := scan_of(session))["state"] in states and scan)


def frame_of(session: Session, after: int = 0) -> dict[str, Any]:
    data = wait_for(lambda: session.frames.after(after))[1]
    (length,) = struct.unpack(">I", data[:4])
    document: dict[str, Any] = json.loads(data[4 : 4 + length])
    return document


def reference(path: Path, frames: int = 5) -> dict[str, bytes]:
    """The bytes of the same scan without a page."""
    track = FakeTrack()
    with create_run(path, fake_rig(frames)) as writer:
        acquire_into(writer, FakeCamera(track), track)
    return folder_bytes(path)


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    with live_bench(monkeypatch, tmp_path) as bench:
        yield bench


def test_a_recording_that_fails_is_said_and_ends(bench: Bench) -> None:
    """The page goes on; what was recorded is kept by whoever opened the file."""

    class Recording:
        added = 0

        def add(self, stamp: int, *picture: Any) -> None:
            self.added += 1
            assert abs(stamp / 1e9 - time.time()) < LONG_S
            if self.added == 2:
                raise OSError("no space left")

    recording: Any = Recording()
    session = bench.open(recording=recording)
    wait_for(lambda: session.recording_fault)
    number = session.frames.after(0)[0]
    frame_of(session, number)
    assert session.recording_fault == "recording ended: OSError: no space left"
    assert session.state()["camera"]["error"] == session.recording_fault
    assert recording.added == 2


def test_what_the_page_looks_at_is_recorded_where_the_head_is(bench: Bench) -> None:
    """Each picture's points lie in the sheet at the track's own position."""

    class LevelMap:
        def to_plane(self, image_px: Floats, sigma_px: Floats) -> PlanePoints:
            status = np.full(len(image_px), Status.OK)
            return PlanePoints(image_px, np.ones_like(image_px), status)

    level: Any = LevelMap()

    class Recording:
        kept: list[tuple[Any, ...]] = []  # noqa: RUF012 - of one test

        def add(self, stamp: int, *picture: Any) -> None:
            self.kept.append(picture)

    recording: Any = Recording()
    session = bench.open(
        calibration=LiveCalibration(bench.output / "c.json", level), recording=recording
    )
    session.move_to(7.0)
    kept = wait_for(lambda: [p for p in recording.kept if p[1] == pytest.approx(7.013)])
    image, position_mm, surface, plane_map = kept[0]
    assert image.shape[:2] == bench.drivers.camera.size_px[::-1]
    assert plane_map is level
    assert (surface.xyz_mm[0, :, 1] == position_mm).all()


Gated = tuple[Bench, Session, GatedTrack]


@pytest.fixture
def gated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Gated]:
    """A page whose track waits, before each frame, for its gate."""
    track = GatedTrack(gate=threading.Semaphore(0))
    with live_bench(monkeypatch, tmp_path / "runs", track) as bench:
        yield bench, bench.open(), track


# ---- scans ------------------------------------------------------------------------------


@pytest.mark.parametrize("camera", [FakeCamera, SeeingCamera])
def test_a_scan_with_the_page_open_gives_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, camera: type[FakeCamera]
) -> None:
    with live_bench(monkeypatch, tmp_path / "runs", camera=camera) as bench:
        session = bench.open(frames=12)
        frame_of(session)
        session.start_scan("a")
        scan = reaches(session, "done", "failed")
    assert (scan["state"], scan["done"], scan["planned"]) == ("done", 12, 12)
    assert folder_bytes(tmp_path / "runs" / "a") == reference(tmp_path / "b", 12)


def test_a_camera_that_can_be_looked_at_is_shown_while_a_scan_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    track = GatedTrack(gate=threading.Semaphore(0))
    with live_bench(monkeypatch, tmp_path, track, SeeingCamera) as bench:
        session = bench.open()
        session.start_scan()
        seen = bench.drivers.camera.previews
        wait_for(lambda: bench.drivers.camera.previews > seen + 5)
        assert scan_of(session)["done"] == 0


def test_the_scans_own_pictures_are_shown_where_nobody_else_may_grab(gated: Gated) -> None:
    bench, session, track = gated
    session.start_scan()
    before = sum(bench.drivers.camera.grabs.values())
    track.gate.release()
    wait_for(lambda: scan_of(session)["done"] == 1)
    shown = wait_for(lambda: (f := frame_of(session))["position_mm"] == 1.013 and f)
    assert shown["size_px"] == [20, 16]
    assert sum(bench.drivers.camera.grabs.values()) == before + 1


def test_pause_and_resume_lose_and_repeat_no_frame(tmp_path: Path, gated: Gated) -> None:
    _, session, track = gated
    session.start_scan("a")
    with pytest.raises(NotNow, match="a scan is going on"):
        session.start_scan("b")
    track.gate.release()
    wait_for(lambda: scan_of(session)["done"] == 1)
    session.scanning.pause()
    assert scan_of(session)["state"] in ("stopping", "paused")
    track.gate.release()  # the frame being taken, where it was begun before the pause
    paused = reaches(session, "paused")
    assert paused["done"] in (1, 2)
    assert open_run(tmp_path / "runs" / "a").state == "scanning"
    with pytest.raises(NotNow):
        session.scanning.pause()
    track.gate.release(10)
    session.resume_scan()
    done = reaches(session, "done")
    assert (done["done"], done["left_s"]) == (5, None)
    with pytest.raises(NotNow, match="no scan to go on with"):
        session.resume_scan()
    assert folder_bytes(tmp_path / "runs" / "a") == reference(tmp_path / "b")


def test_a_stopped_scan_can_be_resumed_and_says_so(tmp_path: Path, gated: Gated) -> None:
    _, session, track = gated
    track.gate.release(2)
    with pytest.raises(NotNow):
        session.scanning.stop()
    session.start_scan()
    wait_for(lambda: scan_of(session)["done"] == 2)
    session.scanning.stop()
    track.gate.release(10)
    stopped = reaches(session, "idle")
    assert stopped["message"] == "frames are kept; Resume goes on"
    assert stopped["folder"].endswith("scan-001")
    session.resume_scan()
    reaches(session, "done")
    assert folder_bytes(tmp_path / "runs" / "scan-001") == reference(tmp_path / "b")


def test_a_paused_scan_is_stopped_by_stop_and_left_by_a_new_one(gated: Gated) -> None:
    _, session, track = gated
    track.gate.release(1)
    session.start_scan("a")
    wait_for(lambda: scan_of(session)["done"] == 1)
    session.scanning.pause()
    track.gate.release(100)
    reaches(session, "paused")
    session.scanning.stop()
    assert scan_of(session)["state"] == "idle"
    session.start_scan("b")
    assert reaches(session, "done")["folder"].endswith("b")


def test_closing_ends_a_scan_after_its_frame_and_names_its_folder(
    tmp_path: Path, gated: Gated
) -> None:
    bench, session, track = gated
    track.gate.release(1)
    session.start_scan("a")
    wait_for(lambda: scan_of(session)["done"] == 1)
    threading.Timer(0.1, track.gate.release, [100]).start()
    assert session.close() == tmp_path / "runs" / "a"
    assert bench.drivers.camera.closed >= 1
    assert track.closed >= 1
    assert len(open_run(tmp_path / "runs" / "a")) < 5
    again = bench.open()  # the page opened anew
    with pytest.raises(InputError, match="exists already"):
        again.start_scan("a")
    again.start_scan()
    reaches(again, "done")
    assert again.close() is None


def killed_scan(folder: Path, frames: int = 5, done: int = 2) -> None:
    """A run that ended without a word after ``done`` frames, in the middle of the next row."""
    track = FakeTrack()
    with create_run(folder, fake_rig(frames)) as writer:
        acquire_into(writer, FakeCamera(track), track, None, lambda: writer.written < done)
    with (folder / "frames.csv").open("a") as table:
        table.write("2,1.2")


def test_a_run_left_unfinished_is_offered_by_the_page_opened_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "runs"
    killed_scan(output / "a")
    before = folder_bytes(output)
    with live_bench(monkeypatch, output) as bench:
        session = bench.open()
        scan = scan_of(session)
        assert (scan["state"], scan["done"], scan["planned"]) == ("idle", 2, 5)
        assert scan["folder"] == str(output / "a")
        assert scan["message"] == "frames are kept; Resume goes on"
        assert folder_bytes(output) == before  # looked at, and left as it is
        assert bench.drivers.track.moves == 0
        session.resume_scan()
        reaches(session, "done")
    assert folder_bytes(output / "a") == reference(tmp_path / "b")


def test_only_the_newest_run_of_this_rig_is_offered_and_only_if_unfinished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "runs"
    killed_scan(output / "old")
    killed_scan(output / "another-rig", frames=6)
    (output / "no-run").mkdir()
    (output / "no-run" / "frames.csv").write_text("x")
    killed_scan(output / "sparse")
    os.truncate(output / "sparse" / "frames.csv", 2**40)  # refused before it is read
    for seconds, name in enumerate(("old", "another-rig", "no-run", "sparse")):
        os.utime(output / name / "frames.csv", (seconds, seconds))
    with live_bench(monkeypatch, output) as bench:
        assert scan_of(bench.open())["folder"] == str(output / "old")
        assert bench.sessions[0].close() is None  # nothing was scanned in this session
        session = bench.open()
        session.start_scan("new")
        reaches(session, "done")
        session.close()
        assert scan_of(bench.open())["folder"] is None


@pytest.mark.parametrize("name", ["../a", "a/b", "", ".", "..", "a\n", "/x", "é", "a" * 101])
def test_a_name_that_is_no_plain_folder_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    output = tmp_path / "runs"
    with live_bench(monkeypatch, output) as bench:
        session = bench.open()
        if name:
            with pytest.raises(InputError, match="not a folder name"):
                session.start_scan(name)
            assert not output.exists()
        else:
            session.start_scan(name)
            assert scan_of(session)["folder"] == str(output / "scan-001")


def test_the_next_name_is_above_all_there_are(tmp_path: Path) -> None:
    assert next_name(tmp_path / "none", "scan") == "scan-001"
    for name in ("scan-002", "scan-9.json", "scan-x", "board-040"):
        (tmp_path / name).mkdir()
    assert next_name(tmp_path, "scan") == "scan-010"


def test_a_name_longer_than_any_file_may_have_holds_no_run(tmp_path: Path) -> None:
    """Linux takes 255 bytes; pathlib raises for more where it is asked what there is."""
    output = tmp_path / ("a" * 300)
    assert next_name(output, "scan") == "scan-001"
    assert find_unfinished(output, fake_rig(5)) is None


def test_frames_are_numbered_one_by_one_where_pictures_were_passed_over(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Or a browser that asks for what comes after its last would wait for pictures long gone."""
    sessions: list[Session] = []

    def slow_line(*arguments: Any) -> Figures:
        """Measure once four more pictures have come, or the session is being closed."""
        session = wait_for(lambda: sessions and sessions[0])
        newest = session._pictures.after(0)
        last = newest[0] + 4 if newest else 4
        wait_for(lambda: session._closing.is_set() or session._pictures.after(last - 1))
        return measure_line(*arguments)

    monkeypatch.setattr("lscan.live.session.measure_line", slow_line)
    session = bench.open()
    sessions.append(session)
    for number in range(1, 6):
        newest = wait_for(lambda after=number - 1: session.frames.after(after))
        assert newest[0] == number
        (length,) = struct.unpack(">I", newest[1][:4])
        assert json.loads(newest[1][4 : 4 + length])["number"] == number
    assert session._pictures.after(number) is not None


# ---- devices that fail ------------------------------------------------------------------


def test_a_failing_track_fails_the_scan_which_can_be_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    track = FakeTrack(fail_at=2)
    with live_bench(monkeypatch, tmp_path / "runs", track) as bench:
        session = bench.open()
        session.start_scan("a")
        failed = reaches(session, "failed")
        assert failed["done"] == 2
        assert "limit switch" in failed["message"]
        assert failed["message"].endswith("2 of 5 frames are kept; Resume goes on")
        frame_of(session, after=frame_of(session)["number"])  # the page lives on
        track.fail_at = None
        session.resume_scan()
        reaches(session, "done")
    assert folder_bytes(tmp_path / "runs" / "a") == reference(tmp_path / "b")


def test_a_failing_camera_is_reported_and_opened_again(bench: Bench) -> None:
    session, camera = bench.open(), bench.drivers.camera
    frame_of(session)
    opened = bench.drivers.opened
    camera.fail_at = sum(camera.grabs.values()) + 1
    wait_for(lambda: "no picture within" in session.state()["camera"]["error"])
    wait_for(lambda: bench.drivers.opened > opened + 2)
    camera.fail_at = None
    wait_for(lambda: session.state()["camera"]["error"] == "")
    frame_of(session, after=frame_of(session)["number"])


@pytest.mark.parametrize("shape", [(16, 20, 4), (0, 0)])
def test_a_picture_that_cannot_be_measured_is_reported(
    bench: Bench, shape: tuple[int, ...]
) -> None:
    session, camera = bench.open(), bench.drivers.camera
    frame_of(session)
    camera.bad_picture = np.zeros(shape, dtype=np.uint8)
    camera.fail_at = sum(camera.grabs.values())
    wait_for(lambda: session.state()["camera"]["error"])
    camera.fail_at = None
    wait_for(lambda: session.state()["camera"]["error"] == "")


@pytest.mark.parametrize("name", ["time_s", "exposure_ms"])
def test_a_camera_that_reports_no_finite_number_is_reported(bench: Bench, name: str) -> None:
    """JSON has none; the thread that measures goes on, so pictures come again after it."""
    session, camera = bench.open(), bench.drivers.camera
    sound = camera.grab
    frame_of(session)
    camera.grab = lambda *given, **named: replace(sound(*given, **named), **{name: np.inf})
    what = f"the camera reported {name} that is not finite"
    wait_for(lambda: session.state()["camera"]["error"] == what)
    camera.grab = sound
    wait_for(lambda: session.state()["camera"]["error"] == "")
    frame_of(session, after=frame_of(session)["number"])


def test_a_track_that_reports_no_finite_position_is_reported(bench: Bench) -> None:
    session, track = bench.open(), bench.drivers.track
    frame_of(session)
    bench.drivers.camera.track = FakeTrack()  # its pictures are made of the position
    track.position_mm = np.nan
    said = session.state()["track"]
    assert (said["position_mm"], said["error"]) == (
        None,
        "the track reports a position that is not finite",
    )
    json.dumps(session.state(), allow_nan=False)
    last = frame_of(session)["number"]
    assert frame_of(session, after=last + 1)["position_mm"] is None


def test_the_time_of_the_last_picture_of_a_camera_that_is_gone_is_shown(bench: Bench) -> None:
    session, camera = bench.open(), bench.drivers.camera
    frame_of(session)
    assert session.state()["camera"]["gone"] is False
    camera.fail_at = sum(camera.grabs.values()) + 1
    gone = wait_for(lambda: (state := session.state()["camera"])["gone"] and state)
    later = wait_for(  # shown in tenths of a second
        lambda: (state := session.state()["camera"])["seen_s_ago"] > gone["seen_s_ago"] and state
    )
    assert later["gone"]
    camera.fail_at = None
    wait_for(lambda: not session.state()["camera"]["gone"])


def test_what_was_wrong_before_a_scan_is_not_said_through_it(gated: Gated) -> None:
    """A camera shown by its grabs alone is not looked at beside the scan's."""
    _, session, track = gated
    session._task_message = "no board was found"
    session.start_scan("a")
    wait_for(lambda: session._devices._scanning)
    session._devices.camera_error = "no picture"  # of a look that ended just then
    track.gate.release(2)
    wait_for(lambda: session.state()["scan"]["done"] == 2)
    state = session.state()
    assert state["scan"]["state"] == "scanning"
    assert (state["task"]["message"], state["camera"]["error"]) == ("", "")


def test_a_scan_that_a_device_ended_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A device's fault is reported for the device; a fault of the disk, for the scan alone."""
    with live_bench(monkeypatch, tmp_path, FakeTrack(fail_at=2)) as bench:
        session = bench.open()
        session.start_scan("a")
        assert reaches(session, "failed")["by_device"] is True

    def full(*_: object) -> None:
        raise DiskError("cannot be written: no space left on device")

    with live_bench(monkeypatch, tmp_path / "b") as bench:
        session = bench.open()
        monkeypatch.setattr("lscan.acquisition.writer.RunWriter.append", full)
        session.start_scan("b")
        assert reaches(session, "failed")["by_device"] is False


class LostTrack(FakeTrack):
    """Fails once, and then has no position until it is opened again."""

    lost = False

    @property  # type: ignore[override]
    def position_mm(self) -> float:
        if self.lost:
            raise DeviceError("lost track: must be opened again")
        return self._at_mm

    @position_mm.setter
    def position_mm(self, value: float) -> None:
        self._at_mm = value

    def move_to(self, position_mm: float) -> float:
        if self.moves == self.fail_at:
            self.lost = True
        return super().move_to(position_mm)

    def close(self) -> None:
        super().close()
        self.lost, self.fail_at = False, None


def test_a_lost_track_is_opened_again_only_when_it_is_to_move(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Opening may home: nothing may move by itself."""
    track = LostTrack(fail_at=1)
    with live_bench(monkeypatch, tmp_path, track, SeeingCamera) as bench:
        session = bench.open()
        session.start_scan()
        reaches(session, "failed")
        state = session.state()
        assert state["track"]["position_mm"] is None
        assert "opened again" in state["track"]["error"]
        assert track.closed == 0
        session.resume_scan()
        reaches(session, "done")
        assert track.closed == 1
        assert session.state()["track"]["error"] == ""


def test_devices_that_do_not_open_leave_nothing_open(bench: Bench) -> None:
    bench.drivers.camera.size_px = (30, 16)
    with pytest.raises(DeviceError, match="30 by 16"):
        bench.open()
    assert bench.drivers.track.closed == 1
    assert bench.drivers.camera.closed == 1


# ---- which advice holds -----------------------------------------------------------------


def test_optics_are_aligned_only_without_calibration_and_scan(tmp_path: Path, gated: Gated) -> None:
    _, session, track = gated
    track.gate.release(1)

    def phase() -> str:
        last = frame_of(session)["number"]
        return str(frame_of(session, after=last + 1)["phase"])  # begun after the last came

    assert phase() == "alignment"
    session.start_scan("a")
    wait_for(lambda: scan_of(session)["done"] == 1)
    session.scanning.pause()
    track.gate.release(1)
    reaches(session, "paused")
    assert phase() == "scan"
    session.scanning.stop()
    assert phase() == "alignment"
    session._calibration = LiveCalibration(tmp_path / "c.json", None)  # type: ignore
    assert phase() == "calibrated"


def test_the_best_focus_is_that_of_the_place_where_the_head_stands() -> None:
    best = BestFocus()
    assert [best.among(focus, 10.0) for focus in (5.0, 9.0, 7.0)] == [5.0, 9.0, 9.0]
    assert best.among(6.0, 10.0 + MOVED_MM / 2) == 9.0  # a reading that scatters
    assert best.among(3.0, 11.0) == 3.0
    for crept_mm in np.arange(11.0, 11.0 + MOVED_MM, MOVED_MM / 4):
        assert best.among(4.0, crept_mm) == 4.0
    assert best.among(2.0, 11.0 + 1.01 * MOVED_MM) == 2.0  # it crept away all the same
    assert best.among(1.0, None) == 1.0  # moved by who knows whom
    assert best.among(0.5, None) == 1.0
    best.forget()
    assert best.among(0.5, None) == 0.5


def test_the_best_focus_is_begun_anew_by_a_move(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    sharp = threading.Event()

    def measured(*_: Any) -> Figures:
        return Figures(0.0, 90.0 if sharp.is_set() else 30.0, None, None)

    monkeypatch.setattr("lscan.live.session.measure_line", measured)
    session = bench.open()
    sharp.set()
    wait_for(lambda: frame_of(session)["focus_best"] == 90.0)
    sharp.clear()
    wait_for(lambda: (f := frame_of(session))["focus"] == 30.0 and f["focus_best"] == 90.0)
    session.move_to(5.0)
    wait_for(lambda: frame_of(session)["focus_best"] == 30.0)


# ---- the other commands -----------------------------------------------------------------


def test_the_head_is_moved_but_not_beside_a_scan(gated: Gated) -> None:
    _, session, track = gated
    track.gate.release(1)
    session.move_to(7.0)
    assert session.state()["track"]["position_mm"] == pytest.approx(7.013)
    session.start_scan()
    for command in (
        lambda: session.move_to(1.0),
        lambda: session.switch_laser(True),
        session.take_board,
        session.resume_scan,
    ):
        with pytest.raises(NotNow, match="a scan is going on"):
            command()


def test_the_laser_is_switched_where_the_track_can_and_off_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    track = LaserTrack()
    with live_bench(monkeypatch, tmp_path, track) as bench:
        session = bench.open()
        state = session.state()
        assert (state["can_switch_laser"], state["laser"]) == (True, None)
        session.switch_laser(True)
        assert session.state()["laser"] == "on"
        session.close()
    assert track.trace == ["laser on", "laser off"]


def test_a_laser_that_cannot_be_switched_off_is_said_until_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a track that answers all else, so that nothing else would say so."""
    track = LaserTrack()
    with live_bench(monkeypatch, tmp_path, track) as bench:
        session = bench.open()
        session.switch_laser(True)
        with monkeypatch.context() as stuck:
            stuck.setattr(track, "laser_off", lambda: FakeTrack(fail_at=0).move_to(0.0))
            with pytest.raises(DeviceError):
                session.switch_laser(False)
        assert session.state()["laser_warning"] == LASER_MAY_BE_LIT
        session.switch_laser(False)
        assert (session.state()["laser_warning"], session.state()["laser"]) == ("", "off")


def test_a_scan_in_pairs_leaves_the_laser_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with live_bench(monkeypatch, tmp_path, LaserTrack()) as bench:
        session = bench.open(frames=3, plan={"laser": "pairs"})
        session.switch_laser(True)
        session.start_scan("pairs")
        assert reaches(session, "done", "failed")["state"] == "done"
        assert session.state()["laser"] == "off"
    assert all(frame.background is not None for frame in open_run(tmp_path / "pairs").frames())


def test_a_track_without_a_switch_refuses(bench: Bench) -> None:
    session = bench.open()
    assert session.state()["can_switch_laser"] is False
    with pytest.raises(InputError, match="cannot switch the laser"):
        session.switch_laser(True)


def test_board_commands_need_a_board(bench: Bench) -> None:
    session = bench.open()
    for command in (session.take_board, lambda: session.set_mode("board")):
        with pytest.raises(InputError, match=r"no section \[board\]"):
            command()
    session.set_mode("stripe")


# ---- the newest -------------------------------------------------------------------------


def test_the_newest_replaces_what_nobody_took() -> None:
    box: Newest[str] = Newest()
    called: list[int] = []
    box.listen(lambda: called.append(1))
    assert box.after(0) is None
    box.put("a")
    box.put("b")
    assert box.after(0) == box.after(1) == (2, "b")
    assert box.after(2, timeout_s=0.01) is None
    assert len(called) == 2
    assert box.rate_hz() == 1.0  # two within two seconds
