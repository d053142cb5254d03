"""Reading boards whose truth is known: every mark found, in its place, with its index."""

from dataclasses import replace

import numpy as np
import pytest
from boards import Light, View, render
from drawn_examples import examples
from hypothesis import Phase, given, strategies as st
from places import ROOT, SUPPORT

from lscan.board import draw_overlay, read_board
from lscan.config.board import Board, load_board
from lscan.errors import BoardNotFound, InputError
from lscan.records import BoardReading, Bytes, Floats, Status

pytestmark = pytest.mark.xdist_group("reader")  # one worker: they share a fixture

PAPER = load_board(ROOT / "scenes" / "paper" / "calibration-board.toml")
PLAIN = PAPER.model_copy(update={"ruler": (), "dot": (), "ring": (), "distances": ()})
RMS_PX = 0.10  # what is asked of a picture with 2 % noise
GROUND_PX = 0.002  # what the rounding of the ground to 1/255 of the grey values' range shifts a dot
SLOPE_PX = 0.0022
"""What the slope of the light, 1.5:1 over 640 px, shifts a dot where it is not divided out: the
window's variance, 3.5 px², times ln 1.5 / 640 px."""

VIEWS = st.builds(
    View,
    distance_mm=st.floats(880, 1000),
    tilt_rad=st.floats(np.deg2rad(15), np.deg2rad(35)),
    roll_rad=st.floats(np.deg2rad(-10), np.deg2rad(10)),
    barrel=st.floats(0.0, 0.3),
    shift_px=st.tuples(st.floats(-60, 60), st.floats(-8, 8)),
)
LIGHTS = st.builds(
    Light,
    ratio=st.floats(1.0, 2.0),
    toward_rad=st.floats(0, 2 * np.pi),
    blur_px=st.floats(0.5, 0.8),
    noise=st.floats(0.0, 0.02),
)


def with_grid(board: Board, **changes: object) -> Board:
    return board.model_copy(update={"grid": board.grid.model_copy(update=changes)})


def disc_in_view(view: View, board_mm: Floats, diameter_mm: float, margin: float) -> np.ndarray:
    """Whether each mark's disc, wider by ``margin`` px, lies in the picture."""
    at = view.image_px(board_mm)
    per_px = np.sqrt(np.abs(np.linalg.det(view.jacobian(at))))
    reach = (diameter_mm / 2 / per_px + margin)[:, None]
    return ((at - reach >= -0.5) & (at + reach <= np.array(view.size) - 0.5)).all(axis=1)


def assert_right(reading: BoardReading, view: View, board: Board) -> None:
    """Every dot in view found at its own place; nothing where there is nothing to see."""
    grid = reading.grid
    assert reading.shape == (board.grid.rows, board.grid.columns)
    np.testing.assert_array_equal(grid.board_mm, board.grid.points_mm())
    diameter = board.grid.dot_diameter_mm
    # One pixel either way is left open: a dot touching the edge may be called cut.
    assert grid.found[disc_in_view(view, grid.board_mm, diameter, 1.0)].all()
    assert (grid.status[~disc_in_view(view, grid.board_mm, diameter, -1.0)] != Status.OK).all()
    miss = grid.image_px - view.image_px(grid.board_mm)
    assert np.sqrt(np.nanmean(miss**2)) <= RMS_PX
    # No dot can be mistaken for its neighbour: the worst is below six of the largest sigmas.
    assert np.nanmax(np.abs(miss)) <= 0.5
    assert np.array_equal(np.isfinite(grid.image_px).all(axis=1), grid.found)
    assert np.array_equal(np.isfinite(grid.sigma_px), grid.found)


@pytest.mark.slow
@given(view=VIEWS, light=LIGHTS, seed=st.integers(0, 2**31))
@examples(20, phases=(Phase.explicit, Phase.generate))
def test_every_dot_in_view_is_found_in_its_place(view: View, light: Light, seed: int) -> None:
    # At these poses each row and column of the board is at least partly in view.
    picture = render(PLAIN, view, light, seed)
    assert_right(read_board(picture, PLAIN), view, PLAIN)


@pytest.fixture(scope="module")
def paper() -> tuple[View, Bytes, BoardReading]:
    view = View(distance_mm=880.0, roll_rad=np.deg2rad(2.0))
    picture = render(PAPER, view, Light(ratio=1.5, toward_rad=1.0), seed=3)
    return view, picture, read_board(picture, PAPER)


def test_the_paper_board(paper: tuple[View, Bytes, BoardReading]) -> None:
    view, _, reading = paper
    assert_right(reading, view, PAPER)
    miss = reading.grid.image_px - view.image_px(reading.grid.board_mm)
    # Uncertainties are correct: 200 coordinates know their scatter to 5 %; three of that.
    ratio = np.sqrt(np.mean((miss / reading.grid.sigma_px[:, None]) ** 2))
    assert 0.85 <= ratio <= 1.2


def test_rulers_and_dots(paper: tuple[View, Bytes, BoardReading]) -> None:
    view, _, reading = paper
    marks = [ruler.marks for ruler in reading.rulers]
    assert [len(m.status) for m in marks] == [46] * 5
    assert all(m.found.all() for m in marks)
    miss = np.concatenate([m.image_px - view.image_px(m.board_mm) for m in marks])
    sigma = np.concatenate([m.sigma_px for m in marks])
    assert np.sqrt(np.mean((miss / sigma[:, None]) ** 2)) == pytest.approx(1.0, abs=0.2)
    assert np.sqrt(np.mean(miss**2)) <= RMS_PX
    places = np.array([[dot.x_mm, dot.z_mm] for dot in PAPER.dot])
    found = np.array([reading.dots[dot.name].image_px for dot in PAPER.dot])
    assert np.sqrt(np.mean((found - view.image_px(places)) ** 2)) <= RMS_PX


def test_circles_through_the_true_map(paper: tuple[View, Bytes, BoardReading]) -> None:
    view, _, reading = paper
    for ring in PAPER.ring:
        points = view.board_mm(reading.rings[ring.name].image_px)
        assert len(points) >= 0.7 * ring.diameter_mm  # every third pixel, 0.8 to 1 px a mm
        x, z = points.T
        fit = np.linalg.lstsq(np.column_stack([x, z, np.ones_like(x)]), x**2 + z**2, rcond=None)[0]
        middle = fit[:2] / 2
        radius = np.sqrt(fit[2] + middle @ middle)
        # A point scatters by about 0.1 mm (0.3 of the dots' contrast over a line blurred to
        # 0.9 px, 2 % noise over three pixels); the mean of 72 by 0.012, a diameter by 0.024 mm.
        # Blur draws a line of radius R inwards by s^2 / 2R, 0.02 mm at most.  Together with
        # three sigmas: 0.11 mm; the paper's own Table II is good to 1 %, 0.28 to 0.49 mm.
        assert 2 * radius == pytest.approx(ring.diameter_mm, abs=0.11)
        np.testing.assert_allclose(middle, [ring.x_mm, ring.z_mm], atol=0.06)


def test_bright_marks_read_as_dark_ones(paper: tuple[View, Bytes, BoardReading]) -> None:
    _, picture, reading = paper
    inverted = read_board(255 - picture, PAPER.model_copy(update={"marks": "bright"}))
    # Only a bright plate shows the slope of the light.
    atol = GROUND_PX + SLOPE_PX
    np.testing.assert_allclose(inverted.grid.image_px, reading.grid.image_px, atol=atol)
    assert np.array_equal(inverted.grid.status, reading.grid.status)


@pytest.mark.parametrize(("scale", "offset"), [(3.0, 40.0), (1 / 255, 0.0)])
def test_grey_values_of_any_unit(
    paper: tuple[View, Bytes, BoardReading], scale: float, offset: float
) -> None:
    _, picture, reading = paper
    other = read_board(picture * scale + offset, PAPER)
    # The ground is rounded to the same part of the range, but for values on the brink.
    np.testing.assert_allclose(other.grid.image_px, reading.grid.image_px, atol=GROUND_PX)
    np.testing.assert_allclose(other.grid.sigma_px, reading.grid.sigma_px, rtol=1e-3)


def test_a_shifted_picture_gives_a_shifted_reading(
    paper: tuple[View, Bytes, BoardReading],
) -> None:
    _, picture, reading = paper
    shifted = read_board(np.pad(picture, ((7, 0), (12, 0)), mode="reflect"), PAPER)
    moved = shifted.grid.image_px - [12, 7]
    np.testing.assert_allclose(moved, reading.grid.image_px, atol=2 * GROUND_PX)


def test_a_transposed_board_gives_a_transposed_reading() -> None:
    board = with_grid(PLAIN, columns=9, rows=6)
    turned = with_grid(PLAIN, columns=6, rows=9)
    picture = render(board, View(target_mm=(200, -125), tilt_rad=0.3), seed=4)
    one, other = read_board(picture, board), read_board(picture.T.copy(), turned)
    lattice = other.grid.image_px.reshape(9, 6, 2).transpose(1, 0, 2)[..., ::-1]
    np.testing.assert_allclose(lattice.reshape(-1, 2), one.grid.image_px, atol=2 * GROUND_PX)


@pytest.mark.slow
@given(shake=st.lists(st.floats(-0.22, 0.22), min_size=6, max_size=6))
@examples(8)
def test_rough_seeds_by_hand_give_the_automatic_reading(
    paper: tuple[View, Bytes, BoardReading], shake: list[float]
) -> None:
    _, picture, reading = paper
    lattice = reading.grid.image_px.reshape(10, 10, 2)
    right = lattice[[0, 1, 0], [0, 0, 1]]
    pitch = np.linalg.norm(right[2] - right[0])
    by_hand = read_board(picture, PAPER, seeds=right + pitch * np.reshape(shake, (3, 2)))
    # The seeds' distance decides the window of the ground under the dots, and nothing else.
    atol = 2 * GROUND_PX + SLOPE_PX
    np.testing.assert_allclose(by_hand.grid.image_px, reading.grid.image_px, atol=atol)
    assert np.array_equal(by_hand.grid.status, reading.grid.status)


def test_a_colour_picture_is_read_in_the_channel_asked_for(
    paper: tuple[View, Bytes, BoardReading],
) -> None:
    _, picture, reading = paper
    flat = np.full_like(picture, 90)
    colour = np.stack([flat, picture, flat], axis=-1)
    green = read_board(colour, PAPER, channel="green")
    np.testing.assert_array_equal(green.grid.image_px, reading.grid.image_px)
    with pytest.raises(BoardNotFound):
        read_board(colour, PAPER, channel="red")
    grey = read_board(np.stack([picture] * 3, axis=-1), PAPER)
    np.testing.assert_allclose(grey.grid.image_px, reading.grid.image_px, atol=GROUND_PX)


def test_hidden_dots_are_reported_and_the_others_keep_their_index() -> None:
    view = View()
    picture = render(PLAIN, view, seed=5)
    hidden = [0, 34, 35, 44, 45, 99]
    for u, v in view.image_px(PLAIN.grid.points_mm()[hidden]).round().astype(int):
        picture[v - 6 : v + 7, u - 6 : u + 7] = 217  # the plate: 0.85 of full scale
    reading = read_board(picture, PLAIN)
    assert np.array_equal(np.nonzero(reading.grid.status == Status.NOT_FOUND)[0], hidden)
    miss = reading.grid.image_px - view.image_px(reading.grid.board_mm)
    assert np.sqrt(np.nanmean(miss**2)) <= RMS_PX


@pytest.mark.parametrize(
    "shift", [(150.0, 90.0), pytest.param((-150.0, -90.0), marks=pytest.mark.slow)]
)
def test_a_board_partly_out_of_view_keeps_its_indices(shift: tuple[float, float]) -> None:
    # Moved right and down its upper left corner is seen, moved left and up its lower right.
    view = View(shift_px=shift)
    reading = read_board(render(PAPER, view, seed=6), PAPER)
    assert_right(reading, view, PAPER)
    gone = reading.grid.status == Status.OUT_OF_VIEW
    assert gone.sum() >= 10
    for ruler in reading.rulers:
        marks = ruler.marks
        assert marks.found[disc_in_view(view, marks.board_mm, 2.0, 1.0)].all()
        away = ~disc_in_view(view, marks.board_mm, 2.0, -1.0)
        assert (marks.status[away] == Status.OUT_OF_VIEW).all()


def test_no_rim_in_view_is_refused_and_seeds_help() -> None:
    view = View(distance_mm=500.0)
    picture = render(PLAIN, view, seed=7)
    with pytest.raises(BoardNotFound, match="give the seeds by hand"):
        read_board(picture, PLAIN)
    part = with_grid(PLAIN, whole=False)
    reading = read_board(picture, part)
    assert reading.shape < (10, 10)
    lattice = reading.grid.image_px.reshape(*reading.shape, 2)
    known = np.nonzero(np.isfinite(lattice[..., 0]))
    assert known[0].min() == 0 and known[1].min() == 0
    # The whole-board index of each dot found, from the truth: a constant shift of ours.
    truth = view.board_mm(reading.grid.image_px[reading.grid.found])
    shift = truth - reading.grid.board_mm[reading.grid.found]
    # Five times what is asked of a centre, in mm by the pitch of 50 mm.
    pitch = np.nanmedian(np.linalg.norm(np.diff(lattice, axis=1), axis=-1))
    miss = 5 * RMS_PX * 50 / pitch
    np.testing.assert_allclose(shift, shift.mean(axis=0)[None].repeat(len(shift), 0), atol=miss)
    nodes = shift.mean(axis=0) / 50
    np.testing.assert_allclose(nodes, np.rint(nodes), atol=miss / 50)


def test_a_mirrored_picture_is_refused(paper: tuple[View, Bytes, BoardReading]) -> None:
    # A4, B4, C4, D4 ... lie where the mirror image has others; the grid and rulers look alike.
    mirrored = paper[1][:, ::-1]
    with pytest.raises(BoardNotFound, match=r"1\d of 16 named dots and 2 of 3 rings.*mirrored"):
        read_board(mirrored, PAPER)


def test_seeds_at_another_corner_are_refused(paper: tuple[View, Bytes, BoardReading]) -> None:
    _, picture, reading = paper
    seeds = reading.grid.image_px[[99, 89, 98]]  # from the lower right corner up and to the left
    turned, there = picture[::-1, ::-1], np.array(picture.shape[::-1]) - 1
    with pytest.raises(BoardNotFound, match=r"named dots.*check that the seeds"):
        read_board(turned, PAPER, seeds=there - seeds)


def test_the_file_of_another_board_is_refused(paper: tuple[View, Bytes, BoardReading]) -> None:
    dots = tuple(dot.model_copy(update={"x_mm": dot.x_mm - 12.0}) for dot in PAPER.dot)
    other = PAPER.model_copy(update={"dot": dots})
    with pytest.raises(BoardNotFound, match=r"16 of 16 named dots .*: check the board file"):
        read_board(paper[1], other)


@pytest.mark.slow
def test_marks_under_dirt_do_not_speak_against_the_board(
    paper: tuple[View, Bytes, BoardReading],
) -> None:
    view, picture, _ = paper
    dirty = picture.copy()
    (left, top), (right, bottom) = view.image_px(np.array([[80.0, -5.0], [470.0, -240.0]]))
    dirty[int(top) : int(bottom), int(left) : int(right)] = 217  # half of the named marks
    reading = read_board(dirty, PAPER)
    assert reading.dots["A1"].status == Status.NOT_FOUND
    assert reading.dots["D1"].status == Status.OK


def test_fewer_dots_than_the_board_file_says() -> None:
    picture = render(PLAIN, View(), seed=8)
    with pytest.raises(BoardNotFound, match="more than the 8"):
        read_board(picture, with_grid(PLAIN, columns=8))
    with pytest.raises(BoardNotFound, match="only 10 of the 12 columns"):
        read_board(picture, with_grid(PLAIN, columns=12))


def chessboard(square: int) -> Bytes:
    v, u = np.mgrid[:480, :640]
    return np.where((u // square + v // square) % 2, 220, 20).astype(np.uint8)


NOISE = np.random.default_rng(9)
NO_BOARD = {
    "noise": np.clip(NOISE.normal(128, 5, (480, 640)), 0, 255).astype(np.uint8),
    "wild noise": NOISE.integers(0, 256, (480, 640)).astype(np.uint8),
    "flat": np.full((480, 640), 128, np.uint8),
    "black": np.zeros((480, 640), np.uint8),
    "white": np.full((480, 640, 3), 255, np.uint8),
    "chessboard": chessboard(40),
    "eight dots": render(with_grid(PLAIN, columns=4, rows=2), View(target_mm=(75, -25)), seed=1),
}


@pytest.mark.parametrize("what", NO_BOARD)
def test_no_board(what: str) -> None:
    with pytest.raises(BoardNotFound, match=r"\w+ \w+ \w+"):
        read_board(NO_BOARD[what], PAPER)


@pytest.mark.slow
def test_a_chessboard_is_no_board_of_many_dots() -> None:
    dense = load_board(SUPPORT / "dot-photograph.toml")
    with pytest.raises(BoardNotFound, match=r"\w+ \w+ \w+"):
        read_board(NO_BOARD["chessboard"], dense)


@pytest.mark.slow
def test_a_board_with_dots_of_another_size(paper: tuple[View, Bytes, BoardReading]) -> None:
    with pytest.raises(BoardNotFound):
        read_board(paper[1], with_grid(PAPER, dot_diameter_mm=25.0))
    large = render(with_grid(PLAIN, dot_diameter_mm=10.0), View(), seed=2)
    with pytest.raises(BoardNotFound, match="they are about 10 mm wide, dot_diameter_mm is 5"):
        read_board(large, PLAIN)


def test_seeds_beside_the_dots(paper: tuple[View, Bytes, BoardReading]) -> None:
    _, picture, reading = paper
    seeds = reading.grid.image_px[[0, 10, 1]] + 25  # half a pitch off
    with pytest.raises(BoardNotFound, match="seeds"):
        read_board(picture, PAPER, seeds=seeds)
    named = np.array([reading.dots[name].image_px for name in ("B1", "B2", "B4")])
    with pytest.raises(BoardNotFound):
        read_board(picture, PAPER, seeds=named)


@pytest.mark.parametrize(
    "seeds",
    [
        [[10, 10], [10, 60]],
        [[10, 10], [10, 60], [np.nan, 10]],
        [[10, 10], [10, 60], [700, 10]],
        [[10, 10], [60, 10], [10, 60]],  # beneath and right exchanged
        [[10, 10], [10, 60], [10, 110]],
        [[10, 10], [10, 10], [10, 10]],
    ],
)
def test_seeds_that_cannot_be(seeds: list[list[float]]) -> None:
    with pytest.raises(InputError, match="seed"):
        read_board(np.zeros((480, 640), np.uint8), PAPER, seeds=np.array(seeds))


@pytest.mark.parametrize(
    "image",
    [
        np.zeros(9),
        np.zeros((40, 40, 4)),
        np.zeros((8, 40)),
        np.full((40, 40), np.nan),
        np.full((40, 40), 1e300),
        np.zeros((40, 40), complex),
        np.full((40, 40), "x"),
    ],
)
def test_what_is_no_picture(image: np.ndarray) -> None:
    with pytest.raises(InputError, match="image"):
        read_board(image, PAPER)


def test_an_unknown_channel() -> None:
    with pytest.raises(InputError, match="channel"):
        read_board(np.zeros((40, 40, 3)), PAPER, channel="violet")  # type: ignore[arg-type]


def test_features_need_to_know_where_o_is(paper: tuple[View, Bytes, BoardReading]) -> None:
    _, picture, reading = paper
    part = with_grid(PAPER, whole=False)
    with pytest.raises(InputError, match="origin"):
        read_board(picture, part)
    seeded = read_board(picture, part, seeds=reading.grid.image_px[[0, 10, 1]])
    np.testing.assert_allclose(
        seeded.dots["A1"].image_px, reading.dots["A1"].image_px, atol=GROUND_PX
    )


def test_the_overlay_marks_the_dots(paper: tuple[View, Bytes, BoardReading]) -> None:
    _, picture, reading = paper
    drawn = draw_overlay(picture, reading)
    assert drawn.shape == (*picture.shape, 3) and drawn.dtype == np.uint8
    column, row = reading.grid.image_px[0].round().astype(int)
    red, green, blue = drawn[row, column].astype(int)
    assert red > green + 50 and red > blue + 50
    far = drawn[-5:, -5:].astype(int)
    np.testing.assert_array_equal(far, np.stack([picture[-5:, -5:]] * 3, axis=-1))
    empty = replace(reading.grid, image_px=np.full_like(reading.grid.image_px, np.nan))
    assert draw_overlay(picture / 255.0, replace(reading, grid=empty)).shape == drawn.shape


@pytest.mark.parametrize("large_px", [640 * 480 - 1, 640 * 480 // 8])
def test_a_large_picture_is_searched_in_a_smaller_copy(
    paper: tuple[View, Bytes, BoardReading], monkeypatch: pytest.MonkeyPatch, large_px: int
) -> None:
    """Reduced by two the dots are still seen; by three they are too small, and it is the whole.

    Every mark is measured in the picture itself: its place differs by what the ground of the
    smaller copy, rounded to 1/255 of the range, shifts it.
    """
    _, picture, reading = paper
    monkeypatch.setattr("lscan.board.picture.LARGE_PX", large_px)
    again = read_board(picture, PAPER)
    np.testing.assert_array_equal(again.grid.status, reading.grid.status)
    shift = again.grid.image_px - reading.grid.image_px
    assert np.nanmax(np.abs(shift)) <= GROUND_PX
