"""The tank as hardware: all of it, plugged in and switched on within a ``with`` block."""

import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Self

from lscan.config.documents import Document, write_toml
from lscan.config.rig import RigFile, parse_rig
from lscan.files.disk import make_folder
from lscan.records import Progress
from sim.emulators.faults import (
    CAMERA_FAULTS,
    HEALED,
    TRACK_FAULTS,
    UNPLUGGED,
    TimedFault,
    check_name,
)
from sim.emulators.grbl import Faults, GrblEmulator
from sim.emulators.options import ServeOptions
from sim.emulators.places import Places
from sim.emulators.rigfile import HEADING, rig_document
from sim.emulators.track import EmulatedTrack
from sim.emulators.webcam.camera import EmulatedCamera, HeadState
from sim.emulators.webcam.mjpeg import SNAPSHOT, STREAM, MjpegServer
from sim.scene import Scene

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
        self,
        scene: Scene,
        options: ServeOptions | None = None,
        progress: Progress | None = None,
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
            self._track = EmulatedTrack(scene.rig.plan, self.options.dialect, self.options.link)
            stack.callback(self._track.unplug)
            self.controller = self._track.controller
            self._places = places = self._rendered(progress)
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
        """The track's serial port."""
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
        name : str, one of ``sim.emulators.faults.NAMES``; "none" ends all

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

    def _rendered(self, progress: Progress | None) -> Places:
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
