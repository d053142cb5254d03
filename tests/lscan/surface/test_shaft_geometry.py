"""Profiles turned about a shaft: closed forms, symmetries, uncertainties, files, bad input."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from rotary_scans import turned
from scipy.spatial.transform import Rotation

from lscan.config.documents import check
from lscan.config.rig import ShaftSection, parse_rig
from lscan.errors import InputError
from lscan.records import Floats, PlanePoints, Profile, Status
from lscan.surface import load_surface, save_surface
from lscan.surface.shaft import PARAMETERS, Shaft, load_shaft, section_of, shaft_of, stack_about

FEW = examples(25)
EXACT = np.zeros((PARAMETERS, PARAMETERS))

coordinates = st.floats(-300, 300)
directions = (
    st.tuples(*[st.floats(-1, 1)] * 3)
    .filter(lambda d: np.linalg.norm(d) > 0.1)
    .filter(lambda d: abs(d[1]) < 0.99 * np.linalg.norm(d))
)
shafts = st.builds(
    lambda point, direction, radius: Shaft(
        np.array(point), np.array(direction) / np.linalg.norm(direction), radius, EXACT
    ),
    st.tuples(*[coordinates] * 3),
    directions,
    st.floats(20, 500),
)


def profiles(xz_mm: Floats, position_mm: Floats, sigma_mm: Floats | float = 0.0) -> list[Profile]:
    """Profiles (F, N, 2) without modes."""
    status = np.full(xz_mm.shape[1], int(Status.OK))
    sigma = np.broadcast_to(sigma_mm, xz_mm.shape[1:])
    return [
        Profile(float(s), PlanePoints(xz, sigma, status), np.ones(len(xz)))
        for s, xz in zip(position_mm, xz_mm, strict=True)
    ]


def test_a_cylinder_about_the_shaft_is_a_plane_in_angle() -> None:
    """Every profile shows the same line; unrolled, the points lie at r over angle and length."""
    shaft = Shaft(np.array([40.0, 0.0, 250.0]), np.array([1.0, 0.0, 0.0]), 180 / np.pi, EXACT)
    position = np.arange(-30.0, 31.0, 5.0)
    x = np.linspace(-100, 100, 21)
    line = np.column_stack([x, np.full(21, 250.0 - 80.0)])
    surface = stack_about(profiles(np.stack([line] * len(position)), position), shaft)
    _, y, z = np.moveaxis(surface.xyz_mm, -1, 0)
    np.testing.assert_allclose(np.hypot(y, z - 250.0), 80.0, atol=1e-12)
    # Right-hand rule about +x: what hangs beneath swings towards +y.
    angle = np.degrees(np.arctan2(y, 250.0 - z))
    np.testing.assert_allclose(angle, np.broadcast_to(position[:, None], angle.shape), atol=1e-12)
    np.testing.assert_allclose(surface.xyz_mm[..., 0], np.broadcast_to(x, angle.shape), atol=1e-12)


@FEW
@given(shafts, st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.integers(0, 100))
def test_a_plane_scanned_about_any_shaft_is_a_plane(
    shaft: Shaft, lean_x: float, lean_y: float, seed: int
) -> None:
    """The profiles are solved from the plane by scipy's rotation, not by the code's own."""
    normal = np.array([lean_x, lean_y, 1.0])
    generator = np.random.default_rng(seed)
    position = generator.uniform(-0.2, 0.2, 6) * shaft.arc_radius_mm
    x = generator.uniform(-100, 100, (6, 8))
    z = np.empty_like(x)
    for row, s in enumerate(position):
        origin, along, up = (turned(shaft, part, s) for part in (np.zeros(3), *np.eye(3)[[0, 2]]))
        rise = normal @ (up - origin)
        if abs(rise) < 0.1:
            return  # the sheet hardly meets such a plane
        z[row] = (-400.0 - normal @ origin - x[row] * (normal @ (along - origin))) / rise
    surface = stack_about(profiles(np.stack([x, z], axis=-1), position), shaft)
    # 1e-9 of lengths of some 1e4 mm at most (0.1 of rise beneath 1 of normal).
    np.testing.assert_allclose(surface.xyz_mm @ normal, -400.0, atol=1e-8)


@FEW
@given(shafts, st.integers(0, 100))
def test_turning_back_brings_points_home_and_distances_stay(shaft: Shaft, seed: int) -> None:
    generator = np.random.default_rng(seed)
    points, position = generator.uniform(-300, 300, (9, 3)), generator.uniform(-90, 90, 9)
    away = shaft.turn(points, position)
    np.testing.assert_allclose(shaft.turn(away, -position), points, atol=1e-10)
    offset, moved = points - shaft.point_mm, away - shaft.point_mm
    np.testing.assert_allclose(moved @ shaft.direction, offset @ shaft.direction, atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), np.linalg.norm(offset, axis=1))
    for point, s, there in zip(points, position, away, strict=True):
        np.testing.assert_allclose(turned(shaft, point, s), there, atol=1e-10)


@FEW
@given(shafts, st.integers(0, 100))
def test_the_scene_and_its_shaft_may_be_moved_together(shaft: Shaft, seed: int) -> None:
    generator = np.random.default_rng(seed)
    move, shift = Rotation.random(rng=generator).as_matrix(), generator.uniform(-100, 100, 3)
    points, position = generator.uniform(-300, 300, (9, 3)), generator.uniform(-90, 90, 9)
    other = Shaft(move @ shaft.point_mm + shift, move @ shaft.direction, shaft.arc_radius_mm, EXACT)
    np.testing.assert_allclose(
        other.turn(points @ move.T + shift, position),
        shaft.turn(points, position) @ move.T + shift,
        atol=1e-9,
    )


@FEW
@given(shafts, st.floats(0.1, 10), st.integers(0, 100))
def test_only_arc_over_radius_counts(shaft: Shaft, factor: float, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(-300, 300, (9, 3))
    position = np.linspace(-50, 50, 9)
    other = Shaft(shaft.point_mm, shaft.direction, factor * shaft.arc_radius_mm, EXACT)
    np.testing.assert_allclose(
        other.turn(points, factor * position), shaft.turn(points, position), atol=1e-9
    )


@pytest.mark.parametrize("parameter", range(PARAMETERS))
@FEW
@given(shaft=shafts)
def test_displacements_are_derivatives(shaft: Shaft, parameter: int) -> None:
    points = np.random.default_rng(parameter).uniform(-300, 300, (9, 3))
    position = np.linspace(-0.5, 0.5, 9) * shaft.arc_radius_mm
    step = np.zeros(PARAMETERS)
    step[parameter] = 1e-5
    ahead, behind = (shaft.moved(sign * step).turn(points, position) for sign in (1.0, -1.0))
    stated = shaft.displacement(shaft.turn(points, position), position)[..., parameter]
    # Third derivatives of 1e3 mm leave 1e3 * 1e-10 / 6; rounding 1e3 * 2e-16 / 1e-5 = 2e-8.
    np.testing.assert_allclose((ahead - behind) / 2e-5, stated, atol=1e-6)


def test_axes_stand_square_and_the_first_is_the_sheets_normal() -> None:
    shaft = Shaft(np.zeros(3), np.array([0.0, 0.6, 0.8]), 1.0, EXACT)
    frame = np.vstack([shaft.axes, shaft.direction])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-15)
    level = Shaft(np.zeros(3), np.array([1.0, 0.0, 0.0]), 1.0, EXACT)
    np.testing.assert_array_equal(level.axes, [[0, 1, 0], [0, 0, 1]])


def uncertain(seed: int = 3) -> Shaft:
    """A leaning shaft whose five errors are correlated."""
    mixed = np.random.default_rng(seed).normal(size=(5, 5))
    sigma = np.array([0.8, 0.5, 0.003, 0.002, 0.001])
    covariance = mixed @ mixed.T
    scale = sigma / np.sqrt(np.diag(covariance))
    direction = np.array([1.0, 0.2, -0.1])
    return Shaft(
        np.array([20.0, 5.0, 240.0]),
        direction / np.linalg.norm(direction),
        180 / np.pi,
        covariance * np.outer(scale, scale),
    )


def test_uncertainties_of_points_are_their_scatter() -> None:
    """Noise, a mode of the plane map and the shaft's five errors, drawn 1000 times."""
    generator, shaft, draws = np.random.default_rng(5), uncertain(), 1000
    xz = np.array([[-80.0, -330.0], [10.0, -300.0], [90.0, -350.0]])
    own = np.array([[0.3, 0.2]] * 3)
    mode = np.array([[0.5, 0.0], [0.4, 0.3], [0.0, -0.6]])[..., None]
    status, position = np.full(3, int(Status.OK)), np.array([-12.0, 25.0])
    sigma = np.sqrt(own**2 + mode[..., 0] ** 2)
    stated = stack_about(
        [Profile(s, PlanePoints(xz, sigma, status, mode), np.ones(3)) for s in position], shaft
    )
    found = np.empty((draws, 2, 3, 3))
    for k in range(draws):
        true = shaft.moved(shaft.root @ generator.normal(size=PARAMETERS))
        common = generator.normal() * mode[..., 0]
        for f, s in enumerate(position):
            place = xz + common + own * generator.normal(size=xz.shape)
            points = np.column_stack([place[:, 0], np.zeros(3), place[:, 1]])
            found[k, f] = turned(true, points, s)
    assert stated.sigma_y_mm is not None
    sigmas = np.stack([stated.sigma_x_mm, stated.sigma_y_mm, stated.sigma_z_mm], axis=-1)
    # A standard deviation of 1000 draws is known to 1/sqrt(2000) = 2.2 %: five of those.
    np.testing.assert_allclose(found.std(axis=0), sigmas, rtol=0.112)
    assert stated.modes_mm is not None
    assert stated.modes_mm.shape == (2, 3, 3, 1 + PARAMETERS)
    # What two points have in common is their modes' product, here of the heights of two frames.
    modes = stated.modes_mm[..., 2, :].astype(float)
    between = np.cov(found[:, 0, 0, 2], found[:, 1, 2, 2])[0, 1]
    spread = sigmas[0, 0, 2] * sigmas[1, 2, 2] / np.sqrt(draws)
    assert abs(between - modes[0, 0] @ modes[1, 2]) < 5 * 1.5 * spread


def test_points_without_a_value_stay_without() -> None:
    xz = np.array([[[1.0, -300.0], [np.nan, np.nan]]])
    status = np.array([Status.OK, Status.NO_PEAK])
    sigma = np.array([[0.1, 0.1], [np.nan, np.nan]])
    surface = stack_about(
        [Profile(3.0, PlanePoints(xz[0], sigma, status), np.ones(2))], uncertain()
    )
    assert np.isfinite(surface.xyz_mm[0, 0]).all()
    assert np.isnan(surface.xyz_mm[0, 1]).all()
    assert np.isnan(surface.sigma_z_mm[0, 1])


def test_a_surface_file_keeps_the_uncertainty_of_y(tmp_path: Path) -> None:
    xz = np.random.default_rng(1).uniform(-100, 100, (3, 4, 2))
    surface = stack_about(profiles(xz, np.arange(3.0), 0.1), uncertain())
    save_surface(tmp_path / "surface.nc", surface)
    np.testing.assert_array_equal(
        load_surface(tmp_path / "surface.nc").sigma_y_mm, surface.sigma_y_mm
    )


# Files


def section(**keys: Any) -> dict[str, Any]:
    return {"point_mm": [0.0, 0.0, 250.0], "direction": [1.0, 0.0, 0.0], **keys}


def rig(shaft: dict[str, Any], **sections: Any) -> dict[str, Any]:
    hardware = {"camera": {"driver": "replay"}, "track": {"driver": "replay"}}
    return {**hardware, "shaft": shaft, **sections}


def test_a_section_says_all_there_is() -> None:
    shaft = uncertain()
    again = shaft_of(section_of(shaft))
    np.testing.assert_allclose(again.covariance, shaft.covariance, rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(again.direction, shaft.direction, rtol=1e-15)
    np.testing.assert_array_equal(again.point_mm, shaft.point_mm)
    np.testing.assert_allclose(shaft.root @ shaft.root.T, shaft.covariance, atol=1e-15)


def test_without_a_radius_a_millimetre_is_a_degree() -> None:
    shaft = shaft_of(check(ShaftSection, section(direction=[3.0, 0.0, 4.0]), "test"))
    np.testing.assert_allclose(shaft.direction, [0.6, 0, 0.8])
    turned_by = Rotation.from_matrix(shaft.rotation(np.array(7.0))).as_rotvec(degrees=True)
    np.testing.assert_allclose(turned_by, 7 * shaft.direction, atol=1e-12)


@pytest.mark.parametrize(
    ("keys", "named"),
    [
        ({"direction": [0.0, 0.0, 0.0]}, "direction must not be zero"),
        ({"direction": [0.0, 5.0, 0.0]}, "scan nothing"),
        ({"direction": [0.01, 1.0, 0.0]}, "scan nothing"),
        ({"direction": [1.0, 0.0]}, "shaft.direction"),
        ({"point_mm": [0.0, float("inf"), 0.0]}, "shaft.point_mm"),
        ({"arc_radius_mm": 0.0}, "shaft.arc_radius_mm"),
        ({"arc_radius_mm": "57"}, "shaft.arc_radius_mm"),
        ({"offset_sigma_mm": [1.0, -1.0]}, "shaft.offset_sigma_mm"),
        ({"tilt_sigma_deg": [1.0]}, "shaft.tilt_sigma_deg"),
        ({"scale_sigma": -0.1}, "shaft.scale_sigma"),
        ({"correlation": [0.1]}, "shaft.correlation"),
        ({"correlation": [1.0, 1.0, 0, 0, -1.0, 0, 0, 0, 0, 0]}, "none is below nought"),
        ({"radius_mm": 5.0}, "unknown key"),
    ],
)
def test_bad_shafts_are_refused(keys: dict[str, Any], named: str) -> None:
    with pytest.raises(InputError, match=named):
        parse_rig(rig(section(**keys)), source="rig.toml", trusted=True)


def test_more_than_a_full_turn_is_refused() -> None:
    plan = {"start_mm": 0.0, "step_mm": -1.0, "frames": 361}
    parse_rig(rig(section(), plan=plan), source="rig.toml", trusted=True)
    with pytest.raises(InputError, match=r"full turn.*361 deg"):
        parse_rig(rig(section(), plan={**plan, "frames": 362}), source="rig.toml", trusted=True)


def test_thickness_and_shaft_together_are_refused() -> None:
    sheet = {"thickness_mm": 1.5, "camera_mm": [0, -800, 300], "apex_mm": [0, 0, 250]}
    with pytest.raises(InputError, match="linear track only"):
        parse_rig(rig(section(), sheet=sheet), source="rig.toml", trusted=True)


def test_a_file_without_a_shaft_is_named(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text('name = "no shaft"\n')
    with pytest.raises(InputError, match=r"rig.toml: has no section \[shaft\]"):
        load_shaft(tmp_path / "rig.toml")
