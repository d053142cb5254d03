"""Made-up but realistic inputs of a report: the paper's experiment without a tank.

A pinhole camera with barrel distortion looks at the laser sheet from 1 m, 30 degrees down.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from places import PAPER_BOARD
from scipy.interpolate import CubicSpline

from lscan.config.board import Board, load_board
from lscan.config.targets import GroovedBlock, Sandwave
from lscan.figures.reportfigure import RowFits, RulerCurve, SliceData
from lscan.paper.experiment import METHODS
from lscan.paper.published import TABLE_1, TABLE_2, TABLE_3
from lscan.paper.report import ReportInputs
from lscan.records import (
    BoardReading,
    Bytes,
    Floats,
    Marks,
    RulerReading,
    Status,
    Stripe,
    Surface,
)

WIDTH, HEIGHT = 640, 480
MAPS = METHODS
YAW_DEG = 2.2
_BOARD = PAPER_BOARD


def to_image(xz_mm: Floats) -> Floats:
    """(N, 2) px of points (N, 2) mm in the sheet."""
    x, z = xz_mm[:, 0] - 225.0, xz_mm[:, 1] + 225.0
    depth = 1000.0 - 0.5 * z
    ray = np.column_stack([x, -0.866 * z]) / depth[:, None]
    ray *= 1.0 - 0.22 * (ray**2).sum(axis=1, keepdims=True)
    return 1000.0 * ray + [319.5, 239.5]


def board() -> Board:
    """The paper's board."""
    return load_board(_BOARD)


def marks(board_mm: Floats, rng: np.random.Generator) -> Marks:
    """Marks seen with 0.05 px of noise; those outside the picture have no place."""
    image_px = to_image(board_mm) + rng.normal(0, 0.05, board_mm.shape)
    inside = ((image_px > 3) & (image_px < [WIDTH - 4, HEIGHT - 4])).all(axis=1)
    status = np.where(inside, int(Status.OK), int(Status.OUT_OF_VIEW))
    image_px[~inside] = np.nan
    return Marks(board_mm, image_px, np.where(inside, 0.05, np.nan), status)


def reading(rng: np.random.Generator) -> BoardReading:
    """All marks of the paper's board."""
    plan = board()
    rulers = tuple(
        RulerReading(ruler.direction, ruler.at_mm, marks(ruler.points_mm(), rng))
        for ruler in plan.ruler
    )
    shape = (plan.grid.rows, plan.grid.columns)
    grid = marks(plan.grid.points_mm(), rng)
    return BoardReading((WIDTH, HEIGHT), plan.grid.pitch_mm, shape, grid, rulers)


def board_image(rng: np.random.Generator) -> Bytes:
    """The board picture: dark dots on a bright plate, with noise."""
    image = np.full((HEIGHT, WIDTH), 165.0)
    plan = board()
    spots = [(plan.grid.points_mm(), 2.5)]
    spots += [(ruler.points_mm(), 1.0) for ruler in plan.ruler]
    for points_mm, radius_mm in spots:
        for centre in np.rint(to_image(points_mm) * 16).astype(int):
            cv2.circle(image, tuple(map(int, centre)), int(radius_mm * 16), 40, -1, cv2.LINE_AA, 4)
    image = cv2.GaussianBlur(image, (0, 0), 0.7) + rng.normal(0, 2.0, image.shape)
    tint = np.array([0.86, 1.0, 0.97])
    return np.clip(image[:, :, None] * tint, 0, 255).astype(np.uint8)


def row_fits(points_px: Floats) -> RowFits:
    """The three fits of a row, as found and with its fifth point shifted by a pixel."""
    shifted = points_px.copy()
    shifted[4, 1] += 1.0
    return RowFits(points_px, _curves(points_px), shifted, _curves(shifted))


def _curves(points: Floats) -> dict[str, Floats]:
    u = np.linspace(points[0, 0], points[-1, 0], 400)
    fits: dict[str, Any] = {
        "graticule-1": np.poly1d(np.polyfit(*points.T, 1)),
        "graticule-2": np.poly1d(np.polyfit(*points.T, 2)),
        "graticule-bspline": CubicSpline(*points.T),
    }
    return {name: np.column_stack([u, fit(u)]) for name, fit in fits.items()}


def ruler_curve(ruler: RulerReading) -> RulerCurve:
    """The conversion curve of a vertical ruler."""
    seen = ruler.marks.found
    px, mm = ruler.marks.image_px[seen, 1], ruler.marks.board_mm[seen, 1]
    curve = CubicSpline(px, mm)
    along = np.linspace(px[0], px[-1], 300)
    return RulerCurve("R4", "z", px, mm, along, curve(along))


def line_picture(profile_mm: Floats, rng: np.random.Generator) -> tuple[Bytes, Stripe]:
    """A picture of the laser line along (N, 2) points of the sheet, and the stripe in it."""
    u, v = to_image(profile_mm).T
    kept = np.diff(u, prepend=-np.inf) > 0
    columns = np.arange(WIDTH)
    near = np.abs(columns[:, None] - u[kept]).min(axis=1) < 1.0
    centre = np.where(near, np.interp(columns, u[kept], v[kept]), np.nan)
    rows = np.arange(HEIGHT)[:, None]
    light = np.nan_to_num(230 * np.exp(-(((rows - centre) / 1.5) ** 2) / 2))
    red = light + 12 + rng.normal(0, 3.0, light.shape)
    image = np.stack([red, 0.12 * red, 0.08 * red], axis=2)
    status = np.where(near, int(Status.OK), int(Status.NO_PEAK))
    sigma = np.where(near, 0.04, np.nan)
    stripe = Stripe("columns", centre, sigma, np.where(near, 230.0, 0.0), status)
    return np.clip(image, 0, 255).astype(np.uint8), stripe


def groove_profile() -> Floats:
    """The top outline of the grooved block in the sheet, without its walls."""
    block = GroovedBlock()
    x = np.arange(0.0, block.edges_mm()[-1], 0.2)
    z = np.full(len(x), block.height_mm)
    for k, groove in enumerate(block.grooves):
        left, right = block.edges_mm()[1 + 2 * k : 3 + 2 * k]
        z[(x >= left) & (x < right)] -= groove.depth_mm
        z[(x >= left) & (x < left + 3)] = np.nan  # the shadow in the corner
    kept = np.isfinite(z)
    return np.column_stack([x + 110.0, z - 390.0])[kept]


def workpiece_mm(frames: int = 200, columns: int = 230) -> Floats:
    """(F, N, 3) of the sandwave block with its wedges, in the workpiece frame."""
    piece = Sandwave()
    rim, side = piece.rim_mm, piece.side_mm
    x, y = np.meshgrid(
        np.linspace(-rim, side + rim, columns), np.linspace(-rim, side + rim, frames)
    )
    wave = (x >= 0) & (x <= side) & (y >= 0) & (y <= side)
    z = np.where(wave, piece.height_mm(x, y), 0.0)
    for plan in piece.wedge_plans_mm():
        inside = cv2_inside(plan, x, y)
        z[inside] = piece.wedge.height_mm
    return np.stack([x, y, z], axis=2)


def cv2_inside(plan: Floats, x: Floats, y: Floats) -> Any:
    """Mask of the points inside a counter-clockwise triangle."""
    inside = np.ones(x.shape, dtype=bool)
    for start, end in zip(plan, np.roll(plan, -1, axis=0), strict=True):
        edge = end - start
        inside &= edge[0] * (y - start[1]) - edge[1] * (x - start[0]) >= 0
    return inside


def surface(xyz_mm: Floats, frame: Any) -> Surface:
    """A surface record around points."""
    held = np.isfinite(xyz_mm[..., 2])
    status = np.where(held, int(Status.OK), int(Status.OCCLUDED))
    sigma = np.where(held, 0.08, np.nan)
    return Surface(xyz_mm, sigma, sigma, status, np.arange(len(xyz_mm)) * 1.05, frame)


def slice_data(name: str, rng: np.random.Generator) -> SliceData:
    """A slice of the sandwave with 0.15 mm of noise and a stretch that is hidden."""
    piece = Sandwave()
    start, end = piece.slices_mm()[name]
    share = np.linspace(0, 1, 301)
    x, y = (start + share[:, None] * (end - start)).T
    nominal = piece.height_mm(x, y)
    error = 0.3 * np.gradient(np.gradient(nominal, x, edge_order=2), x) * 5
    error = error + rng.normal(0, 0.1, len(x))
    hidden = (share > 0.62) & (share < 0.67)
    error[hidden] = np.nan
    return SliceData(
        along_mm=share * float(np.linalg.norm(end - start)),
        measured_mm=nominal + error,
        status=np.where(hidden, int(Status.OCCLUDED), int(Status.OK)),
        nominal_mm=nominal,
        error_mm=error,
        sigma_mm=np.where(hidden, np.nan, 0.1),
        ends_mm=np.array([start, end]),
    )


def results(rng: np.random.Generator) -> dict[str, Any]:
    """A whole results.json."""
    piece = {name: slice_data(name, rng) for name in Sandwave().slices_mm()}
    return {
        "scene": "paper: the whole experiment",
        "versions": {"lscan": "0.1.0", "numpy": "2.4.6"},
        "seconds": {"board": 12.3, "groove": 8.1, "sandwave": 301.2, "total": 321.6},
        "control_points": {"expected": 100, "found": 100, "rms_px": 0.031, "max_px": 0.092},
        "render_check": {"stripe_rms_px": 0.041, "stripe_max_px": 0.217},
        "distances": {
            name: {f: _length(row["First rms"].nominal_mm, rng) for f, row in TABLE_1.items()}
            for name in MAPS
        },
        "diameters": {
            name: {f: _length(row["First rms"].nominal_mm, rng) for f, row in TABLE_2.items()}
            for name in MAPS
        },
        "groove": {name: _length(row.nominal_mm, rng) for name, row in TABLE_3.items()},
        "sandwave": {
            "frames": 200,
            "step_mm": 1.05,
            "yaw_deg": {"true": YAW_DEG, "estimated": 2.187},
            "slices": {name: _slice_summary(data) for name, data in piece.items()},
        },
    }


def _length(nominal_mm: float, rng: np.random.Generator) -> dict[str, float]:
    error = float(rng.normal(0, 0.15))
    measured = nominal_mm + error
    return {
        "nominal_mm": nominal_mm,
        "measured_mm": measured,
        "error_mm": error,
        "sigma_mm": 0.12,
    }


def _slice_summary(data: SliceData) -> dict[str, float]:
    assert data.error_mm is not None
    return {
        "points": len(data.status),
        "unseen": int((data.status == Status.OCCLUDED).sum()),
        "rmse_mm": float(np.sqrt(np.nanmean(data.error_mm**2))),
        "min_mm": float(np.nanmin(data.error_mm)),
        "max_mm": float(np.nanmax(data.error_mm)),
    }


def whole_experiment(seed: int = 20) -> ReportInputs:
    """Everything a report can show."""
    rng = np.random.default_rng(seed)
    read = reading(rng)
    rows, columns = read.shape
    lattice = read.grid.image_px.reshape(rows, columns, 2)
    groove_image, groove_stripe = line_picture(groove_profile(), rng)
    across = np.linspace(120.0, 330.0, 900)
    wave = np.column_stack([across, Sandwave().height_mm(across - 150.0, 75.0 + 0 * across) - 300])
    pictures = [line_picture(wave, rng) for _ in range(3)]

    aligned = workpiece_mm()
    aligned[..., 2] += rng.normal(0, 0.08, aligned.shape[:2])
    aligned[120:124, 100:140] = np.nan  # a shadow
    skewed = aligned.copy()
    skewed[..., 0] += np.tan(np.radians(YAW_DEG)) * aligned[..., 1]
    turn = np.radians(4.0)
    turned = np.array(
        [[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    )
    levelled = skewed @ turned.T
    tips = np.array([[*tip, Sandwave().wedge.height_mm] for tip in Sandwave().wedge_tips_mm()])
    tips[:, 0] += np.tan(np.radians(YAW_DEG)) * tips[:, 1]
    tips = tips @ turned.T
    raw = levelled.copy()
    raw[..., 2] += 0.05 * raw[..., 0] - 0.03 * raw[..., 1] - 390.0
    return ReportInputs(
        results=results(rng),
        board_image=board_image(rng),
        reading=read,
        row=row_fits(lattice[0]),
        ruler=ruler_curve(read.rulers[1]),
        groove_image=groove_image,
        groove_stripe=groove_stripe,
        sandwave_images=[image for image, _ in pictures],
        sandwave_stripe=pictures[0][1],
        raw=surface(raw, "head"),
        levelled=levelled,
        corners=(tips[0], tips[1]),
        turned=skewed,
        aligned=surface(aligned, "workpiece"),
        slices={name: slice_data(name, rng) for name in Sandwave().slices_mm()},
    )
