"""``lscan extract``: points in mm, a part of the picture, two lasers."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import call, refused
from drawn_runs import sandwave_run
from metricviews import SIZE, known, paper_rig, poses, views_of, with_noise
from PIL import ExifTags, Image

from lscan.calibration.calibrationfile import save_calibration
from lscan.calibration.check import map_for_rig
from lscan.calibration.metric.solve import MetricCalibration, calibrate_metric
from lscan.files.pictures import read_picture, write_picture

UPPER, LOWER = 200.0, 260.0
LOWER_HALF = slice(230, None)


@pytest.fixture(scope="module")
def solved() -> MetricCalibration:
    rig, rng = paper_rig(), np.random.default_rng(1)
    views = [with_noise(view, 0.02, rng) for view in views_of(rig, poses(rig, rng))]
    return calibrate_metric(views, known(rig), SIZE)


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    """Two level lines, one pixel and a half wide."""
    v = np.arange(SIZE[1], dtype=float)[:, None]
    lines = sum(150 * np.exp(-((v - centre) ** 2) / 4.5) for centre in (UPPER, LOWER))
    noise = np.random.default_rng(2).normal(20, 1, (SIZE[1], SIZE[0]))
    path = tmp_path / "lines.png"
    write_picture(path, np.clip(np.rint(lines + noise), 0, 255).astype(np.uint8))
    return path


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize(
    ("extractor", "width_px", "hint"),
    [("centroid", 6.0, True), ("centroid", 1.5, False), ("ml", 6.0, False)],
)
def test_a_line_wider_than_the_span_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], extractor: str, width_px: float, hint: bool
) -> None:
    """Of a standard deviation of 6 px, 14 px are above half its height; the span looks at 5."""
    v = np.arange(160, dtype=float)[:, None]
    line = np.tile(20 + 150 * np.exp(-((v - 80) ** 2) / (2 * width_px**2)), (1, 60))
    write_picture(tmp_path / "wide.png", np.rint(line).astype(np.uint8))
    code, _, err = call(capsys, "extract", tmp_path / "wide.png", "--extractor", extractor)
    assert code == 0
    assert ("at least 14 px wide at half its height" in err and "--extractor ml" in err) == hint


@pytest.mark.parametrize(("sigma_px", "height_dn"), [(120.0, 180), (2.0, 3)])
def test_a_line_that_is_found_nowhere_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], sigma_px: float, height_dn: int
) -> None:
    """It fills the columns, so that they have no ground, or is below the threshold; then found."""
    v = np.arange(480, dtype=float)[:, None]
    line = np.tile(20 + height_dn * np.exp(-((v - 240) ** 2) / (2 * sigma_px**2)), (1, 64))
    write_picture(tmp_path / "wide.png", np.rint(line).astype(np.uint8))
    write_picture(tmp_path / "small.png", np.rint(line[::4, ::4]).astype(np.uint8))
    tried = ["small.png"] if height_dn > 100 else ["wide.png", "--threshold-dn", 1.5]
    code, out, err = call(capsys, "extract", tmp_path / "wide.png")
    assert (code, "line found in 0 of 64" in out) == (0, True)
    assert "none of the columns has a peak" in err and "a smaller picture" in err
    code, out, err = call(capsys, "extract", tmp_path / tried[0], *tried[1:])
    assert (code, "found in 0" in out, "has a peak" in err) == (0, False, False)


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_a_picture_of_more_bits_is_read_and_its_bits_are_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], bits: int
) -> None:
    """As a camera's program stores it, in the lower bits; the line is where it is in 8."""
    v = np.arange(120, dtype=float)[:, None]
    line = np.tile(20 + 150 * np.exp(-((v - 60.3) ** 2) / 4.5), (1, 60))
    line += np.random.default_rng(bits).normal(0, 0.2, line.shape)
    line[0, 0] = 250.0
    numbers = np.rint(line * 2.0 ** (bits - 8)).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "deep.png"), numbers)
    code, out, err = call(
        capsys, "extract", tmp_path / "deep.png", "-o", tmp_path / "line.csv", "--overlay",
        tmp_path / "overlay.png",
    )  # fmt: skip
    assert (code, "line found in 60 of 60" in out) == (0, True)
    assert f"of 16 bit, taken for a camera's of {bits}, its brightest pixel at 250" in err
    rows = rows_of(tmp_path / "line.csv")
    assert abs(np.mean([float(row["centre_px"]) for row in rows]) - 60.3) < 0.01
    assert abs(np.mean([float(row["peak_dn"]) for row in rows]) - 147) < 3
    assert read_picture(tmp_path / "overlay.png").dtype == np.uint8


def test_how_viewers_turn_a_picture_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    v = np.arange(80, dtype=float)[:, None]
    line = np.tile(20 + 150 * np.exp(-((v - 30) ** 2) / 4.5), (1, 60)).astype(np.uint8)
    for orientation in (1, 6):
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = orientation
        Image.fromarray(line).save(tmp_path / f"{orientation}.jpg", exif=exif)
        code, out, err = call(capsys, "extract", tmp_path / f"{orientation}.jpg")
        assert code == 0 and "found in 60 of 60 columns" in out  # upright it would be one of rows
        assert ("turned by 90 degrees to the right" in err) == (orientation == 6)


def test_a_single_picture_is_read_in_the_colour_of_its_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A green line in a lit room, which red shows as little as the wall."""
    v = np.arange(120, dtype=float)[:, None, None]
    line = 120 * np.exp(-((v - 60) ** 2) / 4.5) * np.array([0.1, 1.0, 0.1])
    noise = np.random.default_rng(3).normal(90, 1, (120, 80, 3))
    write_picture(tmp_path / "green.png", np.clip(np.rint(line + noise), 0, 255).astype(np.uint8))
    found = {}
    for channel in ([], ["--channel", "red"]):
        code, out, err = call(capsys, "extract", tmp_path / "green.png", *channel, "--json")
        assert code == 0, err
        found[len(channel)] = json.loads(out)["found"]
    assert found == {0: 80, 2: 0}


def test_an_upright_line_is_told_apart_from_a_level_one(
    picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    upright = tmp_path / "upright.png"
    write_picture(upright, np.ascontiguousarray(read_picture(picture)[LOWER_HALF].T))
    for arguments, hinted in (
        ([upright], True),
        ([picture], False),
        ([upright, "--axis", "rows"], False),
    ):
        code, _, err = call(capsys, "extract", *arguments)
        assert code == 0, err
        assert ("--axis rows" in err) is hinted


def test_a_line_without_colour_is_told_from_one_that_has(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An overexposed line, white on a wall that the room's light makes pink."""
    v = np.arange(120, dtype=float)[:, None, None]
    profile = np.exp(-((v - 60) ** 2) / 4.5)
    white, green = np.array([75.0, 90.0, 65.0]), np.array([10.0, 90.0, 10.0])
    for name, colour in (("white.png", white), ("green.png", green)):
        wall = np.array([160.0, 146.0, 172.0])
        noise = np.random.default_rng(3).normal(0, 1, (120, 80, 3))
        lit = np.rint(wall + profile * colour + noise)
        write_picture(tmp_path / name, np.clip(lit, 0, 255).astype(np.uint8))
    for arguments, hinted, least in (
        (["white.png"], True, 0),
        (["white.png", "--channel", "grey"], False, 80),
        (["green.png"], False, 80),
    ):
        code, out, err = call(capsys, "extract", tmp_path / arguments[0], *arguments[1:], "--json")
        assert code == 0, err
        assert ("--channel grey" in err) is hinted
        assert json.loads(out)["found"] >= least


def test_a_calibration_gives_points_in_mm(
    solved: MetricCalibration, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration, table = tmp_path / "c.json", tmp_path / "line.csv"
    save_calibration(calibration, solved)
    code, out, err = call(
        capsys, "extract", picture, "-c", calibration, "-o", table, "--returns", "first", "--json"
    )
    assert code == 0, err
    row = rows_of(table)[320]
    pixel = np.array([[320.0, float(row["centre_px"])]])
    points = solved.plane_map.to_plane(pixel, np.array([float(row["sigma_px"])]))
    given = [float(row[key]) for key in ("x_mm", "z_mm", "sigma_x_mm", "sigma_z_mm")]
    # One pixel and 640 are summed up in another order.
    np.testing.assert_allclose(given, [*points.xz_mm[0], *points.sigma_mm[0]], rtol=1e-12)
    assert abs(pixel[0, 1] - UPPER) < 0.1
    assert rows_of(table)[0]["status_mm"] == "OUT_OF_BOARD" and rows_of(table)[0]["x_mm"] == ""
    counts = json.loads(out)
    in_mm = sum(row["x_mm"] != "" for row in rows_of(table))
    assert counts["points_mm"]["found"] == in_mm > 100
    assert sum(counts["points_mm"]["status"].values()) == counts["columns"] == 640


def test_the_map_is_carried_to_the_water_of_a_run(
    solved: MetricCalibration, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration, table = tmp_path / "c.json", tmp_path / "line.csv"
    save_calibration(calibration, solved)
    run = sandwave_run(tmp_path / "run", 1, optics={"water_index": [1.4, 0.001]})
    code, _, err = call(capsys, "extract", run.path, "-c", calibration, "-o", table)
    assert code == 0, err
    row = next(row for row in rows_of(table) if row["x_mm"])
    pixel = np.array([[float(row["column"]), float(row["centre_px"])]])
    there = map_for_rig(solved.plane_map, run.rig_file.rig).to_plane(pixel).xz_mm[0]
    here = solved.plane_map.to_plane(pixel).xz_mm[0]
    np.testing.assert_allclose([float(row["x_mm"]), float(row["z_mm"])], there, rtol=1e-9)
    assert np.abs(there - here).max() > 0.1  # else the water would not be seen to count


def test_both_lines_of_two_lasers_are_read(
    solved: MetricCalibration, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration = tmp_path / "c.json"
    save_calibration(calibration, solved)
    overlay = tmp_path / "seen.png"
    code, out, err = call(
        capsys, "extract", picture, "--returns", "both", "-c", calibration, "-c", calibration,
        "-o", tmp_path / "line.csv", "--overlay", overlay,
    )  # fmt: skip
    assert code == 0, err
    assert "0: line found in 640 of 640" in out and "1: line found in 640 of 640" in out
    for number, v in enumerate((UPPER, LOWER)):
        rows = rows_of(tmp_path / f"line-{number}.csv")
        centres = np.array([float(row["centre_px"]) for row in rows])
        assert np.abs(centres - v).max() < 0.2
        assert (read_picture(overlay)[int(v)] == [0, 255, 0]).all()
    refused(call(capsys, "extract", picture, "--returns", "both", "-c", calibration), "-c", "two")
    assert "several lines" in call(capsys, "extract", picture)[2] and "several lines" not in err


def test_a_part_of_the_picture_and_a_mask(
    picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = call(capsys, "extract", picture, "--roi", "100,230,299,300", "--json",
                          "-o", tmp_path / "line.csv")  # fmt: skip
    assert code == 0, err
    assert json.loads(out)["status"] == {"OK": 200, "NO_DATA": 440}
    assert abs(float(rows_of(tmp_path / "line.csv")[150]["centre_px"]) - LOWER) < 0.2
    white = np.zeros((SIZE[1], SIZE[0]), dtype=np.uint8)
    white[180:220, :320] = 255
    write_picture(tmp_path / "mask.png", white)
    code, out, err = call(capsys, "extract", picture, "--mask", tmp_path / "mask.png", "--json")
    assert code == 0, err
    assert json.loads(out)["status"] == {"OK": 320, "NO_DATA": 320}


def test_bad_parts_and_calibrations_are_refused(
    solved: MetricCalibration, picture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for roi in ("1,2,3", "a,b,c,d", "10,10,5,20", "0,0,640,10"):
        refused(call(capsys, "extract", picture, "--roi", roi), "--roi", roi, "640")
    refused(call(capsys, "extract", picture, "-o", "."), ".: cannot be written")
    small = tmp_path / "small.png"
    write_picture(small, np.full((24, 32), 255, dtype=np.uint8))
    refused(call(capsys, "extract", picture, "--mask", small), "small.png", "640 x 480")
    write_picture(tmp_path / "black.png", np.zeros((SIZE[1], SIZE[0]), dtype=np.uint8))
    refused(call(capsys, "extract", picture, "--mask", tmp_path / "black.png"), "--mask")
    calibration = tmp_path / "c.json"
    save_calibration(calibration, solved)
    refused(call(capsys, "extract", small, "-c", calibration), "small.png", "640 x 480")
    refused(call(capsys, "extract", picture, "--returns", "third"), "--returns", "third", "both")
    lower = ("--returns", "both", "--roi", f"0,{LOWER - 15:.0f},639,{LOWER + 15:.0f}")
    told = call(capsys, "extract", picture, *lower, "-o", tmp_path / "one.csv")
    refused(told, "--returns: both: 640 columns hold one line, and none holds two")
    assert not list(tmp_path.glob("one*"))
    for option in ("--span", "--span-px"):
        refused(call(capsys, "extract", picture, option, 0), "span_px")
