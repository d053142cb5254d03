"""Sections of a scene file about the instrument: lens, port, head, laser, sensor.

Lengths mm, angles degrees, wavelengths nm, as in the file.
"""

from functools import lru_cache
from math import exp, hypot, pi
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Discriminator, Field, NonNegativeFloat, PositiveFloat, Tag, model_validator

from lscan.config.documents import Strict
from lscan.config.rig import LensKind
from lscan.records import Floats

FULL_SCALE_DN = 255.0
"""The brightest value of a pixel: of 8 bit."""

Vector = tuple[float, float, float]
Fraction = Annotated[float, Field(ge=0, le=1)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]
SmallAngle = Annotated[float, Field(gt=-45, lt=45)]
# A number, or a material whose dispersion sim.water knows.
Glass = Annotated[float, Field(ge=1, le=2.5)] | Literal["N-BK7", "fused silica", "PMMA"]


class Lens(Strict):
    """Pinhole with distortion as OpenCV writes it, in px of the picture.

    model: "brown" (k1 to k3, p1, p2), "rational" (k4 to k6 too) or "fisheye", by the angle off
    the axis instead of its tangent (k1 to k4).
    vignetting: the exponent of the cosine with which light falls off the axis; 4 is the
    natural law.  focus_mm: distance from the pinhole, in air and along the axis, that is
    sharp; nothing is blurred by defocus where it is left out.  blur_px: standard deviation
    of the point spread's core, taken as Gaussian; ``glare`` of the light is spread by a
    second Gaussian of ``glare_px``.
    """

    model: LensKind = "brown"
    focal_px: PositiveFloat
    centre_px: tuple[float, float]
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    f_number: Annotated[float, Field(ge=0.5, le=64)] = 2.8
    transmission: Fraction = 0.85
    vignetting: Annotated[float, Field(ge=0, le=8)] = 4.0
    focus_mm: PositiveFloat | None = None
    blur_px: Annotated[float, Field(ge=0, le=1000)] = 0.7
    glare: Annotated[float, Field(ge=0, lt=1)] = 0.0
    glare_px: Annotated[float, Field(gt=0, le=1000)] = 20.0

    @model_validator(mode="after")
    def _coefficients_of_its_model(self) -> Self:
        foreign = {"brown": ("k4", "k5", "k6"), "fisheye": ("k5", "k6", "p1", "p2")}
        for name in foreign.get(self.model, ()):
            if getattr(self, name):
                raise ValueError(f'{name} is no coefficient of model = "{self.model}"')
        return self


class PlanePort(Strict):
    """Flat port: ``gap_mm`` of air from pinhole to glass along its normal, then the glass.

    The normal is the camera's axis turned by the tilts about the camera's x and y.
    """

    kind: Literal["flat"] = "flat"
    gap_mm: PositiveFloat = 10.0
    thickness_mm: PositiveFloat = 6.0
    glass_index: Glass = 1.488  # PMMA, docs/explanation/physics.md, section 1
    tilt_x_deg: SmallAngle = 0.0
    tilt_y_deg: SmallAngle = 0.0


class DomePort(Strict):
    """Spherical port: air inside ``radius_mm``, then ``thickness_mm`` of glass.

    centre_mm: the dome's centre from the pinhole, camera frame (x right, y down, z ahead).
    """

    kind: Literal["dome"]
    radius_mm: PositiveFloat = 50.0
    thickness_mm: PositiveFloat = 4.0
    glass_index: Glass = 1.488
    centre_mm: Vector = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _pinhole_inside(self) -> Self:
        if sum(c * c for c in self.centre_mm) >= (0.9 * self.radius_mm) ** 2:
            raise ValueError("centre_mm must lie within 0.9 radius_mm of the pinhole")
        return self


def _port_kind(value: Any) -> Any:
    """ "flat" where the file does not say which kind of port it is."""
    return value.get("kind", "flat") if isinstance(value, dict) else getattr(value, "kind", None)


Port = Annotated[
    Annotated[PlanePort, Tag("flat")] | Annotated[DomePort, Tag("dome")], Discriminator(_port_kind)
]


class TrueShaft(Strict):
    """The shaft that the tank's head truly turns about, in the head frame of position 0.

    point_mm: a point of it.  direction: along it, right-hand rule, of any length.
    arc_radius_mm: a position divided by it is the angle in rad; the rig's if left out.
    """

    point_mm: Vector
    direction: Vector
    arc_radius_mm: PositiveFloat | None = None

    @model_validator(mode="after")
    def _has_direction(self) -> Self:
        if hypot(*self.direction) < 1e-9:
            raise ValueError("direction must not be zero")
        return self


class Head(Strict):
    """Where the camera sits in the head, and how the head sits on the track.

    camera_mm: the pinhole.  The axis lies ``depression_deg`` below the horizon, turned by
    ``heading_deg`` about z (positive to the left), the camera rolled by ``roll_deg`` about it.
    yaw_deg: the head's plane y = 0 against the track, which runs along
    (sin yaw, cos yaw, 0) of the head.
    turn_deg, shift_mm: how the head is turned about its own x, y and z (first about x, then y,
    then z), about ``pivot_mm`` of it, and shifted in the world, against where the track ought to
    hold it; a board stays where it is.
    speed_mm_s: how fast the head moves along the track while a picture is taken; 0: it stands.
    shaft: what the head truly turns about, where the rig has a ``[shaft]``; the rig's if left
    out.
    """

    camera_mm: Vector
    depression_deg: Annotated[float, Field(gt=-90, lt=90)] = 30.0
    heading_deg: float = 0.0
    roll_deg: float = 0.0
    yaw_deg: SmallAngle = 0.0
    turn_deg: tuple[SmallAngle, SmallAngle, SmallAngle] = (0.0, 0.0, 0.0)
    shift_mm: Vector = (0.0, 0.0, 0.0)
    pivot_mm: Vector = (0.0, 0.0, 0.0)
    speed_mm_s: Annotated[float, Field(ge=-1e4, le=1e4)] = 0.0
    shaft: TrueShaft | None = None


class LaserLine(Strict):
    """One of several sheets: leans by ``tilt_deg`` more, and has this share of the power."""

    tilt_deg: SmallAngle
    share: Annotated[float, Field(gt=0, le=1)]


class Drift(Strict):
    """A diode that warms up: by ``rise_c``, ``nm_per_c`` each, with the time constant ``time_s``.

    0.2 to 0.3 nm a degree is usual for red diodes (recalled, not sourced).
    """

    nm_per_c: float = 0.2
    rise_c: Annotated[float, Field(ge=-50, le=50)] = 10.0
    time_s: PositiveFloat = 300.0


class Laser(Strict):
    """A laser sheet that opens from ``apex_mm`` of the head, Gaussian across its thickness.

    The fan's axis points down, turned by ``aim_deg`` towards +x; the sheet is then leant by
    ``tilt_deg`` about x (its lower part towards +y) and turned by ``skew_deg`` about z, both
    about the apex.  An apex in y = 0 without tilt and skew puts it in the head's plane y = 0,
    the board's; anything else is a misalignment.
    waist_mm is the 1/e2 half thickness at ``waist_distance_mm`` from the apex; m2 the beam
    quality of its divergence.
    fan "uniform": a Powell lens, its power per angle higher by ``fan_rise`` at the edges than
    in the middle; "gaussian": a cylinder lens, the fan's half angle being the 1/e2 half width
    of its power, cut off there.
    port_tilt_deg: the laser's window against the sheet: where it is not 0 the sheet is bowed
    (sim.render.plugins.sheet).  lines: several sheets of one diode; one straight sheet if empty.
    """

    power_mw: Annotated[float, Field(gt=0, le=1e5)]
    wavelength_nm: Annotated[float, Field(ge=450, le=700)] = 650.0
    drift: Drift | None = None
    apex_mm: Vector
    aim_deg: float = 0.0
    tilt_deg: SmallAngle = 0.0
    skew_deg: SmallAngle = 0.0
    fan_half_angle_deg: Annotated[float, Field(gt=0, lt=80)] = 35.0
    fan: Literal["uniform", "gaussian"] = "uniform"
    fan_rise: Annotated[float, Field(gt=-0.9, le=5)] = 0.0
    waist_mm: PositiveFloat = 1.5
    waist_distance_mm: float = 600.0
    m2: Annotated[float, Field(ge=1)] = 1.0
    port_tilt_deg: SmallAngle = 0.0
    lines: tuple[LaserLine, ...] = ()
    on: bool = True

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        total = sum(line.share for line in self.lines)
        if total > 1 + 1e-9:
            raise ValueError(f"lines: the shares of the power add up to {total:g}, more than 1")
        warm_nm = self.wavelength_nm
        if self.drift is not None:
            warm_nm += self.drift.nm_per_c * self.drift.rise_c
        if not 450 <= warm_nm <= 700:
            raise ValueError(f"drift: warms up to {warm_nm:g} nm (allowed: 450 to 700)")
        if self.fan_rise != 0 and self.fan != "uniform":
            raise ValueError('fan_rise goes with fan = "uniform" only')
        return self

    @property
    def sheets(self) -> tuple[LaserLine, ...]:
        """The sheets there are: ``lines``, or one that holds all the power."""
        return self.lines or (LaserLine(tilt_deg=0.0, share=1.0),)

    def half_thickness_mm(self, distance_mm: Floats, water_index: float) -> Floats:
        """1/e2 half thickness of the sheet, that of a Gaussian beam, mm; same shape.

        Parameters
        ----------
        distance_mm : array, mm, from the apex
        water_index : float, refractive index of the water

        References
        ----------
        docs/explanation/physics.md, section 4.
        """
        rayleigh_mm = pi * self.waist_mm**2 * water_index / (self.wavelength_nm * 1e-6 * self.m2)
        off_waist = (distance_mm - self.waist_distance_mm) / rayleigh_mm
        return self.waist_mm * np.hypot(1.0, off_waist)

    def wavelength_at(self, time_s: float) -> float:
        """Wavelength, nm.

        Parameters
        ----------
        time_s : float, s since the laser was switched on
        """
        if self.drift is None:
            return self.wavelength_nm
        warmed = self.drift.rise_c * (1 - exp(-time_s / self.drift.time_s))
        return self.wavelength_nm + self.drift.nm_per_c * warmed


class Response(Strict):
    """Quantum efficiency of the red, green and blue pixels to one kind of light."""

    red: Fraction
    green: Fraction
    blue: Fraction


RESPONSES = (
    (400.0, 0.0, 0.0, 0.001),
    (420.0, 0.036, 0.052, 0.223),
    (440.0, 0.042, 0.13, 0.515),
    (460.0, 0.027, 0.187, 0.563),
    (480.0, 0.033, 0.325, 0.489),
    (500.0, 0.03, 0.418, 0.294),
    (520.0, 0.059, 0.612, 0.124),
    (540.0, 0.043, 0.604, 0.053),
    (560.0, 0.023, 0.47, 0.016),
    (580.0, 0.295, 0.288, 0.006),
    (600.0, 0.5, 0.11, 0.003),
    (620.0, 0.46, 0.046, 0.003),
    (640.0, 0.42, 0.034, 0.005),
    (650.0, 0.4, 0.03, 0.01),
    (680.0, 0.34, 0.048, 0.013),
    (700.0, 0.3, 0.042, 0.011),
)
"""Quantum efficiency of red, green and blue pixels by wavelength in nm, see response_at."""


def response_at(wavelength_nm: float) -> Response:
    """What the pixels of a webcam without an infrared filter make of laser light.

    Parameters
    ----------
    wavelength_nm : float, nm, 400 to 700; linear between the rows of RESPONSES

    References
    ----------
    The colours' curves are those measured of a Nikon D5100: M. M. Darrodi, G. Finlayson, T. Goodman
    and M. Mackiewicz, J. Opt. Soc. Am. A 32, 381 (2015), responses to power, each divided by its
    largest.  Taken per photon here, their peaks have the efficiency 0.563 at 460 nm, 0.64 at 530 nm
    and 0.51 at 595 nm: estimated, as those of a design whose camera states none.  From 600 nm on,
    where that camera's infrared filter sets in, red falls to 0.4 at 650 nm and 0.3 at 700 nm, also
    estimated, and green and blue keep their measured ratio to it.  At 650 nm the numbers are those
    of scenes/paper, 0.4, 0.03 and 0.01, where the ratios give 0.031 and 0.007.
    """
    nm, *colours = np.transpose(RESPONSES)
    red, green, blue = (float(np.interp(wavelength_nm, nm, colour)) for colour in colours)
    return Response(red=red, green=green, blue=blue)


class Sensor(Strict):
    """EMVA 1288 linear model of a webcam's sensor, and what follows it.

    See docs/explanation/physics.md, section 5.

    gain: 1 puts the full well at 255 DN.  gamma: the camera's; 1 is linear, a webcam has 2.2.
    prnu, dsnu_e: spread of the pixels' sensitivities, and of their offsets in electrons.
    hot_pixels: the share of pixels that show ``hot_e`` electrons more.
    speckle: of the laser's light; "depolarised" where the target turns its polarisation, as
    matt ones do.  bayer: pattern of the colour filter, from the top-left pixel; "none": every
    pixel sees all three colours.  jpeg_quality: the picture has been through MJPEG.
    readout_ms: a rolling shutter's time from the first row's to the last row's.
    clips_dn: grey value at which the camera's range ends; some end early.  frame_dn: grey value of
    a frame, one pixel wide, that a capture program draws around the picture; None: no frame.
    laser_response: of a scene that states none, that at its laser's nominal wavelength.
    """

    pixel_um: PositiveFloat = 6.0
    full_well_e: PositiveFloat = 15000.0
    dark_noise_e: NonNegativeFloat = 53.0
    prnu: Annotated[float, Field(ge=0, le=0.2)] = 0.01
    dsnu_e: NonNegativeFloat = 0.0
    hot_pixels: Annotated[float, Field(ge=0, le=0.1)] = 0.0
    hot_e: NonNegativeFloat = 3000.0
    speckle: Literal["none", "polarised", "depolarised"] = "none"
    gain: PositiveFloat = 1.0
    black_level_dn: Annotated[float, Field(ge=0, lt=255)] = 2.0
    gamma: Annotated[float, Field(ge=1, le=3)] = 1.0
    bayer: Literal["none", "RGGB", "BGGR", "GRBG", "GBRG"] = "none"
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] | None = None
    jpeg_subsampling: Literal["4:4:4", "4:2:2", "4:2:0"] = "4:2:0"
    readout_ms: Annotated[float, Field(ge=0, le=1000)] = 0.0
    clips_dn: Annotated[int, Field(ge=1, le=255)] = 255
    frame_dn: Annotated[int, Field(ge=0, le=255)] | None = None
    laser_response: Response = response_at(650.0)
    ambient_response: Response = Response(red=0.30, green=0.33, blue=0.28)
    noise: bool = True
    seed: Seed = 1

    @model_validator(mode="after")
    def _has_range(self) -> Self:
        black_dn = FULL_SCALE_DN * (self.black_level_dn / FULL_SCALE_DN) ** (1 / self.gamma)
        if self.clips_dn <= black_dn:
            raise ValueError(f"clips_dn = {self.clips_dn} is not above black, {black_dn:g} DN")
        return self


# Whether a lens images its whole picture, or its distortion folds before the border.
#
# A distortion polynomial has no inverse far off the axis.  A place of the picture is imaged where
# the straight way to it from the axis can be followed in undistorted tangents, along which two
# things are positive: the Jacobian's determinant of the whole distortion, and the growth of its
# radial part, beyond whose turn neither truth nor instrument follow a lens.
#
# Tangents are complex here, z = x + i y.  With q = |z|2 and P = p2 + i p1 the distortion (Brown
# 1971, Conrady 1919, as OpenCV writes it) is z R(q) + conj(P) z2 + 2 P q; of a fisheye, R is the
# distorted angle over the tangent of the angle (Kannala & Brandt 2006).  Its derivatives by z and
# by conj(z) are a = R + q R' + 4 Re(conj(P) z), which is real, and b = z2 R' + 2 P z; the
# determinant is a2 - |b|2.


Complexes = NDArray[np.complex128]

ALONG_BORDER = 17  # places on each side of the picture, its corners among them
STEPS = 16  # of the way from the axis to each place
# Iterations a step, at most: each halves the error close to a fold, and leaves two thirds of it
# where the distortion hardly grows: 3e-6 in the end.
NEWTON = 32
BETWEEN = np.arange(1, 5).reshape(-1, 1) / 4  # where the way is looked at within a step
FOUND_PX = 1e-3


@lru_cache(maxsize=256)  # a scene is read many times
def is_folded(lens: Lens, width_px: int, height_px: int) -> bool:
    """Whether the distortion folds somewhere in the picture, its outermost edge included.

    Parameters
    ----------
    lens : Lens, whose distortion is meant
    width_px, height_px : int, px, of the picture
    """
    u = np.linspace(-0.5, width_px - 0.5, ALONG_BORDER)
    v = np.linspace(-0.5, height_px - 0.5, ALONG_BORDER)
    sides = np.concatenate([u + 1j * v[0], u + 1j * v[-1], u[0] + 1j * v, u[-1] + 1j * v])
    border = np.asarray((sides - complex(*lens.centre_px)) / lens.focal_px)  # distorted tangents
    found = np.zeros_like(border)
    with np.errstate(all="ignore"):  # beyond a fold Newton's method goes anywhere, or to NaN
        for part in np.arange(1, STEPS + 1) / STEPS:
            before = found
            for _ in range(NEWTON):
                found = found - (step := _newton_step(lens, found, part * border))
                if not (np.abs(step) * lens.focal_px > FOUND_PX).any():
                    break  # most lenses settle in a few
            off_px = np.abs(_distort(lens, found) - part * border) * lens.focal_px
            # Neither the Jacobian's determinant nor the growth of the distorted radius may vanish.
            between = before + BETWEEN * (found - before)
            by_z, by_conjugate = _derivatives(lens, between)
            q, radial, slope, _ = _terms(lens, between)
            grows = (by_z**2 > np.abs(by_conjugate) ** 2) & (radial + 2 * q * slope > 0)
            if not (np.all(off_px < FOUND_PX) and np.all(grows)):
                return True
    return False


def _terms(lens: Lens, z: Complexes) -> tuple[Floats, Floats, Floats, complex]:
    """q, R, R' and P."""
    q, k1, k2, k3, k4 = z.real**2 + z.imag**2, lens.k1, lens.k2, lens.k3, lens.k4
    decentring = complex(lens.p2, lens.p1)
    if lens.model == "fisheye":
        tangent = np.maximum(np.sqrt(q), 1e-5)  # nearer to the axis the slope would lose its digits
        s = np.arctan(tangent) ** 2
        radial = np.sqrt(s) / tangent * (1 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
        growth = 1 + s * (3 * k1 + s * (5 * k2 + s * (7 * k3 + s * 9 * k4)))
        return q, radial, (growth / (1 + tangent**2) - radial) / (2 * tangent**2), decentring
    radial = 1 + q * (k1 + q * (k2 + q * k3))
    below = 1 + q * (k4 + q * (lens.k5 + q * lens.k6))
    slope, sinks = k1 + q * (2 * k2 + q * 3 * k3), k4 + q * (2 * lens.k5 + q * 3 * lens.k6)
    return q, radial / below, (slope - radial / below * sinks) / below, decentring


def _distort(lens: Lens, z: Complexes) -> Complexes:
    q, radial, _, decentring = _terms(lens, z)
    return z * radial + decentring.conjugate() * z**2 + 2 * decentring * q


def _derivatives(lens: Lens, z: Complexes) -> tuple[Floats, Complexes]:
    """By z and by conj(z)."""
    q, radial, slope, decentring = _terms(lens, z)
    by_z = radial + q * slope + 4 * (decentring.conjugate() * z).real
    return by_z, z**2 * slope + 2 * decentring * z


def _newton_step(lens: Lens, z: Complexes, distorted: Complexes) -> Complexes:
    """By how much z is too large, to first order."""
    by_z, by_conjugate = _derivatives(lens, z)
    off = _distort(lens, z) - distorted
    return (by_z * off - by_conjugate * off.conj()) / (by_z**2 - np.abs(by_conjugate) ** 2)
