"""Runs as recordings: each number as rosbags reads it is the run's, and frames fit together."""

from collections import defaultdict
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from calibrations import drawn_calibration
from command_line import call, refused
from drawn_runs import flat_run, rig_file
from mcap.reader import make_reader
from metricviews import paper_rig
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from lscan.acquisition.run import Run, open_run
from lscan.acquisition.writer import create_run
from lscan.calibration.calibrationfile import load_calibration, save_calibration
from lscan.calibration.marks import Region
from lscan.calibration.metric.planemap import Metric, metric_map
from lscan.camera import CameraModel
from lscan.errors import InputError
from lscan.files.rosmessages import message_file
from lscan.pipeline import build_surface, read_profiles, reconstruct
from lscan.records import Floats, Frame, Status, Surface
from lscan.stripe import extract_stripe
from lscan.surface import save_surface
from lscan.surface.recording import (
    BACKGROUND,
    LENS,
    PICTURE,
    POINTS,
    TRACK,
    TRANSFORMS,
    LiveRecording,
    head_camera,
    profiles_of,
    stamps_ns,
    write_recording,
)

FRAMES = 3
CORNERS = np.array([[0.0, 0.0], [639.0, 0.0], [639.0, 479.0], [0.0, 479.0]])
SHAFT = {"arc_radius_mm": 100.0, "point_mm": [0.0, 10.0, 250.0], "direction": [1.0, 0.1, 0.0]}
ONE_DIGIT = 2.0**-23  # of a single-precision number


def metric(water: bool) -> Metric:
    """The paper's camera and sheet, as if they were known exactly."""
    return metric_map(paper_rig(water).truth, np.zeros((17, 1)), Region(CORNERS, 1.0))


def read(path: Path) -> dict[str, list[Any]]:
    """All messages by topic, in the order of their stamps, by the definitions in the file."""
    found, store = defaultdict(list), get_typestore(Stores.EMPTY)
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            assert schema is not None
            if schema.name not in store.types:
                store.register(get_types_from_msg(schema.data.decode(), schema.name))
            one: Any = store.deserialize_cdr(message.data, schema.name)
            held = getattr(one, "transforms", [one])[0].header.stamp
            assert held.sec * 10**9 + held.nanosec == message.log_time
            found[channel.topic].append(one)
    return found


def table_of(cloud: Any) -> Any:
    """A cloud's points by field, as its own description of them says."""
    kinds = {2: "u1", 7: "<f4"}
    described = {
        "names": [field.name for field in cloud.fields],
        "formats": [kinds[field.datatype] for field in cloud.fields],
        "offsets": [field.offset for field in cloud.fields],
        "itemsize": cloud.point_step,
    }
    assert (cloud.height, cloud.is_bigendian) == (1, False)
    assert cloud.row_step == cloud.point_step * cloud.width == len(cloud.data)
    return np.frombuffer(cloud.data.tobytes(), np.dtype(described))


def pose(transform: Any) -> tuple[Floats, Floats]:
    """(3, 3) and (3,) m: from the child's frame to the parent's."""
    turn, moved = transform.transform.rotation, transform.transform.translation
    matrix = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    return matrix, np.array([moved.x, moved.y, moved.z])


def clouds_of(run: Run, plane_map: Metric) -> list[Surface]:
    rig = run.rig_file.rig
    return [build_surface([profile], rig) for profile in read_profiles(run, plane_map)]


@pytest.fixture
def paired(tmp_path: Path) -> Run:
    """Two frames with backgrounds, in colour."""
    rng = np.random.default_rng(3)
    plan = {"frames": 2, "step_mm": 2.0, "laser": "pairs"}
    with create_run(tmp_path / "paired", rig_file(plan=plan)) as writer:
        for index in range(2):
            lit, dark = rng.integers(0, 256, (2, 480, 640, 3), dtype=np.uint8)
            time_s = 12.5 + 0.1 * index
            writer.append(Frame(lit, index, 2.0 * index, 2.0 * index + 0.01, time_s, 20.0, dark))
        return writer.finish()


def test_pictures_positions_and_tables_are_the_runs(tmp_path: Path, paired: Run) -> None:
    counts = write_recording(tmp_path / "run.mcap", paired, stamps_ns(paired))
    assert counts == dict.fromkeys((TRACK, TRANSFORMS, PICTURE, BACKGROUND), 2)
    messages = read(tmp_path / "run.mcap")
    assert {topic: len(each) for topic, each in messages.items()} == counts
    for index, frame in enumerate(paired.frames()):
        for topic, taken in {PICTURE: frame.image, BACKGROUND: frame.background}.items():
            message = messages[topic][index]
            decoded: Any = cv2.imdecode(message.data, cv2.IMREAD_COLOR_RGB)
            np.testing.assert_array_equal(decoded, taken)
            assert (message.format, message.header.frame_id) == ("png", "camera")
        head = messages[TRACK][index]
        assert head.header.frame_id == "world"
        place = head.pose.position
        assert (place.x, place.z) == (0.0, 0.0)
        assert place.y == pytest.approx(frame.position_mm / 1000, rel=1e-15)
        assert head.header.stamp.sec * 10**9 + head.header.stamp.nanosec == round(
            1e9 * frame.time_s
        )
    with (tmp_path / "run.mcap").open("rb") as stream:
        attached = {one.name: one.data for one in make_reader(stream).iter_attachments()}
    for name in ("run.json", "frames.csv"):
        assert attached[name] == (paired.path / name).read_bytes()
    assert f"{int(Status.OCCLUDED)} OCCLUDED" in attached["status-codes.txt"].decode().splitlines()


@pytest.mark.parametrize("sections", [{}, {"shaft": SHAFT}], ids=["track", "shaft"])
def test_points_are_the_surfaces_in_metres(tmp_path: Path, sections: dict[str, Any]) -> None:
    run = flat_run(tmp_path / "run", FRAMES, lit=slice(100, 500), **sections)
    made = clouds_of(run, metric(water=True))
    write_recording(tmp_path / "run.mcap", run, stamps_ns(run), made)
    for cloud, surface in zip(read(tmp_path / "run.mcap")[POINTS], made, strict=True):
        points = table_of(cloud)
        assert cloud.header.frame_id == "world" and not cloud.is_dense
        np.testing.assert_array_equal(points["status"], surface.status[0])
        wanted = dict(zip("xyz", surface.xyz_mm[0].T / 1000, strict=True))
        wanted |= {"sigma_x": surface.sigma_x_mm[0] / 1000, "sigma_z": surface.sigma_z_mm[0] / 1000}
        if surface.sigma_y_mm is not None:
            wanted["sigma_y"] = surface.sigma_y_mm[0] / 1000
        assert surface.brightness is not None
        wanted["intensity"] = surface.brightness[0]
        assert set(points.dtype.names) == {*wanted, "status"}
        for name, values in wanted.items():
            np.testing.assert_allclose(points[name], values, rtol=ONE_DIGIT, err_msg=name)
        assert np.isnan(points["x"][surface.status[0] == Status.NO_PEAK]).all()


@pytest.mark.parametrize("sections", [{}, {"shaft": SHAFT}], ids=["track", "shaft"])
@pytest.mark.parametrize("water", [False, True], ids=["air", "port"])
def test_points_lie_on_the_line_in_the_picture(
    tmp_path: Path, water: bool, sections: dict[str, Any]
) -> None:
    """A reader projects them by transforms and camera_info alone, as OpenCV does."""
    run, plane_map = flat_run(tmp_path / "run", FRAMES, **sections), metric(water)
    camera = head_camera(plane_map, run.rig_file.rig)
    assert camera is not None and (0 < camera.off_px < 0.1 if water else camera.off_px == 0)
    made = clouds_of(run, plane_map)
    write_recording(tmp_path / "run.mcap", run, stamps_ns(run), made, camera)
    messages = read(tmp_path / "run.mcap")
    for index, frame in enumerate(run.frames()):
        points = table_of(messages[POINTS][index])
        world = np.column_stack([points[axis] for axis in "xyz"]).astype(float)
        to_world, to_head = map(pose, messages[TRANSFORMS][index].transforms)
        head = (world - to_world[1]) @ to_world[0]
        valued = np.isfinite(head).all(axis=1)
        assert np.abs(head[valued, 1]).max() < 1e-6  # the sheet of the head
        seen = ((head - to_head[1]) @ to_head[0])[valued]
        info = messages[LENS][index]
        assert (info.width, info.height) == (640, 480)
        assert (info.distortion_model, info.header.frame_id) == ("plumb_bob", "camera")
        still = np.zeros(3)
        shown, _ = cv2.projectPoints(seen, still, still, info.k.reshape(3, 3), info.d)
        line = extract_stripe(frame.image, run.rig_file.rig.stripe).image_px[valued]
        # Single precision of a metre is a ten-thousandth of a pixel.
        assert np.linalg.norm(shown[:, 0] - line, axis=1).max() < camera.off_px + 1e-3


@pytest.mark.parametrize(
    ("lens", "model", "d"),
    [
        (CameraModel(500.0, (1.0, 2.0), 1, 2, 3, 4, 5), "plumb_bob", [1, 2, 3, 4, 5]),
        (
            CameraModel(500.0, (1.0, 2.0), 1, 2, 3, 4, 5, 6, 7, 8),
            "rational_polynomial",
            [1, 2, 3, 4, 5, 6, 7, 8],
        ),
        (
            CameraModel(500.0, (1.0, 2.0), 1, 2, k3=3, k4=4, fisheye=True),
            "equidistant",
            [1, 2, 3, 4],
        ),
    ],
)
def test_a_lens_is_named_as_its_readers_know_it(
    tmp_path: Path, lens: CameraModel, model: str, d: list[float]
) -> None:
    """sensor_msgs/distortion_models.h of ROS, and the order of each one's coefficients there."""
    run = flat_run(tmp_path / "run", 1)
    camera = replace(head_camera(metric(water=False), run.rig_file.rig), lens=lens)
    write_recording(tmp_path / "run.mcap", run, stamps_ns(run), None, camera)
    (info,) = read(tmp_path / "run.mcap")[LENS]
    assert (info.distortion_model, list(info.d)) == (model, d)


@pytest.mark.parametrize("sections", [{}, {"shaft": SHAFT}], ids=["track", "shaft"])
def test_what_is_looked_at_is_recorded_as_a_run_is(
    tmp_path: Path, sections: dict[str, Any]
) -> None:
    """The same pictures, one by one, at the same times: the same messages, to their numbers."""
    run, plane_map = flat_run(tmp_path / "run", FRAMES, **sections), metric(water=True)
    rig, stamps, clouds = run.rig_file.rig, stamps_ns(run), clouds_of(run, plane_map)
    write_recording(tmp_path / "run.mcap", run, stamps, clouds, head_camera(plane_map, rig))
    with message_file(tmp_path / "live.mcap") as file:
        recording = LiveRecording(file, rig)
        for frame, stamp, cloud in zip(run.frames(), stamps, clouds, strict=True):
            recording.add(stamp, frame.image, frame.position_mm, cloud, plane_map)
    asked, found = (read(tmp_path / f"{name}.mcap") for name in ("run", "live"))
    assert set(found) == set(asked)
    for topic in (LENS, TRACK, POINTS, TRANSFORMS):
        assert list(map(repr, found[topic])) == list(map(repr, asked[topic]))
    for one, other in zip(found[PICTURE], asked[PICTURE], strict=True):
        pair = (cv2.imdecode(each.data, cv2.IMREAD_UNCHANGED) for each in (one, other))
        np.testing.assert_array_equal(*pair)


def test_a_head_that_is_nowhere_known_has_its_pictures_recorded(tmp_path: Path) -> None:
    run = flat_run(tmp_path / "run", 1)
    with message_file(tmp_path / "live.mcap") as file:
        LiveRecording(file, run.rig_file.rig).add(5, run.frame(0).image, None)
    assert list(read(tmp_path / "live.mcap")) == [PICTURE]


def test_frames_are_named_from_the_world_to_the_camera(tmp_path: Path) -> None:
    run = flat_run(tmp_path / "run", 1)
    camera = head_camera(metric(water=False), run.rig_file.rig)
    write_recording(tmp_path / "run.mcap", run, stamps_ns(run), None, camera)
    (message,) = read(tmp_path / "run.mcap")[TRANSFORMS]
    names = [(one.header.frame_id, one.child_frame_id) for one in message.transforms]
    assert names == [("world", "head"), ("head", "camera")]
    # From behind the sheet and beneath, the camera looks along the track and up, by 30 degrees.
    turn, place = pose(message.transforms[1])
    np.testing.assert_allclose(turn[:, 0], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(turn[:, 2], [0, np.cos(np.pi / 6), np.sin(np.pi / 6)], atol=1e-12)
    np.testing.assert_allclose(place[1:], [-np.cos(np.pi / 6), -np.sin(np.pi / 6)], atol=1e-12)


def test_an_aligned_surface_keeps_its_frame(tmp_path: Path) -> None:
    run = flat_run(tmp_path / "run", FRAMES)
    whole = build_surface([*read_profiles(run, metric(water=True))], run.rig_file.rig)
    whole = replace(whole, frame="workpiece", brightness=None)
    made = [*profiles_of(whole, run, tmp_path)]
    write_recording(tmp_path / "run.mcap", run, stamps_ns(run), made)
    clouds = read(tmp_path / "run.mcap")[POINTS]
    assert {cloud.header.frame_id for cloud in clouds} == {"workpiece"}
    z = np.stack([table_of(cloud)["z"] for cloud in clouds])
    np.testing.assert_allclose(z, whole.xyz_mm[..., 2] / 1000, rtol=ONE_DIGIT)
    with pytest.raises(InputError, match="other positions"):
        profiles_of(replace(whole, position_mm=whole.position_mm + 0.01), run, tmp_path)


def test_stamps_count_from_the_time_that_is_stated(tmp_path: Path) -> None:
    run = flat_run(tmp_path / "run", FRAMES)
    assert stamps_ns(run) == [0, 10**9, 2 * 10**9]
    began = datetime(2026, 5, 4, 9, 30, 0, 250_000, tzinfo=UTC)
    first = 1_777_887_000_250_000_000  # date -u -d 2026-05-04T09:30:00 +%s
    assert stamps_ns(run, began) == [first, first + 10**9, first + 2 * 10**9]
    before = replace(run, rows=(replace(run.rows[0], time_s=-1.0),))
    with pytest.raises(InputError, match="cannot hold"):
        stamps_ns(before)
    assert stamps_ns(before, began) == [first]
    with pytest.raises(InputError, match="holds no picture"):
        stamps_ns(replace(run, rows=()))


def test_the_same_run_gives_the_same_bytes(tmp_path: Path) -> None:
    run = flat_run(tmp_path / "run", 1)
    for name in ("a.mcap", "b.mcap"):
        write_recording(tmp_path / name, run, stamps_ns(run), clouds_of(run, metric(water=True)))
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_a_changed_picture_leaves_no_recording(tmp_path: Path) -> None:
    run = flat_run(tmp_path / "run", FRAMES)
    (tmp_path / "run/frames/000002.png").write_bytes(b"none")
    with pytest.raises(InputError, match=r"000002\.png: is not the picture"):
        write_recording(tmp_path / "run.mcap", run, stamps_ns(run))
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


# The command


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run, calibrations that know its camera and that do not, and its surface."""
    folder = tmp_path_factory.mktemp("export")
    flat_run(folder / "run", FRAMES)
    for name in ("refractive", "projective"):
        save_calibration(folder / f"{name}.json", drawn_calibration(name))
    run = open_run(folder / "run")
    plane_map = load_calibration(folder / "refractive.json").plane_map
    save_surface(folder / "surface.nc", reconstruct(run, plane_map).surface)
    return folder


def test_export_takes_points_from_pictures_or_from_a_surface(
    scanned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def export(name: str, *more: object) -> dict[str, list[Any]]:
        file = tmp_path / f"{name}.mcap"
        code, out, _ = call(capsys, "export", scanned / "run", "-o", file, *more)
        assert code == 0 and f"{FRAMES} of {PICTURE}" in out and out.endswith(f"{file}\n")
        return read(file)

    by_picture = export("pictures", "-c", scanned / "refractive.json")
    by_surface = export("surface", "--surface", scanned / "surface.nc")
    assert LENS in by_picture and LENS not in by_surface
    for one, other in zip(by_picture[POINTS], by_surface[POINTS], strict=True):
        for axis in "xyz":
            np.testing.assert_array_equal(table_of(one)[axis], table_of(other)[axis])
    assert POINTS not in export("plain", "--start", "2026-05-04T09:30:00Z")


def test_export_says_what_a_viewer_will_not_see(
    scanned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = "export", scanned / "run", "-o", tmp_path / "run.mcap", "-c"
    assert "knows no camera" in call(capsys, *words, scanned / "projective.json")[2]
    assert "a lens without a window" in call(capsys, *words, scanned / "refractive.json")[2]


def test_what_cannot_be_exported_is_refused_by_name(
    scanned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, file = scanned / "run", tmp_path / "run.mcap"
    refused(call(capsys, "export", run, "-o", tmp_path / "run.bag"), "--output", ".mcap")
    for start in ("yesterday", "2026-05-04T09:30:00"):
        refused(call(capsys, "export", run, "-o", file, "--start", start), "--start", start)
    other = flat_run(tmp_path / "other", 2)
    words = "--surface", scanned / "surface.nc"
    refused(call(capsys, "export", other.path, "-o", file, *words), "surface.nc", "other positions")
    assert not file.exists()
