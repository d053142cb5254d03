"""Any surface: a target that no rig file names, brought into the block's frame by a kept alignment.

The block is scanned and its alignment kept in a file; on the same rig a target of a dome, a step, a
half cylinder and an egg is scanned, and what is measured of it is held against what it was made as.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import trimesh

from lscan.calibration.planemap import PlaneMap
from lscan.config.rig import parse_rig
from lscan.config.targets import Sandwave, ShapesDocument
from lscan.files.disk import write_atomically
from lscan.measure.meshes import MeshPose, compare_mesh
from lscan.measure.shapes import Quantity, measure_shapes
from lscan.pipeline import build_surface, finish
from lscan.records import Floats, Mask, Surface
from lscan.surface import align_sandwave
from lscan.surface.alignment import KeptAlignment, load_alignment, save_alignment
from lscan.surface.surface import provenance_of
from sim.scene import Pose, Scene, load_scene, scene_of, target_pose
from tests.validation.exposures import ScanReading, band_miss_percent, read_scan, share_inside
from tests.validation.instrument.board import calibrations
from tests.validation.rows import Row, row
from tests.validation.surfaces.drawn import FieldEffort

STEP_MM = 2.0
"""Of the track over the target."""

DOME_MM, ROD_MM, STEP_HEIGHT_MM = 30.0, 25.0, 15.0
"""Radii of the dome and of the half cylinder, height of the step."""

DOME, STEP, ROD, EGG = -105.0, -30.0, 35.0, 110.0
"""Where they stand along x of the target, whose slab's top is z = 0."""

EGG_MM = (35.0, 28.0, 18.0)
"""Half axes of the egg, which no shape but its mesh describes."""

PLACE: Mapping[str, Any] = {"position_mm": [225.0, 60.0, -345.0], "turn_deg": -2.0}
"""Of the target in the tank, level: the block lay tilted, and elsewhere."""

HALF_MM = 30.0
"""Half the slab along the track."""

BLOCK_MM = (50.0, 163.0)
"""Track positions over the block's wedges and enough of its sides, 1 mm apart.  Rendered with few
samples a pixel, a side that runs along the track dims in steps; neighbouring frames share that
error, which the yaw's uncertainty does not know of: 2 mm apart the yaw comes out up to 0.2 degrees
off, with 0.06 stated.  Of lines that dim evenly it is stated right."""

COARSE = 2.0
"""Times these distances are those of a quick run, whose yaw and intervals nobody judges."""

SETUPS = 4
"""Calibrations, each with a block scanned and aligned; the target's exposures take them in turn.
To render and expose the block's many frames is most of the work."""

_TO_CAMERA = np.array([0.0, -np.cos(np.radians(30.0)), np.sin(np.radians(30.0))])
"""The camera of the paper's rig looks 30 degrees downwards, along the track."""

COMPARED = 3
"""Exposures compared with the mesh, some 700 points each."""

GRAZING_DEG = 15.0
"""The egg is compared where the camera sees it at more than this."""


def surface_rows(scenes: Path, effort: FieldEffort) -> list[Row]:
    """Shapes, and distances from the target's own mesh: how often their intervals hold the truth.

    Parameters
    ----------
    scenes : Path, folder of the scene files
    effort : FieldEffort, its seeds are those of sensor noise
    """
    block, board = (_rendered(scenes, name, effort) for name in ("sandwave", "board"))
    plane_map = "polynomial-5" if effort.plain else board.rig.calibration.plane_map
    maps = [one.plane_map for one in calibrations(board, effort.seeds[:SETUPS], plane_map)]
    apart = COARSE if effort.plain else 1.0
    over_block = np.arange(*BLOCK_MM, apart).tolist()
    extractor = "centroid-relative" if effort.plain else block.rig.stripe.extractor
    stripe = block.rig.stripe.model_copy(update={"extractor": extractor})
    with TemporaryDirectory() as folder:
        mesh = target_mesh(3 if effort.plain else 5)
        file = Path(folder) / "target.ply"
        write_atomically(file, mesh.export(file_type="ply"))
        target = _target_scene(block, file)
        blocks = read_scan(block, over_block, effort.seeds[: len(maps)], stripe)
        scans = read_scan(target, _over_target(apart * STEP_MM), effort.seeds, stripe)
        kept = [
            _kept(block, _raw(block, reading, one), Path(folder))
            for reading, one in zip(blocks, maps, strict=True)
        ]
    surfaces = [
        finish(_raw(target, reading, one), target.rig, alignment).surface
        for reading, (one, alignment) in zip(
            scans, cycle(zip(maps, kept, strict=True)), strict=False
        )
    ]
    truth = _Truth(target_pose(target), target_pose(block))
    return [
        *_shape_rows(surfaces, truth, effort),
        _mesh_row(surfaces[:COMPARED], mesh, truth, effort),
        _yaw_row(kept, target, effort),
    ]


def target_mesh(subdivisions: int = 5) -> trimesh.Trimesh:
    """The target in its own frame, mm: the tops of dome, step, half cylinder and egg on a slab.

    subdivisions: of the triangles of dome and egg.
    """
    dome = trimesh.creation.icosphere(subdivisions, radius=DOME_MM)
    dome.apply_translation([DOME, 0.0, 0.0])
    egg = trimesh.creation.icosphere(subdivisions)
    egg.apply_scale(EGG_MM)
    egg.apply_translation([EGG, 0.0, 0.0])
    rod = trimesh.creation.cylinder(radius=ROD_MM, height=2 * HALF_MM, sections=180)
    rod.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    rod.apply_translation([ROD, 0.0, 0.0])
    low = [STEP - 25.0, -HALF_MM, -5.0]
    step = trimesh.creation.box(bounds=[low, [STEP + 25.0, HALF_MM, STEP_HEIGHT_MM]])
    slab = trimesh.creation.box(bounds=[[-150.0, -HALF_MM, -20.0], [150.0, HALF_MM, 0.0]])
    return trimesh.util.concatenate([dome, egg, rod, step, slab])


@dataclass(frozen=True)
class _Truth:
    """What is to be measured of the target, in the frame of the block.

    target, block: their frames to the world's.
    """

    target: Pose
    block: Pose

    def place(self, x: float, y: float, z: float) -> Floats:
        """(3,) mm, a place of the target."""
        return self.block.invert(self.target.apply(np.array([x, y, z])))

    @property
    def up(self) -> Floats:
        """(3,) the target's z axis."""
        return self.block.rotation.T @ self.target.rotation[:, 2]

    def height(self, plan: Floats, level_mm: float) -> float:
        """The height, mm, at a place in plan (2,) of the target's level ``level_mm``."""
        on = self.place(0.0, 0.0, level_mm)
        return float(on[2] - self.up[:2] @ (plan - on[:2]) / self.up[2])

    def box(self, x: float, half_x: float, half_y: float, y: float = 0.0) -> dict[str, Any]:
        """An upright box about a place of the target."""
        middle = self.place(x, y, 0.0)
        sides = {"x_mm": (middle[0], half_x), "y_mm": (middle[1], half_y)}
        return {key: [float(at - half), float(at + half)] for key, (at, half) in sides.items()}

    def wanted(self) -> ShapesDocument:
        """What is measured, clear of edges and of flanks steeper than 53 degrees."""
        upper = self.box(STEP, 18.0, 20.0)
        lower = self.box(-67.0, 4.0, 20.0)
        here, there = (self.place(x, -10.0, 0.0)[:2].tolist() for x in (-67.0, STEP))
        return ShapesDocument.model_validate(
            {
                "sphere": [{"name": "dome", **self.box(DOME, 17.0, 17.0)}],
                "cylinder": [{"name": "rod", **self.box(ROD, 17.0, 25.0)}],
                "step": [{"name": "step", "upper": upper, "lower": lower}],
                "height": [{"name": "up", "from_mm": here, "to_mm": there}],
            }
        )

    def values(self) -> dict[str, dict[str, float]]:
        """The true values by entry and quantity, of those that do not depend on the points."""
        x, y, z = self.place(DOME, 0.0, 0.0).tolist()
        slope_x, slope_y = np.degrees(np.arctan(-self.up[:2] / self.up[2])).tolist()
        along = self.block.rotation.T @ self.target.rotation[:, 1]
        turn, rise = np.degrees([np.arctan2(along[1], along[0]), np.arcsin(along[2])]).tolist()
        here, there = (self.place(x, -10.0, 0.0)[:2] for x in (-67.0, STEP))
        rise_mm = self.height(there, STEP_HEIGHT_MM) - self.height(here, 0.0)
        return {
            "dome": {"radius_mm": DOME_MM, "x_mm": x, "y_mm": y, "z_mm": z},
            "rod": {"radius_mm": ROD_MM, "turn_deg": turn, "rise_deg": rise},
            "step": {"height_mm": STEP_HEIGHT_MM, "slope_x_deg": slope_x, "slope_y_deg": slope_y},
            "up": {"height_mm": rise_mm},
        }


def _rendered(scenes: Path, name: str, effort: FieldEffort) -> Scene:
    """The best chain's scene; its laser in plain renders."""
    scene = load_scene(scenes / "best" / f"{name}.toml")
    if name == "board" and not effort.plain:
        return scene
    samples = 1 if effort.plain else 4
    return scene.with_tank(render={"fineness": 1, "samples": samples, "scatter_samples": 0})


def _target_scene(block: Scene, file: Path) -> Scene:
    """The block's scene with the mesh in its place, and no workpiece."""
    document = {key: value for key, value in block.document.items() if key != "workpiece"}
    target = {"shape": "mesh", "file": str(file), "albedo": 0.5, **PLACE}
    scene = scene_of(parse_rig({**document, "target": target}, source="field", trusted=True))
    return replace(scene, tank=scene.tank.model_copy(update={"render": block.tank.render}))


def _over_target(step_mm: float) -> list[float]:
    """Track positions, mm, over the slab."""
    middle, reach = float(PLACE["position_mm"][1]), HALF_MM + STEP_MM
    return np.arange(middle - reach, middle + reach + step_mm / 2, step_mm).tolist()


def _raw(scene: Scene, reading: ScanReading, plane_map: PlaneMap) -> Surface:
    raw = build_surface(reading.profiles(plane_map), scene.rig)
    made_from = provenance_of(scene.rig, len(reading.stripes), plane_map)
    return replace(raw, provenance=made_from)


def _kept(block: Scene, raw: Surface, folder: Path) -> KeptAlignment:
    """The block's alignment, by way of its file."""
    piece = block.rig.workpiece
    assert isinstance(piece, Sandwave) and raw.provenance is not None
    file = folder / "alignment.json"
    save_alignment(file, align_sandwave(raw, piece), raw.provenance, piece)
    return load_alignment(file)


def _errors(surface: Surface, truth: _Truth) -> dict[tuple[str, str], tuple[float, float]]:
    """Error and sigma of each quantity that is known, by entry and quantity."""
    found = {one.name: one.values for one in measure_shapes(surface, truth.wanted())}

    def error(known: Quantity, true: float) -> tuple[float, float]:
        return known.value - true, known.sigma

    return {
        (name, key): error(found[name][key], true)
        for name, values in truth.values().items()
        for key, true in values.items()
    }


def _shape_rows(surfaces: Sequence[Surface], truth: _Truth, effort: FieldEffort) -> list[Row]:
    """Intervals of all quantities together, and the largest errors of the lengths."""
    each = [_errors(surface, truth) for surface in surfaces]
    error, sigma = np.array([list(one.values()) for one in each]).T
    share = share_inside(error, sigma)
    words: dict[str, Any] = {"seeded": effort.seeded, "seed": effort.seeds[0]}
    lengths = {"dome": "radius_mm", "rod": "radius_mm", "step": "height_mm"}
    worst = {name: max(abs(one[name, key][0]) for one in each) for name, key in lengths.items()}
    return [
        row(
            "surface-intervals", band_miss_percent(share), percent=100 * share, count=error.size,
            **words,
        ),
        *(row("surface-length", figure, name=name, **words) for name, figure in worst.items()),
    ]  # fmt: skip


def _mesh_row(
    surfaces: Sequence[Surface], mesh: trimesh.Trimesh, truth: _Truth, effort: FieldEffort
) -> Row:
    """Intervals of the distances from the target's own mesh, its pose fitted, over the egg."""
    error, sigma = [], []
    rotation = truth.block.rotation.T @ truth.target.rotation
    pose = MeshPose(rotation, truth.place(0.0, 0.0, 0.0))
    for surface in surfaces:
        found = compare_mesh(surface, mesh, pose, fit=True, within_mm=3.0)
        wanted = _well_seen((found.xyz_mm - pose.translation_mm) @ pose.rotation)
        error.append(found.distance_mm[wanted])
        sigma.append(found.sigma_mm[wanted])
    errors, sigmas = np.concatenate(error), np.concatenate(sigma)
    share = share_inside(errors, sigmas)
    return row(
        "surface-mesh", band_miss_percent(share), percent=100 * share, count=len(errors),
        rms=float(np.sqrt(np.mean(errors**2))), seeded=effort.seeded, seed=effort.seeds[0],
    )  # fmt: skip


def _well_seen(places: Floats) -> Mask:
    """(K,) places (K, 3) of the target, mm, on the egg and not seen at grazing incidence."""
    own = places - [EGG, 0.0, 0.0]
    normal = own / np.square(EGG_MM)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    seen = normal @ _TO_CAMERA > np.sin(np.radians(GRAZING_DEG))
    return np.asarray(seen & (own[:, 2] > 3.0) & (np.abs(own[:, 0]) < 26.0))


def _yaw_row(kept: Sequence[KeptAlignment], target: Scene, effort: FieldEffort) -> Row:
    """The yaws that were kept against the tank's: root mean square, beside their uncertainty."""
    true = np.radians(target.tank.head.yaw_deg)
    yaw = np.array([one.alignment.yaw_rad for one in kept])
    sigma = np.array([one.alignment.yaw_sigma_rad for one in kept])
    off, stated = np.degrees(np.sqrt(np.mean([np.square(yaw - true), sigma**2], axis=1)))
    return row(
        "surface-yaw", float(off), count=len(yaw), stated_deg=float(stated),
        seeded=effort.seeded, seed=effort.seeds[0],
    )  # fmt: skip
