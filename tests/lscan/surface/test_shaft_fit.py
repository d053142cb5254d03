"""A shaft found from a scan of the sandwave block: exactness, pulls, honesty, bad input."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rotary_scans import Nodding, profiles_of, sheet_points

from lscan.config.documents import check
from lscan.config.rig import ShaftSection
from lscan.config.targets import Sandwave
from lscan.errors import InputError, MeasurementError
from lscan.records import Floats
from lscan.surface import align_sandwave, apply, shaft as shaftfit
from lscan.surface.features import above_top, nominal_top
from lscan.surface.shaft import (
    PARAMETERS,
    Shaft,
    ShaftFit,
    calibrate_shaft,
    load_shaft,
    save_shaft,
    shaft_of,
    stack_about,
)

PIECE, NODDING = Sandwave(), Nodding(frames=72, columns=80)
SIGMA = np.array([2.0, 2.0, np.radians(1.0), np.radians(1.0), 0.002])
TRUE = Shaft(np.zeros(3), np.array([1.0, 0.0, 0.0]), 180 / np.pi, np.diag(SIGMA**2))
NOISE_MM = 0.03
"""So little that what is of second order in it (1e-4 mm, see shaftfit) is far below a sigma."""


@pytest.fixture(scope="module")
def sheet() -> Floats:
    return sheet_points(PIECE, NODDING, TRUE)


def plane_map_modes(xz_mm: Floats) -> Floats:
    """(F, N, 2, 4) modes of 0.05 mm: shifts along x and z, a stretch of depth, a bow."""
    x, z = xz_mm[..., 0] / 100, (xz_mm[..., 1] - NODDING.place_mm[2]) / 100
    nought, one = np.zeros_like(x), np.ones_like(x)
    modes = [(one, nought), (nought, one), (nought, z), (nought, x**2)]
    return 0.05 * np.stack([np.stack(mode, axis=-1) for mode in modes], axis=-1)


def errors(shaft: Shaft) -> Floats:
    """(5,) what a shaft found is off TRUE by, along its own axes, at its own point."""
    beside = TRUE.direction * (shaft.point_mm @ shaft.direction)
    return np.concatenate(
        [
            shaft.axes @ (shaft.point_mm - beside),
            shaft.axes @ (shaft.direction - TRUE.direction),
            [TRUE.arc_radius_mm / shaft.arc_radius_mm - 1],
        ]
    )


def fitted(sheet_mm: Floats, seed: int, modes: bool = True) -> ShaftFit:
    """The fit of a noisy scan, the prior drawn about the truth as it says of itself."""
    generator = np.random.default_rng(seed)
    prior = TRUE.moved(SIGMA * generator.normal(size=PARAMETERS))
    common = plane_map_modes(sheet_mm) if modes else None
    scan = profiles_of(sheet_mm, NODDING.positions_mm, NOISE_MM, generator, common)
    return calibrate_shaft(scan, PIECE, prior)


def test_the_nominal_top_is_eq_4_with_its_slopes() -> None:
    plan = np.random.default_rng(1).uniform(5, 145, (200, 2))
    top = nominal_top(PIECE, plan, 2.5)
    assert top.clear.all()
    np.testing.assert_array_equal(top.height_mm, PIECE.height_mm(*plan.T))
    for axis in (0, 1):
        step = 1e-5 * np.eye(2)[axis]
        ahead, behind = (PIECE.height_mm(*(plan + sign * step).T) for sign in (1, -1))
        # Third derivatives of 0.3/mm2 leave 5e-12; rounding 10 mm * 2e-16 / 1e-5 = 2e-10.
        np.testing.assert_allclose((ahead - behind) / 2e-5, top.slope[:, axis], atol=2e-9)


def test_flats_and_steps_of_the_nominal_top() -> None:
    tip = PIECE.wedge_tips_mm()[0]
    places = {
        "rim": (-15.0, 10.0, 0.0, True),
        "wedge": (-20.0, 75.0, 10.0, True),
        "beside the wedge's tip": (float(tip[0]) + 1.0, 75.0, 0.0, False),
        "inside the wedge's tip": (float(tip[0]) - 1.0, 75.0, 10.0, False),
        "at the border of the waves": (-1.0, 20.0, 0.0, False),
        "beside the block": (-31.0, 20.0, 0.0, False),
        "near the block's side": (-29.0, 20.0, 0.0, False),
        "right wedge": (170.0, 75.0, 10.0, True),
    }
    top = nominal_top(PIECE, np.array([place[:2] for place in places.values()]), 2.5)
    assert top.height_mm.tolist() == [place[2] for place in places.values()]
    assert top.clear.tolist() == [place[3] for place in places.values()]


def test_a_point_lifted_along_the_normal_is_that_far_off() -> None:
    plan = np.random.default_rng(2).uniform(20, 130, (100, 2))
    top = nominal_top(PIECE, plan, 2.5)
    foot = np.column_stack([plan, top.height_mm])
    for lift in (0.3, -0.3):
        distance, _ = above_top(PIECE, foot + lift * top.normal, 2.5)
        # Two rounds of a foot off by 0.3 mm times 0.06 (curvature times lift), squared, times
        # half the curvature: 0.11 (0.3 * 0.06**2)**2 = 1e-7 mm.
        np.testing.assert_allclose(distance, lift, atol=1e-6)


def test_without_noise_the_shaft_is_found_exactly(sheet: Floats) -> None:
    """What is left: the priors' pull, sigma_found² / sigma_prior² of 3 mm or less, and rays."""
    prior = replace(TRUE, covariance=np.diag([9.0, 9.0, 1e-3, 1e-3, 0.0]))
    prior = prior.moved(np.array([3.0, -3.0, 0.017, -0.017, 0.0]))
    scan = profiles_of(sheet, NODDING.positions_mm, 1e-5, np.random.default_rng(1))
    fit = calibrate_shaft(scan, PIECE, prior)
    # Points are weighed as if known to 1e-4 mm, 300 times better than where pulls are tested: the
    # sigmas there, of at most 0.4 mm and 0.1 degree, over 300, squared over 3 mm: nothing.
    assert np.abs(errors(fit.shaft)[:2]).max() < 5e-3
    assert np.degrees(np.abs(errors(fit.shaft)[2:4])).max() < 2e-3
    assert fit.rms_mm < 1e-3


@pytest.mark.slow
def test_errors_of_the_shaft_are_as_large_as_is_said(
    sheet: Floats, monkeypatch: pytest.MonkeyPatch
) -> None:
    """100 scans: pulls have mean 0 and variance 1; together they are chi-squared.

    They are so of any number of points: a third of them, six a cell, are fitted in less time.
    """
    monkeypatch.setattr(shaftfit, "MOST_POINTS", 1200)
    fits = [fitted(sheet, seed) for seed in range(100)]
    assert max(fit.points for fit in fits) < 1200
    found = np.stack([errors(fit.shaft) for fit in fits])
    pulls = found / np.stack([fit.shaft.sigma for fit in fits])
    # Five sigma: of a mean 1/sqrt(100); of a variance sqrt(2/100), and 10 % for the 196 cells
    # that the covariance itself is judged from.
    assert np.abs(pulls.mean(axis=0)).max() < 0.5
    assert np.abs((pulls**2).mean(axis=0) - 1).max() < 5 * np.sqrt(2 / 100) + 0.1
    whole = [
        e @ np.linalg.solve(fit.shaft.covariance, e) for e, fit in zip(found, fits, strict=True)
    ]
    # Chi-squared of 5 has variance 10; a covariance from 196 cells raises its mean by 5/196.
    assert abs(np.mean(whole) - 5) < 5 * np.sqrt(10 / 100) + 5 * 5 / 196


def test_a_misstated_shaft_is_found_and_the_surface_is_right_again(sheet: Floats) -> None:
    """3 mm and 1 degree off: found within 4 sigma; heights then err as their sigmas say."""
    generator = np.random.default_rng(11)
    prior = replace(TRUE, covariance=np.diag([9.0, 9.0, *[np.radians(1.0) ** 2] * 2, 0.0]))
    prior = prior.moved(np.array([2.1, -2.1, 0.0122, -0.0122, 0.0]))
    scan = profiles_of(sheet, NODDING.positions_mm, NOISE_MM, generator, plane_map_modes(sheet))
    fit = calibrate_shaft(scan, PIECE, prior)
    assert (np.abs(errors(fit.shaft)[:4]) < 4 * fit.shaft.sigma[:4]).all()
    assert fit.shaft.sigma[4] == 0
    spread = []
    for shaft in (prior, fit.shaft):
        place = stack_about(scan, shaft).xyz_mm @ fit.rotation.T + fit.translation_mm
        distance, top = above_top(PIECE, place[np.isfinite(place).all(axis=-1)], 2.5)
        spread.append(float(np.std(distance[top.clear])))
    # Noise of 0.03 mm in x and z, and three modes of 0.05 mm that the pose does not take out.
    assert spread[1] < np.hypot(NOISE_MM, 2 * 0.05)
    assert spread[0] > 5 * spread[1]


def test_outliers_do_not_move_the_shaft(sheet: Floats) -> None:
    clean = fitted(sheet, 3, modes=False)
    generator = np.random.default_rng(4)
    with_outliers = sheet.copy()
    with_outliers[generator.random(sheet.shape[:2]) < 0.02, 1] += 5.0
    fit = fitted(with_outliers, 3, modes=False)
    assert fit.outliers > 0.015 * fit.points
    # Two points in a hundred fewer, of which some hundred lie near enough to stay.
    assert (np.abs(errors(fit.shaft) - errors(clean.shaft)) < 0.5 * clean.shaft.sigma).all()


def test_a_flat_piece_does_not_distinguish_height_from_scale() -> None:
    """Closed form of what stays: on a plane d beneath the shaft, an offset h up or down bends the
    scan by h a²/2 at the angle a, a scale k by d k a²; only their sum is seen, so that h = -2 d k
    is left as uncertain as the priors leave it."""
    flat = Sandwave(a_mm=1e-6, b=0.0)
    ratios = []
    for piece in (flat, PIECE):
        points = sheet_points(piece, NODDING, TRUE)
        scan = profiles_of(points, NODDING.positions_mm, NOISE_MM, np.random.default_rng(5))
        ratios.append(calibrate_shaft(scan, piece, TRUE).shaft.sigma / SIGMA)
    by_offset, by_scale = SIGMA[1], 2 * -NODDING.place_mm[2] * SIGMA[4]
    left = by_offset * by_scale / np.hypot(by_offset, by_scale)
    # The wedges, 10 mm nearer, and terms of a^4 inform a little more than the plane: 10 / 580 and
    # a²/3 are 2 %; a sigma judged from 196 cells is good to 1 / sqrt(2 * 196) = 5 %.
    np.testing.assert_allclose(ratios[0][[1, 4]], [left / by_offset, left / by_scale], rtol=0.07)
    # Waves determine how the scan is stretched along y, h / d + k: both are found.
    assert (ratios[1][[1, 4]] < 0.25).all()


def test_the_alignment_about_a_shaft_has_no_yaw(sheet: Floats) -> None:
    """Six parameters: the surface of a true shaft lies on the block, its sides along y."""
    fine = Nodding(frames=200, columns=160)
    points = sheet_points(PIECE, fine, TRUE)
    scan = profiles_of(points, fine.positions_mm, NOISE_MM, np.random.default_rng(6))
    raw = stack_about(scan, replace(TRUE, covariance=np.zeros((5, 5))))
    alignment = align_sandwave(raw, PIECE, sheared=False)
    assert (alignment.yaw_rad, alignment.yaw_sigma_rad) == (0.0, 0.0)
    rotation, shift = fine.to_head(PIECE)
    off = alignment.rotation @ rotation
    # Columns are 1.6 mm apart: a side of 200 mm is known to a column over it, 0.5 degree.
    assert np.abs(off - np.eye(3)).max() < 1.6 / 200
    middle = alignment.to_workpiece(rotation @ np.array([75.0, 75.0, 0.0]) + shift)
    np.testing.assert_allclose(middle, [75.0, 75.0, 0.0], atol=1.6)
    assert abs(middle[2]) < 0.05
    aligned = apply(alignment, raw)
    assert aligned.sigma_y_mm is not None
    assert np.isfinite(aligned.sigma_y_mm[np.isfinite(aligned.sigma_z_mm)]).all()


def test_a_file_gives_the_shaft_back(sheet: Floats, tmp_path: Path) -> None:
    fit = fitted(sheet, 7)
    save_shaft(tmp_path / "shaft.toml", fit)
    again = shaft_of(load_shaft(tmp_path / "shaft.toml"))
    np.testing.assert_allclose(again.covariance, fit.shaft.covariance, rtol=1e-9)
    np.testing.assert_array_equal(again.point_mm, fit.shaft.point_mm)
    assert again.arc_radius_mm == fit.shaft.arc_radius_mm


def test_what_cannot_be_found_is_refused(sheet: Floats) -> None:
    scan = profiles_of(sheet, NODDING.positions_mm, NOISE_MM, np.random.default_rng(8))
    known = shaft_of(
        check(ShaftSection, {"point_mm": (0, 0, 0), "direction": (1, 0, 0)}, where="test")
    )
    with pytest.raises(InputError, match="known exactly"):
        calibrate_shaft(scan, PIECE, known)
    with pytest.raises(InputError, match="no profiles"):
        calibrate_shaft([], PIECE, TRUE)
    empty = profiles_of(
        np.full_like(sheet, np.nan), NODDING.positions_mm, 0.1, np.random.default_rng(1)
    )
    with pytest.raises(MeasurementError, match="measured points"):
        calibrate_shaft(empty, PIECE, TRUE)


def test_too_small_a_part_of_the_block_is_refused(sheet: Floats) -> None:
    """Only the wedges' neighbourhood: both are found, but there are not cells enough."""
    middle = slice(30, 42)
    narrow = sheet[middle].copy()
    scan = profiles_of(narrow, NODDING.positions_mm[middle], NOISE_MM, np.random.default_rng(9))
    with pytest.raises(MeasurementError, match="too little of the block"):
        calibrate_shaft(scan, PIECE, TRUE)
