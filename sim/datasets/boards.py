"""Pictures of the calibration board for a suite, with the truth of marks and map."""

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from lscan.calibration.planemap import joined_marks
from lscan.records import Floats
from lscan.suites import BoardCase
from sim.scene import Scene
from sim.truth import board_truth

if TYPE_CHECKING:
    from sim.render.layers import Layers

PLACES = 25  # of the map, along either side of the board


def board_case(scene: Scene, name: str, axes: Mapping[str, str], layers: "Layers") -> BoardCase:
    """The light of one render as the scene's webcam takes it, with the board's truth.

    Parameters
    ----------
    scene : Scene
    name : str, of the case
    axes : mapping, its values
    layers : Layers, rendered at the start of the plan
    """
    from sim.devices import exposure_of
    from sim.sensor import Webcam

    webcam = Webcam(scene)
    rng = np.random.default_rng([scene.tank.sensor.seed, 1])
    pixels, places = _map(scene)
    return BoardCase(
        name,
        axes,
        webcam.expose(layers, exposure_of(scene, webcam, layers), rng),
        scene.board(),
        scene.rig.optics,
        joined_marks(board_truth(scene, scene.rig.plan.start_mm).centres),
        pixels,
        places,
    )


def _map(scene: Scene) -> tuple[Floats, Floats]:
    """Places of the picture, and of the sheet that they show, over the board in its own frame."""
    grid, camera = scene.board().grid, scene.rig.camera
    width, height = (grid.columns - 1) * grid.pitch_mm, (grid.rows - 1) * grid.pitch_mm
    x, z = np.meshgrid(np.linspace(0, width, PLACES), np.linspace(0, -height, PLACES))
    places = np.column_stack([x.ravel(), z.ravel()])
    pixels = board_truth(scene, scene.rig.plan.start_mm).sheet_px(places)
    inside = ((pixels >= 0) & (pixels <= np.array(camera.size_px) - 1)).all(axis=1)
    return pixels[inside], places[inside]
