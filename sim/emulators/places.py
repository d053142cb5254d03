"""What the webcam sees from each place of the head, rendered once and kept."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np

from lscan.errors import InputError
from lscan.records import Bytes
from sim.devices import camera_options
from sim.processes import HelperProcess, started
from sim.render.backend import sharing
from sim.render.tank import Tank
from sim.scene import Scene
from sim.scene.file import is_changing
from sim.sensor import Webcam
from sim.sensor.webcam import StillView

NANOMETRE = 6  # decimals of a place in mm: finer, two places are one


class Places:
    """Views of the tank from track positions; the ``most`` used last are kept.

    One view of 640 by 480 px takes about 5 MB, twice that where the laser is switched.
    """

    def __init__(self, scene: Scene, most: int, *, switched_laser: bool = False) -> None:
        """Load the tank; InputError where the scene holds what pictures kept cannot show."""
        _refuse_change(scene)
        self._scene = scene
        self._tank, self._webcam = Tank(scene), Webcam(scene)
        self._exposure_ms = scene.rig.camera.exposure_ms
        self._switched = switched_laser
        self._kept = lru_cache(most)(self._render)

    def view(self, position_mm: float, *, lit: bool = True) -> StillView:
        """The view from a position in mm, rendered where it is not kept."""
        with_laser, without = self._kept(round(position_mm, NANOMETRE))
        return with_laser if lit else without

    def passed(self, position_mm: float, *, lit: bool = True) -> StillView:
        """The view from a position in mm that the head passes: nothing is kept of it."""
        with_laser, without = self._render(position_mm)
        return with_laser if lit else without

    @contextmanager
    def helpers(self) -> Iterator[list[HelperProcess]]:
        """Processes on the other cores that make a ``PassedPicture`` each, until the block ends."""
        with sharing() as environments:
            make = partial(PassedPicture, self._scene, self._switched)
            helpers = started(make, environments)
            try:
                yield helpers
            finally:
                for helper in helpers:
                    helper.close()

    def _render(self, position_mm: float) -> tuple[StillView, StillView]:
        """The views with the laser on and off; both are lit where it is never switched."""
        layers = self._tank.render(position_mm)
        lit = self._webcam.still(layers, self._exposure_ms)
        if not self._switched:
            return lit, lit
        none = np.zeros_like(layers.direct)
        dark = replace(layers, direct=none, scattered=none)
        return lit, self._webcam.still(dark, self._exposure_ms)


class PassedPicture:
    """Pictures of places that the head passes, as a process of its own takes them."""

    def __init__(self, scene: Scene, switched_laser: bool) -> None:
        self._places = Places(scene, 0, switched_laser=switched_laser)

    def __call__(self, position_mm: float, lit: bool, seed: int) -> Bytes:
        """The picture of a place in mm, with the noise of a seed."""
        view = self._places.passed(position_mm, lit=lit)
        return view.picture(np.random.Generator(np.random.SFC64(seed)))


def _refuse_change(scene: Scene) -> None:
    """Refuse what makes two pictures of one place differ by more than noise, or not at all."""
    refused = {
        "laser.drift": (scene.tank.laser.drift is not None, "no such table"),
        "track_errors and change": (is_changing(scene), "neither"),
        "head.speed_mm_s": (scene.tank.head.speed_mm_s != 0, "0"),
        "camera.options.auto_exposure": (camera_options(scene).auto_exposure, "false"),
        "sensor.noise": (not scene.tank.sensor.noise, "true: a camera without noise looks stuck"),
    }
    for key, (is_so, allowed) in refused.items():
        if is_so:
            raise InputError(
                f"{key}: cannot be served as hardware", where=scene.source, allowed=allowed
            )
