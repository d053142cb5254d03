"""The scene as it is in one picture: with that picture's numbers, the head where it truly is.

All is a function of the scene, the picture's number and the commanded position alone, so that a
scan which is stopped and resumed gives the same pictures, and camera and truth see the same.
"""

from dataclasses import dataclass, replace

import numpy as np

from sim.scene.change import with_offsets
from sim.scene.file import Scene
from sim.scene.trackerrors import TrackErrors


@dataclass(frozen=True)
class Moment:
    """What holds in one picture.

    Attributes
    ----------
    scene : Scene, with the picture's numbers; its head is turned and shifted as the track's errors
        have it, which are no longer in it themselves
    position_mm : float, mm, true position along the track: ``head_pose`` of both is the head's
        true pose

    Examples
    --------
    >>> import sim
    >>> moment = sim.at_moment(sim.load_scene("paper/groove"), 0, 2.5)
    >>> moment.scene.rig.name, moment.position_mm
    ('paper: grooved block', 2.5)
    """

    scene: Scene
    position_mm: float


def at_moment(scene: Scene, frame: int, position_mm: float) -> Moment:
    """The scene as picture ``frame`` shows it, the track commanded to ``position_mm``.

    Parameters
    ----------
    scene
        The scene; without ``[track_errors]`` and ``[[change]]`` it comes back as it is.
    frame
        Number of the picture in the scan, from 0.
    position_mm
        Commanded position of the track.

    Raises
    ------
    InputError
        Changes put a number of the scene out of its range.

    Examples
    --------
    >>> import sim
    >>> scene = sim.load_scene("paper/groove")
    >>> sim.at_moment(scene, 3, 10.0).position_mm
    10.0
    """
    tank = scene.tank
    if not is_changing(scene):
        return Moment(scene, position_mm)
    drawn = [(change, change.offset(frame, position_mm)) for change in tank.change]
    where = f"{scene.source}, picture {frame}"
    errors, changed = tank.track_errors, with_offsets(scene, drawn, where)
    head = changed.tank.head
    turn = np.add(head.turn_deg, errors.turn_deg(position_mm))
    shift = np.add(head.shift_mm, errors.shift_mm(position_mm))
    here = {"turn_deg": tuple(turn.tolist()), "shift_mm": tuple(shift.tolist())}
    update = {
        "head": head.model_copy(update=here),
        "track_errors": TrackErrors(),
        "change": (),
    }
    changed = replace(changed, tank=changed.tank.model_copy(update=update))
    return Moment(changed, errors.true_mm(scene.rig.plan, frame, position_mm))


def is_changing(scene: Scene) -> bool:
    """Whether anything but the commanded position sets one picture apart from another.

    Parameters
    ----------
    scene : Scene, its changes and its track's errors
    """
    return bool(scene.tank.change) or scene.tank.track_errors != TrackErrors()
