"""Synthetic readings of a calibration board: what a camera behind a flat port would find.

The projection is written here from first principles in float64 and shares no formula with
the plane maps it is to judge: Snell's law at a flat port (the ray's n sin(theta) is the
same in every layer), a pinhole, and radial distortion k1, k2.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from hypothesis import strategies as st
from places import PAPER_BOARD

from lscan.calibration.physical import BoardKnown
from lscan.config.board import Board, load_board
from lscan.records import BoardReading, Floats, Mark, Marks, RingPoints, RulerReading, Status

PAPER_BOARD = PAPER_BOARD


def paper_board() -> Board:
    """The paper's board (Figs. 8, 14, 18)."""
    return load_board(PAPER_BOARD)


@dataclass(frozen=True)
class View:
    """A camera in front of the board's plane y = 0; the defaults are the tank's view.

    The camera stands ``distance_mm`` from ``target_mm`` (x, z), turned right by yaw_deg and
    raised by elevation_deg, and looks at it; roll_deg turns it about its axis.  With
    ``water`` False there is no port and the ray is straight.
    """

    distance_mm: float = 1000.0
    elevation_deg: float = 30.0
    yaw_deg: float = 0.0
    roll_deg: float = 0.0
    target_mm: tuple[float, float] = (225.0, -200.0)
    focal_px: float = 850.0
    centre_px: tuple[float, float] = (319.5, 239.5)
    k1: float = -0.22
    k2: float = 0.06
    water: bool = True
    gap_mm: float = 10.0
    glass_mm: float = 6.0
    n_glass: float = 1.49
    n_water: float = 1.331

    def axes(self) -> Floats:
        """(3, 3) camera axes right, down, forward as columns, in the head frame."""
        lift, turn, roll = np.radians([self.elevation_deg, self.yaw_deg, self.roll_deg])
        forward = np.array(
            [-np.cos(lift) * np.sin(turn), np.cos(lift) * np.cos(turn), -np.sin(lift)]
        )
        right = np.array([np.cos(turn), np.sin(turn), 0.0])
        down = np.cross(forward, right)
        c, s = np.cos(roll), np.sin(roll)
        return np.column_stack([c * right + s * down, c * down - s * right, forward])

    def eye_mm(self) -> Floats:
        """(3,) the pinhole in the head frame."""
        x, z = self.target_mm
        return np.array([x, 0.0, z]) - self.distance_mm * self.axes()[:, 2]

    def project(self, xz_mm: Floats) -> Floats:
        """(N, 2) px of the board points (N, 2) mm."""
        points = np.column_stack([xz_mm[:, 0], np.zeros(len(xz_mm)), xz_mm[:, 1]])
        camera = (points - self.eye_mm()) @ self.axes()
        radius = np.hypot(camera[:, 0], camera[:, 1])
        tangent = self._tangent(radius, camera[:, 2])
        unit = camera[:, :2] / np.maximum(radius, 1e-300)[:, None]
        bent = tangent * (1 + self.k1 * tangent**2 + self.k2 * tangent**4)
        return np.array(self.centre_px) + self.focal_px * unit * bent[:, None]

    def locate(self, image_px: Floats) -> Floats:
        """(N, 2) board point mm seen at each pixel (N, 2): the exact inverse of project."""
        offset = (image_px - np.array(self.centre_px)) / self.focal_px
        bent = np.hypot(offset[:, 0], offset[:, 1])
        tangent = bent.copy()
        for _ in range(60):
            tangent = bent / (1 + self.k1 * tangent**2 + self.k2 * tangent**4)
        unit = offset / np.maximum(bent, 1e-300)[:, None]
        sine = tangent / np.hypot(1.0, tangent)
        start, slope = 0.0 * tangent, tangent
        if self.water:
            in_glass = sine / np.sqrt(self.n_glass**2 - sine**2)
            start = self.gap_mm * tangent + self.glass_mm * in_glass
            slope = sine / np.sqrt(self.n_water**2 - sine**2)
        depth = self._port_mm()
        origin = np.column_stack([unit * start[:, None], np.full(len(bent), depth)])
        ray = np.column_stack([unit * slope[:, None], np.ones(len(bent))])
        world, ray = origin @ self.axes().T + self.eye_mm(), ray @ self.axes().T
        hit = world - ray * (world[:, 1] / ray[:, 1])[:, None]
        return hit[:, [0, 2]]

    def _port_mm(self) -> float:
        return self.gap_mm + self.glass_mm if self.water else 0.0

    def _tangent(self, radius: Floats, depth: Floats) -> Floats:
        """Tangent of the ray's angle in air; r(sine) rises strictly, so bisection finds it."""
        if not self.water:
            return radius / depth
        low, high = np.zeros_like(radius), np.ones_like(radius)
        beyond = depth - self._port_mm()
        for _ in range(60):
            sine = (low + high) / 2
            reached = (
                self.gap_mm * sine / np.sqrt(1 - sine**2)
                + self.glass_mm * sine / np.sqrt(self.n_glass**2 - sine**2)
                + beyond * sine / np.sqrt(self.n_water**2 - sine**2)
            )
            low, high = (
                np.where(reached < radius, sine, low),
                np.where(reached < radius, high, sine),
            )
        return low / np.sqrt(1 - low**2)


Projection = Callable[[Floats], Floats]
EXACT_BOARD: dict[str, Any] = dict.fromkeys(BoardKnown.__annotations__, 0.0)
"""What [optics] says of the boards drawn here: flat, to scale, and in the sheet."""


def read_board(
    board: Board,
    project: Projection,
    noise_px: float = 0.0,
    rng: np.random.Generator | None = None,
    missing: Any = False,
    sigma_px: float | None = None,
    image_size: tuple[int, int] = (640, 480),
) -> BoardReading:
    """The board as ``project`` shows it, marks shifted by noise, dots and rings exact.

    missing: mask over the grid's marks of those that were not found.
    sigma_px: the uncertainty stated; noise_px where None.
    """
    stated = noise_px if sigma_px is None else sigma_px

    turn = np.linspace(0.0, 2 * np.pi, 36, endpoint=False)
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    places = [
        board.grid.points_mm(),
        *(ruler.points_mm() for ruler in board.ruler),
        *(board.dot_mm(dot.name)[None] for dot in board.dot),
        *([ring.x_mm, ring.z_mm] + ring.diameter_mm / 2 * circle for ring in board.ring),
    ]
    ends = np.cumsum([len(part) for part in places])[:-1]
    seen_px = iter(np.split(project(np.concatenate(places)), ends))  # in one go

    def marks(points_mm: Floats, lost: Any = False) -> Marks:
        image = next(seen_px)
        seen = ((image >= 0) & (image <= np.array(image_size) - 1)).all(axis=1)
        status = np.where(seen, np.where(lost, Status.NOT_FOUND, Status.OK), Status.OUT_OF_VIEW)
        found = status == Status.OK
        return Marks(
            board_mm=points_mm,
            image_px=np.where(found[:, None], image, np.nan),
            sigma_px=np.where(found, stated, np.nan),
            status=status.astype(np.int64),
        )

    exact = BoardReading(
        image_size=image_size,
        pitch_mm=board.grid.pitch_mm,
        shape=(board.grid.rows, board.grid.columns),
        grid=marks(board.grid.points_mm(), missing),
        rulers=tuple(
            RulerReading(ruler.direction, ruler.at_mm, marks(ruler.points_mm()))
            for ruler in board.ruler
        ),
        dots={dot.name: Mark(next(seen_px)[0], stated, Status.OK) for dot in board.dot},
        rings={
            ring.name: RingPoints(next(seen_px), np.full(len(circle), stated))
            for ring in board.ring
        },
    )
    return exact if rng is None else with_noise(exact, noise_px, rng)


def with_noise(reading: BoardReading, noise_px: float, rng: np.random.Generator) -> BoardReading:
    """The reading with every mark shifted at random, normal with noise_px in u and in v."""

    def shift(marks: Marks) -> Marks:
        noise = rng.normal(0.0, noise_px, marks.image_px.shape)
        return replace(marks, image_px=marks.image_px + noise)

    rulers = tuple(replace(ruler, marks=shift(ruler.marks)) for ruler in reading.rulers)
    return replace(reading, grid=shift(reading.grid), rulers=rulers)


@st.composite
def views(draw: st.DrawFn, kind: Literal["perspective", "full"] = "full") -> View:
    """Random rigs that see most of the paper's board; "perspective" has neither lens nor port."""
    distance = draw(st.floats(700.0, 1500.0))
    wide = kind == "full"
    return View(
        distance_mm=distance,
        elevation_deg=draw(st.floats(10.0, 45.0)),
        yaw_deg=draw(st.floats(-12.0, 12.0)),
        roll_deg=draw(st.floats(-6.0, 6.0)),
        target_mm=(draw(st.floats(200.0, 250.0)), draw(st.floats(-230.0, -190.0))),
        focal_px=0.85 * distance,
        k1=draw(st.floats(-0.3, 0.1)) if wide else 0.0,
        k2=draw(st.floats(-0.05, 0.1)) if wide else 0.0,
        water=wide,
        gap_mm=draw(st.floats(5.0, 40.0)) if wide else 10.0,
        n_water=draw(st.floats(1.33, 1.345)) if wide else 1.331,
    )


# docs/explanation/physics.md, section 9, does not say which lens its figures are for.  k1 is
# chosen here so that first order without rulers has its 0.33 mm rms; its other figures then
# check the rest.  (At the tank's k1 = -0.22 lens and port nearly cancel, and lines look straight.)
BARREL = View(k1=-0.26)


def affine(xz_mm: Floats) -> Floats:
    """A view without perspective or distortion, about a pixel a millimetre, a little turned."""
    return xz_mm @ np.array([[1.1, 0.05], [-0.03, -0.95]]) + np.array([40.0, 10.0])


def board_points(count: int, seed: int) -> Floats:
    """(count, 2) points of the paper's board between its outermost control points, mm."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(0.0, 450.0, count), rng.uniform(-450.0, 0.0, count)])
