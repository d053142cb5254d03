"""The camera of the opencv driver: fresh pictures, checked one by one."""

import logging
import math
import os
import threading
import time
from typing import cast

import cv2
import numpy as np

from lscan.config.documents import check
from lscan.config.rig import CameraSection, RigFile
from lscan.devices.api import LONGEST_GRAB_S, Fact, Grab, Track, require_rigs_picture
from lscan.devices.opencv_camera.jpeg import is_whole
from lscan.devices.opencv_camera.options import (
    OpenCapture,
    OpencvOptions,
    Setting,
    Settings,
    device_identity,
)
from lscan.devices.opencv_camera.reader import DeviceLost, Reader, TimedPicture, open_capture
from lscan.errors import DeviceError, InputError
from lscan.files.pictures import aligned, grey_dn
from lscan.records import Picture

SLOWEST_S = 0.2
"""Between two pictures of a webcam that works: 5 a second are few even for large ones."""

_log = logging.getLogger(__name__)


class OpencvCamera:
    """A webcam, a stream or a video file as a camera.

    Parameters
    ----------
    section : CameraSection, size and exposure of the rig's camera
    options : OpencvOptions, which camera, how it is set, and what is done with its pictures
    open_capture : callable, opens OpenCV's capture by the options

    Raises
    ------
    DeviceError
        The camera does not open, sends pictures that are not of the rig's size or, with
        strict_settings, does not do as it is set.
    """

    def __init__(
        self,
        section: CameraSection,
        options: OpencvOptions,
        open_capture: OpenCapture = open_capture,
    ) -> None:
        self._section, self._options = section, options
        self._open_capture = open_capture
        self._closed = threading.Event()
        self._shape: tuple[int, ...] | None = None
        self._last: Picture | None = None
        self._last_time_s = -math.inf
        self._shown_s = -math.inf
        self._broken = 0  # pictures dropped, since they came damaged
        self._read = 0  # pictures of a file taken so far
        self._reader = self._new_reader()
        self._settings = self._first_settings()
        self.identity = self._device_identity()
        """What tells it from other cameras; None for a stream, a file, and where unknown."""

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) of every picture."""
        return self._section.size_px

    @property
    def longest_grab_s(self) -> float:
        """How long a grab takes at most while nothing is amiss, s; longer, and the laser goes off.

        SLOWEST_S or the exposure time for each picture, and LONGEST_GRAB_S to spare; what is waited
        for a camera that does not open (``timeout_s``) is no matter of the laser.
        """
        options, exposure_s = self._options, self._settings.exposure_ms / 1000
        pictures_s = options.pictures_per_grab * max(SLOWEST_S, exposure_s)
        return LONGEST_GRAB_S + options.flush_ms / 1000 + pictures_s

    @property
    def settings(self) -> tuple[Setting, ...]:
        """Each setting with what was asked and what the camera reports; none for a stream."""
        return self._settings.settings

    @property
    def can_set_exposure(self) -> bool:
        """Whether :meth:`set_exposure` can be asked of it: a device, not a stream or a file."""
        return self._options.exposure_settable

    def set_exposure(self, exposure_ms: float) -> float:
        """The exposure time as read back after setting it, ms; the camera is opened anew.

        Parameters
        ----------
        exposure_ms : float, ms

        Raises
        ------
        DeviceError
            The exposure time cannot be set, or the camera does not come back.
        """
        if not self.can_set_exposure:
            raise DeviceError(f"{self._options.name}: its exposure cannot be set")
        self._section = self._section.model_copy(update={"exposure_ms": exposure_ms})
        self._settings = self._open_anew()
        return self._settings.exposure_ms

    def accept_black(self) -> None:
        """From now on black pictures are meant: the cap is on."""
        self._options = self._options.model_copy(update={"black": "accept"})

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        """A picture that arrived after this call began, RGB.

        What was exposed before the call is dropped with the first ``flush_frames`` pictures.

        Parameters
        ----------
        frame : int or None, where the camera is a video file, which of its pictures is wanted; so a
            resumed scan goes on where it stopped
        dark : bool, the laser is off, and a black picture is meant

        Raises
        ------
        DeviceError
            No picture can be had.
        """
        self._require_open()
        began_s = time.monotonic()
        lost: DeviceLost | None = None
        attempts = 1 + (self._options.reconnects if self._options.live else 0)
        for attempt in range(attempts):
            try:
                if attempt:
                    self._closed.wait(self._options.reconnect_wait_s)
                    self._reconnect()
                return self._grab(began_s, frame, dark or self._options.black == "accept")
            except DeviceLost as error:
                lost = error
                if attempt + 1 < attempts:
                    _log.warning("%s (it is opened anew)", error)
        raise DeviceError(f"{lost}" + (f" (opened {attempts - 1} times anew)" * (attempts > 1)))

    def preview(self) -> Grab:
        """The newest picture not shown yet, RGB; DeviceError where none comes.

        It is only looked at: a grab, of another thread even, gets what it would get without.
        A black one is shown like any other.  A file's stands until the next is grabbed.
        """
        self._require_open()
        picture = self._reader.peek(self._shown_s)
        self._shown_s = picture.time_s
        return Grab(_rgb(picture.image), picture.time_s, self._settings.exposure_ms)

    def close(self) -> None:
        """Release the camera; closing twice is harmless.  A grab under way elsewhere fails."""
        if self._broken and not self._closed.is_set():
            _log.warning("%s: %d broken pictures were dropped", self._options.name, self._broken)
        self._closed.set()
        self._reader.give_up()

    # ---- taking pictures ----------------------------------------------------------------

    def _grab(self, began_s: float, frame: int | None, may_be_black: bool) -> Grab:
        if self._options.live:
            after_s = began_s + self._options.flush_ms / 1000
            for _ in range(self._options.flush_frames):
                # Black ones that are not meant may be one, sent again and again.
                self._sound_picture(after_s, may_be_black)
        else:
            after_s = -math.inf
            wanted = self._read if frame is None else frame * self._options.average_frames
            if wanted < self._read:
                self._open_anew()
            while self._read < wanted:
                self._take(after_s)
        count = self._options.average_frames
        pictures = [self._sound_picture(after_s, may_be_black) for _ in range(count)]
        images = [_rgb(picture.image) for picture in pictures]
        image = images[0]
        if count > 1:
            image = np.rint(np.mean(images, axis=0)).astype(image.dtype)
        # A clock that has not ticked since the last picture is moved by the least step.
        later_s = math.nextafter(self._last_time_s, math.inf)
        self._last_time_s = max(pictures[-1].time_s, later_s)
        return Grab(image, self._last_time_s, self._settings.exposure_ms)

    def _sound_picture(self, after_s: float, may_be_black: bool) -> TimedPicture:
        """The next picture that is neither black, unless it may be, nor the last one again."""
        retries = self._options.retries if self._options.live else 0
        fault = ""
        for _ in range(retries + 1):
            picture = self._take(after_s)
            if not (fault := self._fault(picture, may_be_black)):
                self._last = picture.image
                return picture
        raise DeviceError(f"{self._options.name}: {fault}, {retries + 1} times in a row")

    def _take(self, after_s: float) -> TimedPicture:
        picture = self._reader.take(after_s)
        self._read += 1
        return picture

    def _fault(self, picture: TimedPicture, may_be_black: bool) -> str:
        """What is wrong with a picture of the right size; "" where nothing is."""
        image = picture.image
        if picture.file is not None and not is_whole(picture.file):
            self._broken += 1
            return "a JPEG picture that is broken inside; check cable, network and camera"
        if self._options.is_black(image) and not may_be_black:
            exposure_ms = self._settings.exposure_ms
            brightest_dn = grey_dn(image).max()
            said = f"a black picture, brightest pixel {brightest_dn:g} DN at {exposure_ms:g} ms"
            if self._options.black == "refuse":
                return f"{said}; take the cap off, or set camera.options.black = 'accept'"
            _log.warning("%s: %s", self._options.name, said)
        if self._last is not None and self._reader.is_stuck(image, self._last):
            return "sent the picture of the grab before again; plug it in anew"
        return ""

    # ---- opening ------------------------------------------------------------------------

    def _new_reader(self) -> Reader:
        return Reader(self._section, self._options, self._open_capture, self._check_picture)

    def _first_settings(self) -> Settings:
        """The settings of a camera just opened; it is released where they are refused."""
        try:
            settings = self._reader.settings_read_back()
            ignored = "; ".join(str(each) for each in settings.settings if not each.obeyed)
            if ignored and self._options.strict_settings:
                raise DeviceError(
                    f"{self._options.name}: does not do as it is set: {ignored}; "
                    "ask for what it has, or set camera.options.strict_settings = false"
                )
        except DeviceError:
            self._reader.give_up()
            raise
        if ignored:
            _log.warning("%s: does not do as it is set: %s", self._options.name, ignored)
        return settings

    def _device_identity(self) -> str | None:
        return device_identity(self._options.device) or self._options.file

    def _reconnect(self) -> None:
        settings = self._open_anew()
        if (identity := self._device_identity()) != self.identity:
            raise DeviceError(
                f"{self._options.name}: what came back is another camera ({identity or 'unknown'}, "
                f"before {self.identity or 'unknown'}); plug the first one in, or name it by "
                "camera.options.device, then scan with --resume"
            )
        if settings != self._settings:
            changed = zip(settings.settings, self._settings.settings, strict=True)
            others = "; ".join(f"{now}, before {was.got}" for now, was in changed if now != was)
            others = others or f"{settings.exposure_ms:g} ms"
            raise DeviceError(
                f"{self._options.name}: came back with other settings ({others}); "
                "its pictures would not match those before: begin a new scan"
            )

    def _open_anew(self) -> Settings:
        """The settings of the camera, which a new reader opens."""
        self._reader.give_up()
        self._require_open()
        self._read, self._reader = 0, self._new_reader()
        if self._closed.is_set():  # by another thread meanwhile, which knew only the old reader
            self._reader.give_up()
            self._require_open()
        return self._first_settings()

    def _require_open(self) -> None:
        if self._closed.is_set():
            raise DeviceError(f"{self._options.name}: is closed")

    def _check_picture(self, raw: object) -> Picture:
        """The picture, if it is what a run can hold and what the rig says: DeviceError."""
        image = np.asarray(raw)
        if image.ndim == 3 and image.shape[2] == 1:
            image = image[:, :, 0]
        bits = self._section.bits
        advice = "ask for another camera.options.pixel_format"
        require_rigs_picture(image, self._section, self._options.name, lambda: advice)
        self._shape = self._shape or image.shape
        if image.shape != self._shape:
            raise DeviceError(
                f"{self._options.name}: pictures change from shape {self._shape} to "
                f"{image.shape}; set camera.options.pixel_format, then scan with --resume"
            )
        try:
            return image if bits == 8 else aligned(image, bits, where=self._options.name)
        except InputError as error:
            raise DeviceError(str(error)) from error


def _rgb(image: Picture) -> Picture:
    """The picture as RGB, or grey, in memory of its own."""
    if image.ndim == 2:
        return image.copy()
    return cast(Picture, cv2.cvtColor(image, cv2.COLOR_BGR2RGB))


# The driver of the entry point ``opencv``: checks the options, opens the camera.


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
            what = "a video file does not see the laser being switched"
            where = f"{rig_file.source}: plan.laser"
            allowed = "untouched, on; or a camera.options.device or url"
            raise InputError(what, where=where, value=rig_file.rig.plan.laser, allowed=allowed)

    def capabilities(self, rig_file: RigFile) -> dict[str, Fact]:
        """Where its pictures come from, and whether its exposure can be set."""
        options = self._options(rig_file)
        kind = "device" if options.device is not None else "url" if options.url else "file"
        return {kind: str(getattr(options, kind)), "exposure_settable": options.exposure_settable}

    def open(self, rig_file: RigFile, track: Track) -> OpencvCamera:
        """The camera, ready to grab; DeviceError where it is not as the rig file says."""
        return OpencvCamera(rig_file.rig.camera, self._options(rig_file))

    def _options(self, rig_file: RigFile) -> OpencvOptions:
        section, where = rig_file.rig.camera, rig_file.source
        options = check(OpencvOptions, section.options, where=where, prefix="camera.options")
        if options.file is not None and not os.path.isfile(options.file):  # noqa: PTH113
            what = "camera.options.file: no such file"
            allowed = "a video, its path counted from the rig file's folder"
            raise InputError(what, where=where, value=options.file, allowed=allowed)
        return options


camera_driver = OpencvCameraDriver()
