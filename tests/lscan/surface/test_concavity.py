"""The sheet's thickness corrected for: against the integral it stands for, noise, bad input."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.config.rig import SheetSection
from lscan.errors import InputError
from lscan.records import Floats, Status, Surface
from lscan.surface.thickness import correct_thickness

SHEET = SheetSection(thickness_mm=1.5, camera_mm=(0.0, -870.0, 300.0), apex_mm=(0.0, 0.0, 250.0))
LEVEL_MM = -330.0
Height = Callable[[Floats, Floats], Floats]


def scan(
    height: Height, frames: int = 25, columns: int = 31, shift: Floats | float = 0.0
) -> Surface:
    """A scan of ``height`` (x, y) about (0, 0), 0.5 mm by 1.1 mm, its heights off by ``shift``."""
    s = 0.5 * (np.arange(frames) - frames // 2)
    x = 1.1 * (np.arange(columns) - columns // 2)
    x, y = np.meshgrid(x, s)
    z = LEVEL_MM + height(x, y) + shift
    ones = np.ones_like(x)
    ok = np.zeros(x.shape, dtype=np.int64)
    return Surface(np.stack([x, y, z], axis=-1), 0 * ones, 0.01 * ones, ok, s)


def displaced(height: Height, x: float, s: float, sheet: SheetSection) -> float:
    """Centroid of the light in the column of (x, s), less the height there: by quadrature.

    Along the line of sight plane of the column, weighted by the cosine of incidence, the
    sheet's Gaussian and the stretching of the picture; derivatives are finite differences.
    """
    y = np.linspace(-3, 3, 4001) * sheet.thickness_mm
    z0 = LEVEL_MM + float(height(np.array(x), np.array(s)))
    depth = -sheet.camera_mm[1]
    kappa, tau = (x - sheet.camera_mm[0]) / depth, (sheet.camera_mm[2] - z0) / depth

    def at(dx: float, dy: float) -> Floats:
        return height(x + kappa * y + dx, s + y + dy)

    e = 1e-4
    slope_x, slope_y = (at(e, 0) - at(-e, 0)) / (2 * e), (at(0, e) - at(0, -e)) / (2 * e)
    zeta = at(0, 0) - at(0, 0)[len(y) // 2] + tau * y
    light = sheet.apex_mm[0] - x, sheet.apex_mm[2] - z0
    cosine = (light[1] - slope_x * light[0]) / np.sqrt(1 + slope_x**2 + slope_y**2)
    weight = cosine * np.exp(-0.5 * (y / (sheet.thickness_mm / 2)) ** 2) * np.gradient(zeta, y)
    return float((zeta * weight).sum() / weight.sum())


def test_a_level_plane_and_a_slope_are_left_alone() -> None:
    """Uneven light and stretching come from concavity: a plane has none."""
    surface = scan(lambda x, y: 0.2 * x + 0.3 * y)
    moved = correct_thickness(surface, SHEET)
    np.testing.assert_allclose(moved.xyz_mm, surface.xyz_mm, atol=1e-9)
    assert (moved.sigma_z_mm >= surface.sigma_z_mm).all()


@given(
    st.floats(-0.02, 0.02),
    st.floats(-0.02, 0.02),
    st.floats(-0.03, 0.03),
    st.floats(-0.5, 0.5),
    st.floats(-0.1, 0.4),
    st.floats(0.3, 1.2),
    st.floats(-60, 60),
)
@examples(40)
def test_the_displacement_is_that_of_the_integral(
    xx: float, xy: float, yy: float, x1: float, y1: float, sigma: float, apex: float
) -> None:
    sheet = SHEET.model_copy(update={"thickness_mm": 2 * sigma, "apex_mm": (apex, 0.0, 250.0)})

    def height(x: Floats, y: Floats) -> Floats:
        return x1 * x + y1 * y + xx / 2 * x**2 + xy * x * y + yy / 2 * y**2

    truth = displaced(height, 0.0, 0.0, sheet)
    surface = scan(height)
    moved = correct_thickness(surface, sheet)
    middle = (12, 15)
    found = surface.xyz_mm[middle][2] - moved.xyz_mm[middle][2]
    # The series goes on in (sigma zeta''/zeta')², here at most (sigma 0.03 / 0.6)², and in the
    # bend of ln c, which is of the order of the bends' squares: 3 sigma⁴ times both.
    bend = max(abs(xx), abs(xy), abs(yy))
    rise = y1 + 630 / 870
    assert abs(found - truth) < 1e-5 + 12 * sigma**4 * bend**2 * (bend / rise + bend + 0.1)


def test_a_yawed_track_is_unsheared() -> None:
    """The same bowl scanned along a track at 20 degrees gives the same displacement."""
    yaw = np.radians(20.0)
    bowl = lambda x, y: 0.01 * y**2  # noqa: E731
    straight = correct_thickness(scan(bowl), SHEET)
    turned = scan(lambda x, s: bowl(x + s * np.sin(yaw), s * np.cos(yaw)))
    moved = correct_thickness(turned, SHEET, float(yaw))
    there = np.s_[12, 15, 2]
    np.testing.assert_allclose(moved.xyz_mm[there], straight.xyz_mm[there], atol=1e-6)


def test_sigma_covers_the_noise_of_the_correction() -> None:
    """60 noisy scans: the shift's scatter is known to 1 / sqrt(120) = 9 %, four of which."""
    generator = np.random.default_rng(3)
    shifts, sigmas = [], []
    for _ in range(60):
        surface = replace(
            scan(lambda x, y: 0.01 * y**2, 17, 13, generator.normal(0, 0.05, (17, 13))),
            sigma_z_mm=np.full((17, 13), 0.05),
        )
        moved = correct_thickness(surface, SHEET)
        shifts.append((surface.xyz_mm - moved.xyz_mm)[8, 6, 2])
        sigmas.append(np.sqrt(moved.sigma_z_mm**2 - surface.sigma_z_mm**2)[8, 6])
    # The stated variance takes the larger of what is stated and what is found: 10 % more.
    assert np.std(shifts) == pytest.approx(np.sqrt(np.mean(np.square(sigmas))), rel=0.36 + 0.1)


def test_points_without_neighbours_keep_their_place_and_say_so() -> None:
    surface = scan(lambda x, y: 0.01 * y**2)
    status = surface.status.copy()
    status[:, 16:] = int(Status.NO_PEAK)
    status[12, 28] = int(Status.OK)
    xyz = np.where((status == Status.OK)[..., None], surface.xyz_mm, np.nan)
    moved = correct_thickness(replace(surface, xyz_mm=xyz, status=status), SHEET)
    assert moved.xyz_mm[12, 28, 2] == surface.xyz_mm[12, 28, 2]
    assert moved.sigma_z_mm[12, 28] > surface.sigma_z_mm[12, 28]
    np.testing.assert_array_equal(np.isfinite(moved.xyz_mm), np.isfinite(xyz))
    assert np.isfinite(moved.sigma_z_mm).all()


def test_exact_heights_and_empty_scans_are_no_trouble() -> None:
    surface = scan(lambda x, y: 0.01 * y**2)
    exact = correct_thickness(replace(surface, sigma_z_mm=0 * surface.sigma_z_mm), SHEET)
    np.testing.assert_allclose(
        exact.xyz_mm, correct_thickness(surface, SHEET).xyz_mm, rtol=0, atol=1e-9
    )
    lost = np.full_like(surface.status, int(Status.NO_PEAK))
    empty = replace(surface, xyz_mm=np.nan * surface.xyz_mm, status=lost)
    assert np.isnan(correct_thickness(empty, SHEET).xyz_mm).all()


def test_bad_input_is_refused() -> None:
    surface = scan(lambda x, y: 0 * x)
    with pytest.raises(InputError, match="head frame"):
        correct_thickness(replace(surface, frame="workpiece"), SHEET)
