# The public names of sim and the modules that define them; __init__.py offers what is named here.

from sim.devices import render_picture as render_picture
from sim.emulators.hardware import EmulatedHardware as EmulatedHardware
from sim.emulators.track import ServeOptions as ServeOptions
from sim.scene import (
    Moment as Moment,
    Scene as Scene,
    at_moment as at_moment,
    load_scene as load_scene,
)
from sim.truth import (
    BoardTruth as BoardTruth,
    StripeTruth as StripeTruth,
    board_truth as board_truth,
    stripe_truth as stripe_truth,
)
