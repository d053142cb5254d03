"""One scene rendered as a case: a picture with its truth."""

from lscan.config.documents import Document
from lscan.config.rig import inline_board, parse_rig
from lscan.suites import BoardCase, SuiteCase
from sim.datasets.boards import board_case
from sim.datasets.lines import line_case, line_truths
from sim.scene import scene_of


def rendered_case(scene: str, document: Document) -> SuiteCase | BoardCase:
    """The picture that a scene's webcam takes at the start of its plan, with its truth.

    Parameters
    ----------
    scene : str, a name or a path, for errors
    document : Document, of that scene

    Raises
    ------
    InputError
        A key or a value is wrong.
    """
    from sim.render.tank import Tank

    loaded = scene_of(parse_rig(inline_board(document, source=scene), source=scene))
    layers = Tank(loaded).render(loaded.rig.plan.start_mm)
    name, axes = loaded.rig.name, {"scene": scene}
    if loaded.tank.target.shape == "board":
        return board_case(loaded, name, axes, layers)
    return line_case(loaded, name, axes, layers, line_truths(loaded))
