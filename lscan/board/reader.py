"""Reading the whole calibration board from one picture, stage by stage."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any, Literal

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.special import ndtr

from lscan.board.lattice import (
    LocalMap,
    complete_nodes,
    dot_part,
    drop_islands,
    drop_outliers,
    fault_of,
    grid_points_mm,
    lattice_scatter,
    less_sure,
    local_map,
    lost_marks,
    place_on_board,
    shift_of_discs,
)
from lscan.board.loops import noise_by_level
from lscan.board.marks import Contrast, mark_status, read_ring, read_round_marks
from lscan.board.picture import (
    IMMERKAER,
    STEPS_FROM_NEAR,
    BoardPicture,
    Image,
    bright_marks,
    enlarge,
    fit_centres,
    noise_of,
    prepare,
    reduction_of,
    rounding_of,
    shrink,
    stand_alone,
    window_sigma,
    working_reduction,
)
from lscan.board.search import Nodes, check_seeds, grow, local_pitch, propose_seeds, shift_by
from lscan.config.board import Board, Grid
from lscan.config.rig import Channel
from lscan.errors import BoardNotFound, InputError
from lscan.records import BoardReading, Floats, Marks, Mask, Status

LEAST = 0.5  # of the other marks in view, for a turn that the first does not allow
UNSURE = 0.01  # of the pitch: a dot of so large an uncertainty is none that counts
ENOUGH = 0.9  # of the other marks in view: the board is not looked at any other way up


def read_board(
    image: NDArray[Any], board: Board, *, seeds: Floats | None = None, channel: Channel = "grey"
) -> BoardReading:
    """All marks of the calibration board found in one picture (Sec. III.1 and III.3).

    The board may be turned by any angle: rulers, dots and rings show which way is up.  On a
    board with none, O is the corner that is upper left in the picture.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) array, integer or float grey values, or RGB
    board : Board, which marks there are.  With ``grid.whole`` False the origin is the upper left
        node of those seen, and the reading has as many rows and columns as are seen.
    seeds : (3, 2) array, optional, px, (u, v) of dots #1 (the upper left one), #2 (beneath it) and
        #3 (to its right), each good to a third of the pitch; found in the picture by default.  Dots
        above and to the left of #1 are not looked for.
    channel : str, of a colour picture: "red", "green", "blue" or "grey"

    Raises
    ------
    InputError
        For what is no picture, for seeds that are no corner of a grid, and for rulers, dots or
        rings on a board with ``whole`` False unless seeds say where O is.
    BoardNotFound
        Where there is no board, too little of it, or no telling which dot is O.

    References
    ----------
    Secs. III.1 and III.3 and Figs. 8 to 12 of the paper.

    Examples
    --------
    >>> import lscan
    >>> run = lscan.open_run("runs/board")
    >>> reading = lscan.read_board(run.frame(0).image, run.rig_file.rig.board)
    >>> int(reading.grid.found.sum())
    100
    """
    bright = bright_marks(image, channel, board.marks)
    if seeds is not None:
        picture, nodes = _search_from(bright, board, check_seeds(seeds, bright.shape[::-1]))
        reading = _all_marks(bright, picture, nodes, board)
        if lost := lost_marks(reading, board):
            raise BoardNotFound(
                f"{lost} are not where the board file has them: check that the seeds are dot O, "
                "the one beneath it and the one to its right, and the board file"
            )
        return reading
    if not board.grid.whole and (board.ruler or board.dot or board.ring):
        what = "rulers, dots and rings cannot be placed where the origin is whichever dot is seen"
        allowed = "grid.whole = true, seeds that say which dot is O, or control points alone"
        raise InputError(what, where="board", allowed=allowed)
    try:
        picture, nodes = _search_from_anywhere(bright, board)
    except BoardNotFound:
        _refuse_other_contrast(-bright, board)
        raise
    reading = _upright(bright, picture, nodes, board)
    if lost := lost_marks(reading, board):
        why = _why_lost(bright, board)
        raise BoardNotFound(f"{lost} are not where the board file has them{why}")
    return reading


def _why_lost(bright: Image, board: Board) -> str:
    """What to do where other marks are lost: the picture may show the board as in a mirror."""
    with suppress(BoardNotFound):
        mirrored = np.ascontiguousarray(bright[:, ::-1])
        reading = _upright(mirrored, *_search_from_anywhere(mirrored, board), board)
        if not lost_marks(reading, board):
            return (
                ", but they are in the mirror image: the picture is mirrored (take it as the "
                "camera sees it, without a mirror or a flip)"
            )
    return ": check the board file, or take out of it the marks that the board does not have"


def _refuse_other_contrast(inverted: Image, board: Board) -> None:
    """Raise BoardNotFound where the board is there with marks of the other brightness."""
    other: Literal["dark", "bright"] = "bright" if board.marks == "dark" else "dark"
    try:
        _search_from_anywhere(inverted, board.model_copy(update={"marks": other}))
    except BoardNotFound:
        return
    raise BoardNotFound(
        f"no grid of {board.marks} dots in the picture, but one of {other} dots: say "
        f'marks = "{other}" in the board file'
    )


def _upright(bright: Image, picture: BoardPicture, nodes: Nodes, board: Board) -> BoardReading:
    """The reading in the first quarter turn in which the board's other marks are found.

    The grid alone looks alike in two or four of them: rulers, dots and rings show.  Where they
    show nothing, the dot nearest to the picture's upper left corner is O.
    """
    radius_px = _median_radius(nodes, board.grid)
    best, refusal = None, None
    for turns in _quarter_turns(nodes, board):
        turned = Nodes(np.rot90(nodes.values, turns))
        try:
            placed = place_on_board(picture, turned, board.grid, radius_px)
        except BoardNotFound as error:
            refusal = refusal or error
            continue
        reading = _all_marks(bright, picture, placed, board)
        share = _share_found(reading)
        if best is None or share > best[0]:
            best = share, reading
        if share >= ENOUGH:
            break
    if refusal is not None and (best is None or best[0] < LEAST):
        raise refusal
    assert best is not None  # without a refusal there was a reading
    return best[1]


def _quarter_turns(nodes: Nodes, board: Board) -> range:
    """Those worth trying: all where other marks can show, else the first in which the grid fits."""
    if board.ruler or board.dot or board.ring:
        return range(4)
    rows, columns = nodes.height.shape
    upright = rows <= board.grid.rows and columns <= board.grid.columns
    lying = rows <= board.grid.columns and columns <= board.grid.rows
    return range(1, 2) if lying and not upright else range(1)


def _share_found(reading: BoardReading) -> float:
    """Mean share of the ruler marks and dots in view that were found, and of the rings."""
    marks = [ruler.marks.status for ruler in reading.rulers]
    marks.append(np.array([dot.status for dot in reading.dots.values()], dtype=np.int64))
    in_view = [status[status != Status.OUT_OF_VIEW] for status in marks]
    shares = [float((status == Status.OK).mean()) for status in in_view if len(status)]
    if reading.rings:
        shares.append(float(np.mean([len(r.sigma_px) > 0 for r in reading.rings.values()])))
    return float(np.mean(shares)) if shares else 1.0


def _all_marks(bright: Image, picture: BoardPicture, nodes: Nodes, board: Board) -> BoardReading:
    """The dots measured again on the board's place for them, and all other marks."""
    mapping = local_map(complete_nodes(nodes, board.grid.pitch_mm), board.grid.pitch_mm)
    noise = noise_image(bright, nodes, _median_radius(nodes, board.grid))
    picture = replace(picture, noise=picture.gain * noise)
    nodes = _remeasure(picture, nodes, mapping, board)
    mapping = local_map(complete_nodes(nodes, board.grid.pitch_mm), board.grid.pitch_mm)
    contrast = Contrast.of(nodes, mapping, board.grid.dot_diameter_mm)
    rulers, dots = read_round_marks(picture, mapping, contrast, board)
    reading = BoardReading(
        image_size=picture.size,
        pitch_mm=board.grid.pitch_mm,
        shape=(nodes.height.shape[0], nodes.height.shape[1]),
        grid=_grid_marks(picture, nodes, mapping, board.grid),
        rulers=rulers,
        dots=dots,
        rings={ring.name: read_ring(picture, mapping, contrast, ring) for ring in board.ring},
    )
    return less_sure(reading, lattice_scatter(nodes))


def _search_from_anywhere(bright: Image, board: Board) -> tuple[BoardPicture, Nodes]:
    """The dots found from the first automatic seeds that lead to a board."""
    grid = board.grid
    shape = (2 * grid.rows + 1, 2 * grid.columns + 1)  # the seed may be any dot of the board
    faults = []
    noise = noise_of(bright)
    for seeds in _proposals(bright, board, noise):
        corner = grid.rows, grid.columns
        picture, nodes, fault = _search_dots(bright, noise, grid, seeds, shape, corner)
        if fault is None:
            return picture, nodes.part(nodes.extent())
        faults.append((int(nodes.found.sum()), fault))
    most = max(faults, key=lambda found: found[0])
    raise BoardNotFound(f"the board was not found: {most[1]}")


def _proposals(bright: Image, board: Board, noise: float) -> Iterator[Floats]:
    """Seeds to begin with; of a large picture, those that a smaller copy shows come first."""
    reduction = reduction_of(bright)
    if reduction > 1:
        small = shrink(bright, reduction)
        with suppress(BoardNotFound):  # dots may be too small in it
            for seeds in propose_seeds(small, board, noise_of(small)):
                yield (seeds + 0.5) * reduction - 0.5
    yield from propose_seeds(bright, board, noise)


def _search_from(bright: Image, board: Board, seeds: Floats) -> tuple[BoardPicture, Nodes]:
    """The dots found from seeds given by hand, the first of which is the origin."""
    grid = board.grid
    shape, noise = (grid.rows, grid.columns), noise_of(bright)
    picture, nodes, fault = _search_dots(bright, noise, grid, seeds, shape, (0, 0))
    if fault is not None:
        given = np.round(seeds, 1).tolist()
        raise BoardNotFound(f"the board was not found from the seeds {given}: {fault}")
    if grid.whole:
        return picture, nodes
    rows, columns = nodes.extent()
    return picture, nodes.part((slice(0, rows.stop), slice(0, columns.stop)))


def _search_dots(
    bright: Image,
    noise: float,
    grid: Grid,
    seeds: Floats,
    shape: tuple[int, int],
    corner: tuple[int, int],
) -> tuple[BoardPicture, Nodes, str | None]:
    """The picture levelled, the dots found from seeds, and what speaks against them.

    shape: of the nodes to fill.  corner: the node of the first seed.
    """
    pitch_px = float(np.linalg.norm(seeds[1:] - seeds[0], axis=1).mean())
    picture = prepare(bright, pitch_px * dot_part(grid) / 2, noise)
    nodes = grow(picture, seeds, shape, corner, dot_part(grid))
    drop_outliers(nodes, grid.pitch_mm)
    drop_islands(nodes)
    return picture, nodes, fault_of(picture, nodes, grid)


def _median_radius(nodes: Nodes, grid: Grid) -> float:
    return float(np.nanmedian(local_pitch(nodes.points))) * dot_part(grid) / 2


def _remeasure(picture: BoardPicture, nodes: Nodes, mapping: LocalMap, board: Board) -> Nodes:
    """The same dots: windows by the local map, corrected for its bias, the noise as it is there."""
    grid = board.grid
    map_there = mapping.expansion(grid_points_mm(nodes.height.shape, grid.pitch_mm)[nodes.found])
    sigma = window_sigma(map_there.scale * grid.dot_diameter_mm / 2)
    start = nodes.points[nodes.found]
    centres = fit_centres(picture.flat, start, sigma, picture.noise, STEPS_FROM_NEAR)
    shift = shift_of_discs(map_there, grid.dot_diameter_mm / 2, sigma)
    again = Nodes.empty(*nodes.height.shape)
    sigma_px = centres.sigma_px
    if not (board.ruler or board.dot or board.ring):  # nothing else is between the dots
        every = complete_nodes(nodes, grid.pitch_mm)
        sigma_px = sigma_px * grain(picture, every, _median_radius(nodes, grid))[nodes.found]
    measured = replace(centres, points=centres.points - shift, sigma_px=sigma_px)
    sure = sigma_px <= UNSURE * map_there.scale * grid.pitch_mm
    alone = stand_alone(picture.flat, centres, sigma, picture.noise)
    again.put(np.nonzero(nodes.found), measured, centres.round & alone & sure)
    return again


def _grid_marks(picture: BoardPicture, nodes: Nodes, mapping: LocalMap, grid: Grid) -> Marks:
    board = grid_points_mm(nodes.height.shape, grid.pitch_mm).reshape(-1, 2)
    map_there = mapping.expansion(board)
    radius = map_there.scale * grid.dot_diameter_mm / 2
    in_view = picture.wholly_in_view(map_there.image_px, radius)
    image_px, status = nodes.points.reshape(-1, 2), mark_status(nodes.found.ravel(), in_view)
    return Marks(board_mm=board, image_px=image_px, sigma_px=nodes.sigma_px.ravel(), status=status)


# How noisy each pixel is: the scatter of grey values on the plate and inside the dots.
#
# A sensor's noise grows with the light, so a bright plate is noisier than the dark dots on it.
# On the plate it is seen directly.  A dot of few pixels is nowhere flat; there the noise is what
# its odd third differences do not share with those of all other dots, which are alike.


CUT = 2.5  # sigmas beyond which a difference is taken for a mark's, not for noise
# The variance of a normal so cut.
KEPT = 1 - 2 * CUT * np.exp(-(CUT**2) / 2) / np.sqrt(2 * np.pi) / (2 * ndtr(CUT) - 1)
CLEAR = 1.7  # of the dot's radius: from there on the plate
LEVELS = 8  # of the plate's brightness
FEWEST_PIXELS = 400  # per level: they give sigma to 4 %
MOST_PIXELS = 100_000  # they give the sigma of each level to 1 %
FEWEST_DOTS = 40  # two differences each, 24 coefficients: sigma to 10 %
GRAINY = 2.0  # times white noise; chance makes 1.5 of some twenty differences
GRAIN_REACH = 3  # nodes to either side
GRAIN_FEWEST = 6  # differences about a node; with fewer it is as elsewhere


def noise_image(bright: Image, nodes: Nodes, radius_px: float) -> Image:
    """(H, W) standard deviation of the noise of each pixel, in grey values.

    Between the levels at which the variance is seen it is taken as linear in the grey value, as
    shot noise is; it is at least that of rounding.

    Parameters
    ----------
    bright : (H, W) array, grey values, marks bright
    nodes : Nodes, px, the dots found
    radius_px : float, px, about that of the dots
    """
    smooth = np.asarray(cv2.GaussianBlur(bright, (0, 0), 1.0), dtype=np.float32)
    levels, variances = _plate_levels(bright, smooth, nodes, radius_px)
    if (dot := _dot_level(bright, nodes)) is not None:
        levels, variances = np.append(levels, dot[0]), np.append(variances, dot[1])
    order = np.argsort(levels)
    some = shrink(smooth, working_reduction(bright, radius_px))
    noise = noise_by_level(some, levels[order], variances[order], rounding_of(bright) ** 2)
    return enlarge(noise, bright.shape)


def _plate_levels(
    bright: Image, smooth: Image, nodes: Nodes, radius_px: float
) -> tuple[Floats, Floats]:
    """Levels and variances of up to eight parts of the plate, from the darkest to the brightest.

    The norm of Immerkær's mask (picture.noise_of) is 6.
    """
    plate = np.flatnonzero(_clear_of(nodes, radius_px, bright.shape))
    some = plate[:: max(1, len(plate) // MOST_PIXELS)]
    response = cv2.filter2D(bright, cv2.CV_32F, IMMERKAER)
    values, level = (of.ravel()[some].astype(float) for of in (response, smooth))
    count = int(np.clip(len(level) // FEWEST_PIXELS, 1, LEVELS))
    order = np.argsort(level)
    levels, parts = (np.array_split(of[order], count) for of in (level, values))
    middles = [_middle(part) for part in levels]
    return np.array(middles), np.array([_cut_variance(part) / 36 for part in parts])


def _clear_of(nodes: Nodes, radius_px: float, shape: tuple[int, ...]) -> Mask:
    """(H, W) mask of the pixels well away from every dot, all inner pixels where none are."""
    clear = np.zeros(shape, np.uint8)
    clear[1:-1, 1:-1] = 1
    radius = int(np.ceil(CLEAR * radius_px))
    for u, v in np.rint(nodes.points[nodes.found]).astype(int):
        cv2.circle(clear, (int(u), int(v)), radius, 0, -1)
    if clear.sum() < FEWEST_PIXELS:
        clear[1:-1, 1:-1] = 1
    return clear.view(bool)


def _dot_level(bright: Image, nodes: Nodes) -> tuple[float, float] | None:
    """Level and variance in the middle of the dots, None where too few were found.

    The third difference [1 -2 1] by [-1 0 1], whose squared norm is 12, vanishes in the middle
    of a symmetric dot; beside the middle it grows as an odd function of the distance from it,
    alike in all dots but for their size, which changes evenly over the board.  A regression
    over the dots takes that out.
    """
    points, contrast = nodes.points[nodes.found], nodes.height[nodes.found]
    base = np.rint(points).astype(np.int64)
    height, width = bright.shape
    inner = (base >= 1).all(axis=1) & (base <= [width - 2, height - 2]).all(axis=1)
    points, contrast, base = points[inner], contrast[inner], base[inner]
    if len(base) < FEWEST_DOTS:
        return None
    column, row = (base - 1).T
    patches = sliding_window_view(bright, (3, 3))[row, column].astype(np.float64)
    even, odd = np.array([1.0, -2.0, 1.0]), np.array([-1.0, 0.0, 1.0])
    offset = points - base
    middle = (points - points.mean(axis=0)) / points.std(axis=0)
    place = np.column_stack([np.ones(len(points)), middle])
    squares = []
    for axis in (0, 1):
        rows, columns = (odd, even) if axis == 1 else (even, odd)
        difference = np.einsum("nij,i,j->n", patches, rows, columns)
        along, across = offset[:, axis], offset[:, 1 - axis]
        odd_terms = np.stack([along, along**3, along * across**2], axis=1)
        sized = (odd_terms[:, :, None] * place[:, None]).reshape(len(base), -1)
        rest = np.stack([np.ones_like(along), across, along**5], axis=1)
        design = np.hstack([sized, rest]) * contrast[:, None]
        solved = np.linalg.lstsq(design, difference, rcond=None)[0]
        freedom = len(base) / (len(base) - design.shape[1])
        squares.append(_cut_variance(difference - design @ solved) * freedom / 12)
    return float(np.median(patches)), float(np.mean(squares))


def _cut_variance(values: Floats) -> float:
    """Variance of the normal noise in ``values``, what lies beyond 2.5 sigmas left out."""
    sizes = np.sort(np.abs(values))
    squares = sizes**2
    total, variance = np.cumsum(squares), (_middle(sizes) / 0.6745) ** 2
    for _ in range(10):
        kept = int(np.searchsorted(squares, CUT**2 * variance, side="right"))
        if kept == 0 or variance == 0:
            break
        variance = float(total[kept - 1]) / kept / KEPT
    return variance


def _middle(values: Floats) -> float:
    """The median of values that rise."""
    return float(values[(len(values) - 1) // 2] + values[len(values) // 2]) / 2


def grain(picture: BoardPicture, points: Floats, radius_px: float) -> Floats:
    """(R, C) by how much noise under the marks' windows exceeds white noise of pixels; 1 or more.

    Denoising and coding leave noise that neighbouring pixels share, which smoothing hardly takes
    away.  It is seen in the middle between four dots, in the picture smoothed as for them, by
    second differences from cell to cell: slopes of the ground cancel, and the marks of a ruler
    disturb one direction only.  Below twice that of white noise it is taken for chance.

    Parameters
    ----------
    picture : BoardPicture, levelled, with the noise of its pixels
    points : (R, C, 2) array, px, (u, v) of all nodes of the grid, seen or not
    radius_px : float, px, of the control dots
    """
    middle = (points[1:, 1:] + points[1:, :-1] + points[:-1, 1:] + points[:-1, :-1]) / 4
    inside = picture.wholly_in_view(middle, radius_px)
    middle = np.where(inside[..., None], middle, 0.0)
    column, row = np.moveaxis(np.rint(middle).astype(np.int64), -1, 0)
    sigma = float(window_sigma(np.array([radius_px]))[0])
    white = picture.noise_at(middle.reshape(-1, 2)).reshape(inside.shape) / (2 * np.sqrt(np.pi))
    scaled = np.where(inside, picture.smooth[row, column] * sigma / white, np.nan)
    scaled = np.pad(scaled, ((0, 1), (0, 1)), constant_values=np.nan)  # cell beneath, right of node
    spread = [_usual(_second_difference(scaled, *way)) for way in ((1, 0), (0, 1))]
    ratio = np.fmin(*spread)
    if np.isfinite(ratio).any():
        ratio = np.where(np.isfinite(ratio), ratio, np.nanmedian(ratio))
    return np.where(ratio > GRAINY, ratio, 1.0)


def _second_difference(values: Floats, rows: int, columns: int) -> Floats:
    """(R, C) of values and those beside, over what independent ones of unit size make of it."""
    beside = shift_by(values, rows, columns) + shift_by(values, -rows, -columns)
    return (beside - 2 * values) / np.sqrt(6)


def _usual(differences: Floats) -> Floats:
    """(R, C) robust standard deviation of those within GRAIN_REACH of each; NaN where too few."""
    span = range(-GRAIN_REACH, GRAIN_REACH + 1)
    near = np.abs(np.stack([shift_by(differences, row, column) for row in span for column in span]))
    enough = np.isfinite(near).sum(axis=0) >= GRAIN_FEWEST
    usual = np.full(differences.shape, np.nan)
    usual[enough] = np.nanmedian(near[:, enough], axis=0) / 0.6745
    return usual
