"""The tank in software: what a webcam would see of a laser line under water, and the truth of it.

What is named here is the public interface; each name is loaded when it is first asked for.

    import sim

    scene = sim.load_scene("scene.toml")
    picture = sim.render_picture(scene)
    truth = sim.stripe_truth(scene, 0.0)
    with sim.EmulatedHardware(scene) as hardware:  # a webcam and a track for lscan
        print(hardware.url, hardware.port)
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sim.devices import render_picture
    from sim.emulators.hardware import EmulatedHardware
    from sim.emulators.options import ServeOptions
    from sim.scene import Scene, load_scene
    from sim.truth import BoardTruth, StripeTruth, board_truth, stripe_truth

__all__ = [
    "BoardTruth",
    "EmulatedHardware",
    "Scene",
    "ServeOptions",
    "StripeTruth",
    "board_truth",
    "load_scene",
    "render_picture",
    "stripe_truth",
]

_HOMES = {
    "sim.devices": ("render_picture",),
    "sim.emulators.hardware": ("EmulatedHardware",),
    "sim.emulators.options": ("ServeOptions",),
    "sim.scene": ("Scene", "load_scene"),
    "sim.truth": ("BoardTruth", "StripeTruth", "board_truth", "stripe_truth"),
}
"""The public names by the module that defines them, as the imports above say to type checkers."""


def __getattr__(name: str) -> Any:
    """A public name, its module imported now."""
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(home), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
