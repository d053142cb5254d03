"""From profiles to a surface, its alignment with the workpiece, slices of it, and its files."""

from lscan.surface.align import align_sandwave
from lscan.surface.alignment import Alignment, apply, level, levelling_step, shear
from lscan.surface.files import load_surface, save_grid, save_points, save_surface
from lscan.surface.grid import HeightGrid, fitting_cell_mm, grid_cells
from lscan.surface.surface import Slice, resample, stack

__all__ = [
    "Alignment", "HeightGrid", "Slice", "align_sandwave", "apply", "fitting_cell_mm",
    "grid_cells", "level", "levelling_step", "load_surface", "resample", "save_grid",
    "save_points", "save_surface", "shear", "stack",
]  # fmt: skip
