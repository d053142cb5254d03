"""Whether the picture of a board tells which of its dots are seen."""

import numpy as np

from lscan.board.lattice import RIM_EVIDENCE
from lscan.errors import MeasurementError
from lscan.records import Floats, Mask
from sim.scene import Scene
from sim.truth import board_truth


def require_rim(scene: Scene) -> None:
    """Refuse a rig whose picture shows no rim of the board's dots.

    Where the picture cuts a whole board, the instrument knows a row for the first by the empty
    place beside it; where it sees neither that nor the one beside the last, it does not know which
    rows it sees.

    Parameters
    ----------
    scene : Scene, its target is the board

    Raises
    ------
    MeasurementError
        Neither the first nor the last row is known by its rim, or column.
    """
    grid, camera = scene.board().grid, scene.rig.camera
    if not grid.whole:
        return
    truth = board_truth(scene)
    dots = truth.marks_px()[: grid.rows * grid.columns].reshape(grid.rows, grid.columns, 2)
    shown = truth.centres.grid.found.reshape(grid.rows, grid.columns)
    pitch_px = np.nanmedian(np.linalg.norm(np.diff(dots, axis=1), axis=-1))
    radius_px = float(pitch_px * grid.dot_diameter_mm / grid.pitch_mm / 2)
    size = np.array([camera.width_px, camera.height_px])

    def in_view(places: Floats, margin_px: float) -> Mask:
        return np.all((places >= margin_px) & (places <= size - 1 - margin_px), axis=-1)

    shown &= in_view(dots, radius_px)
    for axis, what in ((0, "rows"), (1, "columns")):
        lines = np.flatnonzero(shown.any(axis=1 - axis))
        whole = shown.shape[axis]
        if len(lines) < 2:
            raise MeasurementError(f"{len(lines)} of the {whole} {what} of dots are in view")
        p = np.moveaxis(dots, axis, 0)
        rims = ((lines[0], lines[0] + 1), (lines[-1], lines[-1] - 1))
        empty = [in_view(2 * p[rim] - p[inner], 2 * radius_px).sum() for rim, inner in rims]
        if len(lines) < whole and (np.array(empty) >= RIM_EVIDENCE).sum() != 1:
            raise MeasurementError(
                f"{len(lines)} of the {whole} {what} of dots are in view and neither end of them "
                "is: the instrument would not know which it sees"
            )
