"""From stripe to profile with a plane map that is known in closed form."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.errors import InputError
from lscan.records import PlanePoints, Status, Stripe, has_value
from lscan.surface.surface import to_profile, to_profiles


@dataclass(frozen=True)
class AffineMap:
    """(x, z) = matrix (u, v) + shift; beyond ``limit_mm`` of x it is outside the board."""

    matrix: np.ndarray
    shift: np.ndarray
    sigma_mm: float = 0.0
    limit_mm: float = np.inf
    modes_mm: np.ndarray | None = None  # (2, M), the same everywhere
    name: str = "affine"

    def to_plane(self, image_px, sigma_px=None):
        xz = image_px @ self.matrix.T + self.shift
        sigma_px = np.zeros(len(xz)) if sigma_px is None else sigma_px
        carried = np.sqrt((self.matrix**2).sum(axis=1)) * sigma_px[:, None]
        status = np.where(np.abs(xz[:, 0]) > self.limit_mm, Status.OUT_OF_BOARD, Status.OK)
        # What lies outside keeps its number here: to_profile must not let it through.
        modes = None if self.modes_mm is None else np.tile(self.modes_mm, (len(xz), 1, 1))
        return PlanePoints(xz, np.hypot(carried, self.sigma_mm), status.astype(np.int64), modes)

    def parameters(self) -> dict[str, Any]:
        return {}


def stripe_of(centre, status, axis="columns", sigma=0.1):
    centre = np.where(has_value(np.asarray(status)), centre, np.nan)
    sigma = np.where(np.isfinite(centre), sigma, np.nan)
    peak = 100.0 + np.arange(len(centre))
    return Stripe(axis, centre, sigma, peak, np.asarray(status, dtype=np.int64))


HALF_MM = AffineMap(np.array([[0.5, 0.0], [0.0, -0.5]]), np.array([-1.0, 10.0]))


@pytest.mark.parametrize("axis", ["columns", "rows"])
def test_points_are_the_mapped_pixels_in_the_pictures_order(axis):
    centre = np.array([3.0, 4.0, 5.5, 2.0])
    profile = to_profile(stripe_of(centre, [Status.OK] * 4, axis), HALF_MM, 12.5)
    along = np.arange(4.0)
    u, v = (along, centre) if axis == "columns" else (centre, along)
    np.testing.assert_allclose(profile.points.xz_mm, np.column_stack([u / 2 - 1, 10 - v / 2]))
    np.testing.assert_array_equal(profile.brightness, [100, 101, 102, 103])
    assert profile.position_mm == 12.5


def test_a_status_without_a_value_is_the_stripes():
    codes = [Status.OK, Status.NO_PEAK, Status.SATURATED, Status.AT_BORDER, Status.OCCLUDED]
    profile = to_profile(stripe_of(np.full(5, 4.0), codes), HALF_MM, 0.0)
    np.testing.assert_array_equal(profile.points.status, codes)
    known = np.isfinite(profile.points.xz_mm).all(axis=1)
    assert known.tolist() == [True, False, True, False, False]  # a clipped line is one all the same


def test_where_the_stripe_has_a_value_the_map_may_refuse_it():
    map_of_2_mm = AffineMap(HALF_MM.matrix, np.zeros(2), limit_mm=2.0)  # u up to 4
    codes = [Status.OK] * 5 + [Status.SATURATED, Status.OK, Status.NO_PEAK]
    profile = to_profile(stripe_of(np.full(8, 4.0), codes), map_of_2_mm, 0.0)
    expected = [Status.OK] * 5 + [Status.OUT_OF_BOARD] * 2 + [Status.NO_PEAK]
    np.testing.assert_array_equal(profile.points.status, expected)
    assert np.isnan(profile.points.xz_mm[5:]).all()
    assert np.isnan(profile.points.sigma_mm[5:]).all()


def test_sigma_is_the_maps_combination():
    rotated = AffineMap(np.array([[0.3, 0.4], [0.0, -0.5]]), np.zeros(2), sigma_mm=0.12)
    profile = to_profile(stripe_of(np.full(3, 4.0), [Status.OK] * 3, sigma=0.1), rotated, 0.0)
    # 0.1 px by 0.5 mm/px in either coordinate, and 0.12 mm of the map: 0.05, 0.12, 0.13.
    np.testing.assert_allclose(profile.points.sigma_mm, np.full((3, 2), 0.13), rtol=1e-12)


@examples(50)
@given(
    codes=st.lists(st.sampled_from(list(Status)), min_size=1, max_size=40),
    limit=st.floats(0, 20),
)
def test_numbers_stand_exactly_where_the_status_says_so(codes, limit):
    plane_map = AffineMap(HALF_MM.matrix, np.zeros(2), sigma_mm=0.1, limit_mm=limit)
    points = to_profile(stripe_of(np.full(len(codes), 4.0), codes), plane_map, 1.0).points
    assert len(points.status) == len(codes)
    valued = has_value(points.status)[:, None] & np.ones(2, dtype=bool)
    np.testing.assert_array_equal(np.isfinite(points.xz_mm), valued)
    np.testing.assert_array_equal(np.isfinite(points.sigma_mm), valued)


def test_modes_are_passed_on_where_there_is_a_value():
    modes = np.array([[0.1, 0.0, 0.02], [0.0, 0.2, -0.03]])
    map_of_2_mm = AffineMap(HALF_MM.matrix, np.zeros(2), limit_mm=2.0, modes_mm=modes)
    codes = [Status.OK] * 6 + [Status.NO_PEAK]
    points = to_profile(stripe_of(np.full(7, 4.0), codes), map_of_2_mm, 0.0).points
    valued = has_value(points.status)
    np.testing.assert_array_equal(points.modes_mm[valued], np.tile(modes, (5, 1, 1)))
    assert np.isnan(points.modes_mm[~valued]).all()
    assert to_profile(stripe_of(np.full(7, 4.0), codes), HALF_MM, 0.0).points.modes_mm is None


@pytest.mark.parametrize("position", [np.nan, np.inf])
def test_a_position_that_is_not_finite_is_refused(position):
    with pytest.raises(InputError, match="track position"):
        to_profile(stripe_of(np.ones(3), [Status.OK] * 3), HALF_MM, position)


@pytest.mark.parametrize("modes", [None, np.array([[0.1, 0.2], [0.3, 0.0]])])
def test_several_stripes_are_mapped_as_each_is_by_itself(modes: np.ndarray | None) -> None:
    generator, status = np.random.default_rng(6), [Status.OK, Status.NO_PEAK, Status.SATURATED] * 9
    stripes = [stripe_of(centre, status) for centre in generator.uniform(10, 400, (3, 27))]
    plane_map = replace(HALF_MM, modes_mm=modes, limit_mm=9.0)
    places_mm = [0.0, 0.5, 1.0]
    together = to_profiles(stripes, plane_map, places_mm)
    for one, stripe, place_mm in zip(together, stripes, places_mm, strict=True):
        alone = to_profile(stripe, plane_map, place_mm)
        assert one.position_mm == place_mm
        for name, values in vars(alone.points).items():
            np.testing.assert_array_equal(getattr(one.points, name), values)
