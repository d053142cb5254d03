"""The tank as hardware: all of it, plugged in and switched on within a ``with`` block."""

import math
import threading
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, get_args

import numpy as np

from lscan.config.documents import Document, write_toml
from lscan.config.rig import Rig, RigFile, parse_rig
from lscan.errors import InputError
from lscan.files.disk import make_folder
from lscan.records import Progress
from sim.emulators.grbl import Faults, GrblEmulator
from sim.emulators.track import EmulatedTrack, ServeOptions
from sim.emulators.webcam import (
    SNAPSHOT,
    STREAM,
    CameraFault,
    EmulatedCamera,
    HeadState,
    MjpegServer,
    Places,
)
from sim.scene import Scene, camera_pose
from sim.water import water_optics

# Faults of the emulated hardware by name, as a command line gives them.


CAMERA_FAULTS: Mapping[str, CameraFault] = {
    f"camera-{fault}": fault for fault in get_args(CameraFault)
}
TRACK_FAULTS: Mapping[str, Faults] = {
    "track-silent": Faults(silent=True),
    "track-garbled": Faults(garble=0.2, seed=1),
    "track-alarm": Faults(alarm=True),  # the limit switch closes in the next motion
    "track-stuck": Faults(stuck=True),
}
UNPLUGGED, HEALED = "track-unplugged", "none"
NAMES = (*CAMERA_FAULTS, *TRACK_FAULTS, UNPLUGGED, HEALED)


@dataclass(frozen=True)
class TimedFault:
    """A fault, one of NAMES, and how long after the start it begins; "none" ends all others."""

    name: str
    after_s: float


def parse_fault(text: str) -> TimedFault:
    """The fault that a text names, and when it begins.

    Parameters
    ----------
    text : str, ``NAME@SECONDS``; at once without the seconds

    Raises
    ------
    InputError
        The text names no fault, or no time from 0 to 1e6 s.
    """
    name, at, seconds = text.partition("@")
    check_name(name)
    try:
        after_s = float(seconds) if at else 0.0
    except ValueError:
        after_s = math.nan
    if not 0 <= after_s <= 1e6:  # nor NaN
        allowed = "NAME@SECONDS, 0 to 1e6"
        raise InputError("bad time", where="--fault", value=text, allowed=allowed)
    return TimedFault(name, after_s)


def check_name(name: str) -> None:
    """Raise InputError where no fault is called so."""
    if name not in NAMES:
        raise InputError("no such fault", where="--fault", value=name, allowed=", ".join(NAMES))


# The rig file of the emulated hardware: the scene's instrument, with the drivers of real ones.


HEADING = "# Written by `lscan-sim serve`: the tank as a webcam and a track."
TIMEOUT_S = 30.0
"""For a picture: it may wait for several renderings, of the places passed and its own, each of
seconds on a busy machine.  Not measured: the same scene gives the same file each time."""


def rig_document(
    scene: Scene, url: str, track: Mapping[str, Any], *, switched_laser: bool = False
) -> Document:
    """The scene's own sections without the tank's, its devices replaced, and ``[sheet]``.

    url: of the camera's stream, for the driver "opencv".  track: ``[track.options]`` of "grbl".
    switched_laser: the track lights the laser, so a plan that says nothing of it gets "on".
    """
    # A picture handed out while the head rests is true when it is sent; flush_frames takes care
    # of the one that was on its way when the head came to rest.
    camera = {"url": url, "warm_up_frames": 2, "flush_frames": 1, "timeout_s": TIMEOUT_S}
    instrument = {key: value for key, value in scene.document.items() if key in Rig.model_fields}
    section = {key: value for key, value in instrument["camera"].items() if key != "options"}
    if switched_laser:
        instrument["plan"] = {"laser": "on", **instrument.get("plan", {})}
    if (sheet := sheet_section(scene)) is not None:
        instrument = {"sheet": sheet, **instrument}
    return {
        **instrument,
        "camera": {**section, "driver": "opencv", "options": camera},
        "track": {"driver": "grbl", "options": dict(track)},
    }


def sheet_section(scene: Scene) -> dict[str, Any] | None:
    """``[sheet]`` as a ruler at the scene's head would measure it, the thickness to 0.01 mm.

    The thickness is that at the place the camera looks at, where its axis meets the head's
    plane y = 0.  None for a camera that does not look at that plane from before it.
    """
    laser, pose = scene.tank.laser, camera_pose(scene.tank.head)
    axis = pose.rotation[:, 2]
    if pose.origin_mm[1] >= 0 or axis[1] <= 0:
        return None
    seen_mm = pose.origin_mm - axis * pose.origin_mm[1] / axis[1]
    index = water_optics(scene.tank.water, laser.wavelength_nm).index
    distance_mm = np.linalg.norm([seen_mm - np.array(laser.apex_mm)], axis=1)
    return {
        "thickness_mm": round(float(laser.half_thickness_mm(distance_mm, index)[0]), 2),
        "camera_mm": list(scene.tank.head.camera_mm),
        "apex_mm": list(laser.apex_mm),
    }


# The tank as hardware: all of it, plugged in and switched on within a ``with`` block.


PLACES_BESIDE_THE_PLAN = 4  # of homing and approach


class EmulatedHardware:
    """A webcam and a track in the tank of a scene.

    url, snapshot_url: of the stream, and of one picture.  controller: the emulated one, whose
    ``head_mm`` is the truth.

    with EmulatedHardware(scene) as hardware:
        scan(hardware.rig_file(), folder)  # or open hardware.url and hardware.port

    Examples
    --------
    >>> import sim
    >>> scene = sim.load_scene("board.toml")
    >>> with sim.EmulatedHardware(scene) as hardware:
    ...     hardware.url.startswith("http://127.0.0.1"), hardware.position_mm
    (True, 0.0)
    """

    def __init__(
        self, scene: Scene, options: ServeOptions | None = None, progress: Progress | None = None
    ) -> None:
        """Switch on.

        Parameters
        ----------
        scene : Scene, its tank is served
        options : ServeOptions or None, how; the defaults where it is None
        progress : Progress or None, called with (done, all) of the places that ``prepare`` renders

        Raises
        ------
        InputError
            The scene cannot be served, or a port is taken.
        """
        self.scene, self.options = scene, options or ServeOptions()
        self._timers: list[threading.Timer] = []
        with ExitStack() as stack:
            line = self.options.dialect, self.options.link, self.options.tcp
            self._track = EmulatedTrack(scene.rig.plan, *line)
            stack.callback(self._track.unplug)
            self.controller = self._track.controller
            self._places = places = self._render_places(progress)
            seed = scene.tank.sensor.seed
            self._camera = EmulatedCamera(places, self._head_state, self.options, seed)
            stack.callback(self._camera.close)
            self._server = MjpegServer(self._camera, self.options.http_port)
            stack.callback(self._server.close)
            address = self._server.address
            self.url, self.snapshot_url = address + STREAM, address + SNAPSHOT
            self._open = stack.pop_all()

    @property
    def port(self) -> str:
        """The track's serial port, or its address."""
        return self._track.port

    @property
    def position_mm(self) -> float | None:
        """The track position where the head truly rests; None while it moves."""
        return self._track.position_mm

    def rig_document(self) -> Document:
        """The rig file of this hardware, as a document."""
        track, switched = self._track.rig_options(), self.options.switched_laser
        return rig_document(self.scene, self.url, track, switched_laser=switched)

    def rig_file(self) -> RigFile:
        """The rig of this hardware."""
        return parse_rig(self.rig_document(), source="emulated hardware")

    def write_rig(self, path: Path) -> None:
        """Write the rig file of this hardware.

        Parameters
        ----------
        path : Path, the file

        Raises
        ------
        InputError
            The disk refuses.
        """
        make_folder(path.parent)
        write_toml(path, self.rig_document(), HEADING)

    def inject(self, name: str) -> None:
        """Begin a fault.

        Parameters
        ----------
        name : str, one of ``sim.emulators.hardware.NAMES``; "none" ends all

        Raises
        ------
        InputError
            There is no such fault, or the controller's dialect has none such.
        """
        check_name(name)
        if name == HEALED:
            self.heal()
        elif name == UNPLUGGED:
            self._track.unplug()
        elif name in TRACK_FAULTS:
            self._track.inject(TRACK_FAULTS[name])
        else:
            self._camera.fault = CAMERA_FAULTS[name]
            if self._camera.fault == "drop":
                self._server.drop()

    def heal(self) -> None:
        """End all faults and plug in what was unplugged; an alarm stays until it is cleared."""
        self._camera.fault = None
        self._track.plug_in()
        if isinstance(self.controller, GrblEmulator):
            self._track.inject(Faults())

    def schedule(self, fault: TimedFault) -> None:
        """Let a fault begin in a while.

        Parameters
        ----------
        fault : TimedFault, its name, and after how many seconds it begins

        Raises
        ------
        InputError
            There is no such fault, or the controller's dialect has none such.
        """
        check_name(fault.name)
        if fault.name in TRACK_FAULTS:
            self._track.require_faults()
        timer = threading.Timer(fault.after_s, self.inject, args=(fault.name,))
        timer.daemon = True
        self._timers.append(timer)
        timer.start()

    def close(self) -> None:
        """Switch off: no thread, port or link stays.  Closing twice is harmless."""
        for timer in self._timers:
            timer.cancel()
        self._open.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _head_state(self) -> HeadState:
        lit = not self.options.switched_laser or self._track.lit
        return HeadState(self._track.position_mm, lit, self._track.now_mm)

    def _render_places(self, progress: Progress | None) -> Places:
        """The places, with the plan's first or, to prepare, all of them rendered."""
        options, plan = self.options, self.scene.rig.plan
        wanted = plan.positions_mm() if options.prepare else plan.positions_mm()[:1]
        most = max(options.places, len(wanted) + PLACES_BESIDE_THE_PLAN * options.prepare)
        places = Places(self.scene, most, switched_laser=options.switched_laser)
        report = progress or (lambda done, of: None)
        report(0, len(wanted))
        for done, position_mm in enumerate(wanted, start=1):
            places.view(self._track.travel.standing_mm(position_mm))
            report(done, len(wanted))
        return places
