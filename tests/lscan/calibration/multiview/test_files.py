"""Views files, calibration files and the command of the metric route."""

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import typer
from metricviews import SIZE, known, paper_rig, poses, views_of, with_noise
from typer.testing import CliRunner

from lscan.calibration.calibrationfile import (
    load_camera,
    load_metric,
    load_plane_map,
    save_calibration,
)
from lscan.calibration.marks import without
from lscan.calibration.metric import views as viewsfile
from lscan.calibration.metric.solve import (
    MetricCalibration,
    UnsolvedViews,
    calibrate_camera,
    calibrate_metric,
)
from lscan.calibration.metric.views import CalibrationView, load_views, read_views
from lscan.calibration.planemap import find_solver
from lscan.camera import CameraModel, project
from lscan.cli.calibrate import calibrate_metric as command
from lscan.config.rig import OpticsSection
from lscan.errors import InputError
from lscan.files.pictures import encode_picture, read_picture, write_picture
from lscan.records import BoardReading, Bytes, Floats, Marks

CHESSBOARD = '[board]\nkind = "chessboard"\ncolumns = 8\nrows = 6\nsquare_mm = 25.0\n'
KNOWN_BOARDS: dict[Any, Marks] = {}


@pytest.fixture(scope="module")
def solved() -> MetricCalibration:
    rig, rng = paper_rig(), np.random.default_rng(1)
    views = [with_noise(view, 0.02, rng) for view in views_of(rig, poses(rig, rng))]
    views.append(CalibrationView("dark.png", None, None, "no board"))
    return calibrate_metric(views, known(rig), SIZE)


def test_a_file_comes_back_number_for_number(solved: MetricCalibration, tmp_path: Path) -> None:
    save_calibration(tmp_path / "a.json", solved)
    read = load_metric(tmp_path / "a.json")
    pixels = np.array([[250.0, 200.0], [319.5, 239.5], [400.0, 260.0]])
    one, two = solved.plane_map.to_plane(pixels), read.plane_map.to_plane(pixels)
    np.testing.assert_array_equal(one.xz_mm, two.xz_mm)
    np.testing.assert_array_equal(one.sigma_mm, two.sigma_mm)
    assert [view.reason for view in read.views] == [view.reason for view in solved.views]
    assert (read.rms_px, read.line_rms_mm) == (solved.rms_px, solved.line_rms_mm)
    save_calibration(tmp_path / "b.json", read)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()


def test_a_file_can_be_solved_again(solved: MetricCalibration, tmp_path: Path) -> None:
    save_calibration(tmp_path / "a.json", solved)
    read = load_metric(tmp_path / "a.json")
    again = calibrate_metric(read.views, read.optics, read.image_size, read.k3)
    # The order of sums differs with the arrays' place in memory; the fit stops where the sum
    # of squares changes by 1e-12 of itself, which parameters reach to half the digits.
    np.testing.assert_allclose(
        again.plane_map.view.theta, solved.plane_map.view.theta, rtol=1e-6, atol=1e-8
    )
    pixels = np.array([[250.0, 200.0], [400.0, 260.0]])
    one, two = solved.plane_map.to_plane(pixels), again.plane_map.to_plane(pixels)
    np.testing.assert_allclose(two.xz_mm, one.xz_mm, rtol=0, atol=1e-5)
    np.testing.assert_allclose(two.sigma_mm, one.sigma_mm, rtol=1e-3)


def test_the_map_is_known_by_name_but_not_solved_from_one_picture(
    solved: MetricCalibration,
) -> None:
    named = find_solver("metric")
    restored = named.restore(solved.plane_map.parameters())
    pixels = np.array([[300.0, 250.0]])
    np.testing.assert_array_equal(
        restored.to_plane(pixels).xz_mm, solved.plane_map.to_plane(pixels).xz_mm
    )
    marks = solved.views[0].marks
    assert marks is not None
    reading = BoardReading(SIZE, 25.0, (6, 8), marks)
    with pytest.raises(InputError, match="calibrate-metric"):
        named.solve(reading)
    with pytest.raises(InputError, match="no such metric map"):
        find_solver("metric-3").restore({})


def spoilt(key: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def spoil(document: dict[str, Any]) -> None:
        *way, last = key.split(".")
        inner: Any = document
        for part in way:
            inner = inner[int(part)] if part.isdigit() else inner[part]
        inner[last] = value

    return spoil


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (spoilt("format", "lscan-calibration"), "is no metric calibration"),
        (spoilt("version", 2), "version"),
        (spoilt("surprise", 1), "surprise: unknown key"),
        (spoilt("parameters.q_per_mm", [0.0, 0.0, 0.0]), "q_per_mm"),
        (spoilt("parameters.theta.water_index", 0.3), "theta.water_index"),
        (spoilt("parameters.modes", [[1.0]]), "modes"),
        (spoilt("views.0.line.sigma_px", [0.1]), "views.0.line"),
        (spoilt("views.0.marks.status", ["OK"]), "views.0.marks"),
        (spoilt("image_size", [640, 0]), "image_size"),
        (spoilt("camera_sigma", [1.0]), "camera_sigma"),
        (spoilt("views.0.rms_px", None), "views.0"),
        (spoilt("views.8.used", True), "views.8"),
    ],
)
def test_a_spoilt_file_is_refused(
    solved: MetricCalibration,
    tmp_path: Path,
    spoil: Callable[[dict[str, Any]], None],
    named: str,
) -> None:
    path = tmp_path / "a.json"
    save_calibration(path, solved)
    document = json.loads(path.read_text())
    spoil(document)
    path.write_text(json.dumps(document))
    with pytest.raises(InputError) as caught:
        load_metric(path)
    assert str(path) in str(caught.value) and named in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"format": NaN}'])
def test_what_is_no_json_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"a\.json"):
        load_metric(path)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("", "board"),
        (CHESSBOARD, "view"),
        (CHESSBOARD + "[[view]]\n", "view.0.picture"),
        (CHESSBOARD + '[[view]]\npicture = "a.png"\nlamp = 1\n', "lamp: unknown key"),
        (CHESSBOARD + '[[view]]\npicture = "a.png"\nbackground = "b.png"\n', "view.0.background: "),
        ('[board]\nkind = "stripes"\n[[view]]\npicture = "a.png"\n', "no such kind (got 'stripes'"),
        (CHESSBOARD.replace("8", "2") + '[[view]]\npicture = "a.png"\n', "columns"),
        (CHESSBOARD.replace("25.0", "0.0") + '[[view]]\npicture = "a.png"\n', "square_mm"),
        (CHESSBOARD + '[optics]\nport = "dome"\n[[view]]\npicture = "a.png"\n', "optics.port"),
    ],
)
def test_a_bad_views_file_is_refused(tmp_path: Path, text: str, named: str) -> None:
    path = tmp_path / "views.toml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        load_views(path)
    assert str(path) in str(caught.value) and named in str(caught.value)


def drawn(camera: CameraModel, rotation: Floats, place: Floats) -> Bytes:
    """A chessboard of 8 by 6 inner corners as the camera sees it, supersampled twice."""
    scale = 4
    image = np.full((SIZE[1] * scale, SIZE[0] * scale), 120, dtype=np.uint8)

    def pixels(corners: list[tuple[float, float]]) -> Any:
        local = np.array([[x, y, 0.0] for x, y in corners]) * 25.0
        seen = project(camera, local @ rotation.T + place)
        return np.rint(((seen + 0.5) * scale - 0.5) * 16).astype(np.int32)

    left, top = -4.5, -3.5
    rim = [(left - 1, top - 1), (-left + 1, top - 1), (-left + 1, -top + 1), (left - 1, -top + 1)]
    cv2.fillConvexPoly(image, pixels(rim), 230, shift=4)
    for row in range(7):
        for column in range(9):
            if (row + column) % 2 == 0:
                x, y = left + column, top + row
                square = [(x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1)]
                cv2.fillConvexPoly(image, pixels(square), 20, shift=4)
    small = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)
    return np.repeat(small[:, :, None], 3, axis=2)


@pytest.fixture(autouse=True)
def boards_of_the_same_picture_are_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def remembered(picture: Bytes, *kind: Any) -> Marks:
        key = picture.tobytes(), kind
        if key not in KNOWN_BOARDS:
            KNOWN_BOARDS[key] = read(picture, *kind)
        return KNOWN_BOARDS[key]

    read = viewsfile.read_chessboard
    monkeypatch.setattr(viewsfile, "read_chessboard", remembered)


def write_pictures(folder: Path) -> Path:
    """Views in air: the paper's camera without distortion, five chessboards with a line."""
    for name, content in pictures().items():
        (folder / name).write_bytes(content)
    return folder / "views.toml"


@cache
def pictures() -> dict[str, bytes]:
    """The files of :func:`write_pictures` by name."""
    rig = paper_rig(water=False)
    camera = CameraModel(850.0, (319.5, 239.5))
    text = CHESSBOARD + '[optics]\nport = "none"\n[stripe]\nthreshold_dn = 30.0\n'
    found, rng = {}, np.random.default_rng(3)
    for number, pose in enumerate(poses(rig, rng, 6)):
        plain = drawn(camera, pose.rotation, pose.place_mm)
        lit = plain.astype(float)
        along = np.cross(pose.rotation[:, 2], rig.q_per_mm)
        reach = np.linspace(-300, 300, 1200)[:, None]
        line = project(camera, pose.place_mm + reach * along / np.linalg.norm(along))
        order = np.argsort(line[:, 0])
        centre = np.interp(np.arange(SIZE[0]), line[order, 0], line[order, 1])
        profile = np.exp(-((np.arange(SIZE[1])[:, None] - centre) ** 2) / (2 * 1.5**2))
        lit[:, :, 0] += 100 * profile * (np.ptp(line[:, 0]) > np.ptp(line[:, 1]))
        found[f"p{number}.png"] = encode_picture(plain, ".png")
        found[f"l{number}.png"] = encode_picture(np.clip(lit, 0, 255).astype(np.uint8), ".png")
        text += f'[[view]]\npicture = "p{number}.png"\nlaser = "l{number}.png"\n'
    return found | {"views.toml": text.encode()}


def test_the_command_goes_all_the_way(tmp_path: Path) -> None:
    path = write_pictures(tmp_path)
    write_picture(tmp_path / "empty.png", np.full((SIZE[1], SIZE[0]), 90, dtype=np.uint8))
    path.write_text(path.read_text() + '[[view]]\npicture = "empty.png"\n')
    app = typer.Typer()
    app.command()(command)
    output = tmp_path / "metric.json"
    result = CliRunner().invoke(app, [str(path), "-o", str(output), "--json"])
    assert result.exit_code == 0, result.output
    printed = json.loads(result.output)
    assert [view["used"] for view in printed["views"]] == [True] * 6 + [False]
    assert "no chessboard" in printed["views"][6]["fault"]
    assert printed["rms_px"] < 0.1  # 8-bit corners drawn with squares whose edges are soft
    focal = printed["camera"]["focal_px"]
    assert abs(focal["value"] - 850.0) < 5 * focal["sigma"]
    truth, found = paper_rig(water=False).q_per_mm, load_metric(output).plane_map.view.q_per_mm
    cosine = truth @ found / np.linalg.norm(truth) / np.linalg.norm(found)
    assert np.degrees(np.arccos(min(cosine, 1.0))) < 0.5  # five lines of some 100 mm, 0.1 px


def test_pictures_of_another_size_are_refused(tmp_path: Path) -> None:
    path = write_pictures(tmp_path)
    write_picture(tmp_path / "p2.png", np.zeros((100, 100), dtype=np.uint8))
    with pytest.raises(InputError, match=r"p2\.png.*first picture's size"):
        read_views(load_views(path))
    (tmp_path / "p1.png").unlink()
    with pytest.raises(InputError, match=r"p1\.png"):
        read_views(load_views(path))


def called(*arguments: object) -> Any:
    app = typer.Typer()
    app.command()(command)
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_a_failure_shows_the_views_and_what_was_seen(tmp_path: Path) -> None:
    """Laser pictures without a laser: the boards are found, no line is."""
    path = write_pictures(tmp_path)
    for number in range(6):
        (tmp_path / f"l{number}.png").write_bytes((tmp_path / f"p{number}.png").read_bytes())
    result = called(path, "-o", tmp_path / "metric.json")
    assert isinstance(result.exception, UnsolvedViews)
    assert "p3.png" in str(result.exception) and "no laser line" in str(result.exception)
    assert "p0.png" in result.output and "48 of 48" in result.output
    assert not (tmp_path / "metric.json").exists()
    pictures = sorted((tmp_path / "metric-views").iterdir())
    assert [picture.name for picture in pictures] == [f"{k}-p{k}.png" for k in range(6)]
    drawn_over = read_picture(pictures[2]).astype(int) - read_picture(tmp_path / "p2.png")
    assert (drawn_over[20:, :, 1] > 100).sum() >= 48  # a green cross on each dark corner
    as_json = called(path, "-o", tmp_path / "metric.json", "--json")
    printed = json.loads(as_json.output[: as_json.output.rindex("}") + 1])
    assert printed["calibration"] is None and len(printed["views"]) == 6


def test_pictures_of_the_views_are_written_where_asked(tmp_path: Path) -> None:
    path = write_pictures(tmp_path)
    result = called(path, "-o", tmp_path / "metric.json", "--overlays", tmp_path / "seen")
    assert result.exit_code == 0, result.output
    amber = read_picture(tmp_path / "seen" / "1-p1.png")
    on_line = (amber == np.array([255, 200, 0])).all(axis=2).sum()
    used = load_metric(tmp_path / "metric.json").views[1]
    assert used.line_used and on_line == used.points_found


@pytest.mark.slow
def test_a_camera_is_kept_and_used_for_a_later_sheet(tmp_path: Path) -> None:
    """The boards without lines give the camera; two poses with lines then give the sheet."""
    path = write_pictures(tmp_path)
    whole = path.read_text()
    head, *entries = whole.split("[[view]]\n")
    boards = ["[[view]]\n" + entry.split("laser")[0] for entry in entries]
    path.write_text(head + "".join(boards))
    camera, output = tmp_path / "camera.json", tmp_path / "metric.json"
    result = called(path, "-o", camera, "--camera-only", "--json")
    assert result.exit_code == 0, result.output
    focal = json.loads(result.output)["camera"]["focal_px"]
    assert abs(focal["value"] - 850.0) < 5 * focal["sigma"]
    read = load_camera(camera)
    save_calibration(tmp_path / "again.json", read)
    assert (tmp_path / "again.json").read_bytes() == camera.read_bytes()
    with pytest.raises(InputError, match=r"camera alone.*--camera"):
        load_plane_map(camera)
    level = [k for k in range(6) if load_views_line(tmp_path, head, entries[k])][:2]
    few = head + "".join("[[view]]\n" + entries[k] for k in level)
    path.write_text(few)
    refused = called(path, "-o", output)
    assert "needs 3 views" in str(refused.exception)
    assert called(path, "-o", output, "--camera", camera).exit_code == 0
    found = load_metric(output)
    # The poses that both files list count once: the same marks twice would say half their variance.
    assert sum(view.line_used for view in found.views) == 2 and len(found.views) == 6
    path.write_text(few.replace('port = "none"', 'port = "none"\nk1 = [0.1, 0.1]'))
    other = called(path, "-o", output, "--camera", camera)
    assert isinstance(other.exception, InputError) and "optics" in str(other.exception)


def test_lines_are_no_matter_to_a_camera_alone(tmp_path: Path) -> None:
    result = called(write_pictures(tmp_path), "-o", tmp_path / "camera.json", "--camera-only")
    assert result.exit_code == 0, result.output
    assert result.output.count("│ used") == 6 and "line was found" not in result.output


def load_views_line(folder: Path, head: str, entry: str) -> bool:
    """Whether the line of one view is found: only those that run across the columns are drawn."""
    (folder / "one.toml").write_text(head + "[[view]]\n" + entry)
    views, _ = read_views(load_views(folder / "one.toml"))
    return views[0].line is not None


def test_a_spoilt_camera_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"format": "lscan-metric-calibration"}')
    with pytest.raises(InputError, match=r"a\.json: is no camera calibration"):
        load_camera(tmp_path / "a.json")
    (tmp_path / "a.json").write_text('{"format": "lscan-camera-calibration", "version": 1}')
    with pytest.raises(InputError, match=r"a\.json: .*software"):
        load_camera(tmp_path / "a.json")


@pytest.mark.parametrize("kept", [pytest.param(3, marks=pytest.mark.slow), 8])
def test_a_board_of_which_little_is_left_is_a_fault_of_its_view(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kept: int
) -> None:
    """Corners that a blurred picture leaves: three, or one row."""
    read = viewsfile.read_chessboard
    calls = []

    def few(*arguments: Any) -> Marks:
        marks = read(*arguments)
        calls.append(marks)
        left = marks.found & (np.arange(len(marks.status)) < kept)
        if kept == 3:
            left[[1, 8]] = [False, True]
        reading = BoardReading(SIZE, 25.0, (6, 8), marks)
        return without(reading, ~left).grid if len(calls) == 3 else marks

    monkeypatch.setattr(viewsfile, "read_chessboard", few)
    views, _ = read_views(load_views(write_pictures(tmp_path)))
    assert [view.marks_found for view in views] == [48, 48, kept, 48, 48, 48]
    optics = OpticsSection(port="none")
    fitted = calibrate_camera(views, optics, SIZE).views
    assert [view.used for view in fitted] == [True, True, False, True, True, True]
    assert "needed" in fitted[2].reason or "in one line" in fitted[2].reason
