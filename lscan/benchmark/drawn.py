"""Pictures of a laser line drawn from closed forms: the line's true centre is known exactly.

Across the line the light is a Gaussian integrated over each pixel, on the skirt that small-angle
scattering puts beside it: ``skirt / (|d| + 1.5 px)`` of the line's peak, d px from its centre.
The skirts were read off the tank's groove scene with each of its waters (the light of all
orders, median over the columns clear of edges); the form fits them to a fifth from the core to
40 px.  Then come speckle, shot noise, reading noise, the end of the range, and 8 bits.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from scipy.special import erf

from lscan.benchmark.judging import WORST, WorstColumn
from lscan.camera import CameraModel, PortModel, project
from lscan.config.board import Board, Grid, Ruler
from lscan.config.rig import NoiseSection, OpticsSection
from lscan.figures import style
from lscan.records import BoardReading, Bytes, Floats, Marks, RulerReading, Status

SHAPE = (96, 320)  # rows, columns
SKIRT_PX = 1.5
SKIRTS: Mapping[str, float] = {"tap": 0.0, "clear": 0.026, "coastal": 0.072, "harbor": 1.0}
"""The skirt of each water, px: its height at 1 px distance is skirt / 2.5 of the peak."""

BACKGROUND_DN = 4.0  # black level and what light there is
FULL_SCALE_DN = 255.0
SLOPE = 0.0471  # px a column: 320 columns see every sub-pixel phase many times over


@dataclass(frozen=True)
class LineCase:
    """One kind of picture.

    Attributes
    ----------
    water : str, a key of SKIRTS
    sigma_px : float, px, standard deviation of the line's cross-section
    peak_dn : float, DN, its height, without the skirt, before the range ends at 255 DN
    noise : NoiseSection, of the sensor
    """

    water: str
    sigma_px: float
    peak_dn: float
    noise: NoiseSection

    @property
    def saturated(self) -> bool:
        """Whether the crest, on its skirt and the background, is clipped."""
        crest = self.peak_dn * (1 + SKIRTS[self.water] / SKIRT_PX)
        return crest + BACKGROUND_DN > FULL_SCALE_DN


def centres(phase_px: float) -> Floats:
    """The true centre of the line in each column.

    Parameters
    ----------
    phase_px : float
        By which the line is shifted.

    Returns
    -------
    (W,) array
        Rows, px.
    """
    along: Floats = np.arange(float(SHAPE[1])) - SHAPE[1] / 2
    return SHAPE[0] / 2 + phase_px + SLOPE * along


def mean_picture(case: LineCase, centre_px: Floats) -> Floats:
    """(H, W) expected grey values in DN, before noise and the end of the range."""
    light: Floats = _line(case, centre_px) + _skirt(case, centre_px)
    return BACKGROUND_DN + case.peak_dn * light


def draw(case: LineCase, centre_px: Floats, generator: np.random.Generator) -> Bytes:
    """One picture of the line with all its noise.

    Parameters
    ----------
    case : LineCase
        Water, width and brightness of the line, and the noise.
    centre_px : (W,) array
        The line's true centre in each column, as :func:`centres` gives it.
    generator : numpy.random.Generator
        Of the noise.

    Returns
    -------
    (H, W) uint8 array
        Grey values, DN.

    Notes
    -----
    Speckle, gamma distributed with the contrast given (Goodman's law for integrated speckle),
    is of the light that the target reflects; the skirt comes from particles that drift.
    """
    noise = case.noise
    line = case.peak_dn * _line(case, centre_px)
    if noise.speckle > 0:
        degrees = 1 / noise.speckle**2
        line = line * generator.standard_gamma(degrees, SHAPE) / degrees
    mean: Floats = BACKGROUND_DN + case.peak_dn * _skirt(case, centre_px) + line
    if noise.dn_per_electron > 0:
        electrons = generator.poisson(mean / noise.dn_per_electron)
        mean = noise.dn_per_electron * electrons.astype(float)
    # read_dn includes the rounding to whole DN, which is made below.
    reading = max(noise.read_dn**2 - 1 / 12, 0.0) ** 0.5
    read = mean + reading * generator.standard_normal(SHAPE)
    return np.clip(np.rint(read), 0, FULL_SCALE_DN).astype(np.uint8)


def _line(case: LineCase, centre_px: Floats) -> Floats:
    """(H, W) the Gaussian of height 1, its mean over each pixel."""
    edges = np.arange(SHAPE[0] + 1)[:, None] - 0.5 - centre_px
    area: Floats = np.diff(erf(edges / (np.sqrt(2) * case.sigma_px)), axis=0) / 2
    return np.sqrt(2 * np.pi) * case.sigma_px * area


def _skirt(case: LineCase, centre_px: Floats) -> Floats:
    distance = np.abs(np.arange(SHAPE[0])[:, None] - centre_px)
    return SKIRTS[case.water] / (distance + SKIRT_PX)


# Calibration boards seen through a flat port from the paper's place: exact marks, then noise.


IMAGE_SIZE = (640, 480)
CAMERA_MM = np.array([225.0, -866.0254, 300.0])  # as in scenes/paper/rig.toml: 1 m, 30 degrees down
DEPRESSION = np.radians(30.0)


CAMERA = CameraModel(
    focal_px=850.0,
    centre_px=(319.5, 239.5),
    k1=-0.26,
    k2=0.06,
    port=PortModel(gap_mm=10.0, thickness_mm=6.0, glass_index=1.488, water_index=1.33131),
)
OPTICS = OpticsSection(
    focal_px=(830.0, 80.0),
    gap_mm=(11.0, 3.0),
    thickness_mm=(6.0, 0.3),
    glass_index=(1.49, 0.005),
    water_index=(1.3317, 0.0005),
    board_offset_mm=0.0,
    board_tilt_deg=0.0,
    board_bend_mm=0.0,
    board_scale_percent=0.0,
)
"""What the owner of such a rig knows of it: the port by ruler and data sheet, the drawn board."""


def image_px(xz_mm: Floats) -> Floats:
    """(N, 2) px where the camera at ``CAMERA_MM`` sees places of the sheet.

    Parameters
    ----------
    xz_mm : (N, 2) array, mm, (x, z) in the sheet y = 0
    """
    head = np.column_stack([xz_mm[:, 0], np.zeros(len(xz_mm)), xz_mm[:, 1]]) - CAMERA_MM
    cosine, sine = np.cos(DEPRESSION), np.sin(DEPRESSION)
    right = np.array([1.0, 0.0, 0.0])
    ahead, down = np.array([0.0, cosine, -sine]), np.array([0.0, -sine, -cosine])
    return project(CAMERA, head @ np.column_stack([right, down, ahead]))


def _ruled_board(grid: Grid) -> Board:
    """The grid with the paper's kind of rulers: marks every 10 mm half-way between dots."""
    width, height = (grid.columns - 1) * grid.pitch_mm, (grid.rows - 1) * grid.pitch_mm
    middle = grid.pitch_mm / 2
    down = [k * grid.pitch_mm + middle for k in (1, grid.columns // 2 - 1, grid.columns - 3)]
    across = [-k * grid.pitch_mm - middle for k in (2, grid.rows - 4)]
    rulers = [Ruler(direction="vertical", at_mm=x, first_mm=0.0, last_mm=-height) for x in down] + [
        Ruler(direction="horizontal", at_mm=z, first_mm=0.0, last_mm=width) for z in across
    ]
    return Board(grid=grid, ruler=tuple(rulers))


BOARDS: Mapping[str, Board] = {
    "paper": _ruled_board(Grid(columns=10, rows=10, pitch_mm=50.0, dot_diameter_mm=5.0)),
    "dots alone": Board(grid=Grid(columns=10, rows=10, pitch_mm=50.0, dot_diameter_mm=5.0)),
    "coarse": Board(grid=Grid(columns=6, rows=6, pitch_mm=90.0, dot_diameter_mm=8.0)),
    "dense": Board(grid=Grid(columns=31, rows=31, pitch_mm=15.0, dot_diameter_mm=5.0)),
}


def reading_of(board: Board, noise_px: float, generator: np.random.Generator) -> BoardReading:
    """The board's marks as the camera shows them, each shifted by normal noise in u and in v.

    Their sigma_px is the noise, or 1e-4 px where there is none.

    Parameters
    ----------
    board : Board, mm
    noise_px : float, px, standard deviation
    generator : Generator, of NumPy
    """

    def marks(places: Floats) -> Marks:
        return seen_marks(places, image_px(places), IMAGE_SIZE, noise_px, generator)

    rulers = [RulerReading(r.direction, r.at_mm, marks(r.points_mm())) for r in board.ruler]
    return BoardReading(
        image_size=IMAGE_SIZE,
        pitch_mm=board.grid.pitch_mm,
        shape=(board.grid.rows, board.grid.columns),
        grid=marks(board.grid.points_mm()),
        rulers=tuple(rulers),
    )


def seen_marks(
    board_mm: Floats,
    exact_px: Floats,
    image_size: tuple[int, int],
    noise_px: float,
    generator: np.random.Generator,
) -> Marks:
    """Marks with normal noise in u and in v; OUT_OF_VIEW where that takes them off the picture.

    Their sigma_px is the noise, or 1e-4 px where there is none.

    Parameters
    ----------
    board_mm : (N, 2) array, mm, on the board
    exact_px : (N, 2) array, px, where the camera sees them
    image_size : tuple of int, (width, height) of the picture, px
    noise_px : float, px, standard deviation
    generator : Generator, of NumPy
    """
    image = exact_px + noise_px * generator.standard_normal(exact_px.shape)
    seen = np.all((image >= 0) & (image <= np.array(image_size) - 1), axis=1)
    return Marks(
        board_mm=board_mm,
        image_px=np.where(seen[:, None], image, np.nan),
        sigma_px=np.where(seen, max(noise_px, 1e-4), np.nan),
        status=np.where(seen, Status.OK, Status.OUT_OF_VIEW).astype(np.int64),
    )


# The columns that an extractor errs in most, as one picture.


DPI = 90


@style.styled
def draw_worst(extractor: str, worst: Sequence[WorstColumn]) -> bytes:
    """The picture, PNG: the part about each of the worst columns, truth and what was found.

    Parameters
    ----------
    extractor : str, its name
    worst : sequence of WorstColumn, one at least
    """
    figure = Figure(figsize=(15.0, 6.5), layout="constrained")
    figure.suptitle(f"{extractor}: true +, found ×; grey values as their square roots")
    panels = np.ravel(figure.subplots(2, WORST // 2))
    for axes in panels:
        axes.set_axis_off()
        axes.set(xticks=[], yticks=[])  # else labels are laid out, not drawn
    for axes, one in zip(panels, worst, strict=False):
        axes.imshow(np.sqrt(one.part), cmap="gray", aspect="auto")
        axes.plot(*one.true, "+", color="tab:green", markersize=12)
        axes.plot(*one.found, "x", color="tab:red", markersize=9)
        axes.set_title(
            f"{one.case}, column {one.column}\n{one.error_px:+.2f} px, sigma {one.sigma_px:.2g}",
            fontsize=8,
        )
        axes.grid(False)
    return style.png(figure, DPI)
