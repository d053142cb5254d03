"""The tank's camera and track, behind the protocols of real ones.

Given the same scene, a picture depends only on where the track stands and on its index in the
scan, so a scan that is stopped and resumed gives the same bytes.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Self

import numpy as np
from pydantic import Field, PositiveFloat, model_validator

from lscan.acquisition.run import require_same_files
from lscan.config.documents import Strict, check, named_files
from lscan.config.rig import RigFile, load_rig
from lscan.devices.api import Fact, Grab, PassiveTrack, Track, TravelDriver, TravelOptions
from lscan.errors import DeviceError, InputError
from lscan.records import Picture
from sim.processes import Ahead
from sim.scene import SECTIONS, Scene, at_moment, scene_of
from sim.truth.placement import check_placement

if TYPE_CHECKING:
    from sim.render.layers import Layers
    from sim.render.tank import Tank
    from sim.sensor import Webcam

FRAME_PERIOD_S = 0.2  # the simulated clock: a frame takes this long, its background half of it
_LIT, _DARK = 1, 2  # the streams that the noise of either picture is drawn from


class TrackOptions(TravelOptions):
    """``[track.options]`` of the tank's track: its travel."""

    min_mm: float = -1000.0
    max_mm: float = 1000.0


class CameraOptions(Strict):
    """``[camera.options]`` of the tank's camera: how it sets its exposure.

    auto_exposure: instead of the rig's ``exposure_ms``, the exposure within ``min_ms`` and
    ``max_ms`` that brings the ``percentile`` of each picture's pixels, by their brightest
    colour, closest to ``target_dn``.
    """

    auto_exposure: bool = False
    target_dn: Annotated[float, Field(gt=0, lt=255)] = 200.0
    percentile: Annotated[float, Field(gt=0, le=100)] = 99.9
    min_ms: PositiveFloat = 0.1
    max_ms: PositiveFloat = 100.0

    @model_validator(mode="after")
    def _not_empty(self) -> Self:
        if self.min_ms > self.max_ms:
            raise ValueError("min_ms must not be above max_ms")
        return self


class SimTrack(PassiveTrack):
    """A track that reaches a commanded position at once.

    laser_is_on: whether the tank's laser, where its scene lights it, is on; until it is switched
    it is.  One that the track switched on is off when the track is closed.
    """

    name = "sim track"

    def __init__(self, options: TrackOptions) -> None:
        super().__init__(0.0, (options.min_mm, options.max_mm), tolerance_mm=0.0)
        self.laser_is_on = True
        self._switched_on = False

    def move_to(self, position_mm: float) -> float:
        """The position reached, mm; DeviceError outside the track's travel."""
        self._require_free_way(position_mm)
        self.position_mm = float(position_mm)
        return self.position_mm

    def laser_on(self) -> None:
        """Light the tank with what lasers its scene has."""
        self._require_open()
        self.laser_is_on = self._switched_on = True

    def laser_off(self) -> None:
        """Leave the tank to its ambient light."""
        self._require_open()
        self.laser_is_on = self._switched_on = False

    def close(self) -> None:
        """Release the track."""
        super().close()
        if self._switched_on:
            self.laser_is_on = self._switched_on = False


class TankCamera:
    """Pictures of the tank, each by itself: called with the numbers of one, it takes that one.

    files: SHA-256 of what the scene's files are to hold, for another process loads them later.
    """

    def __init__(self, scene: Scene, files: Mapping[str, str] | None = None) -> None:
        from sim.render.tank import Tank
        from sim.sensor import Webcam

        require_same_files(files or {}, Path(scene.source))
        self._scene, self._tank, self._webcam = scene, Tank(scene), Webcam(scene)

    def __call__(self, index: int, position_mm: float, dark: bool, lit: bool) -> Grab:
        """The picture of a place; dark: a background; lit: whether the laser is on."""
        time_s = (index + (0.5 if dark else 0.0)) * FRAME_PERIOD_S
        at = at_moment(self._scene, index, position_mm)
        wavelength_nm, webcam = at.scene.tank.laser.wavelength_at(time_s), self._webcam
        if at.scene is not self._scene:
            webcam = webcam.taking(at.scene)
        layers, exposure_ms = metered_layers(
            at.scene, self._tank, webcam, at.position_mm, time_s=time_s
        )
        if dark or not lit:
            layers = layers.without_laser()
        nanometres, stream = round(position_mm * 1e6), _DARK if dark else _LIT
        place = abs(nanometres), int(nanometres < 0)
        seed = [self._scene.tank.sensor.seed, stream, *place, index]
        generator = np.random.Generator(np.random.SFC64(seed))
        image = webcam.expose(layers, exposure_ms, generator, wavelength_nm)
        return Grab(image=image, time_s=time_s, exposure_ms=exposure_ms)


class SimCamera:
    """A camera that renders the tank from where its track stands.

    Once its pictures follow a long plan, processes on the other cores take the next ones.
    """

    def __init__(self, scene: Scene, track: Track) -> None:
        from sim.render.backend import sharing

        self._scene, self._track = scene, track
        camera_options(scene)
        planned = [  # what ``TankCamera`` is called with in a scan, in its order
            (index, position_mm, dark, not dark)
            for index, position_mm in enumerate(scene.rig.plan.positions_mm())
            for dark in ((False, True) if scene.rig.plan.paired else (False,))
        ]
        make = partial(TankCamera, scene, named_files(scene.document))
        self._pictures: Ahead[Grab] | None = Ahead(make, planned, sharing)
        self._next = 0

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) of every picture."""
        return self._scene.rig.camera.size_px

    @property
    def longest_grab_s(self) -> float:
        """However long it renders, no laser of the world is lit."""
        return math.inf

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        """A picture, (H, W, 3) RGB, seen from the track's position.

        frame: the index that fixes its noise, its time and what changes from picture to picture;
        the next one if None.
        dark: it shows the ambient light alone, with noise of its own, half a period after the
        frame's other picture and with that one's exposure and its other numbers.
        """
        pictures = self._pictures  # another thread may close the camera meanwhile
        if pictures is None:
            raise DeviceError("sim camera: is closed")
        index = self._next if frame is None else frame
        self._next = index + 1
        lit = getattr(self._track, "laser_is_on", True)
        return pictures.take(index, self._track.position_mm, dark, lit)

    def close(self) -> None:
        """Release the tank."""
        pictures, self._pictures = self._pictures, None
        if pictures is not None:
            pictures.close()


class SimTrackDriver(TravelDriver[TrackOptions]):
    """Registered as "sim" under ``lscan.tracks``."""

    model = TrackOptions
    switches_laser = True

    def capabilities(self, rig_file: RigFile) -> dict[str, Fact]:
        """Its travel."""
        return {**dict(self.options(rig_file)), "tolerance_mm": 0.0}

    def open(self, rig_file: RigFile) -> SimTrack:
        """The track at position 0."""
        return SimTrack(self.options(rig_file))


class SimCameraDriver:
    """Registered as "sim" under ``lscan.cameras``; owns the tank's sections."""

    sections: frozenset[str] = SECTIONS
    takes_dark = True

    def validate(self, rig_file: RigFile) -> None:
        """Check options, the tank's sections and that the files they name are there: InputError."""
        scene = scene_of(rig_file)
        camera_options(scene)
        _check_files(scene)

    def capabilities(self, rig_file: RigFile) -> dict[str, Fact]:
        """How it is exposed."""
        options = camera_options(scene_of(rig_file))
        return {"auto_exposure": options.auto_exposure, "exposure_settable": False}

    def open(self, rig_file: RigFile, track: Track) -> SimCamera:
        """The camera, its tank loaded into Mitsuba; InputError as ``check_placement``."""
        scene = scene_of(rig_file)
        check_placement(scene)
        return SimCamera(scene, track)


def metered_layers(
    scene: Scene,
    tank: Tank,
    webcam: Webcam,
    position_mm: float,
    samples: int | None = None,
    *,
    time_s: float = 0.0,
) -> tuple[Layers, float]:
    """What is seen from a track position, exposed as the scene's camera exposes it.

    By the rig's exposure, or with auto exposure the one that this very picture asks for: a real
    webcam meters the pictures before, which a resumed scan does not have.

    Parameters
    ----------
    scene, tank, webcam
        The scene as it is in the picture (``sim.scene.at_moment``), its tank and its webcam.
    position_mm
        Of the head along the track, where it truly is.
    samples, time_s
        As ``Tank.render``.

    Returns
    -------
    The layers, and the exposure in ms.
    """
    tank.take(scene)
    layers = tank.render(position_mm, samples=samples, time_s=time_s)
    exposure_ms = exposure_of(scene, webcam, layers, time_s=time_s)
    if exposure_ms != scene.rig.camera.exposure_ms and scene.tank.head.speed_mm_s != 0:
        layers = tank.render(position_mm, samples=samples, time_s=time_s, exposure_ms=exposure_ms)
    return layers, exposure_ms


def take_picture(
    scene: Scene, tank: Tank, position_mm: float, samples: int | None = None
) -> tuple[Picture, Layers, float]:
    """A picture by itself, (H, W, 3) RGB, its layers of light, and its exposure in ms.

    Parameters
    ----------
    scene, tank, position_mm, samples
        As of ``metered_layers``.
    """
    from sim.sensor import Webcam

    webcam = Webcam(scene)
    layers, exposure_ms = metered_layers(scene, tank, webcam, position_mm, samples)
    generator = np.random.default_rng([scene.tank.sensor.seed, 1])
    return webcam.expose(layers, exposure_ms, generator), layers, exposure_ms


def exposure_of(scene: Scene, webcam: Webcam, layers: Layers, *, time_s: float = 0.0) -> float:
    """The exposure, ms, of a picture of that light: the rig's, or what auto exposure asks for.

    Parameters
    ----------
    scene, webcam
        As they are in the picture.
    layers
        What is seen.
    time_s
        As ``Tank.render``.
    """
    options = camera_options(scene)
    if not options.auto_exposure:
        return scene.rig.camera.exposure_ms
    nm = scene.tank.laser.wavelength_at(time_s)
    wanted = webcam.metered_ms(layers, options.target_dn, options.percentile, nm)
    return min(max(wanted, options.min_ms), options.max_ms)


def render_picture(
    scene: Scene, position_mm: float | None = None, samples: int | None = None
) -> Picture:
    """The picture that the scene's webcam takes, as ``lscan-sim render`` writes it.

    What changes from picture to picture is as in the first one of a scan.

    Parameters
    ----------
    scene : Scene
        The tank, and the rig in it.
    position_mm : float, optional
        Of the track; by default where the rig's plan starts.
    samples : int, optional
        A pixel, a square number; by default the scene's.

    Returns
    -------
    array
        (H, W, 3), RGB, uint8, or uint16 where the camera has more than 8 bits.

    Raises
    ------
    InputError
        Where the number of samples cannot be had, or a mesh or picture cannot be read.

    Examples
    --------
    >>> import sim
    >>> sim.render_picture(sim.load_scene("board.toml"), samples=1).shape
    (480, 640, 3)
    """
    from sim.render.tank import Tank

    place = scene.rig.plan.start_mm if position_mm is None else position_mm
    at = at_moment(scene, 0, place)
    return take_picture(at.scene, Tank(scene), at.position_mm, samples)[0]


def load_checked(path: Path | str) -> Scene:
    """The scene in a file, refused wherever a scan refuses it.

    What is odd about its target is logged, as a scan does.

    Parameters
    ----------
    path : Path or str, a scene file, or a name that ``lscan scenes`` lists

    Raises
    ------
    InputError
        Names the file, the key, the value and what is allowed.
    """
    scene = scene_of(load_rig(path))
    check_placement(scene)
    return scene


def camera_options(scene: Scene) -> CameraOptions:
    """The scene's ``[camera.options]``.

    Parameters
    ----------
    scene : Scene, its rig's camera and its sensor

    Raises
    ------
    InputError
        An option is wrong, or the sensor's black level is not below ``target_dn``.
    """
    options = check(
        CameraOptions, scene.rig.camera.options, where=scene.source, prefix="camera.options"
    )
    sensor = scene.tank.sensor
    if options.auto_exposure and any(c.key == "camera.exposure_ms" for c in scene.tank.change):
        what = "change: camera.exposure_ms is found anew for each picture by auto exposure"
        raise InputError(what, where=scene.source, allowed="camera.options.auto_exposure = false")
    black_dn = 255 * (sensor.black_level_dn / 255) ** (1 / sensor.gamma)
    if options.auto_exposure and options.target_dn <= black_dn:
        what = "camera.options.target_dn: is no brighter than black"
        allowed = f"above {black_dn:.4g} DN, the sensor's black level behind its gamma"
        raise InputError(what, where=scene.source, value=options.target_dn, allowed=allowed)
    return options


def _check_files(scene: Scene) -> None:
    target = scene.tank.target
    named = {
        "target.file": target.file,
        "target.texture.file": target.texture.file if target.texture else None,
    }
    for key, file in named.items():
        if file is not None and not os.path.isfile(file):  # noqa: PTH113 - takes any text
            where, allowed = scene.source, "a file, its path counted from the scene's folder"
            raise InputError(f"{key}: no such file", where=where, value=file, allowed=allowed)


camera_driver = SimCameraDriver()
track_driver = SimTrackDriver()
