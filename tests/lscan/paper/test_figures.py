"""The figures: what they say is what the data hold, and their bytes are stable."""

import base64
import dataclasses
import re
import xml.etree.ElementTree as ElementTree
from importlib.resources import files

import cv2
import numpy as np
import pytest
import report_examples
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.calibration.maps.graticule import DrawnConversion
from lscan.config.targets import Sandwave
from lscan.errors import InputError, MeasurementError
from lscan.figures import style
from lscan.figures.page import signed_number
from lscan.figures.style import cell_for, grid_heights
from lscan.measure import SliceErrors
from lscan.paper import published as paper
from lscan.paper.experiment import LinePictures
from lscan.paper.picturefigures import (
    FITS,
    RowFits,
    board_picture,
    column_intensities,
    control_points,
    groove_snapshot,
    line_fits,
    lit_column,
    row_fits,
    ruler,
    sandwave_snapshot,
    sensitivity,
)
from lscan.paper.surfacefigures import (
    contours_after,
    contours_before,
    levelled_relief,
    on_the_waves,
    raw_relief,
    slice_plot,
    surface_to_turn,
)
from lscan.records import Status, Stripe
from lscan.surface import Slice


def _plane(step_mm: float, offset_mm: float) -> np.ndarray:
    along = offset_mm + np.arange(0, 30, step_mm)
    x, y = np.meshgrid(along, along)
    return np.stack([x, y, 0.3 * x - 0.7 * y + 5], axis=2)


@examples(40)
@given(st.integers(1, 4), st.floats(-5, 5))
def test_grid_keeps_a_plane_sampled_evenly(per_cell, offset):
    """The tent weights' first moment vanishes on a lattice whose step divides the cell."""
    cell = 1.5
    grid = grid_heights(_plane(cell / per_cell, offset), cell)
    plane = 0.3 * grid.x_mm[None, :] - 0.7 * grid.y_mm[:, None] + 5
    inner = (slice(2, -2), slice(2, -2))  # a node on the rim has points on one side only
    np.testing.assert_allclose(grid.z_mm[inner], plane[inner], atol=1e-9)


@examples(40)
@given(st.integers(0, 2**32 - 1), st.integers(-50, 50))
def test_grid_averages_and_moves_with_its_points(seed, cells):
    points = np.random.default_rng(seed).normal(0, 10, (200, 3))
    grid = grid_heights(points, 2.0)
    held = grid.z_mm[np.isfinite(grid.z_mm)]
    assert points[:, 2].min() - 1e-9 <= held.min() <= held.max() <= points[:, 2].max() + 1e-9
    moved = grid_heights(points + np.array([2.0 * cells, 0, 0]), 2.0)
    np.testing.assert_allclose(moved.x_mm, grid.x_mm + 2.0 * cells)
    np.testing.assert_allclose(moved.z_mm, grid.z_mm, atol=1e-6)


def test_grid_leaves_holes_and_refuses_nothing_at_all():
    points = _plane(0.5, 0.0)
    points[20:40, 20:40] = np.nan
    grid = grid_heights(points, 1.5)
    assert np.isnan(grid.z_mm[10, 10])
    assert np.isfinite(grid.z_mm[3, 3])
    with pytest.raises(MeasurementError, match="no point"):
        grid_heights(np.full((4, 4, 3), np.nan), 1.5)


def test_cell_is_no_finer_than_the_scan_nor_than_the_page_can_carry():
    assert cell_for(_plane(0.5, 0.0), least_mm=1.5) == 1.5
    assert cell_for(_plane(4.0, 0.0), least_mm=1.5) == pytest.approx(6.0)
    assert cell_for(_plane(0.5, 0.0), 0.1, most_nodes=10) == pytest.approx(2.95)


def test_svg_is_stable_follows_the_theme_and_keeps_its_ids_apart():
    row = row_fits(report_examples.board_alone().board)
    first, again = line_fits(row), line_fits(row)
    assert first == again
    ids = re.findall(r' id="([^"]+)"', first.body)
    assert ids and all(name.startswith("line-fits-") for name in ids)
    assert len(set(ids)) == len(ids)
    targets = re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', first.body)
    assert targets and {a or b for a, b in targets} <= set(ids)
    bare = re.sub(r"var\(--\w+, #\w+\)", "", first.body)
    assert not [colour for colour in style.PALETTE.values() if colour in bare]
    assert ElementTree.fromstring(first.body).get("role") == "img"


def test_the_style_sheet_has_the_palettes_colours():
    """svg() makes variables of the page's theme of those colours alone."""
    text = files("lscan.figures").joinpath("report.mplstyle").read_text()
    used = set(re.findall(r": ([0-9a-f]{6})\b", text))
    assert used
    assert used <= {colour.removeprefix("#") for colour in style.PALETTE.values()}


def test_photograph_shows_the_picture_in_pixel_coordinates():
    image = np.full((24, 32, 3), (200, 40, 90), dtype=np.uint8)
    text = style.photograph(image, style.spots(np.array([[3.0, 4.0]]), "#fff", 1), 'a "b" & <c>')
    svg = ElementTree.fromstring(text)
    assert svg.get("viewBox") == "-0.5 -0.5 32 24"
    assert svg.get("aria-label") == 'a "b" & <c>'
    picture, spot = svg
    data = base64.b64decode(picture.get("href", "").removeprefix("data:image/jpeg;base64,"))
    shown = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
    # JPEG quality 90 rounds a flat block's mean by at most 2 DN in each of its three planes.
    assert np.abs(shown.astype(int) - image).max() <= 6
    assert spot.get("d") == "M3.00,4.00h0"


@pytest.mark.parametrize(
    "image", [np.zeros((4, 4)), np.zeros((4, 4, 4), np.uint8), np.zeros(4, np.uint8)]
)
def test_photograph_refuses_what_is_no_picture(image):
    with pytest.raises(InputError, match="not a picture"):
        style.photograph(image, "", "")


def test_marks_without_a_place_are_not_drawn():
    points = np.array([[1.0, 2.0], [np.nan, np.nan], [5.0, 6.0]])
    assert style.spots(points, "#fff", 2.0).count("M") == 2


def test_control_points_counts_what_was_found():
    reading = report_examples.reading(np.random.default_rng(1))
    image = np.zeros((480, 640), np.uint8)
    figure = control_points(image, reading)
    found = int(reading.grid.found.sum())
    assert f"{found} of 100 control points" in figure.caption
    assert "230 of 230 marks of 5 rulers" in figure.caption
    top, bottom = (
        np.linalg.norm(np.diff(row, axis=0), axis=1).mean()
        for row in reading.grid.image_px.reshape(10, 10, 2)[[0, -1]]
    )
    caption = board_picture(image, reading).caption
    assert f"{top:.1f} px apart in the top row" in caption
    assert f"{bottom:.1f} px in the bottom row" in caption


def _row(points: np.ndarray, curves: dict[str, np.ndarray], **shifted: object) -> RowFits:
    """A row whose fits are these, the others lying on the points."""
    curves = dict.fromkeys(FITS, points) | curves
    return RowFits(points, curves, **{"shifted_px": points, "shifted_curves": {}} | shifted)


def test_line_fits_report_their_residuals():
    u = np.arange(0.0, 100.0, 10.0)
    points = np.column_stack([u, np.where(np.arange(10) % 2, 3.0, 5.0)])
    level = np.array([[0.0, 4.0], [90.0, 4.0]])  # 1 px off every point
    figure = line_fits(_row(points, {"graticule-1": level}))
    assert "first-order rms 1.00 px rms, 1.00 px at most" in figure.caption
    assert "cubic B-spline 0.00 px rms" in figure.caption
    assert figure.body.count("px rms off the control points") == 3
    turned = {"graticule-1": level[::-1], "graticule-bspline": points[::-1]}
    assert line_fits(_row(points, turned)).caption == figure.caption


def test_sensitivity_reports_move_and_inflections():
    u = np.linspace(0, 5 * np.pi, 2000)
    before = np.column_stack([u, 0.1 * u**2])
    after = before + np.column_stack([0 * u, 0.75 * np.maximum(np.sin(u), -1 / 3)])
    points = before[::200]
    shifted = points + [[0, 1]] * (np.arange(len(points)) == 3)[:, None]

    def caption(moved: np.ndarray) -> str:
        row = _row(
            points,
            {"graticule-2": before},
            shifted_px=shifted,
            shifted_curves={"graticule-2": moved},
        )
        return sensitivity(row, "graticule-2", "Fig. 34").caption

    assert "by up to 0.75 px" in caption(after)
    assert "other way by up to 0.25 px" in caption(after)
    # sin has an inflection at each multiple of pi: four within 0 to 5 pi; a parabola has none.
    waves = caption(np.column_stack([u, np.sin(u)]))
    assert "changes sign 0 times before and 4 times after" in waves


def test_the_shifted_point_moves_its_own_row_alone():
    """The spline goes through the point that was moved up by a pixel; a quadratic averages."""
    row = row_fits(report_examples.board_alone().board)
    shift = row.shifted_px - row.points_px
    assert np.count_nonzero(shift) == 1 and shift[5, 1] == -1.0
    moved = {}
    for name in ("graticule-bspline", "graticule-2"):
        before, after = row.curves[name], row.shifted_curves[name]
        moved[name] = np.abs(np.interp(row.points_px[:, 0], *after.T)
                             - np.interp(row.points_px[:, 0], *before.T))  # fmt: skip
    assert moved["graticule-bspline"].argmax() == 5
    assert moved["graticule-2"].max() < moved["graticule-bspline"].max() < 1.0 + 1e-9


def test_ruler_reports_the_size_of_a_pixel():
    px = np.arange(0.0, 100.0, 8.0)
    figure = ruler(DrawnConversion("vertical", 4.0, px, -1.25 * px, px, -1.25 * px))
    assert "13 marks of ruler at x = 4 mm" in figure.caption
    assert "1.25 to 1.25 mm" in figure.caption
    assert "v / px" in figure.body and "z / mm" in figure.body


def _paper_frames() -> list[np.ndarray]:
    """Dark pictures whose 320th column holds the pixels printed in Sec. V.B."""
    frames = []
    for pixels in paper.COLUMN_PIXELS:
        frame = np.zeros((480, 640, 3), np.uint8)
        for v, intensity in pixels:
            frame[v, paper.COLUMN, 0] = intensity
        frames.append(frame)
    return frames


def test_column_intensities_give_the_papers_centres():
    caption = column_intensities(_paper_frames(), paper.COLUMN).caption
    for centre in (*paper.CENTRES_RAW_PX[:2], *paper.CENTRES_RELATIVE_PX[:2]):
        assert f"{centre:.4f}" in caption
    # Frame 3 as its printed pixels give it (paper.MISPRINTS).
    assert "252.1894" in caption and "252.5498" in caption
    assert "0.6774 px in the paper" in caption and "0.0813 px in the paper" in caption


def test_column_without_a_line_is_said_to_have_none():
    frames = [np.zeros((48, 64, 3), np.uint8)] * 3
    assert "finds no line" in column_intensities(frames, 10).caption


def _stripe(lit: list[int], width: int = 640) -> Stripe:
    status = np.full(width, int(Status.NO_PEAK))
    status[lit] = Status.OK
    centre = np.where(status == Status.OK, 100.0, np.nan)
    return Stripe("columns", centre, centre / 1000, np.zeros(width), status)


def _pictures(lit: list[int], width: int = 640) -> LinePictures:
    return LinePictures([np.zeros((480, width, 3), np.uint8)], _stripe(lit, width))


def test_lit_column_is_the_papers_or_the_nearest_with_a_line():
    assert lit_column(_pictures([100, 320, 330])) == 320
    assert lit_column(_pictures([100, 300, 331])) == 331
    assert lit_column(_pictures([])) == 320
    assert lit_column(_pictures([], width=64)) == 63
    upright = dataclasses.replace(_stripe([7]), axis="rows")
    pictures = dataclasses.replace(_pictures([7]), stripe=upright)
    assert lit_column(pictures) == 320


def test_snapshots_say_how_much_of_the_line_was_found():
    pictures = _pictures([10, 11, 12])
    assert "3 of 640 columns" in groove_snapshot(pictures).caption
    figure = sandwave_snapshot(pictures, 320)
    assert "median standard uncertainty 0.100 px" in figure.caption
    assert "M320,0V480" in figure.body


def _slice(error: list[float], status: list[Status]) -> tuple[Slice, SliceErrors]:
    """A slice of height 5 mm, whose points hold a height where their error is a number."""
    errors, codes = np.array(error), np.array([int(s) for s in status])
    along = np.arange(len(errors), dtype=float)
    nominal = np.full(len(errors), 5.0)
    xy = np.column_stack([along, 0 * along])
    cut = Slice(xy, along, nominal + errors, np.full(len(errors), 0.1), codes, 1.0)
    return cut, SliceErrors(nominal, errors, int(np.isfinite(errors).sum()), 0, 0)


def test_slice_reports_its_error_and_its_gaps():
    cut, errors = _slice(
        [-0.5, 2.0, np.nan, np.nan, np.nan],
        [Status.OK, Status.OK, Status.OCCLUDED, Status.OCCLUDED, Status.NO_DATA],
    )
    figure = slice_plot("S1", cut, errors, "Fig. 29", 1.5)
    assert "rmse 1.46 mm, from −0.50 to +2.00 mm; 50.0 % within ±1.5 mm" in figure.caption
    assert "Grey: 2 occluded, 1 no data, of 5 points" in figure.caption
    assert "two standard uncertainties" in figure.caption and "error / mm" in figure.body
    cut, errors = _slice([0.1, np.nan], [Status.OK, Status.OK])
    uncompared = dataclasses.replace(cut, z_mm=np.array([5.1, 7.0]))
    caption = slice_plot("S1", uncompared, errors, "", 1.5).caption
    assert "Measured but not compared: 1 points" in caption


def test_reliefs_say_tilt_count_and_corners():
    x, y = np.meshgrid(np.linspace(0, 100, 60), np.linspace(0, 100, 200))
    slope_x, slope_y = np.tan(np.radians([3.0, -2.0]))
    points = np.stack([x, y, slope_x * x + slope_y * y], axis=2)
    points[5, 5] = np.nan
    caption = raw_relief(points).caption
    assert "11,999 points of 200 profiles" in caption
    assert "+3.00° along x and −2.00° along y" in caption
    assert "one in 3 profiles drawn" in caption


def test_the_levelled_relief_says_how_far_apart_the_corners_are():
    sandwave = report_examples.experiment().sandwave
    figure = levelled_relief(sandwave.raw.xyz_mm, sandwave.alignment)
    left, right = (
        sandwave.alignment.to_raw(np.array([*corner, sandwave.alignment.base_mm]))
        for corner in Sandwave().wedge_tips_mm()
    )
    assert f"W_L and W_R, {np.linalg.norm(right - left):.2f} mm apart" in figure.caption


def test_contours_say_yaw_shift_and_slices():
    sandwave = report_examples.sandwave_measures(
        np.random.default_rng(1), report_examples.workpiece_mm(90, 160)
    )
    waves = on_the_waves(sandwave)
    before = contours_before(sandwave, waves)
    turned = sandwave.raw.xyz_mm @ sandwave.alignment.rotation.T
    track = np.nanmax(turned[..., 1]) - np.nanmin(turned[..., 1])
    shift = track * np.tan(np.radians(2.2))
    assert f"{shift:.1f} mm over {track:.0f} mm at the yaw found, 2.200°" in before.caption
    after = contours_after(sandwave, waves)
    assert "Lines: the slices S1, S2, S3, SD." in after.caption
    assert ">S1</text>" in after.body
    alignment = dataclasses.replace(sandwave.alignment, yaw_rad=0.0, sheared=False)
    turned_about = dataclasses.replace(sandwave, alignment=alignment)
    assert "°" not in contours_before(turned_about, waves).caption


def test_surface_to_turn_is_plain_json_without_nan():
    points = report_examples.workpiece_mm(60, 60)
    points[20:30, 20:30] = np.nan
    script = surface_to_turn(points, np.isfinite(points[..., 2])).script
    assert script.startswith('Plotly.newPlot("surface", [{"type": "surface"')
    assert "NaN" not in script and "null" in script


@given(st.floats(-1e3, 1e3))
@examples(50)
def test_signed_reads_back(value):
    text = signed_number(value, 3)
    assert text[0] in "+−"
    assert abs(float(text.replace("−", "-")) - value) <= 0.0005 + 1e-9
