"""The grooved block (Table III) and the sandwave: dimensions, slices and grids."""

from collections.abc import Sequence

import numpy as np

from lscan.calibration.planemap import PlaneMap
from lscan.config.targets import GroovedBlock, Sandwave
from lscan.measure import SliceErrors, compare_slice, groove_dimensions
from lscan.pipeline import build_surface, finish
from lscan.records import Floats, Length, Status, Surface
from lscan.surface import grid_cells, resample
from sim.scene import Scene
from sim.truth import slice_visibility
from tests.validation.exposures import ScanReading, read_scan

# The grooved block: Table III, once for each seed.


def dimensions(
    scene: Scene, seeds: Sequence[int], plane_maps: Sequence[PlaneMap]
) -> list[dict[str, Length]]:
    """Table III from the scene's scan: one for each seed, through that seed's own map."""
    readings = read_scan(scene, scene.rig.plan.positions_mm(), seeds, scene.rig.stripe)
    piece = scene.rig.workpiece
    assert isinstance(piece, GroovedBlock)
    return [
        groove_dimensions(reading.profiles(plane_map), piece)
        for reading, plane_map in zip(readings, plane_maps, strict=True)
    ]


# The sandwave: slices against eq. (4), and how often the intervals of its grid are right.


BORDER_MM = 3.0  # cells this near to the border of the waves hold its step


def aligned_surface(scene: Scene, reading: ScanReading, plane_map: PlaneMap) -> Surface:
    """The surface of a scan's stripes in the workpiece frame."""
    built = finish(build_surface(reading.profiles(plane_map), scene.rig), scene.rig)
    built.require_alignment()
    return built.surface


def slice_errors(scene: Scene, surface: Surface) -> dict[str, SliceErrors]:
    """The slices of Fig. 28 against eq. (4), on the points that are lit and seen."""
    piece = _piece(scene)
    cuts = {name: resample(surface, ends) for name, ends in piece.slices_mm().items()}
    return {
        name: compare_slice(cut, piece, visible=slice_visibility(scene, cut.xy_mm))
        for name, cut in cuts.items()
    }


def grid_errors(scene: Scene, surface: Surface, cell_mm: float) -> tuple[Floats, Floats]:
    """Heights of the grid's cells less eq. (4), (K,) mm, and their sigmas, (K,) mm.

    Of the cells, so wide, on the waves that hold a value and are lit and seen.
    """
    piece = _piece(scene)
    grid = grid_cells(surface, cell_mm)
    x, y = (plan.ravel() for plan in np.meshgrid(grid.x_mm, grid.y_mm))
    kept = (grid.status.ravel() == Status.OK) & (piece.inset_mm(x, y) > BORDER_MM)
    kept[kept] = slice_visibility(scene, np.column_stack([x, y])[kept])
    error = grid.z_mm.ravel()[kept] - piece.height_mm(x[kept], y[kept])
    return error, grid.sigma_z_mm.ravel()[kept]


def every_frame(scene: Scene, step_mm: float | None = None) -> Sequence[float]:
    """Track positions over the length of the scene's scan.

    step_mm: between them, the plan's if None.
    """
    plan = scene.rig.plan
    step_mm = step_mm or plan.step_mm
    length = plan.step_mm * (plan.frames - 1)
    return [plan.start_mm + k * step_mm for k in range(int(length / step_mm + 1e-9) + 1)]


def _piece(scene: Scene) -> Sandwave:
    piece = scene.rig.workpiece
    assert isinstance(piece, Sandwave)
    return piece
