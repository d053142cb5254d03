"""Distances and circles: exact where the points are, unbiased under noise, correct sigma."""

from typing import Any

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from places import PAPER_BOARD

from lscan.config.board import load_board
from lscan.errors import MeasurementError
from lscan.measure import diameters, distances, fit_circle, unmeasured_distances
from lscan.records import BoardReading, Floats, Mark, Marks, PlanePoints, RingPoints, Status

BOARD = load_board(PAPER_BOARD)
SCALE = 0.8  # mm a pixel


class FlatMap:
    """x = SCALE u, z = -SCALE v; what lies at u > limit is outside the board."""

    name = "flat"

    def __init__(self, limit_px: float = np.inf) -> None:
        self.limit_px = limit_px

    def to_plane(self, image_px: Floats, sigma_px: Floats | None = None) -> PlanePoints:
        sigma = np.zeros(len(image_px)) if sigma_px is None else sigma_px
        known = np.isfinite(image_px).all(axis=1)
        inside = known & ~(image_px[:, 0] > self.limit_px)
        missing = np.where(known, int(Status.OUT_OF_BOARD), int(Status.NO_PEAK))
        return PlanePoints(
            np.where(inside[:, None], image_px * [SCALE, -SCALE], np.nan),
            np.where(inside[:, None], (SCALE * sigma)[:, None] * [1.0, 1.0], np.nan),
            np.where(inside, int(Status.OK), missing),
        )

    def parameters(self) -> dict[str, Any]:
        return {}


def pixels(xz_mm: Floats) -> Floats:
    return np.asarray(xz_mm) / [SCALE, -SCALE]


def reading(noise_px: float = 0.0, seed: int = 0, count: int = 60) -> BoardReading:
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    rings = {}
    for ring in BOARD.ring:
        exact = pixels(np.array([ring.x_mm, ring.z_mm]) + ring.diameter_mm / 2 * circle)
        noisy = exact + rng.normal(0, 1, (count, 2)) * noise_px
        rings[ring.name] = RingPoints(noisy, np.full(count, noise_px))
    dots = {}
    for dot in BOARD.dot:
        place = pixels(np.array([dot.x_mm, dot.z_mm])) + rng.normal(0, 1, 2) * noise_px
        dots[dot.name] = Mark(place, noise_px, Status.OK)
    nothing = Marks(np.empty((0, 2)), np.empty((0, 2)), np.empty(0), np.empty(0, dtype=np.int64))
    return BoardReading((640, 480), 50.0, (10, 10), nothing, (), dots, rings)


def test_table_1_is_exact_on_exact_points() -> None:
    measured = distances(reading(), BOARD, FlatMap())
    assert list(measured) == [a + b for a, b in BOARD.distances]
    assert all(abs(length.error_mm) < 1e-9 for length in measured.values())
    assert measured["A2A3"].nominal_mm == pytest.approx(np.hypot(80, 40))  # 89.44 in Table I


def test_sigma_of_a_distance_is_its_scatter() -> None:
    sigma_px = 0.05
    found = [distances(reading(sigma_px, seed), BOARD, FlatMap()) for seed in range(400)]
    scatter = np.std([found_[key].measured_mm for found_ in found for key in ["D2D3"]])
    # 400 draws give a scatter good to 1 / sqrt(800) = 3.5 %; four times that.
    assert scatter == pytest.approx(found[0]["D2D3"].sigma_mm, rel=0.14)
    assert found[0]["D2D3"].sigma_mm == pytest.approx(SCALE * sigma_px * np.sqrt(2))


def test_missing_dots_are_named_not_dropped() -> None:
    seen = reading()
    seen.dots["A1"] = Mark(np.full(2, np.nan), np.nan, Status.OUT_OF_VIEW)
    del seen.dots["B2"]
    flat = FlatMap(limit_px=328 / SCALE)  # B and D lie beyond it but for B1, B2
    measured, missing = distances(seen, BOARD, flat), unmeasured_distances(seen, BOARD, flat)
    assert set(measured) | set(missing) == {a + b for a, b in BOARD.distances}
    assert not set(measured) & set(missing)
    assert missing["A1A2"] is Status.OUT_OF_VIEW
    assert missing["B1B2"] is Status.NOT_FOUND
    assert missing["B3B4"] is Status.OUT_OF_BOARD
    assert "C1C2" in measured


def test_no_dots_at_all_is_an_error() -> None:
    seen = reading()
    seen.dots.clear()
    with pytest.raises(MeasurementError, match="no distance"):
        distances(seen, BOARD, FlatMap())


def test_table_2_is_exact_on_exact_points() -> None:
    measured = diameters(reading(), BOARD, FlatMap())
    assert list(measured) == ["E", "F", "G"]
    assert [length.nominal_mm for length in measured.values()] == [28.40, 49.20, 49.20]
    assert all(abs(length.error_mm) < 1e-8 for length in measured.values())


def test_the_maps_own_sigma_does_not_average_out_around_a_ring() -> None:
    class RoughMap(FlatMap):
        def to_plane(self, image_px: Floats, sigma_px: Floats | None = None) -> PlanePoints:
            points = super().to_plane(image_px, sigma_px)
            return PlanePoints(points.xz_mm, np.hypot(points.sigma_mm, 0.06), points.status)

    smooth, rough = (diameters(reading(), BOARD, m)["F"] for m in (FlatMap(), RoughMap()))
    assert rough.sigma_mm == pytest.approx(np.hypot(smooth.sigma_mm, 0.06))


def test_ring_points_outside_the_map_are_left_out() -> None:
    circle = diameters(reading(), BOARD, FlatMap(limit_px=280 / SCALE))["F"]
    assert abs(circle.error_mm) < 1e-6


def test_a_ring_that_is_not_there_is_named() -> None:
    seen = reading()
    few = seen.rings["F"]
    seen.rings["F"] = RingPoints(few.image_px[:3], few.sigma_px[:3])
    with pytest.raises(MeasurementError, match="ring F: 3 of its 3"):
        diameters(seen, BOARD, FlatMap())
    del seen.rings["F"]
    with pytest.raises(MeasurementError, match="ring F: 0"):
        diameters(seen, BOARD, FlatMap())


class SwellingMap(FlatMap):
    """Two common errors: a shift of 0.1 mm along x, and 0.2 % of scale about the origin."""

    def to_plane(self, image_px: Floats, sigma_px: Floats | None = None) -> PlanePoints:
        points = super().to_plane(image_px, sigma_px)
        shift = np.broadcast_to([0.1, 0.0], points.xz_mm.shape)
        modes = np.stack([shift, 0.002 * points.xz_mm], axis=-1)
        sigma = np.sqrt(points.sigma_mm**2 + (modes**2).sum(axis=2))
        return PlanePoints(points.xz_mm, sigma, points.status, modes)


def test_a_common_shift_cancels_and_a_common_scale_does_not() -> None:
    # Closed forms: a shift changes no length; a scale error of 0.2 % changes each by 0.2 %,
    # a distance and a diameter alike.  The marks' own part is that of the map without modes.
    seen = reading(0.03, seed=5)
    for measure in (distances, diameters):
        flat, swelling = measure(seen, BOARD, FlatMap()), measure(seen, BOARD, SwellingMap())
        for key, length in swelling.items():
            assert length.measured_mm == pytest.approx(flat[key].measured_mm)
            expected = np.hypot(flat[key].sigma_mm, 0.002 * length.measured_mm)
            assert length.sigma_mm == pytest.approx(expected, rel=1e-3)


# The circle itself

coordinates = st.floats(-500, 500)


def arc(centre: Floats, radius: float, degrees: float, count: int = 40) -> Floats:
    angle = np.linspace(0.3, 0.3 + np.radians(degrees), count)
    return centre + radius * np.column_stack([np.cos(angle), np.sin(angle)])


@given(coordinates, coordinates, st.floats(1, 200), st.floats(30, 350))
@examples(60)
def test_circle_is_exact_on_exact_points(x: float, z: float, radius: float, span: float) -> None:
    centre = np.array([x, z])
    circle = fit_circle(arc(centre, radius, span), np.full(40, 0.01))
    # Coordinates of 500 carry rounding of 1e-13; a 30 degree arc magnifies it some 100 times.
    assert circle.radius_mm == pytest.approx(radius, rel=1e-7)
    np.testing.assert_allclose(circle.centre_mm, centre, atol=1e-7 * radius)


def test_circle_is_unbiased_and_its_sigma_is_its_scatter() -> None:
    sigma, radius, count = 0.05, 14.2, 40
    rng = np.random.default_rng(3)
    exact = arc(np.zeros(2), radius, 351)
    circles = [
        fit_circle(exact + rng.normal(0, sigma, exact.shape), np.full(count, sigma))
        for _ in range(400)
    ]
    diameters_mm = np.array([2 * circle.radius_mm for circle in circles])
    expected = 2 * sigma / np.sqrt(count)  # closed form for points all around
    error = diameters_mm.std() / 20
    # Second order: distances from the centre grow by sigma² / 2r each, so the diameter by sigma²/r.
    assert abs(diameters_mm.mean() - 2 * radius - sigma**2 / radius) < 4 * error
    assert diameters_mm.std() == pytest.approx(expected, rel=0.15)
    # A covariance enlarged by the scatter is a little larger on average, never smaller.
    mean_sigma = np.mean([circle.diameter_sigma_mm for circle in circles])
    assert expected * 0.98 < mean_sigma < expected * 1.2


def test_scatter_beyond_the_sigma_given_enlarges_the_sigma() -> None:
    rng = np.random.default_rng(4)
    points = arc(np.zeros(2), 20.0, 351) + rng.normal(0, 0.5, (40, 2))
    estimated, known = (fit_circle(points, np.full(40, sigma)) for sigma in (0.01, 0.5))
    assert estimated.diameter_sigma_mm == pytest.approx(known.diameter_sigma_mm, rel=0.3)


def test_points_that_make_no_circle_are_refused() -> None:
    with pytest.raises(MeasurementError, match="3 points"):
        fit_circle(np.eye(3, 2), np.ones(3))
    with pytest.raises(MeasurementError, match="straight line"):
        fit_circle(np.outer(np.arange(9.0), [1.0, 2.0]), np.ones(9))
