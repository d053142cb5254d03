"""The driver of the entry point ``opencv``: checks the options, opens the camera."""

import os

from lscan.config.documents import check
from lscan.config.rig import RigFile
from lscan.devices.api import Fact, Track
from lscan.devices.opencv_camera.camera import OpencvCamera
from lscan.devices.opencv_camera.options import OpencvOptions
from lscan.errors import InputError


class OpencvCameraDriver:
    """Registered as "opencv" under ``lscan.cameras``."""

    sections: frozenset[str] = frozenset()
    takes_dark = True
    connection_options = frozenset(
        {"device", "url", "timeout_s", "retries", "reconnects", "reconnect_wait_s"}
    )

    def validate(self, rig_file: RigFile) -> None:
        """Check the options, and that a video file is there, touching no device: InputError.

        A video was taken without the laser being switched for it: it serves no pairs.
        """
        options = self._options(rig_file)
        if rig_file.rig.plan.paired and not options.live:
            raise InputError(
                "a video file does not see the laser being switched",
                where=f"{rig_file.source}: plan.laser",
                value=rig_file.rig.plan.laser,
                allowed="untouched, on; or a camera.options.device or url",
            )

    def capabilities(self, rig_file: RigFile) -> dict[str, Fact]:
        """Where its pictures come from, and whether its exposure can be set."""
        options = self._options(rig_file)
        kind = "device" if options.device is not None else "url" if options.url else "file"
        return {
            kind: str(getattr(options, kind)),
            "exposure_settable": options.exposure_settable,
        }

    def open(self, rig_file: RigFile, track: Track) -> OpencvCamera:
        """The camera, ready to grab; DeviceError where it is not as the rig file says."""
        return OpencvCamera(rig_file.rig.camera, self._options(rig_file))

    def _options(self, rig_file: RigFile) -> OpencvOptions:
        section, where = rig_file.rig.camera, rig_file.source
        options = check(OpencvOptions, section.options, where=where, prefix="camera.options")
        if options.file is not None and not os.path.isfile(options.file):  # noqa: PTH113
            raise InputError(
                "camera.options.file: no such file",
                where=where,
                value=options.file,
                allowed="a video, its path counted from the rig file's folder",
            )
        return options


camera_driver = OpencvCameraDriver()
