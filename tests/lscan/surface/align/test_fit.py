"""Alignment of scans of the nominal sandwave: closed forms, truth, invariance, bad input."""

import time
from dataclasses import replace

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import Phase, given, strategies as st
from synthetic_scans import Placing, scan

from lscan.config.targets import Sandwave
from lscan.errors import InputError, MeasurementError
from lscan.measure import compare_slice
from lscan.records import Floats, Status, Surface
from lscan.surface import Alignment, align_sandwave, apply, level, levelling_step, resample, shear
from lscan.surface.align import CORNER_MARGIN_MM, _Edges
from lscan.surface.alignment import plane_normal
from lscan.surface.edges import SOFTNESS, EdgeCrossings, EdgeFit, fit_edges

PIECE = Sandwave()
YAW_BAR_DEG = 0.10  # what the paper's slices need: 0.1 degrees move the block's corners 0.2 mm

angles = st.floats(-5.0, 5.0)


def normal_of(tilt_x_deg: float, tilt_y_deg: float) -> Floats:
    n = np.array([np.tan(np.radians(tilt_x_deg)), np.tan(np.radians(tilt_y_deg)), 1.0])
    return n / np.linalg.norm(n)


# Levelling, eqs. (5) to (7)


def test_levelling_step_is_exact_about_one_axis() -> None:
    for n in (normal_of(4.0, 0.0), normal_of(0.0, -7.0)):
        np.testing.assert_allclose(levelling_step(n) @ n, [0, 0, 1], atol=1e-15)


def test_a_level_plane_is_left_alone() -> None:
    np.testing.assert_array_equal(levelling_step(np.array([0.0, 0.0, 1.0])), np.eye(3))


@given(angles, angles)
@examples(50)
def test_levelling_step_leaves_a_third_order_rest(tilt_x: float, tilt_y: float) -> None:
    n = normal_of(tilt_x, tilt_y)
    rest = np.linalg.norm((levelling_step(n) @ n)[:2])
    assert rest <= abs(n[0]) * n[1] ** 2 + 1e-12


@given(angles, angles, st.integers(0, 100))
@examples(30)
def test_levelling_settles_at_the_vertical(tilt_x: float, tilt_y: float, seed: int) -> None:
    n = normal_of(tilt_x, tilt_y)
    xy = np.random.default_rng(seed).uniform(-100, 100, (50, 2))
    points = np.column_stack([xy, 7.0 - (xy @ n[:2]) / n[2]])
    rotation = level(points)
    np.testing.assert_allclose(plane_normal(points), n, atol=1e-9)
    np.testing.assert_allclose(rotation @ n, [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.ptp((points @ rotation.T)[:, 2]), 0, atol=1e-7)


def test_points_without_a_plane_are_refused() -> None:
    with pytest.raises(MeasurementError, match="2 points"):
        level(np.zeros((2, 3)))
    with pytest.raises(MeasurementError, match="one line"):
        level(np.outer(np.arange(5.0), [1.0, 2.0, 0.5]))


def test_shear_moves_the_track_along_its_direction_and_keeps_the_sheet() -> None:
    yaw = np.radians(2.2)
    np.testing.assert_allclose(shear(yaw) @ [0, 1, 0], [np.sin(yaw), np.cos(yaw), 0])
    np.testing.assert_allclose(shear(yaw) @ [3, 0, 4], [3, 0, 4])


# Edges


def edge_samples(at: float, slope: float, lean: float, phase: float) -> EdgeCrossings:
    """Samples 0.9 mm apart on both sides of x = at + (slope + lean) y, exactly."""
    y = np.arange(-60.0, 60.0, 0.5)
    x = at + (slope + lean) * y
    inside = np.floor((x - phase) / 0.9) * 0.9 + phase
    places = (np.column_stack([x, y]) for x in (inside, inside + 0.9))
    return EdgeCrossings(*places, np.arange(len(y)), slope)


@given(st.floats(0.05, 0.2), st.floats(-1, 1), st.floats(0, 0.9))
@examples(40)
def test_edges_are_found_far_within_a_sample(lean: float, at: float, phase: float) -> None:
    upright, leaning = (edge_samples(*edge, lean, phase) for edge in ((at, 0.0), (at + 5, 0.3)))
    fit = fit_edges({"a": upright, "b": leaning}, pivot_mm=0.0)
    # Each of the 240 profiles bounds its edge to 0.9 mm; the bounds leave the line a freedom of
    # about a gap per crossed column, of which there are 120 * 0.05 / 0.9 = 6 at least.
    assert abs(fit.at_mm[0] - at) < 0.9 / 6
    assert abs(fit.lean - lean) < 0.9 / 6 / 60


def test_outlying_profiles_do_not_move_an_edge() -> None:
    clean = edge_samples(1.0, 0.0, 0.1, 0.0)
    inside, outside = clean.inside.copy(), clean.outside.copy()
    inside[::20, 0] -= 6.0
    outside[::20, 0] -= 6.0
    fit = fit_edges({"a": replace(clean, inside=inside, outside=outside)}, 0.0)
    whole = fit_edges({"a": clean}, 0.0)
    assert np.count_nonzero(fit.weight == 0) == 12
    assert abs(fit.at_mm[0] - whole.at_mm[0]) < 0.09  # a tenth of the gap


def test_an_edge_crossed_too_rarely_is_named() -> None:
    few = edge_samples(0.0, 0.0, 0.1, 0.0).only(np.arange(240) < 4)
    with pytest.raises(MeasurementError, match="left wedge, far edge not found: 4 profiles"):
        fit_edges({"left wedge, far edge": few}, 0.0)


# Whole scans


@pytest.mark.parametrize("lean", [0.0, 0.01])
def test_false_light_at_the_near_edges_does_not_move_the_corners(lean: float) -> None:
    """Where both sides are known; else they move by half of what the near edge does along x."""
    slope = 26 / 30 * np.array([1, -1, -1, 1, 0, 0])
    place = np.array([-4.0, -4.0, 154.0, 154.0, -30.0, 180.0])
    outwards = np.array([-0.3, 0.0, 0.3, 0.0, 0.0, 0.0])
    every = EdgeFit(place + outwards, slope, lean, 75.0, np.zeros((7, 7)), np.ones(0, dtype=bool))
    four = replace(every, at_mm=every.at_mm[:4], slope=slope[:4])
    true = np.array([[-4.0, 75.0], [154.0, 75.0]])
    np.testing.assert_allclose(_Edges(every, True, 158.0).corners, true, atol=1e-12)
    moved = _Edges(four, True, 158.0).corners - true
    np.testing.assert_allclose(moved[:, 1], 0.15 / (26 / 30), rtol=1e-9)
    np.testing.assert_allclose(moved[:, 0] - lean * moved[:, 1], [-0.15, 0.15], rtol=1e-9)


def yaw_error_deg(alignment: Alignment, placing: Placing) -> float:
    return float(np.degrees(alignment.yaw_rad)) - placing.yaw_deg


placings = st.builds(
    Placing,
    yaw_deg=st.floats(-3, 3),
    turn_deg=st.floats(-10, 10),
    roll_deg=angles,
    pitch_deg=angles,
    x_mm=st.floats(-15, 15),
    y_mm=st.floats(92, 108),
    z_mm=st.floats(-30, 30),
    noise_mm=st.floats(0.05, 0.2),
    dropout=st.floats(0, 0.04),
    floor=st.booleans(),
    seed=st.integers(0, 1000),
)


COLUMN_MM = Placing.pitch_mm
STEEPEST = (
    np.hypot(PIECE.c_per_mm, PIECE.d_rad * PIECE.e_per_mm)
    * PIECE.height_mm(np.linspace(0, PIECE.side_mm, 2001), np.full(2001, PIECE.side_mm)).max()
)
"""Largest amplitude of eq. (4) times the largest gradient of its phase: 1.5."""


def _left_open_deg(placing: Placing) -> float:
    """Yaw that the columns leave open, degrees.

    A side of length L that stays within one column, of width g, has any slope up to g / L either
    way.  One that passes into the next at a place has any from 0 to g over its longer part, which
    is 2 g / L at most: half of that is left open.  Two such places say the slope.  The likelihood
    lets the line pass a sample by SOFTNESS of g at either end, and corners are left out.
    """
    length = PIECE.side_mm + PIECE.rim_mm - 2 * CORNER_MARGIN_MM
    crossed = length * np.tan(np.radians(abs(placing.turn_deg + placing.yaw_deg))) / COLUMN_MM
    return float(np.degrees(COLUMN_MM * (1 + 2 * SOFTNESS) / length)) if crossed < 2 else 0.0


@pytest.mark.slow
@given(placings)
@examples(6, phases=[Phase.generate])
def test_yaw_and_slices_of_any_placing(placing: Placing) -> None:
    surface = scan(PIECE, placing)
    alignment = align_sandwave(surface, PIECE)
    error = yaw_error_deg(alignment, placing)
    assert abs(error) < 4 * np.degrees(alignment.yaw_sigma_rad)
    assert abs(error) < max(YAW_BAR_DEG, _left_open_deg(placing))
    aligned = apply(alignment, surface)
    for name, line in PIECE.slices_mm().items():
        errors = compare_slice(resample(aligned, line), PIECE)
        # A place off by a third of a column, on the steepest slope of eq. (4).
        assert errors.rmse_mm < STEEPEST * COLUMN_MM / 3, name
        # The paper's own bound (its Sec. V).
        assert max(-errors.min_mm, errors.max_mm) < 1.5, name
        assert errors.points > 100, name


SQUARE = Placing(yaw_deg=2.2, turn_deg=-4.0, roll_deg=2.0, pitch_deg=-1.5, noise_mm=0.1, seed=5)


@pytest.fixture(scope="module")
def raw() -> Surface:
    return scan(PIECE, SQUARE)


@pytest.fixture(scope="module")
def alignment(raw: Surface) -> Alignment:
    return align_sandwave(raw, PIECE)


def test_the_papers_yaw_is_found(alignment: Alignment) -> None:
    assert abs(yaw_error_deg(alignment, SQUARE)) < YAW_BAR_DEG
    assert np.degrees(alignment.yaw_sigma_rad) < YAW_BAR_DEG


def test_corners_lie_on_the_centre_line_about_their_nominal_middle(alignment: Alignment) -> None:
    left, right = alignment.left_corner_mm, alignment.right_corner_mm
    assert abs(left[1] - right[1]) < 1e-4
    np.testing.assert_allclose((left + right) / 2, [75, 75], atol=1e-4)
    # Half a sample is the most that an edge, and so a corner, may be off.
    np.testing.assert_allclose(left, PIECE.wedge_tips_mm()[0], atol=0.45)


def test_tops_are_level_at_their_nominal_height(raw: Surface, alignment: Alignment) -> None:
    z = apply(alignment, raw).xyz_mm[..., 2]
    tops = z[np.abs(z - PIECE.wedge.height_mm) < 1.0]
    # Five standard errors of a median of normal noise.
    error = 1.25 * SQUARE.noise_mm / np.sqrt(len(tops))
    assert abs(np.median(tops) - PIECE.wedge.height_mm) < 5 * error
    assert abs(tops.std() - SQUARE.noise_mm) < 0.02
    np.testing.assert_allclose(alignment.rotation @ alignment.normal, [0, 0, 1], atol=1e-9)


def test_to_raw_undoes_to_workpiece(alignment: Alignment) -> None:
    points = np.random.default_rng(0).uniform(-100, 300, (20, 3))
    np.testing.assert_allclose(alignment.to_raw(alignment.to_workpiece(points)), points, atol=1e-9)


def test_rotation_is_rigid(alignment: Alignment) -> None:
    rotation = alignment.rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_raw_points_go_where_their_block_points_are(raw: Surface, alignment: Alignment) -> None:
    """Against the placing itself: the inverse of how the synthetic scan was made."""
    points = raw.xyz_mm[np.isfinite(raw.xyz_mm).all(axis=-1)][::997]
    place = np.array([SQUARE.x_mm, SQUARE.y_mm, SQUARE.z_mm])
    true = (points @ shear(np.radians(SQUARE.yaw_deg)).T - place) @ SQUARE.rotation()
    true += [75, 75, 0]
    moved = alignment.to_workpiece(points)
    # 0.1 degree over 105 mm, and the corners' place to a quarter of a sample.
    assert np.abs(moved - true)[:, :2].max() < np.radians(0.1) * 105 + 0.25
    assert np.abs(moved - true)[:, 2].max() < 0.1


def test_slices_do_not_depend_on_where_the_scan_was_made(
    raw: Surface, alignment: Alignment
) -> None:
    """Invariance: the origin of the track and of the sheet are anybody's choice."""
    offset = np.array([31.0, -517.0, -204.0])
    moved = replace(raw, xyz_mm=raw.xyz_mm + offset, position_mm=raw.position_mm + offset[1])
    again = align_sandwave(moved, PIECE)
    assert again.yaw_rad == pytest.approx(alignment.yaw_rad, abs=1e-6)
    line = PIECE.slices_mm()["SD"]
    here = resample(apply(alignment, raw), line)
    there = resample(apply(again, moved), line)
    np.testing.assert_array_equal(here.status, there.status)
    np.testing.assert_allclose(there.z_mm, here.z_mm, atol=1e-3)


def test_tilting_the_sheets_frame_changes_nothing_in_slices(
    raw: Surface, alignment: Alignment
) -> None:
    """Invariance: a block rolled about the track (a rigid motion that keeps raw rows raw)."""
    angle = np.radians(1.5)
    turn = np.array(
        [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
    )
    # A rotation about the track's own direction commutes with moving along it.
    true = raw.xyz_mm @ shear(np.radians(SQUARE.yaw_deg)).T
    heading = shear(np.radians(SQUARE.yaw_deg))[:, 1]
    about = np.column_stack([np.cross(heading, [0, 0, 1]), heading, [0, 0, 1]])
    rolled = true @ (about @ turn @ about.T).T
    raw_again = rolled @ np.linalg.inv(shear(np.radians(SQUARE.yaw_deg))).T
    moved = replace(raw, xyz_mm=raw_again)
    again = align_sandwave(moved, PIECE)
    assert abs(np.degrees(again.yaw_rad - alignment.yaw_rad)) < 0.02
    line = PIECE.slices_mm()["S2"]
    here, there = resample(apply(alignment, raw), line), resample(apply(again, moved), line)
    both = np.isfinite(here.z_mm) & np.isfinite(there.z_mm)
    assert np.abs(here.z_mm - there.z_mm)[both].max() < 0.15


def test_a_yaw_put_in_comes_out(raw: Surface, alignment: Alignment) -> None:
    """Equivariance: raw data sheared as a further yaw would do give that much more yaw."""
    further = np.radians(1.0)
    yaw = alignment.yaw_rad
    xyz = raw.xyz_mm @ (np.linalg.inv(shear(yaw + further)) @ shear(yaw)).T
    again = align_sandwave(replace(raw, xyz_mm=xyz), PIECE)
    assert abs(np.degrees(again.yaw_rad - yaw - further)) < 0.02


def test_uncertainty_turns_with_the_axes(raw: Surface, alignment: Alignment) -> None:
    aligned = apply(alignment, raw)
    seen = np.isfinite(raw.sigma_z_mm)
    np.testing.assert_array_equal(np.isfinite(aligned.sigma_z_mm), seen)
    assert aligned.modes_mm is not None
    common = np.square(aligned.modes_mm, dtype=float).sum(axis=-1)
    own = aligned.sigma_z_mm[seen] ** 2 - common[seen][:, 2]
    # Rows of a rotation: the own variance of z is a mean of those of x and z, weighted by the
    # squares of the row, less what its y takes.
    row = alignment.rotation[2]
    expected = row[0] ** 2 * raw.sigma_x_mm**2 + row[2] ** 2 * raw.sigma_z_mm**2
    np.testing.assert_allclose(own, expected[seen], rtol=1e-5)


def test_a_full_scan_is_aligned_in_time() -> None:
    """By the time this process computes: what other programs take does not count."""
    surface = scan(PIECE, replace(SQUARE, columns=640, pitch_mm=0.45, occlusion=False))
    start = time.process_time()
    align_sandwave(surface, PIECE)
    assert time.process_time() - start < 3.0


# What cannot be aligned


def cut(raw: Surface, keep: Floats) -> Surface:
    """The surface with all points outside the mask gone."""
    xyz = np.where(keep[..., None], raw.xyz_mm, np.nan)
    status = np.where(keep, raw.status, int(Status.NO_PEAK))
    return replace(raw, xyz_mm=xyz, status=status)


def test_missing_wedges_are_named(raw: Surface, alignment: Alignment) -> None:
    x = alignment.to_workpiece(raw.xyz_mm)[..., 0]
    with pytest.raises(MeasurementError, match="right wedge"):
        align_sandwave(cut(raw, x < 140), PIECE)
    with pytest.raises(MeasurementError, match="left wedge"):
        align_sandwave(cut(raw, x > 10), PIECE)
    with pytest.raises(MeasurementError, match="no sandwave block"):
        align_sandwave(cut(raw, (x > 10) & (x < 140)), PIECE)


def test_a_scan_too_coarse_for_the_wedges_is_told_its_spacings() -> None:
    coarse = replace(SQUARE, frames=133, step_mm=1.5, columns=32, pitch_mm=9.0)
    with pytest.raises(MeasurementError, match=r"too coarse, .* 1.5 mm apart .* columns 9 mm"):
        align_sandwave(scan(PIECE, coarse), PIECE)


def test_missing_sides_are_named(raw: Surface, alignment: Alignment) -> None:
    plan = alignment.to_workpiece(raw.xyz_mm)
    middle = np.abs(plan[..., 1] - 75) < 34
    inside = (plan[..., 0] > -30) & (plan[..., 0] < 180)
    surface = cut(raw, middle & inside)
    status = np.where(np.isnan(surface.xyz_mm[..., 0]), int(Status.OUT_OF_BOARD), surface.status)
    with pytest.raises(MeasurementError, match="neither side of the block"):
        align_sandwave(replace(surface, status=status), PIECE)


@pytest.mark.parametrize("frames", [0, 3])
def test_nothing_measured_is_said(raw: Surface, frames: int) -> None:
    with pytest.raises(MeasurementError, match="0 measured points"):
        align_sandwave(cut(raw, np.zeros(raw.status.shape, dtype=bool)), PIECE)
    few = Surface(
        raw.xyz_mm[:frames, :20],
        raw.sigma_x_mm[:frames, :20],
        raw.sigma_z_mm[:frames, :20],
        raw.status[:frames, :20],
        raw.position_mm[:frames],
    )
    with pytest.raises(MeasurementError, match="measured points"):
        align_sandwave(few, PIECE)


def test_another_workpiece_is_not_taken_for_a_sandwave(raw: Surface) -> None:
    x, s = raw.xyz_mm[..., 0], raw.xyz_mm[..., 1]
    floor = replace(raw, xyz_mm=np.stack([x, s, 0.02 * x], axis=-1))
    with pytest.raises(MeasurementError, match="no sandwave block"):
        align_sandwave(floor, PIECE)
    grooves = np.where(np.abs(x) < 100, 80.0 - 20 * (np.floor(x / 25) % 2 == 0), 0.0)
    block = replace(raw, xyz_mm=np.stack([x, s, grooves], axis=-1))
    with pytest.raises(MeasurementError):
        align_sandwave(block, PIECE)


def test_an_aligned_surface_is_not_aligned_again(raw: Surface, alignment: Alignment) -> None:
    aligned = apply(alignment, raw)
    for act in (lambda: align_sandwave(aligned, PIECE), lambda: apply(alignment, aligned)):
        with pytest.raises(InputError, match="aligned already"):
            act()
