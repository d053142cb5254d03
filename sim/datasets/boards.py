"""Pictures of the calibration board for a suite, with the truth of marks and map."""

from typing import TYPE_CHECKING

import numpy as np

from lscan.errors import InputError
from lscan.records import Floats, Marks
from lscan.suites import BoardCase
from sim.datasets.suitespec import CaseSet, PlannedCase
from sim.scene import Scene
from sim.truth import board_truth

if TYPE_CHECKING:
    from sim.render.tank import Layers

PLACES = 25  # of the map, along either side of the board


def exposed_board(among: CaseSet, case: PlannedCase, layers: "Layers") -> BoardCase:
    """The light of one render as the webcam of a case takes it, with the board's truth.

    Parameters
    ----------
    among : CaseSet, of boards
    case : PlannedCase, one of them
    layers : Layers, rendered of the scene of its render

    Raises
    ------
    InputError
        The scene's target is no board.
    """
    from sim.devices import exposure_of
    from sim.sensor import Webcam

    scene = among.scene(case)
    if scene.tank.target.shape != "board":
        allowed = 'a scene whose target is of shape "board"'
        raise InputError("boards.scene", where=among.source, value=among.file.scene,
                         allowed=allowed)  # fmt: skip
    webcam = Webcam(scene)
    rng = np.random.default_rng([scene.tank.sensor.seed, 1])
    pixels, places = _map(scene)
    return BoardCase(
        case.name,
        among.axes_of(case),
        webcam.expose(layers, exposure_of(scene, webcam, layers), rng),
        scene.board(),
        scene.rig.optics,
        _marks(scene),
        pixels,
        places,
    )


def _marks(scene: Scene) -> Marks:
    """The control points and the rulers' marks, one after the other."""
    found = board_truth(scene, scene.rig.plan.start_mm).centres
    parts = [found.grid, *(ruler.marks for ruler in found.rulers)]
    board, image, sigma, status = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("board_mm", "image_px", "sigma_px", "status")
    )
    return Marks(board, image, sigma, status)


def _map(scene: Scene) -> tuple[Floats, Floats]:
    """Places of the picture, and of the sheet that they show, over the board in its own frame."""
    grid, camera = scene.board().grid, scene.rig.camera
    width, height = (grid.columns - 1) * grid.pitch_mm, (grid.rows - 1) * grid.pitch_mm
    x, z = np.meshgrid(np.linspace(0, width, PLACES), np.linspace(0, -height, PLACES))
    places = np.column_stack([x.ravel(), z.ravel()])
    pixels = board_truth(scene, scene.rig.plan.start_mm).sheet_px(places)
    inside = ((pixels >= 0) & (pixels <= np.array(camera.size_px) - 1)).all(axis=1)
    return pixels[inside], places[inside]
