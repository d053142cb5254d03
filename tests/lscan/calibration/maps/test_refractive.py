"""The refractive map: exact where its physics holds, correct sigma where marks are noisy."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import Phase, assume, given, strategies as st
from planeviews import EXACT_BOARD, View, board_points, paper_board, read_board, with_noise
from scipy.spatial import Delaunay

from lscan import camera as optics
from lscan.calibration import physical
from lscan.calibration.calibrate import calibrate
from lscan.calibration.calibrationfile import load_calibration, save_calibration
from lscan.calibration.maps import refractive as refractivefit
from lscan.calibration.maps.refractive import NAMES, Refractive, solver
from lscan.calibration.physical import SHARE, board_modes
from lscan.camera.posedboards import CENTRE_WIDTHS, FOCAL_WIDTHS
from lscan.config.rig import OpticsSection
from lscan.errors import BoardNotFound, InputError
from lscan.records import BoardReading, Floats, Marks, RulerReading, Status

BOARD = paper_board()
NOISE_PX = 0.02
BESIDE = OpticsSection(
    board_offset_mm=2.0, board_tilt_deg=0.5, board_bend_mm=0.5, board_scale_percent=0.1
)
PAPER_LENS = OpticsSection(  # the whole of View(), known exactly: only the pose is left
    focal_px=(850.0, 0.0),
    centre_u_px=(319.5, 0.0),
    centre_v_px=(239.5, 0.0),
    k1=(-0.22, 0.0),
    k2=(0.06, 0.0),
    p1=(0.0, 0.0),
    p2=(0.0, 0.0),
    gap_mm=(10.0, 0.0),
    thickness_mm=(6.0, 0.0),
    glass_index=(1.49, 0.0),
    water_index=(1.331, 0.0),
    tilt_x_deg=(0.0, 0.0),
    tilt_y_deg=(0.0, 0.0),
    **EXACT_BOARD,
)


@st.composite
def rigs(draw: st.DrawFn) -> View:
    """Any lens of 500 to 1500 px behind any flat port, up to 40 degrees off in any direction."""
    focal = draw(st.floats(500.0, 1500.0))
    return View(
        distance_mm=focal * draw(st.floats(1.1, 1.35)),
        elevation_deg=draw(st.floats(-40.0, 40.0)),
        yaw_deg=draw(st.floats(-40.0, 40.0)),
        roll_deg=draw(st.floats(-180.0, 180.0)),
        focal_px=focal,
        centre_px=(draw(st.floats(290.0, 350.0)), draw(st.floats(210.0, 270.0))),
        k1=draw(st.floats(-0.3, 0.1)),
        k2=draw(st.floats(-0.05, 0.1)),
        gap_mm=draw(st.floats(5.0, 40.0)),
        glass_mm=draw(st.floats(2.0, 10.0)),
        n_glass=draw(st.floats(1.45, 1.53)),
        n_water=draw(st.floats(1.33, 1.345)),
    )


def errors(solved: Refractive, view: View, count: int = 300) -> tuple[Floats, Floats]:
    """(N, 2) errors and (N, 2) stated uncertainties at points of the board, mm."""
    points, marks = board_points(count, seed=1), read_board(BOARD, view.project).grid
    image = view.project(points)
    answer = solved.to_plane(image)
    valued = answer.status == Status.OK
    # Between the marks that the picture shows there is no hole.  Rows of them may lie just outside
    # of it: 1500 rigs showed 0.6 of the board and more.
    between = Delaunay(marks.image_px[marks.found]).find_simplex(image) >= 0
    assert valued[between].all()
    assert between.mean() > 0.5
    return (answer.xz_mm - points)[valued], answer.sigma_mm[valued]


# --- where the physics holds ---------------------------------------------------------------


def ignorance(view: View, known: OpticsSection) -> float:
    """How far, in standard uncertainties all together, the truth is from what was known."""
    truth = {
        "gap_mm": view.gap_mm,
        "thickness_mm": view.glass_mm,
        "glass_index": view.n_glass,
        "water_index": view.n_water,
        "k1": view.k1,
        "k2": view.k2,
    }
    departures = [(value - getattr(known, key)[0]) / getattr(known, key)[1]
                  for key, value in truth.items()]  # fmt: skip
    mean, sigma = 640 * np.array(FOCAL_WIDTHS)
    departures.append((view.focal_px - mean) / sigma)
    axis = (np.array(view.centre_px) - [319.5, 239.5]) / (640 * CENTRE_WIDTHS)
    return float(np.linalg.norm([*departures, *axis]))


@examples(2, phases=(Phase.explicit, Phase.generate))
@given(view=rigs())
def test_exact_marks_give_an_exact_map(view: View) -> None:
    """Of lens, port and pose only rough values are known, and the map is right to 1e-3 mm rms.

    Rough values pull the solution off the truth.  For a linear fit the pull at any point is at
    most its stated uncertainty times the distance of the truth from what was known, in
    uncertainties (Cauchy and Schwarz; the posterior covariance is below the prior's).  Within
    half a degree of square the marks do not determine the focal length: the fit is not linear
    over the cameras that explain them, and the bound need not hold.
    """
    assume(max(abs(view.elevation_deg), abs(view.yaw_deg)) > 0.5)
    hold_to_the_truth(view)


@pytest.mark.slow
def test_exact_marks_nearly_square_to_the_board() -> None:
    """One degree from square the fit converges slowly: it takes 171 evaluations."""
    view = View(
        distance_mm=791.045, elevation_deg=-0.01556, yaw_deg=-0.99999, roll_deg=-0.33333,
        focal_px=592.071, centre_px=(320.0, 256.39661), k1=-0.19081, k2=0.08557,
        gap_mm=26.632, glass_mm=7.28, n_glass=1.4826, n_water=1.34,
    )  # fmt: skip
    hold_to_the_truth(view)


def hold_to_the_truth(view: View) -> None:
    """The map solved from exact marks of the view is right to 1e-3 mm rms, and as far as stated."""
    rough = OpticsSection(
        gap_mm=(20.0, 15.0),
        thickness_mm=(6.0, 3.0),
        glass_index=(1.49, 0.03),
        water_index=(1.337, 0.006),
    )
    solved = solver.solve(read_board(BOARD, view.project), "", rough)
    error, sigma = errors(solved, view)
    assert np.sqrt(np.mean(error**2)) < 1e-3
    assert np.max(np.abs(error) / sigma) < ignorance(view, rough)
    assert solved.outliers_mm == ()


def test_a_camera_in_air() -> None:
    """port = "none": a view without water, and no port parameter is touched."""
    view = View(water=False, k1=-0.15)
    in_air = OpticsSection(port="none")
    solved = solver.solve(read_board(BOARD, view.project), "", in_air)
    error, _ = errors(solved, view)
    assert np.abs(error).max() < 1e-3
    assert solved.view.camera.port is None
    assert (solved.modes[NAMES.index("gap_mm") : NAMES.index("turn_x")] == 0).all()


def test_what_is_known_exactly_is_held() -> None:
    """With lens and port known, the pose is found: the true distance from pinhole to target."""
    view = View()
    solved = solver.solve(read_board(BOARD, view.project), "", PAPER_LENS)
    assert solved.view.camera.focal_px == 850.0
    target = solved.view.in_camera(np.array([view.target_mm]))[0]
    np.testing.assert_allclose(target, [0.0, 0.0, 1000.0], rtol=0, atol=1e-3)
    np.testing.assert_allclose(solved.view.axes[0, :, 1], view.axes()[1], rtol=0, atol=1e-6)
    assert solved.modes.shape[1] <= 6


def _moved(reading: BoardReading, scale: float, shift: Floats) -> BoardReading:
    def move(marks: Marks) -> Marks:
        return replace(marks, board_mm=scale * marks.board_mm + shift)

    rulers = tuple(
        RulerReading(r.direction, scale * r.at_mm + shift[r.direction != "vertical"], move(r.marks))
        for r in reading.rulers
    )
    return replace(
        reading, pitch_mm=scale * reading.pitch_mm, grid=move(reading.grid), rulers=rulers
    )


@examples(2)
@given(
    scale=st.floats(0.1, 10.0), shift=st.tuples(st.floats(-500.0, 500.0), st.floats(-500.0, 500.0))
)
def test_equivariant_in_origin_and_size(scale: float, shift: tuple[float, float]) -> None:
    """The same picture of a board and a port that are both ``scale`` times as large.

    The sum of squares, some 650, is converged to 1e-9 of itself, so a point moves by no more
    than sqrt(650e-9) of its uncertainty, 1e-3; to a hundredth.
    """
    view, offset = View(), np.array(shift)
    reading = read_board(BOARD, view.project, NOISE_PX, np.random.default_rng(4))
    image = view.project(board_points(60, seed=5))
    scaled = PAPER_LENS.model_copy(
        update={"gap_mm": (10.0 * scale, 0.0), "thickness_mm": (6.0 * scale, 0.0)}
    )
    before = solver.solve(reading, "", PAPER_LENS).to_plane(image)
    after = solver.solve(_moved(reading, scale, offset), "", scaled).to_plane(image)
    np.testing.assert_array_equal(before.status, after.status)
    departure = (after.xz_mm - offset) / scale - before.xz_mm
    assert np.nanmax(np.abs(departure) / before.sigma_mm) < 0.01
    np.testing.assert_allclose(after.sigma_mm, scale * before.sigma_mm, rtol=1e-3)


# --- uncertainty ---------------------------------------------------------------------------


# A map of the known lens errs in 6 independent ways all over the board, one of a lens of which
# little is known in 11 (the square of the covariance's trace over the sum of its squares), and
# takes seven times as long to solve.  So many draws make it 300 and 132 independent errors.
TRIALS, TRIALS_LITTLE_KNOWN = 50, 30
FEW_TRIALS = 16


@cache
def draws(little_known: bool, trials: int) -> tuple[Refractive, ...]:
    """Maps of the same view, each solved from marks drawn anew.

    The search begins at the map of the exact marks, which is near all others, and ends sooner.
    """
    known = OpticsSection(**EXACT_BOARD) if little_known else PAPER_LENS
    rng = np.random.default_rng(2)
    exact = read_board(BOARD, View().project, sigma_px=NOISE_PX)
    near = solver.near(solver.solve(exact, "", known))
    return tuple(near.solve(with_noise(exact, NOISE_PX, rng), "", known) for _ in range(trials))


@pytest.fixture
def without_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    """Uncertainties computed pixel by pixel, as tables have them (test_pixeltable.py).

    To make a map's tables takes longer than to compute the few pixels that are asked for here.
    """
    monkeypatch.setattr(physical, "pixel_table", lambda *_: None)


@pytest.mark.slow
@pytest.mark.usefixtures("without_tables")
@pytest.mark.parametrize("little_known", [False, True])
def test_sigma_holds_the_errors(little_known: bool) -> None:
    """95 % intervals contain the truth in 95 %, and the variance is 1, to 2.5 standard errors.

    Of n independent normal errors: sqrt(0.95 * 0.05 / n), and sqrt(2 / n).  A sigma a fifth too
    small or a quarter too large, with variances of 1.56 and 0.64, is beyond both.
    """
    trials = TRIALS_LITTLE_KNOWN if little_known else TRIALS
    independent = (11 if little_known else 6) * trials
    pairs = [errors(solved, View()) for solved in draws(little_known, trials)]
    scores = np.concatenate([(error / sigma).ravel() for error, sigma in pairs])
    assert abs(np.mean(scores**2) - 1) < 2.5 * np.sqrt(2 / independent)
    covered = np.mean(np.abs(scores) < 1.96)
    assert abs(covered - 0.95) < 2.5 * np.sqrt(0.95 * 0.05 / independent)


@pytest.mark.usefixtures("without_tables")
def test_modes_are_the_covariance_between_points() -> None:
    """The scatter of the distance of two points over resampled marks: its variance is the
    squared difference of their modes.  A standard deviation from n trials has a relative
    one of 1/sqrt(2(n - 1)); 4 of those."""
    ends = View().project(np.array([[60.0, -60.0], [60.0, -100.0], [400.0, -400.0]]))
    exact = read_board(BOARD, View().project, sigma_px=NOISE_PX)
    modes = solver.solve(exact, "", PAPER_LENS).to_plane(ends).modes_mm
    assert modes is not None
    found = np.array([solved.to_plane(ends).xz_mm for solved in draws(False, FEW_TRIALS)])
    for one, other in ((0, 1), (0, 2)):
        scatter = (found[:, one] - found[:, other]).std(axis=0, ddof=1)
        stated = np.linalg.norm(modes[one] - modes[other], axis=1)
        np.testing.assert_allclose(scatter, stated, rtol=4 / np.sqrt(2 * (FEW_TRIALS - 1)))


def test_modes_and_pixel_make_up_sigma() -> None:
    """sigma^2 is the modes' part, the pixel's own and the lack of fit, and no more; the pixel's
    part is linear in its uncertainty."""
    view = View()
    reading = read_board(BOARD, view.project, NOISE_PX, np.random.default_rng(6))
    solved = solver.solve(reading, "", PAPER_LENS)
    image = view.project(board_points(40, seed=7))
    exact, noisy, noisier = (
        solved.to_plane(image, np.full(40, sigma)) for sigma in (0.0, 0.1, 0.2)
    )
    assert exact.modes_mm is not None
    common = (exact.modes_mm**2).sum(axis=2) + solved.lack_of_fit_mm**2
    np.testing.assert_allclose(exact.sigma_mm**2, common, rtol=1e-9)
    pixel = noisy.sigma_mm**2 - common
    np.testing.assert_allclose(noisier.sigma_mm**2 - common, 4 * pixel, rtol=1e-6)
    # One px is about a mm on this view, whose board of 450 mm fills the 480 rows.
    assert 0.05 < np.nanmean(np.sqrt(pixel)) < 0.2


def test_looser_knowledge_never_makes_surer() -> None:
    """Each uncertainty of what is known beforehand, doubled, leaves no point surer."""
    reading = read_board(BOARD, View().project, sigma_px=NOISE_PX)
    image = View().project(board_points(40, seed=8))
    sigmas = []
    for factor in (0.25, 1.0, 4.0):
        known = PAPER_LENS.model_copy(
            update={"focal_px": (850.0, 10 * factor), "k1": (-0.22, 0.001 * factor)}
        )
        sigmas.append(solver.solve(reading, "", known).to_plane(image).sigma_mm)
    assert (sigmas[1] > sigmas[0] * (1 - 1e-6)).all()
    assert (sigmas[2] > sigmas[1] * (1 - 1e-6)).all()


# --- lack of fit ---------------------------------------------------------------------------


def warped(xz_mm: Floats) -> Floats:
    """The view seen through a pane that shifts it by 0.3 px in waves of some 250 px."""
    image = View().project(xz_mm)
    return image + 0.3 * np.sin(image[:, ::-1] / 40.0)


def test_lack_of_fit_is_the_error_of_a_wrong_form() -> None:
    """Noise of a tenth of the wave: the lack of fit is the map's error over the board, within
    a factor of 1.5, and stays so when the marks' uncertainty is understated threefold."""
    exact = read_board(BOARD, warped, sigma_px=NOISE_PX)
    points = board_points(500, seed=9)
    for stated in (NOISE_PX, NOISE_PX / 3):
        reading = with_noise(exact, NOISE_PX, np.random.default_rng(10))
        reading = replace(
            reading, grid=replace(reading.grid, sigma_px=0 * reading.grid.sigma_px + stated)
        )
        solved = solver.solve(reading, "", PAPER_LENS)
        error = solved.to_plane(warped(points)).xz_mm - points
        ratio = solved.lack_of_fit_mm / np.sqrt(np.nanmean(error**2, axis=0))
        assert (ratio > 1 / 1.5).all()
        assert (ratio < 1.5).all()


@pytest.mark.slow
def test_understated_noise_is_no_lack_of_fit() -> None:
    """Marks three times as noisy as they say.  In one coordinate of a draw noise passes for a
    lack of fit with a chance of 1 in 40; among 20, more than 4 would be 1 in 5000.  And the
    stated uncertainty follows the noise there is."""
    view, rng = View(), np.random.default_rng(11)
    exact = read_board(BOARD, view.project, sigma_px=NOISE_PX)
    without_fault = solver.solve(exact, "", PAPER_LENS)
    lacks, growth = [], []
    for _ in range(10):
        solved = solver.solve(with_noise(exact, 3 * NOISE_PX, rng), "", PAPER_LENS)
        lacks.extend(solved.lack_of_fit_mm > 0)
        growth.append(np.linalg.norm(solved.modes) / np.linalg.norm(without_fault.modes))
    assert sum(lacks) <= 4
    # chi of some 650 degrees of freedom is good to 1/sqrt(2 * 650) = 3 %; 5 of those.
    np.testing.assert_allclose(growth, 3.0, rtol=0.14)


# --- the board beside the sheet ------------------------------------------------------------


@pytest.mark.parametrize("fault", range(5))
def test_modes_of_a_board_beside_the_sheet(fault: int) -> None:
    """The laser sheet 2 mm behind the board, tilted against it by half a degree about x or z, or
    the board bent by 0.5 mm or 0.1 % too large: the true point less the map's is the mode, to
    second order: the sheet's slope times the mode itself (1 mm or so), and the square of the
    angle on 250 mm."""
    view = View()
    solved = solver.solve(read_board(BOARD, view.project), "", PAPER_LENS)
    points, middle = board_points(100, seed=12), solved.view.centre_mm
    arm = points - middle
    half = np.abs(solved.locate(solved.region.outline_px) - middle).max(axis=0)
    lean = np.radians(0.5)
    behind = [2.0, lean * arm[:, 1], lean * arm[:, 0], 0.5 * (arm[:, 0] / half[0]) ** 2, 0.0][fault]
    number, slope = (0, 1, 2, 3, 6)[fault], (0.0, lean, lean, 1.0 / half[0], 0.0)[fault]
    if fault == 4:
        larger = read_board(BOARD, lambda xz: view.project(middle + 1.001 * (xz - middle)))
        solved = solver.solve(larger, "", PAPER_LENS)
    in_sheet = np.insert(points, 1, behind, axis=1)
    port = optics.PortModel(view.gap_mm, view.glass_mm, view.n_glass, view.n_water)
    camera = optics.CameraModel(view.focal_px, view.centre_px, view.k1, view.k2, port=port)
    image = optics.project(camera, (in_sheet - view.eye_mm()) @ view.axes())
    answer = solved.to_plane(image)
    valued = answer.status == Status.OK
    modes = board_modes(solved.geometry, BESIDE, solved.region, image)[valued, :, number]
    assert np.abs(modes).max() > 0.2
    missed = (points - answer.xz_mm)[valued] - modes
    assert np.abs(missed).max() < 2e-3 + (slope + 1e-3) * 2 * np.abs(modes).max()


def test_what_was_found_is_stated_and_what_it_contradicts() -> None:
    """The camera 1 m off, 30 degrees above the sheet's normal, 840 +- 5 px known of 850: found
    within 3 sigmas; known to be 700 +- 5, it is named."""
    view = View()
    reading = read_board(BOARD, view.project, NOISE_PX, np.random.default_rng(14))
    lens = PAPER_LENS.model_copy(update={"focal_px": (840.0, 5.0), "p1": (0.0, 1e-3)})
    calibration = calibrate(reading, "refractive", lens)
    assert not calibration.misfit
    nose = abs(view.eye_mm()[1])
    truth = {"focal_px": 850.0, "sheet_distance_mm": nose, "sheet_angle_deg": 30.0}
    for name, true in truth.items():
        value, sigma = calibration.quantities()[name]
        assert 0 < sigma < 0.01 * true
        assert abs(value - true) < 3 * sigma
    wrong = lens.model_copy(update={"focal_px": (700.0, 5.0)})
    assert "focal_px comes out at 8" in calibrate(reading, "refractive", wrong).misfit


def test_a_board_beside_the_sheet_shows_in_sigma() -> None:
    """[optics] board_offset_mm and its like reach the map, its sigma and its modes, but
    not its lack of fit.  To what tables leave (``pixel_table``): 2 SHARE of the largest of a mode,
    twice that of its square, in either map."""
    reading = read_board(BOARD, View().project, sigma_px=NOISE_PX)
    image = View().project(board_points(50, seed=13))
    beside = PAPER_LENS.model_copy(update={name: getattr(BESIDE, name) for name in EXACT_BOARD})
    coplanar, off = solver.solve(reading, "", PAPER_LENS), solver.solve(reading, "", beside)
    np.testing.assert_array_equal(coplanar.lack_of_fit_mm, off.lack_of_fit_mm)
    before, after = coplanar.to_plane(image), off.to_plane(image)
    added = (board_modes(off.geometry, BESIDE, off.region, image) ** 2).sum(axis=2)
    valued = after.status == Status.OK
    assert after.modes_mm is not None
    variance = after.sigma_mm[valued] ** 2
    bound = 8 * SHARE * after.modes_mm.shape[2] * variance.max()
    np.testing.assert_allclose(
        variance, before.sigma_mm[valued] ** 2 + added[valued], rtol=0, atol=bound
    )
    assert after.modes_mm.shape[2] == coplanar.modes.shape[1] + 7


# --- wrong marks, too few marks, wrong knowledge -------------------------------------------


@pytest.mark.parametrize("shift_px", [0.3, 40.0])
def test_a_wrong_mark_is_named_and_set_aside(
    shift_px: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A control point 15 sigmas off, or on its neighbour: the map is as without that mark."""
    view = View()
    reading = read_board(BOARD, view.project, NOISE_PX, np.random.default_rng(14))
    image = reading.grid.image_px.copy()
    image[37] += [shift_px, 0.0]
    faulty = replace(reading, grid=replace(reading.grid, image_px=image))
    missing = reading.grid.status.copy()
    missing[37] = Status.NOT_FOUND
    without = replace(reading, grid=replace(reading.grid, status=missing))
    solved, expected = (solver.solve(r, "", PAPER_LENS) for r in (faulty, without))
    assert [place.tolist() for place in solved.outliers_mm] == [reading.grid.board_mm[37].tolist()]
    points = view.project(board_points(50, seed=15))
    one, other = solved.to_plane(points), expected.to_plane(points)
    assert np.nanmax(np.abs(one.xz_mm - other.xz_mm) / other.sigma_mm) < 0.01
    # Begun near the solution, the wrong mark is left out at once: one fit of least squares does.
    fits = Mock(wraps=refractivefit.fit_boards)
    monkeypatch.setattr(refractivefit, "fit_boards", fits)
    near = solver.near(expected).solve(faulty, "", PAPER_LENS)
    assert fits.call_count == 1 and len(near.outliers_mm) == 1
    assert np.nanmax(np.abs(near.to_plane(points).xz_mm - one.xz_mm) / one.sigma_mm) < 0.01


def test_of_many_marks_a_part_only_leads_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    """Begun with some of the marks, the search ends near the same map of all of them.

    At the worst point it may be off by 0.3 of the uncertainty there, which adds 5 % to it.
    """
    reading = read_board(BOARD, View().project, NOISE_PX, np.random.default_rng(16))
    points = View().project(board_points(50, seed=17))
    whole = solver.solve(reading, "").to_plane(points)
    monkeypatch.setattr(refractivefit, "MANY", 100)
    monkeypatch.setattr(refractivefit, "ENOUGH", 60)
    part = solver.solve(reading, "").to_plane(points)
    assert np.nanmax(np.abs(part.xz_mm - whole.xz_mm) / whole.sigma_mm) < 0.3


def test_too_few_marks() -> None:
    missing = np.ones(100, dtype=bool)
    missing[[0, 5, 9, 40, 45, 49, 90, 95, 99]] = False
    with pytest.raises(BoardNotFound, match="needs 10 control points, found 9"):
        solver.solve(read_board(BOARD, View().project, missing=missing), "")


def test_marks_that_fit_no_view() -> None:
    """Places drawn at random, and the board seen in a mirror."""
    reading = read_board(BOARD, View().project)
    rng = np.random.default_rng(16)
    scattered = rng.uniform(0.0, 480.0, reading.grid.image_px.shape)
    with pytest.raises(BoardNotFound):
        solver.solve(
            replace(reading, rulers=(), grid=replace(reading.grid, image_px=scattered)), ""
        )
    mirrored = read_board(BOARD, lambda xz: [639.0, 0.0] + [-1.0, 1.0] * View().project(xz))
    with pytest.raises(BoardNotFound, match="front"):
        solver.solve(mirrored, "")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("focal_px", (-850.0, 10.0)),
        ("gap_mm", (-1.0, 1.0)),
        ("glass_index", (0.9, 0.1)),
        ("water_index", (0.0, 0.1)),
        ("tilt_x_deg", (60.0, 1.0)),
        ("k1", (float("nan"), 0.1)),
    ],
)
def test_bad_knowledge(key: str, value: tuple[float, float]) -> None:
    known = PAPER_LENS.model_copy(update={key: value})
    with pytest.raises(InputError, match=rf"optics\.{key}: out of range.*allowed"):
        solver.solve(read_board(BOARD, View().project), "", known)


@pytest.mark.parametrize(
    ("key", "value"), [("focal_px", 1.0), ("centre_u_px", 90_000.0), ("focal_px", 100_000.0)]
)
def test_knowledge_that_explains_no_mark(key: str, value: float) -> None:
    """Within its range, but held to be exact: the marks cannot be where they are."""
    known = PAPER_LENS.model_copy(update={key: (value, 0.0)})
    with pytest.raises(BoardNotFound):
        solver.solve(read_board(BOARD, View().project), "", known)


# --- files ---------------------------------------------------------------------------------


def test_file_round_trip(tmp_path: Path) -> None:
    """Number for number, outliers and the board's lie included."""
    reading = read_board(BOARD, View().project, NOISE_PX, np.random.default_rng(17))
    image = reading.grid.image_px.copy()
    image[37] += 5.0
    reading = replace(reading, grid=replace(reading.grid, image_px=image))
    known = PAPER_LENS.model_copy(update={"board_offset_mm": 2.0, "board_tilt_deg": 0.5})
    calibration = calibrate(reading, "refractive", known)
    save_calibration(tmp_path / "calibration.json", calibration)
    loaded = load_calibration(tmp_path / "calibration.json").plane_map
    assert loaded.parameters() == calibration.plane_map.parameters()
    points = View().project(board_points(50, seed=18))
    one, other = (m.to_plane(points, np.full(50, 0.1)) for m in (calibration.plane_map, loaded))
    np.testing.assert_array_equal(one.xz_mm, other.xz_mm)
    np.testing.assert_array_equal(one.sigma_mm, other.sigma_mm)
    np.testing.assert_array_equal(one.modes_mm, other.modes_mm)


def test_parameters_are_read_strictly() -> None:
    solved = solver.solve(read_board(BOARD, View().project, sigma_px=NOISE_PX), "", PAPER_LENS)

    def changed(**changes: object) -> dict[str, object]:
        return {**json.loads(json.dumps(solved.parameters())), **changes}

    assert solver.restore("", changed()).parameters() == solved.parameters()
    theta = solved.parameters()["theta"]
    for changes, said in (
        ({"theta": {**theta, "gap_mm": -1.0}}, "theta.gap_mm"),
        ({"theta": {**theta, "k9": 0.0}}, "theta must hold"),
        ({"theta": {**theta, "k1": "a"}}, "k1"),
        ({"modes": [[1.0]]}, "modes"),
        ({"centre_mm": [1.0]}, "centre_mm"),
        ({"port": "dome"}, "port"),
        ({"board_offset_mm": -1.0}, "board_offset_mm"),
        ({"outliers_mm": [[1.0]]}, "outliers_mm"),
        ({"more": 1}, "more"),
    ):
        with pytest.raises(InputError, match=said):
            solver.restore("", changed(**changes))
