"""Where camera, laser and target stand: what is refused, and what is said of the target."""

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from drawn_examples import examples
from hypothesis import given, strategies as st
from places import SCENES
from truth_scenes import block_mesh, tank
from typer.testing import CliRunner

from lscan.config.rig import load_rig
from lscan.config.targets import GroovedBlock
from lscan.errors import InputError
from sim.cli.app import app
from sim.devices import SimTrack, TrackOptions, camera_driver, load_checked
from sim.meshes import scene_parts, target_mesh
from sim.scene import Pose, Scene
from sim.truth.placement import check_placement, gaps_of, inside
from sim.truth.surfaces import Polygon, surfaces_of

FLOOR_MM = -100.0


def block(**sections: Any) -> Scene:
    """The grooved block on a floor, its middle beneath the laser: 200 mm long along the track."""
    base: dict[str, Any] = {
        "workpiece": {"kind": "grooved-block"},
        "target": {"shape": "workpiece", "position_mm": [-100.0, 0.0, FLOOR_MM]},
        "floor": {"z_mm": FLOOR_MM},
    }
    return tank(**(base | sections))


def mesh_scene(folder: Path, mesh: trimesh.Trimesh, **sections: Any) -> Scene:
    """The mesh on the floor of the small scene, from a file."""
    mesh.export(folder / "stone.ply")
    target = {"shape": "mesh", "file": str(folder / "stone.ply"), "position_mm": [0, 0, -90.0]}
    base = {"target": target | sections.pop("target", {}), "floor": {"z_mm": FLOOR_MM}}
    return tank(**(base | sections))


def notes(scene: Scene, caplog: pytest.LogCaptureFixture) -> list[str]:
    """What is said of the scene's target."""
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        check_placement(scene)
    return [record.getMessage() for record in caplog.records]


@pytest.mark.parametrize(
    ("sections", "key"),
    [
        ({"head": {"camera_mm": [-90.0, 0.0, -97.0], "depression_deg": 10.0}}, "head.camera_mm"),
        # The pinhole before the block's end, its window 16 mm ahead of it within the block.
        ({"head": {"camera_mm": [-90.0, -70.0, -97.0], "depression_deg": 0.0}}, "head.camera_mm"),
        ({"laser": {"power_mw": 1.0, "apex_mm": [-90.0, 0.0, -97.0]}}, "laser.apex_mm"),
        # Outside at the plan's first position, inside 100 mm on.
        (
            {
                "laser": {"power_mw": 1.0, "apex_mm": [-90.0, -100.0, -97.0]},
                "plan": {"frames": 3, "step_mm": 50.0},
            },
            "laser.apex_mm",
        ),
    ],
)
def test_a_camera_or_a_laser_inside_the_target_is_refused(
    sections: dict[str, Any], key: str
) -> None:
    with pytest.raises(InputError, match=f"{key}: .*inside the target at track position") as caught:
        check_placement(block(**sections))
    assert f"got {sections[key.split('.')[0]][key.split('.')[1]]}".replace("[", "(")[:8] in str(
        caught.value
    )
    assert "allowed: outside the target, which spans" in str(caught.value)


@pytest.mark.parametrize("key", ["head.camera_mm", "laser.apex_mm"])
def test_nothing_stands_beneath_the_floor(key: str) -> None:
    section, name = key.split(".")
    given_at = {name: [0.0, -300.0, FLOOR_MM - 1]} | (
        {"power_mw": 1.0} if name == "apex_mm" else {}
    )
    with pytest.raises(InputError, match=f"{key}: .*beneath the floor.*above the floor, at z = -1"):
        check_placement(block(**{section: given_at}))


def test_a_scan_refuses_what_the_commands_refuse(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    base = SCENES / "paper" / "groove.toml"
    path.write_text(f'include = "{base}"\n[laser]\napex_mm = [225.0, 0.0, -460.0]\n')
    with pytest.raises(InputError) as shown:
        load_checked(path)
    with pytest.raises(InputError) as scanned:
        camera_driver.open(load_rig(path), SimTrack(TrackOptions()))
    assert str(shown.value) == str(scanned.value)
    assert str(path) in str(shown.value)


@examples(50)
@given(seed=st.integers(0, 2**31))
def test_inside_is_what_trimesh_s_rays_say(seed: int) -> None:
    """Of a closed mesh that is not convex, and of a box by its bounds with a side taken off."""
    rng = np.random.default_rng(seed)
    mesh = block_mesh(GroovedBlock(), Pose(np.eye(3), np.zeros(3)))
    points = rng.uniform(mesh.bounds[0] - 3, mesh.bounds[1] + 3, (20, 3))
    assert [inside(mesh, point) for point in points] == mesh.contains(points).tolist()


def test_a_gap_does_not_let_the_inside_out() -> None:
    """The middle of a box without a lid sees 5/6 of the sphere covered, a place before it none."""
    box = trimesh.creation.box(extents=(2, 2, 2))
    open_box = box.submesh([box.face_normals[:, 2] < 0.5], append=True)
    assert inside(open_box, np.array([0.0, 0.0, 0.0]))
    assert not inside(open_box, np.array([0.0, 0.0, 1.5]))
    assert not inside(trimesh.Trimesh(), np.zeros(3))


def test_the_size_of_a_mesh_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    box = trimesh.creation.box(extents=(60.0, 50.0, 12.5))
    (said,) = notes(mesh_scene(tmp_path, box), caplog)
    assert said == "note: test: target.file: stone.ply is 60 x 50 x 12.5 mm, 12 triangles"
    double = trimesh.util.concatenate([box, box.submesh([[0, 5]], append=True)])
    assert notes(mesh_scene(tmp_path, double), caplog) == [
        said,
        "note: test: target.file: stone.ply repeats triangles, which count once: 2",
    ]


def test_a_mesh_in_metres_is_a_speck_until_its_unit_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """0.06 mm along the track: no picture of the plan, 0.5 mm apart, catches it."""
    metres = trimesh.creation.box(extents=(0.06, 0.05, 0.0125))
    plan = {"frames": 5, "start_mm": -1.1, "step_mm": 0.5}
    size, missed = notes(mesh_scene(tmp_path, metres, plan=plan), caplog)
    assert size.endswith("stone.ply is 0.06 x 0.05 x 0.0125 mm, 12 triangles")
    assert "the line does not fall on it: the sheet meets it at track positions -0.0" in missed
    assert "the plan's are -1.1 to 0.9 mm" in missed
    assert "is target.unit right?" in missed
    scene = mesh_scene(tmp_path, metres, plan=plan, target={"unit": "m"})
    (size,) = notes(scene, caplog)
    assert size.endswith("stone.ply is 60 x 50 x 12.5 mm, 12 triangles")
    np.testing.assert_allclose(target_mesh(scene).extents, [60, 50, 12.5], rtol=1e-6)  # float32


@pytest.mark.parametrize(
    ("sections", "reason"),
    [
        ({"target": {"position_mm": [0, 400.0, -90.0]}}, "the sheet meets it at track positions 3"),
        ({"floor": {"z_mm": -50.0}}, "it lies beneath the floor"),
    ],
)
def test_a_target_out_of_reach_is_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, sections: dict[str, Any], reason: str
) -> None:
    box = trimesh.creation.box(extents=(60.0, 50.0, 12.5))
    said = notes(mesh_scene(tmp_path, box, **sections), caplog)
    assert len(said) == 2
    assert "the line does not fall on it" in said[1] and reason in said[1]
    dark = mesh_scene(tmp_path, box, **sections)
    laser = dark.tank.laser.model_copy(update={"on": False})
    tank_off = dark.tank.model_copy(update={"laser": laser})
    assert len(notes(Scene(dark.rig, tank_off, dark.document, dark.source), caplog)) == 1


def test_an_end_within_the_sheets_thickness_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    """A block that ends 1 mm before the sheet's middle at the last place of the plan."""
    scene = block(head={"yaw_deg": 0.0}, plan={"frames": 3, "step_mm": 10.0})
    last = scene.rig.plan.positions_mm()[-1]
    ends = float(target_mesh(scene).bounds[1, 1])
    there = scene.tank.target.position_mm
    for short, said in ((1.0, 1), (-1.0, 0), (10.0, 0)):
        at = (there[0], there[1] + last - ends - short, there[2])
        told = notes(scene.with_tank(target={"position_mm": at}, laser={"waist_mm": 1.5}), caplog)
        assert sum(f"at track position {last:g} mm the sheet's middle" in n for n in told) == said


@pytest.mark.parametrize(("start_mm", "far_mm"), [(0.0, 3000.0), (5000.0, 8000.0)])
def test_the_floor_goes_along_with_the_plan(start_mm: float, far_mm: float) -> None:
    """3 m from the origin, or from the laser at y = 5 m; the truth's floor is the picture's."""
    scene = tank(
        target={"shape": "none"},
        head={"yaw_deg": 0.0},
        floor={"z_mm": FLOOR_MM},
        plan={"start_mm": start_mm, "frames": 1},
    )
    (floor,) = scene_parts(scene)
    assert floor.mesh.bounds[1, 1] == pytest.approx(far_mm)
    assert floor.mesh.bounds[0, 1] == -3000.0
    (surface,) = surfaces_of(scene)
    assert isinstance(surface, Polygon)
    np.testing.assert_array_equal(surface.corners_mm, floor.mesh.vertices)


def test_missing_triangles_are_counted() -> None:
    """Out of a sphere: 200 triangles that share no corner, two that share one, two an edge."""
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=40.0)
    taken: list[int] = []
    corners: set[int] = set()
    for face in np.random.default_rng(3).permutation(len(sphere.faces)).tolist():
        if len(taken) < 200 and not corners & set(sphere.faces[face].tolist()):
            taken.append(face)
            corners |= set(sphere.faces[face].tolist())
    first, *others = sphere.vertex_faces[100][sphere.vertex_faces[100] >= 0].tolist()
    across = max(others, key=lambda face: len({*sphere.faces[face], *sphere.faces[first]}))
    for gone, edges, missing in (
        (taken, 600, 200),
        ([first, across], 6, 2),
        (sphere.face_adjacency[7].tolist(), 4, 2),
    ):
        kept = np.setdiff1d(np.arange(len(sphere.faces)), gone)
        (said,) = gaps_of(sphere.submesh([kept], append=True, repair=False))
        start = f"is not watertight: {edges} edges have a triangle on one side only; "
        assert said == f"{start}about {missing} triangles would close it"
    assert gaps_of(trimesh.creation.icosphere()) == []
    # Triangles that share no vertices by number, as in an STL file, join where they meet.
    box = trimesh.creation.box()
    loose = trimesh.Trimesh(
        box.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False
    )
    assert gaps_of(loose) == []


def test_the_commands_say_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    mesh = trimesh.creation.box(extents=(0.06, 0.05, 0.0125))
    mesh.export(tmp_path / "stone.stl")
    path = tmp_path / "scene.toml"
    path.write_text(
        f'include = "{SCENES / "paper" / "groove.toml"}"\nexclude = "workpiece"\n'
        '[target]\nshape = "mesh"\nfile = "stone.stl"\nposition_mm = [225.0, 500.0, -400.0]\n'
    )
    done = CliRunner().invoke(app, ["truth", str(path), "-o", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    size, missed = caplog.messages
    assert size == f"note: {path}: target.file: stone.stl is 0.06 x 0.05 x 0.0125 mm, 12 triangles"
    assert missed.startswith(f"note: {path}: target: the line does not fall on it")


def test_a_unit_goes_with_a_mesh(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unit goes with shape"):
        block(target={"shape": "workpiece", "unit": "m"})
    with pytest.raises(InputError, match=r"target\.unit: must be .*got 'ft'"):
        block(target={"shape": "mesh", "file": "stone.ply", "unit": "ft"})
    path = tmp_path / "scene.toml"
    path.write_text(f'include = "{SCENES / "paper" / "groove.toml"}"\n[target]\nunit = "km"\n')
    done = CliRunner().invoke(app, ["truth", str(path), "-o", str(tmp_path / "out")])
    assert isinstance(done.exception, InputError)
    assert "target.unit" in str(done.exception)
