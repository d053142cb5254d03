"""Lenses whose distortion folds within the picture, told from those that image all of it."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import assume, given, strategies as st

from lscan.camera.optics import CameraModel, fold_radius, undistort
from lscan.records import Floats
from sim.scene import Lens
from sim.scene.instrument import is_folded

WIDTH, HEIGHT = 640, 480
CORNER_PX = np.hypot(WIDTH, HEIGHT) / 2  # of a picture centred on the axis, to its outer edge
CENTRE = ((WIDTH - 1) / 2, (HEIGHT - 1) / 2)
CLOSE = 1e-3


def folded(focal_px: float, centre: tuple[float, float] = CENTRE, **coefficients: float) -> bool:
    lens = Lens(focal_px=focal_px, centre_px=centre, **coefficients)
    return is_folded(lens, WIDTH, HEIGHT)


def border(focal_px: float, centre: tuple[float, float]) -> Floats:
    """(N, 2) distorted tangents of the picture's outer edge."""
    along = np.linspace(-0.5, 0.5, 41)
    sides = [[x, y] for one in along for side in (-0.5, 0.5) for x, y in ((one, side), (side, one))]
    return (np.array(sides) * [WIDTH, HEIGHT] + CENTRE - centre) / focal_px


def determinant(camera: CameraModel, tangents: Floats) -> Floats:
    """Of the distortion's Jacobian, by central differences of the polynomial as written down."""

    def bent(x: Floats, y: Floats) -> Floats:
        q = x**2 + y**2
        radial = 1 + camera.k1 * q + camera.k2 * q**2
        return np.array(
            [
                x * radial + 2 * camera.p1 * x * y + camera.p2 * (q + 2 * x**2),
                y * radial + camera.p1 * (q + 2 * y**2) + 2 * camera.p2 * x * y,
            ]
        )

    (x, y), h = tangents.T, 1e-5
    by_x = (bent(x + h, y) - bent(x - h, y)) / (2 * h)
    by_y = (bent(x, y + h) - bent(x, y - h)) / (2 * h)
    return np.asarray(by_x[0] * by_y[1] - by_x[1] * by_y[0])


@pytest.mark.parametrize("k1", [-0.1, -0.3, -3.0])
def test_a_barrel_folds_at_two_thirds_of_its_turn(k1: float) -> None:
    """r + k1 r3 turns at r = 1 / sqrt(-3 k1) and is 2/3 of that there."""
    focal = CORNER_PX / (2 / 3 / np.sqrt(-3 * k1))
    assert folded(focal * (1 - CLOSE), k1=k1)
    assert not folded(focal * (1 + CLOSE), k1=k1)


@pytest.mark.parametrize("k1", [-0.2, -0.5])
def test_a_fisheye_folds_where_its_radius_turns(k1: float) -> None:
    """t + k1 t3 turns at t = 1 / sqrt(-3 k1), where it is 2/3 of that."""
    focal = CORNER_PX / (2 / 3 / np.sqrt(-3 * k1))
    for share, expected in ((1 - CLOSE, True), (1 + CLOSE, False)):
        lens = Lens(model="fisheye", focal_px=focal * share, centre_px=CENTRE, k1=k1)
        assert is_folded(lens, WIDTH, HEIGHT) is expected


def test_a_fisheye_ends_at_a_right_angle() -> None:
    """An undistorted one's corners lie 90 degrees off the axis at pi/2 focal lengths."""
    for share, expected in ((0.99, True), (1.01, False)):
        focal = share * CORNER_PX / (np.pi / 2)
        lens = Lens(model="fisheye", focal_px=focal, centre_px=CENTRE)
        assert is_folded(lens, WIDTH, HEIGHT) is expected


def test_a_rational_lens_ends_at_its_pole() -> None:
    """r / (1 - q/4) has one at r = 2, in no picture; r / (1 + q/4) turns there, as 1."""
    lens = {"model": "rational", "centre_px": CENTRE}
    assert not is_folded(Lens(focal_px=100.0, k4=-0.25, **lens), WIDTH, HEIGHT)
    for share, expected in ((1 - CLOSE, True), (1 + CLOSE, False)):
        assert (
            is_folded(Lens(focal_px=CORNER_PX * share, k4=0.25, **lens), WIDTH, HEIGHT) is expected
        )


@pytest.mark.parametrize("along", [0.0, 0.02, 0.05])
@pytest.mark.parametrize("turned", [False, True], ids=["p2", "p1"])
def test_decentring_alone_folds_at_its_caustic(along: float, turned: bool) -> None:
    """With u = p2 x and v = p2 y the determinant (1 + 2 u)(1 + 6 u) - 4 v2 vanishes for
    v2 = (1 + 8 u + 12 u2) / 4, and is imaged at (6 u2 + 3 u + 1/4, v + 2 u v) / p2, first at
    u = -1/6.  The corners of one side lie there, and the picture nowhere nearer to the caustic."""
    u = -1 / 6 + along
    v = np.sqrt(max(1 + 8 * u + 12 * u**2, 0.0)) / 2
    ahead, aside = 6 * u**2 + 3 * u + 0.25, v * (1 + 2 * u)
    focal, coefficient = 1000.0, 0.05
    reach = -ahead / coefficient * focal
    half = aside / coefficient * focal
    for share, expected in ((1 + CLOSE, True), (1 - CLOSE, False)):
        size = 200, max(round(2 * half * share), 1)
        # The side at -reach is the picture's left, its top with p1.
        centre = (share * reach - 0.5, (size[1] - 1) / 2)
        terms = {"p1" if turned else "p2": coefficient}
        lens = Lens(focal_px=focal, centre_px=centre[::-1] if turned else centre, **terms)
        assert is_folded(lens, *(size[::-1] if turned else size)) is expected


@pytest.mark.parametrize(("p1", "p2"), [(0.0, -0.002), (0.002, 0.0)])
def test_decentring_folds_a_corner_that_the_radial_part_does_not(p1: float, p2: float) -> None:
    focal, centre, k1 = 613.0, (283.0, 239.0), -0.3
    assert not folded(focal, centre, k1=k1)
    assert folded(focal, centre, k1=k1, p1=p1, p2=p2)


def test_a_lens_of_no_distortion_is_fine_however_wide() -> None:
    assert not folded(1.0)
    assert not folded(20.0, (-4000.0, 9000.0))


@pytest.mark.parametrize("focal_px", [100.0, 110.0, 125.0])
def test_a_lens_that_hardly_grows_but_nowhere_folds_is_fine(focal_px: float) -> None:
    """Its determinant is 0.05 at least, where Newton's method takes long: soak's example."""
    terms, centre = {"k1": -0.390625, "k2": 0.0859375, "p2": -0.015625}, (220.0, 140.0)
    across, down = np.meshgrid(np.linspace(-2.0, 3.0, 301), np.linspace(-2.0, 3.0, 301))
    camera = CameraModel(focal_px=focal_px, centre_px=centre, **terms)
    assert determinant(camera, np.column_stack([across.ravel(), down.ravel()])).min() > 0.05
    assert not folded(focal_px, centre, **terms)


@examples(20)
@given(
    k1=st.floats(-0.4, 0.3),
    k2=st.floats(-0.1, 0.2),
    p1=st.floats(-0.02, 0.02),
    p2=st.floats(-0.02, 0.02),
    centre=st.tuples(st.floats(220, 420), st.floats(140, 340)),
)
def test_a_lens_is_refused_only_where_its_determinant_vanishes(
    k1: float, k2: float, p1: float, p2: float, centre: tuple[float, float]
) -> None:
    """At the focal length where a lens begins to fold, found by halving, the determinant vanishes
    on the way to the border, or an undistorted radius is that at which the radial part turns.

    At the distance e from a fold a determinant is some 2 sqrt(e), as that of x - x2 is: with
    e = 2e-4, of the border's tangent, 0.03; 0.1 is allowed.  Where ``undistort`` finds nothing,
    radii are beyond the turn, or Newton's method has gone there from the picture.
    """
    terms = {"k1": k1, "k2": k2, "p1": p1, "p2": p2}
    low, high = 100.0, 20_000.0
    assume(folded(low, centre, **terms) and not folded(high, centre, **terms))
    while high / low > 1 + 2e-4:
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if folded(middle, centre, **terms) else (low, middle)
    camera = CameraModel(focal_px=high, centre_px=centre, **terms)
    ways = np.linspace(0.02, 1.0, 50)[:, None, None] * border(high, centre)
    tangents = undistort(camera, ways.reshape(-1, 2))
    left = np.minimum(
        determinant(camera, tangents), 1 - np.hypot(*tangents.T) / fold_radius(camera)
    )
    assert not left.min() > 0.1
