"""A recorded run as a camera and a track: what was scanned once can be scanned again.

Rig file, the same option for both devices, relative to the rig file:

    camera = { driver = "replay", options = { run_file = "runs/a" } }
    track = { driver = "replay", options = { run_file = "runs/a" } }

``plan.laser = "pairs"`` needs a run that was recorded in pairs.
"""

import math
from pathlib import Path
from typing import Literal

import numpy as np

from lscan.acquisition.run import Run, open_run
from lscan.config.documents import Strict, check
from lscan.config.rig import RigFile
from lscan.devices.api import Fact, Grab, PassiveTrack, Track
from lscan.errors import DeviceError, InputError
from lscan.records import Frame

# Far below any track's resolution, far above the rounding of a position in mm.
ROUNDING_MM = 1e-9


class ReplayOptions(Strict):
    """Options of both drivers.  run_file: the folder of the recorded run."""

    run_file: str


class ReplayTrack(PassiveTrack):
    """A track that reaches a commanded position at once, within the recorded range.

    It misses the commanded position by as much as the recorded track did at the nearest
    stop, so that a replayed scan reports the positions of the recorded one.
    """

    name, slack_mm = "replay track", ROUNDING_MM

    def __init__(self, run: Run) -> None:
        self._commanded_mm = np.array([row.commanded_mm for row in run.rows])
        self._reported_mm = run.positions_mm
        limits_mm = float(self._commanded_mm.min()), float(self._commanded_mm.max())
        miss_mm = float(np.abs(self._reported_mm - self._commanded_mm).max())
        super().__init__(float(self._reported_mm[0]), limits_mm, miss_mm + ROUNDING_MM)

    def move_to(self, position_mm: float) -> float:
        """Move at once; DeviceError outside the recorded range or after closing."""
        self._require_free_way(position_mm)
        nearest = int(np.argmin(np.abs(self._commanded_mm - position_mm)))
        miss_mm = position_mm - self._commanded_mm[nearest]
        self.position_mm = float(self._reported_mm[nearest] + miss_mm)
        return self.position_mm

    def laser_on(self) -> None:
        """What was recorded with the laser on is asked of the camera: nothing to switch."""
        self._require_open()

    def laser_off(self) -> None:
        """What was recorded with the laser off is asked of the camera: nothing to switch."""
        self._require_open()


class ReplayCamera:
    """A camera that delivers the recorded picture nearest to where the track stands.

    Where several were recorded at one place they come in turn.  time_s is the recorded
    one; where a picture comes again, the least step after the picture before.
    """

    def __init__(self, run: Run, track: Track) -> None:
        self._run, self._track = run, track
        self._reach_mm = abs(run.rig_file.rig.plan.step_mm) / 2 + ROUNDING_MM
        self._last_index, self._last_time_s = -1, -math.inf
        self._closed = False

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) of the recorded pictures."""
        return self._run.rig_file.rig.camera.size_px

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        """The recorded picture; DeviceError where none lies within half a step.

        dark: instead, the background recorded with the picture just delivered there, or with
        the nearest; DeviceError where the run has none.
        Raises InputError where the run folder was damaged.
        """
        recorded = self._nearest_frame(self._last_index - dark)
        image = recorded.background if dark else recorded.image
        if image is None:
            raise DeviceError(f"replay camera: {self._run.path} was recorded without backgrounds")
        time_s = recorded.time_s
        if time_s <= self._last_time_s:
            time_s = math.nextafter(self._last_time_s, math.inf)
        self._last_index, self._last_time_s = recorded.index, time_s
        return Grab(image, time_s, recorded.exposure_ms)

    def preview(self) -> Grab:
        """The recorded picture, as it was; what is delivered next does not change by it."""
        recorded = self._nearest_frame(self._last_index)
        return Grab(recorded.image, recorded.time_s, recorded.exposure_ms)

    def close(self) -> None:
        """Nothing is held open; the camera delivers no more pictures."""
        self._closed = True

    def _nearest_frame(self, after: int) -> Frame:
        """The nearest frame; of several, the first whose index is above ``after``."""
        if self._closed:
            raise DeviceError("replay camera: is closed")
        position_mm = self._track.position_mm
        distance_mm = np.abs(self._run.positions_mm - position_mm)
        least_mm = float(distance_mm.min())
        if not least_mm <= self._reach_mm:
            raise DeviceError(
                f"replay camera: no picture was recorded near {position_mm} mm; "
                f"the nearest is {least_mm} mm away, allowed: {self._reach_mm} mm, half a step"
            )
        candidates = np.flatnonzero(distance_mm == least_mm)
        later = candidates[candidates > after]
        return self._run.frame(int((later if later.size else candidates)[0]))


class ReplayTrackDriver:
    """Registered as "replay" under ``lscan.tracks``."""

    sections: frozenset[str] = frozenset()
    switches_laser = True

    def validate(self, rig_file: RigFile) -> None:
        """Check that the recorded run is there: InputError."""
        _recorded_run(rig_file, "track")

    def capabilities(self, rig_file: RigFile) -> dict[str, Fact]:
        """The recorded travel."""
        track = self.open(rig_file)
        low_mm, high_mm = track.limits_mm
        return {"min_mm": low_mm, "max_mm": high_mm, "tolerance_mm": track.tolerance_mm}

    def open(self, rig_file: RigFile) -> ReplayTrack:
        """The track where the recorded one stood first."""
        return ReplayTrack(_recorded_run(rig_file, "track"))


class ReplayCameraDriver:
    """Registered as "replay" under ``lscan.cameras``."""

    sections: frozenset[str] = frozenset()
    takes_dark = True

    def validate(self, rig_file: RigFile) -> None:
        """Check that the recorded run is there and fits the rig: InputError."""
        self._run(rig_file)

    def capabilities(self, rig_file: RigFile) -> dict[str, Fact]:
        """How many pictures were recorded."""
        return {"recorded_frames": len(self._run(rig_file)), "exposure_settable": False}

    def open(self, rig_file: RigFile, track: Track) -> ReplayCamera:
        """The camera, which looks from where ``track`` stands."""
        return ReplayCamera(self._run(rig_file), track)

    def _run(self, rig_file: RigFile) -> Run:
        run = _recorded_run(rig_file, "camera")
        asked, recorded = rig_file.rig.camera.size_px, run.rig_file.rig.camera.size_px
        if asked != recorded:
            what = "camera.width_px, camera.height_px: not the size of the recorded pictures"
            raise InputError(what, where=rig_file.source, value=asked, allowed=recorded)
        if rig_file.rig.plan.paired and not run.rig_file.rig.plan.paired:
            what = f"the run {run.path} was recorded without backgrounds"
            where = f"{rig_file.source}: plan.laser"
            allowed = "untouched, on"
            raise InputError(what, where=where, value=rig_file.rig.plan.laser, allowed=allowed)
        return run


def _recorded_run(rig_file: RigFile, device: Literal["camera", "track"]) -> Run:
    """The run that a section's options name; InputError where there is none with frames."""
    prefix, source = f"{device}.options", rig_file.source
    options = getattr(rig_file.rig, device).options
    path = Path(check(ReplayOptions, options, where=source, prefix=prefix).run_file)
    try:
        run = open_run(path, trusted=True)  # for its pictures; how the line is found is not asked
        if len(run) == 0:
            raise InputError("a run without frames", where=path)
    except InputError as error:
        what = f"{prefix}.run_file: no recorded run: {error}"
        allowed = "the folder of a recorded run"
        raise InputError(what, where=source, value=str(path), allowed=allowed) from error
    return run


camera_driver = ReplayCameraDriver()
track_driver = ReplayTrackDriver()
