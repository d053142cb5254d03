"""Distances from meshes: against closed forms, and against all triangles looked at one by one."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from drawn_examples import examples
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation
from shape_surfaces import dome, plan, surface_of

from lscan.errors import InputError, MeasurementError
from lscan.measure import meshes as meshdistance
from lscan.measure.meshes import (
    MeshPose,
    MeshSearch,
    compare_mesh,
    save_coloured_points,
    save_histogram,
)
from lscan.records import Floats

BOX_MM = np.array([400.0, 60.0, 20.0])
"""Half its sides: long triangles, which few centroids stand for."""

HOME = MeshPose.at((0.0, 0.0, 0.0), 0.0)


def box_distance(points: Floats) -> Floats:
    """Signed distance from the box, closed form."""
    beyond = np.abs(points) - BOX_MM
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return outside + np.minimum(beyond.max(axis=1), 0.0)


def test_distances_from_a_box_are_the_closed_form() -> None:
    """Outside, inside, beyond edges and beyond corners."""
    box = trimesh.creation.box(extents=2 * BOX_MM)
    points = np.random.default_rng(1).uniform(-1.3, 1.3, (3000, 3)) * BOX_MM
    found = MeshSearch(box).nearest(points)
    np.testing.assert_allclose(found.distance_mm, box_distance(points), atol=1e-9)
    assert not found.border.any()
    step = 1e-4
    for axis in np.eye(3):
        change = box_distance(points + step * axis) - box_distance(points - step * axis)
        smooth = np.abs(change / (2 * step) - found.normal @ axis) < 1e-3
        assert smooth.mean() > 0.995  # the rest lie within a step of where the nearest face changes


@examples(20)
@given(seed=st.integers(0, 10_000), spread=st.floats(0.1, 50.0))
def test_the_nearest_place_is_that_of_all_triangles(seed: int, spread: float) -> None:
    """Triangles of every size and shape in no order."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-50, 50, (40, 1, 3)) + rng.uniform(-1, 1, (40, 3, 3)) * rng.choice(
        [0.5, 5.0, 80.0], (40, 1, 1)
    )
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(120).reshape(-1, 3), process=False)
    points = rng.uniform(-1, 1, (50, 3)) * spread
    found = MeshSearch(mesh).nearest(points)
    each = np.stack(
        [
            trimesh.triangles.closest_point(np.broadcast_to(one, (50, 3, 3)), points)
            for one in corners
        ]
    )
    least = np.linalg.norm(each - points, axis=-1).min(axis=0)
    np.testing.assert_allclose(np.abs(found.distance_mm), least, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(points - found.place_mm, axis=1), least, atol=1e-9)


def spiky() -> trimesh.Trimesh:
    """Peaks and pits about the origin, with many corners of saddle shape."""
    mesh = trimesh.creation.icosphere(subdivisions=2)
    mesh.vertices *= np.random.default_rng(4).uniform(8.0, 40.0, (len(mesh.vertices), 1))
    return mesh


def test_the_sign_is_right_at_corners_of_saddle_shape() -> None:
    """Closed form: a point is sum l v over the corners v of the face it is seen through from the
    origin, l not negative, and inside where the sum of l is below 1."""
    mesh = spiky()
    points = np.random.default_rng(5).uniform(-40, 40, (4_000, 3))
    weights = np.einsum("tab,kb->kta", np.linalg.inv(mesh.triangles.transpose(0, 2, 1)), points)
    through = weights.min(axis=2).argmax(axis=1)
    inside = weights[np.arange(len(points)), through].sum(axis=1) < 1
    np.testing.assert_array_equal(MeshSearch(mesh).nearest(points).distance_mm < 0, inside)


def test_a_triangle_without_area_leaves_no_border() -> None:
    """A box with a corner on the middle of an edge, as earcut and CAD leave them: seen from
    beyond that edge, its nearest place is on two triangles and the thin one between."""
    vertices = [[x, y, z] for z in (0, 9) for x, y in ((0, 0), (9, 0), (9, 9), (0, 9))] + [
        [4, 0, 9]
    ]
    rings = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 8, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
    fans = [[ring[0], *ring[k : k + 2]] for ring in rings for k in range(1, len(ring) - 1)]
    box = trimesh.Trimesh(vertices, [*fans, [4, 8, 5]], process=False)
    found = MeshSearch(box).nearest(np.array([[3.0, -1.0, 10.0], [6.0, -2.0, 11.0]]))
    assert not found.border.any()
    np.testing.assert_allclose(found.distance_mm, [np.sqrt(2), np.sqrt(8)])


def test_beside_an_open_mesh_there_is_nothing_to_compare() -> None:
    """A square patch: points over it have a distance, those beside it have none."""
    x, y = plan(61)
    surface = surface_of(2 * x, 2 * y, 0 * x + 0.3)
    patch = trimesh.creation.box(extents=[40.0, 40.0, 2.0])
    patch.update_faces(patch.face_normals[:, 2] > 0.5)
    found = compare_mesh(surface, patch, MeshPose.at((0.0, 0.0, -1.0), 0.0), within_mm=100.0)
    over = (np.abs(2 * x) < 20) & (np.abs(2 * y) < 20)
    assert len(found.distance_mm) == over.sum()
    assert found.beside == (~over).sum()
    np.testing.assert_allclose(found.distance_mm, 0.3, atol=1e-9)
    double = trimesh.util.concatenate([patch, patch])
    assert compare_mesh(surface, double, found.pose, within_mm=100.0).beside == found.beside


def test_points_far_off_are_of_something_else() -> None:
    x, y = plan(21)
    surface = surface_of(x, y, np.where(x > 0, 0.2, 30.0))
    slab = trimesh.creation.box(bounds=[[-50, -50, -5], [50, 50, 0]])
    found = compare_mesh(surface, slab, HOME)
    assert found.far == (x <= 0).sum()
    summary = found.as_json()
    assert summary["mean_mm"]["value"] == pytest.approx(0.2)
    assert summary["rms_mm"] == pytest.approx(0.2)
    with pytest.raises(MeasurementError, match="no point of the surface lies within 1 mm"):
        compare_mesh(surface, slab, MeshPose.at((0.0, 0.0, 500.0), 0.0), within_mm=1.0)


def egg() -> trimesh.Trimesh:
    """Three half axes of 30, 22 and 18 mm: every motion is felt."""
    mesh = trimesh.creation.icosphere(subdivisions=5)
    mesh.apply_scale([30.0, 22.0, 18.0])
    return mesh


def test_a_pose_is_found_to_its_uncertainty() -> None:
    """Points of the mesh itself, noisy, from a start that is 2 mm and 3 degrees off."""
    mesh = egg()
    rng = np.random.default_rng(7)
    top = mesh.triangles_center[mesh.triangles_center[:, 2] > -5]
    rotation = Rotation.from_rotvec([0.02, -0.03, 0.4]).as_matrix()
    shift = np.array([100.0, 50.0, -300.0])
    noisy = top @ rotation.T + shift + rng.normal(0, 0.05, top.shape)
    surface = surface_of(*noisy.T[:, None, :], sigma_mm=0.05)
    isotropic = np.full(surface.status.shape, 0.05)
    surface = replace(surface, sigma_x_mm=isotropic, sigma_y_mm=isotropic)
    start = MeshPose.at((101.0, 51.0, -301.0), float(np.degrees(0.4)) + 1.0)
    found = compare_mesh(surface, mesh, start, fit=True)
    # 2000 points of 0.05 mm place it to 0.002 mm.  Turned by a radian about its long axis, the
    # surface moves by 1.2 mm (rms), so that the turn is known to 0.001 rad: five times each.
    np.testing.assert_allclose(found.pose.translation_mm, shift, atol=0.01)
    np.testing.assert_allclose(found.pose.rotation, rotation, atol=5e-3)
    assert found.pose_sigma is not None and not found.doubt
    true = np.concatenate([MeshPose(rotation, shift).turns_deg, shift])
    off = np.concatenate([found.pose.turns_deg, found.pose.translation_mm]) - true
    assert (np.abs(off) < 3 * found.pose_sigma).all()
    assert (found.pose_sigma < [0.3] * 3 + [0.01] * 3).all()
    small = replace(found, distance_mm=found.distance_mm + 2.6)
    assert "2.6 mm rms" in small.doubt
    within = np.mean(np.abs(found.distance_mm) <= 1.96 * found.sigma_mm)
    # 3 standard deviations of a share of some 6000 points.
    assert abs(within - 0.95) < 3 * np.sqrt(0.95 * 0.05 / len(top))
    assert abs(found.distance_mm.mean()) < 4 * found.mean_sigma_mm + 1e-9


@pytest.mark.parametrize("turn_deg", [0.0, 10.0])
def test_of_a_plane_the_pose_is_found_that_it_determines(turn_deg: float) -> None:
    """A level slab beneath a plane that leans: neither its turn nor its place in plan shows."""
    x, y = plan(41)
    slab = trimesh.creation.box(bounds=[[-50, -50, -5], [50, 50, 0]])
    start = MeshPose.at((0.0, 0.0, 0.0), turn_deg)
    found = compare_mesh(surface_of(x, y, 0.4 + 0.01 * x), slab, start, fit=True)
    assert len(found.distance_mm) == 41 * 41
    np.testing.assert_allclose(found.distance_mm, 0.0, atol=1e-9)
    lean = found.pose.rotation[:, 2]
    np.testing.assert_allclose(lean[:2] / lean[2], [-0.01, 0.0], atol=1e-9)
    assert found.pose_sigma is not None
    np.testing.assert_array_equal(np.isinf(found.pose_sigma), [0, 0, 1, 1, 1, 0])
    assert "nothing holds" in found.doubt
    # Of 2000 points evenly spread, each known to 0.05 mm.
    assert found.mean_sigma_mm < 2 * 0.05 / np.sqrt(41 * 41)


def test_a_fitted_pose_takes_out_what_all_points_share() -> None:
    """A shift of all points is an error of theirs, and none of their distances from the mesh."""
    x, y = plan(41)
    surface = surface_of(x, y, dome(x, y))
    shift = np.zeros((*x.shape, 3, 1), dtype=np.float32)
    shift[..., 2, 0] = 0.5
    sigma = np.hypot(surface.sigma_z_mm, 0.5)
    surface = replace(surface, modes_mm=shift, sigma_z_mm=sigma)
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=30.0)
    as_placed, fitted = (compare_mesh(surface, mesh, HOME, fit=fit) for fit in (False, True))
    assert as_placed.mean_sigma_mm > 0.3
    assert fitted.mean_sigma_mm < 0.02
    assert np.median(fitted.sigma_mm) < 0.06


def test_points_are_written_with_their_distances(tmp_path: Path) -> None:
    x, y = plan()
    slab = trimesh.creation.box(bounds=[[-50, -50, -5], [50, 50, 0]])
    found = compare_mesh(surface_of(x, y, 0.01 * x), slab, HOME)
    save_coloured_points(tmp_path / "p.ply", found)
    cloud = trimesh.load(tmp_path / "p.ply")
    np.testing.assert_allclose(cloud.vertices, found.xyz_mm, atol=1e-5)
    colours = np.asarray(cloud.colors, dtype=int)
    above, beneath = found.distance_mm > 0.15, found.distance_mm < -0.15
    assert (colours[above, 0] > colours[above, 2]).all()  # red
    assert (colours[beneath, 2] > colours[beneath, 0]).all()  # blue
    assert b"distance_mm" in (tmp_path / "p.ply").read_bytes()[:1000]
    save_histogram(tmp_path / "h.png", found)
    picture = cv2.imread(str(tmp_path / "h.png"))
    assert picture is not None and picture.shape[1] > 600
    first = (tmp_path / "h.png").read_bytes()
    save_histogram(tmp_path / "h.png", found)
    assert (tmp_path / "h.png").read_bytes() == first


def test_points_as_near_to_all_of_a_mesh_are_looked_up_a_few_at_a_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The middle of a ball, 60 times: each asks for all its pieces, and memory has a bound."""
    asked: list[int] = []

    def counted(triangles: Floats, points: Floats) -> Floats:
        asked.append(len(points))
        return np.asarray(closest_point(triangles, points))

    closest_point = trimesh.triangles.closest_point
    monkeypatch.setattr(meshdistance, "AT_ONCE", 100)
    monkeypatch.setattr(meshdistance, "MOST_PIECES", 2000)
    monkeypatch.setattr(trimesh.triangles, "closest_point", counted)
    ball = trimesh.creation.icosphere(subdivisions=3)
    found = MeshSearch(ball).nearest(np.zeros((60, 3)))
    plane = np.einsum("ti,ti->t", ball.triangles_center, ball.face_normals)
    np.testing.assert_allclose(found.distance_mm, -plane.min(), atol=1e-9)
    assert max(asked) <= 100 * meshdistance.FIRST_ASKED + 2000


def test_a_mesh_without_area_is_refused() -> None:
    line = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(InputError, match="no triangle with an area"):
        MeshSearch(line)
