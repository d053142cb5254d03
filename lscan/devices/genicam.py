"""An industrial camera: GenICam over GigE Vision or USB3 Vision, by viva-genicam."""

import importlib
import logging
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from lscan.config.documents import Strict, check
from lscan.config.rig import CameraSection, RigFile
from lscan.devices.api import LONGEST_GRAB_S, Fact, Grab, Track, require_rigs_picture
from lscan.errors import DeviceError, InputError
from lscan.files.pictures import aligned
from lscan.records import Picture

SOFTWARE, FREE = "Software", "off"
SEARCH_MS = 1000
"""How long cameras on the network are given to answer: the standard asks for a second at most."""
SLICE_MS = 100
"""A wait for a picture is cut into these, so that closing the camera ends it."""
USUAL_TICKS_HZ = 1e9
"""Of the clock of a camera that does not state it: USB3 Vision counts nanoseconds."""

_log = logging.getLogger(__name__)

Offset = Annotated[int, Field(ge=0, le=100_000)]


class GenicamOptions(Strict):
    """Which camera, how it is set, and how a picture is asked for.

    One of: address, the IPv4 or hardware address of a GigE camera; serial, the serial number of a
    USB3 camera.  interface: of this machine, by address or name, that the camera is behind.
    offset_px: of the picture on the sensor, its size being the rig's.  pixel_format: as the camera
    names it, such as "Mono12"; gain: mostly in dB; features: any other feature of the camera by
    name.  What is left out is left as the camera has it, its automatics excepted.
    trigger: "Software", with which each picture is asked for; a line, such as "Line1", that
    triggers it; "off", where the camera goes on by itself: ``flush_frames`` pictures are then
    dropped after the call, since they may have been exposed before it.
    retries: pictures in a row that lost packets or did not come within ``timeout_s`` before giving
    up.  packet_bytes, packet_delay_us: of GigE packets, and between two of them.
    """

    address: Annotated[str, Field(pattern=r"^[0-9a-fA-F.:]+$")] | None = None
    serial: Annotated[str, Field(min_length=1)] | None = None
    interface: Annotated[str, Field(min_length=1)] | None = None
    offset_px: tuple[Offset, Offset] = (0, 0)
    pixel_format: Annotated[str, Field(min_length=1)] | None = None
    gain: Annotated[float, Field(ge=-1000, le=1e6)] | None = None
    features: dict[str, bool | int | float | str] = Field(default_factory=dict)
    trigger: Annotated[str, Field(min_length=1)] = SOFTWARE
    flush_frames: Annotated[int, Field(ge=0, le=100)] = 2
    retries: Annotated[int, Field(ge=0, le=1000)] = 3
    timeout_s: Annotated[float, Field(ge=0.05, le=600)] = 5.0
    packet_bytes: Annotated[int, Field(ge=576, le=16_000)] | None = None
    packet_delay_us: Annotated[float, Field(ge=0, le=1e6)] | None = None

    @model_validator(mode="after")
    def _one_camera(self) -> Self:
        if (self.address is None) == (self.serial is None):
            raise ValueError("needs exactly one of address and serial")
        return self

    @property
    def name(self) -> str:
        """What messages call the camera."""
        return f"camera genicam ({self.address or self.serial})"


Connect = Callable[[GenicamOptions], Any]


def viva_genicam() -> Any:
    """The package that speaks to the cameras; DeviceError where it is not installed."""
    try:
        return importlib.import_module("viva_genicam")
    except ImportError as error:
        what = f"camera genicam: viva-genicam is missing ({error}): pip install 'lscan[genicam]'"
        raise DeviceError(what) from error


def found_cameras() -> dict[str, str] | None:
    """Maker and model of each camera that answers, by what ``address`` or ``serial`` may name.

    None where viva-genicam is not installed.
    """
    try:
        viva = viva_genicam()
    except DeviceError:
        return None
    try:  # where the system has no USB, that is an error
        on_usb = viva.discover_u3v()
    except viva.GenicamError:
        on_usb = []
    every = {camera.ip: camera for camera in viva.discover(SEARCH_MS)}
    every |= {camera.serial: camera for camera in on_usb if camera.serial}
    return {key: f"{camera.manufacturer} {camera.model}" for key, camera in every.items()}


def connect(options: GenicamOptions) -> Any:
    """The camera that ``options`` name, under this program's control; DeviceError."""
    viva = viva_genicam()
    try:
        if options.serial is not None:
            cameras = {camera.serial: camera for camera in viva.discover_u3v()}
            wanted = options.serial
        else:
            found = viva.discover(SEARCH_MS, options.interface, all=True)
            cameras = {name: each for each in found for name in (each.ip, each.mac.lower())}
            wanted = (options.address or "").lower()
        if wanted not in cameras:
            others = ", ".join(sorted(str(name) for name in cameras)) or "none"
            raise DeviceError(
                f"{options.name}: no such camera answers; others: {others}; check power and cable, "
                "and that a GigE camera is in the subnet of one of this machine's addresses"
            )
        return viva.Camera.open(cameras[wanted])
    except viva.GenicamError as error:
        raise DeviceError(f"{options.name}: {error}") from error


class GenicamCamera:
    """A GenICam camera, each of whose pictures is exposed after it was asked for.

    Parameters
    ----------
    section : CameraSection, size, bits and exposure of the rig's camera
    options : GenicamOptions, which camera, how it is set, and how a picture is asked for
    connect : callable, a ``viva_genicam.Camera`` by the options

    Raises
    ------
    DeviceError
        It cannot be found or opened, or does not take a setting.

    References
    ----------
    Names of features: SFNC 2.7 of the European Machine Vision Association.
    """

    def __init__(
        self, section: CameraSection, options: GenicamOptions, connect: Connect = connect
    ) -> None:
        self._section, self._options = section, options
        self._lock, self._closed = threading.Lock(), threading.Event()
        self._last_time_s, self._lost = -math.inf, 0
        self._camera = connect(options)
        self._error = viva_genicam().GenicamError
        try:
            with self._failures_told():
                self._features = frozenset(self._camera.nodes())
                self.can_set_exposure = any(name.startswith("Exposure") for name in self._features)
                self._exposure_ms = self._set_up()
                self._ticks_hz = self._stated_ticks_hz()
                names = ("DeviceVendorName", "DeviceModelName", "DeviceSerialNumber")
                known = [self._camera.get(name) for name in names if name in self._features]
                self.identity = " ".join(known) or options.serial
                """Maker, model and serial number, as far as the camera says them."""
                delay_us = options.packet_delay_us
                self._stream = self._camera.stream(
                    iface=options.interface,
                    packet_size=options.packet_bytes,
                    packet_delay_ns=None if delay_us is None else round(1000 * delay_us),
                    deliver_incomplete=True,
                ).__enter__()
        except DeviceError:
            self._camera.close()
            raise

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) of every picture."""
        return self._section.size_px

    @property
    def longest_grab_s(self) -> float:
        """How long a grab takes at most while nothing is amiss, s; longer, and the laser goes off.

        The exposure of each picture, and LONGEST_GRAB_S to spare.
        """
        return LONGEST_GRAB_S + (1 + self._options.flush_frames) * self._exposure_ms / 1000

    def set_exposure(self, exposure_ms: float) -> float:
        """The exposure time as read back after setting it, ms.

        Parameters
        ----------
        exposure_ms : float, ms

        Raises
        ------
        DeviceError
            The camera does not take it.
        """
        with self._lock, self._failures_told():
            self._require_open()
            self._exposure_ms = self._set_exposure(exposure_ms)
        return self._exposure_ms

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        """A picture exposed after this call began; one that lost packets is taken again.

        Parameters
        ----------
        frame : int or None, not used
        dark : bool, not used: a dark picture is one like any other

        Raises
        ------
        DeviceError
            No whole picture can be had.
        """
        fault = ""
        with self._lock, self._failures_told():
            for _ in range(1 + self._options.retries):
                picture = self._next_frame()
                if picture is not None and picture.is_complete:
                    return self._grabbed(picture)
                fault = f"no picture within {self._options.timeout_s:g} s"
                if picture is not None:
                    self._lost += 1
                    fault = f"a picture lost {picture.missing_packets or 'some'} of its packets"
        raise DeviceError(
            f"{self._options.name}: {fault}, {1 + self._options.retries} times in a row; check "
            "cable and power, that its trigger is given, and of a GigE camera packet_delay_us"
        )

    def preview(self) -> Grab:
        """A picture to be looked at; a grab of another thread is waited for."""
        return self.grab()

    def close(self) -> None:
        """Let go of the camera; closing twice is harmless.  A grab under way elsewhere fails."""
        if self._closed.is_set():
            return
        self._closed.set()
        with self._lock:
            again = 0
            with suppress(self._error):
                again = self._stream.stats().resend_recovered
            for let_go in (lambda: self._stream.__exit__(None, None, None), self._camera.close):
                try:
                    let_go()
                except self._error as error:  # it may be gone
                    _log.warning("%s: %s", self._options.name, error)
        if self._lost or again:
            what = "%s: %d pictures that lost packets were taken again; %d packets were sent again"
            _log.warning(what, self._options.name, self._lost, again)

    # ---- taking pictures ----------------------------------------------------------------

    def _next_frame(self) -> Any:
        """The next picture exposed after this call began; None where none comes in time."""
        while self._arrived(1) is not None:  # of before
            pass
        if self._options.trigger == SOFTWARE:
            self._camera.trigger_software()
        deadline_s = time.monotonic() + self._options.timeout_s
        due = 1 + (self._options.flush_frames if self._options.trigger == FREE else 0)
        while time.monotonic() < deadline_s:
            picture = self._arrived(SLICE_MS)
            due -= picture is not None
            if due == 0:
                return picture
        return None

    def _arrived(self, wait_ms: int) -> Any:
        """A picture that has come; None where none comes within ``wait_ms``."""
        self._require_open()
        try:
            return self._stream.next_frame(wait_ms)
        except self._error as error:
            if "timeout" in str(error):
                return None
            raise

    def _grabbed(self, picture: Any) -> Grab:
        # A clock that has not ticked since the last picture is moved by the least step.
        ticks = picture.ts_dev
        time_s = time.monotonic() if ticks is None else ticks / self._ticks_hz
        self._last_time_s = max(time_s, math.nextafter(self._last_time_s, math.inf))
        image = self._check_picture(picture.to_numpy(demosaic=True), picture.pixel_format)
        exposed_us = self._camera.chunk_features(picture).get("ChunkExposureTime")
        exposure_ms = float(exposed_us) / 1000 if isinstance(exposed_us, str) else self._exposure_ms
        return Grab(image, self._last_time_s, exposure_ms)

    def _check_picture(self, image: Any, pixel_format: str) -> Picture:
        """The picture, if it is what a run can hold and what the rig says: DeviceError."""
        bits, name = self._section.bits, self._options.name

        def advice() -> str:
            offered = ", ".join(self._camera.available_enum_entries("PixelFormat"))
            return f"it is {pixel_format}; camera.options.pixel_format may be: {offered}"

        require_rigs_picture(image, self._section, name, advice)
        try:
            return image if bits == 8 else aligned(image, bits, where=f"{name}: {pixel_format}")
        except InputError as error:
            raise DeviceError(str(error)) from error

    # ---- opening ------------------------------------------------------------------------

    def _set_up(self) -> float:
        """Set the camera as the rig says; its exposure time as read back, ms."""
        camera, options, section = self._camera, self._options, self._section
        if "AcquisitionMode" in self._features:
            camera.set_acquisition_mode("Continuous")
        for name, value in options.features.items():
            camera.set(name, str(value).lower() if isinstance(value, bool) else str(value))
        if options.pixel_format is not None:
            camera.set_enum("PixelFormat", options.pixel_format)
        wanted = viva_genicam().Roi(*options.offset_px, *section.size_px)
        if camera.roi() != wanted:
            camera.set_roi(wanted)
        if options.gain is not None:
            self._switch_off("GainAuto")
            camera.set_gain(options.gain)
        if options.trigger != FREE:
            camera.enable_trigger("FrameStart", options.trigger)
        elif "TriggerMode" in self._features:
            camera.disable_trigger("FrameStart")
        if "ChunkExposureTime" in self._features:
            camera.configure_chunks(["ExposureTime"])
        if not self.can_set_exposure:
            _log.warning("%s: has no exposure time; the rig's is recorded", options.name)
            return section.exposure_ms
        self._switch_off("ExposureAuto")
        return self._set_exposure(section.exposure_ms)

    def _switch_off(self, automatic: str) -> None:
        if automatic in self._features:
            self._camera.set_enum(automatic, "Off")

    def _set_exposure(self, exposure_ms: float) -> float:
        feature = self._camera.set_exposure_time(1000 * exposure_ms)
        if "Raw" in feature:
            what = f"{self._options.name}: counts its exposure in units of its own ({feature})"
            raise DeviceError(what)
        return float(self._camera.exposure_time()) / 1000

    def _stated_ticks_hz(self) -> float:
        name = "GevTimestampTickFrequency"
        stated = self._camera.get_integer(name) if name in self._features else 0
        return float(stated) or USUAL_TICKS_HZ

    def _require_open(self) -> None:
        if self._closed.is_set():
            raise DeviceError(f"{self._options.name}: is closed")

    @contextmanager
    def _failures_told(self) -> Iterator[None]:
        """Errors of viva-genicam within the block as DeviceError."""
        try:
            yield
        except self._error as error:
            raise DeviceError(f"{self._options.name}: {error}") from error


# The driver of the entry point ``genicam``: checks the options, opens the camera.


class GenicamCameraDriver:
    """Registered as "genicam" under ``lscan.cameras``."""

    sections: frozenset[str] = frozenset()
    takes_dark = True
    connection_options = frozenset(
        {"address", "interface", "timeout_s", "retries", "packet_bytes", "packet_delay_us"}
    )

    def validate(self, rig_file: RigFile) -> None:
        """Check the options, touching no device: InputError."""
        self._options(rig_file)

    def capabilities(self, rig_file: RigFile) -> dict[str, Fact]:
        """Which camera it is, and how its pictures are triggered."""
        options = self._options(rig_file)
        key = "address" if options.serial is None else "serial"
        return {key: getattr(options, key), "trigger": options.trigger, "exposure_settable": True}

    def open(self, rig_file: RigFile, track: Track) -> GenicamCamera:
        """The camera, ready to grab; DeviceError where it is not as the rig file says."""
        return GenicamCamera(rig_file.rig.camera, self._options(rig_file))

    def _options(self, rig_file: RigFile) -> GenicamOptions:
        section, where = rig_file.rig.camera, rig_file.source
        return check(GenicamOptions, section.options, where=where, prefix="camera.options")


camera_driver = GenicamCameraDriver()
