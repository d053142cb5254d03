"""A catalogue of parts that a rig is made from: cameras, lenses, lasers, windows and tracks."""

from fnmatch import fnmatchcase
from math import atan, degrees, erf, hypot, sqrt
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from lscan.config.documents import Strict, check, read_document
from lscan.config.rig import Pixels
from lscan.config.scenes import CATALOGUE, FOLDERS, scenes_folder
from lscan.errors import InputError
from sim.scene import Laser
from sim.scene.errors import TrackErrors
from sim.scene.instrument import Fraction, Glass, Seed

Standing = Literal["data sheet", "recalled", "estimated"]
Mount = Literal["C", "CS", "M12"]
Year = Annotated[int, Field(ge=1900, le=2100)]
TAKES: dict[Mount, tuple[Mount, ...]] = {"C": ("C",), "CS": ("C", "CS"), "M12": ("M12",)}
"""The lenses' mounts that go on a camera's; a ring of 5 mm puts a C lens on a CS camera."""


class PartSource(Strict):
    """Where figures of a part are from: a document or page of its maker's, unless named so."""

    title: str
    year: Year | None = None
    url: str | None = None


class Price(Strict):
    """What a part costs.  standing: how the figure is known; prices of shops are "recalled"."""

    eur: NonNegativeFloat
    year: Year
    standing: Standing


class Part(Strict):
    """What all parts have.

    standing: keys whose figures ``source`` does not give, and how they are known.
    """

    name: Annotated[str, Field(min_length=1)]
    source: Annotated[tuple[PartSource, ...], Field(min_length=1)]
    price: Price
    standing: dict[str, Standing] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _standing_of_stated(self) -> Self:
        stated = self.model_fields_set - Part.model_fields.keys()
        for key in self.standing:
            if key.split(".")[0] not in stated:
                raise ValueError(f"standing: speaks of {key}, which {self.name} does not state")
        return self


class Objective(Strict):
    """What forms the image: ``focal_mm``, or the whole picture's diagonal field of view in air.

    blur_um: standard deviation of the core that aberrations spread a point over, diffraction
    apart; a scene's usual 0.7 px where it is not stated.
    """

    focal_mm: PositiveFloat | None = None
    diagonal_deg: Annotated[float, Field(gt=0, lt=170)] | None = None
    f_number: Annotated[float, Field(ge=0.5, le=64)] = 2.8
    k1: float = 0.0
    k2: float = 0.0
    blur_um: NonNegativeFloat | None = None

    @model_validator(mode="after")
    def _one_scale(self) -> Self:
        if (self.focal_mm is None) == (self.diagonal_deg is None):
            raise ValueError("exactly one of focal_mm and diagonal_deg says how wide it sees")
        return self


class CameraPart(Part):
    """A camera in one of its modes, with a lens of its own (``built_in``) or a mount for one.

    pixel_um: of the mode's pixels, several of the sensor's where it bins.  efficiency: quantum
    efficiency of its pixels, those of the laser's colour, as pairs (wavelength_nm, efficiency).
    readout_ms: of a rolling shutter.
    """

    width_px: Pixels
    height_px: Pixels
    pixel_um: PositiveFloat
    colour: bool
    sensor: str | None = None
    full_well_e: PositiveFloat | None = None
    dark_noise_e: PositiveFloat | None = None
    efficiency: tuple[tuple[PositiveFloat, Fraction], ...] = ()
    readout_ms: NonNegativeFloat = 0.0
    mount: Mount | None = None
    built_in: Objective | None = None

    @model_validator(mode="after")
    def _sees(self) -> Self:
        if (self.mount is None) == (self.built_in is None):
            raise ValueError("exactly one of mount and built_in says which lens it has")
        return self

    @property
    def diagonal_mm(self) -> float:
        """Of the part of the sensor that the picture shows."""
        return hypot(self.width_px, self.height_px) * self.pixel_um * 1e-3


class LensPart(Part, Objective):
    """A lens.  circle_mm: diameter of the image it is made for."""

    focal_mm: PositiveFloat
    diagonal_deg: None = None  # it would be another on every camera
    mount: Mount
    circle_mm: PositiveFloat

    def fits(self, camera: CameraPart) -> bool:
        """Whether it goes on the camera and fills its picture.

        Parameters
        ----------
        camera : CameraPart
        """
        return (
            camera.mount is not None
            and self.mount in TAKES[camera.mount]
            and self.circle_mm >= camera.diagonal_mm
        )


class LaserPart(Part):
    """A line laser.  fan_deg: full angle.  waist_mm: 1/e2 half thickness of the line in focus.

    stated_class: the maker's; ``sim.studies.design.catalogue`` reckons its own.
    """

    power_mw: Annotated[float, Field(gt=0, le=1e5)]
    wavelength_nm: Annotated[float, Field(ge=450, le=700)]
    fan_deg: Annotated[float, Field(gt=0, lt=160)]
    fan: Literal["uniform", "gaussian"] = "uniform"
    waist_mm: PositiveFloat
    stated_class: str | None = None


class WindowPart(Part):
    """A flat window for the camera's housing."""

    thickness_mm: PositiveFloat
    glass_index: Glass


class TrackPart(Part):
    """A track; its errors stand as in a scene's ``[track_errors]``."""

    travel_mm: PositiveFloat
    errors: TrackErrors = TrackErrors()


class Catalogue(Strict):
    """All parts there are to choose from."""

    name: str = "parts"
    camera: tuple[CameraPart, ...]
    lens: tuple[LensPart, ...] = ()
    laser: tuple[LaserPart, ...]
    window: tuple[WindowPart, ...]
    track: tuple[TrackPart, ...]

    @model_validator(mode="after")
    def _names_once(self) -> Self:
        for kind in ("camera", "lens", "laser", "window", "track"):
            names = [part.name for part in getattr(self, kind)]
            if twice := sorted({name for name in names if names.count(name) > 1}):
                raise ValueError(f"{kind}: {twice[0]!r} stands for several parts")
        return self

    @property
    def sights(self) -> dict[str, tuple[CameraPart, LensPart | None]]:
        """Each camera with each lens that fits it, by "camera" or "camera + lens"."""
        found: dict[str, tuple[CameraPart, LensPart | None]] = {}
        for camera in self.camera:
            if camera.built_in is not None:
                found[camera.name] = (camera, None)
            for lens in self.lens:
                if lens.fits(camera):
                    found[f"{camera.name} + {lens.name}"] = (camera, lens)
        return found


def load_catalogue(file: Path | str | None = None) -> Catalogue:
    """The catalogue in a TOML file.

    Parameters
    ----------
    file : Path, str or None; None: the one that comes with lscan

    Raises
    ------
    InputError
        Names the file, the key at fault, its value and what is allowed.
    """
    file = scenes_folder() / FOLDERS["study"] / CATALOGUE if file is None else file
    return check(Catalogue, read_document(file), where=file)


# The class of a line laser, as its radiation counts by IEC 60825-1.
#
# The standard lets a class be told by what passes an aperture at a distance.  For visible,
# continuous light from a source as small as a laser diode two of its conditions matter: 7 mm at 100
# mm from the laser, the naked eye's pupil (condition 3), and 50 mm at 2 m, binoculars (condition
# 1).  A line's light is spread over its fan, so that less than all of it enters: the share of the
# fan within the angle that the aperture spans, at the fan's brightest place.  Across its thickness
# all of it is taken to enter, and the source to be a point (C6 = 1): both make the class no lower
# than it is.
#
# References ---------- IEC 60825-1:2014 (edition 3), 4.3, 5.4 and tables 3 to 8: accessible
# emission limits of class 1, 0.39 mW (500 nm to 700 nm; at shorter waves a photochemical limit is
# added, and no class 1 is given here), of class 2, 1 mW, of class 3R, 5 mW, of class 3B, 500 mW.


LaserClass = Literal["1", "2", "3R", "3B", "4"]
CLASSES: tuple[LaserClass, ...] = ("1", "2", "3R", "3B", "4")
LIMITS_MW: dict[LaserClass, float] = {"1": 0.39, "2": 1.0, "3R": 5.0, "3B": 500.0}
CLASS_1_FROM_NM = 500.0
APERTURES_MM = ((7.0, 100.0), (50.0, 2000.0))
"""Diameter and distance: conditions 3 and 1."""


def laser_class(laser: Laser) -> LaserClass:
    """The lowest class whose limit the laser keeps.

    Parameters
    ----------
    laser : Laser, its power, wavelength and fan; several sheets count as one
    """
    power_mw = accessible_mw(laser)
    for name, limit_mw in LIMITS_MW.items():
        if name == "1" and laser.wavelength_nm < CLASS_1_FROM_NM:
            continue
        # Beyond 3R the whole beam may do harm, not what enters an eye alone.
        if (laser.power_mw if name == "3B" else power_mw) <= limit_mw:
            return name
    return "4"


def accessible_mw(laser: Laser) -> float:
    """The most of its power that enters one of the apertures, mW.

    Parameters
    ----------
    laser : Laser
    """
    spans = (2 * degrees(atan(diameter / 2 / distance)) for diameter, distance in APERTURES_MM)
    return laser.power_mw * max(_share(laser, span) for span in spans)


def _share(laser: Laser, span_deg: float) -> float:
    """Of the fan's power, within an angle at its brightest place: its middle, or an edge."""
    part = min(span_deg / 2 / laser.fan_half_angle_deg, 1.0)
    if laser.fan == "gaussian":
        return erf(sqrt(2) * part) / erf(sqrt(2))
    if laser.fan_rise <= 0:  # as 1 + rise a^2, a from -1 to 1
        return part * (1 + laser.fan_rise * part**2 / 3) / (1 + laser.fan_rise / 3)
    inner = max(1 - 2 * part, -1.0)
    return (1 - inner + laser.fan_rise * (1 - inner**3) / 3) / (2 + 2 * laser.fan_rise / 3)


# ``[design]`` of a study: which parts and numbers a rig may have, and what is wanted of it.


Figure = Literal["error_mm", "width_mm", "depth_mm", "cost_eur", "laser_class"]
Globs = Annotated[tuple[str, ...], Field(min_length=1)]


class UniformNumber(Strict):
    """A free number, anywhere from the first to the second."""

    uniform: tuple[float, float]

    @model_validator(mode="after")
    def _rises(self) -> Self:
        if not self.uniform[0] < self.uniform[1]:
            raise ValueError("uniform: the second number must be larger than the first")
        return self


FreeNumber = Annotated[tuple[float, ...], Field(min_length=1)] | UniformNumber


class FigureBound(Strict):
    """A limit of a figure; a laser class is a text."""

    at_most: float | LaserClass | None = None
    at_least: float | LaserClass | None = None

    @model_validator(mode="after")
    def _says_one(self) -> Self:
        if (self.at_most is None) == (self.at_least is None):
            raise ValueError("exactly one of at_most and at_least")
        return self

    def excess(self, value: float | LaserClass) -> float:
        """By how much a value is beyond the bound, as a share of it; 0 or less: it is kept.

        Parameters
        ----------
        value : float or str, of the kind the bound is
        """
        sign, bound = (1, self.at_most) if self.at_least is None else (-1, self.at_least)
        beyond = sign * (ordinal(value) - ordinal(bound))
        scale = 1.0 if isinstance(bound, str) else abs(bound or 0.0) or 1.0
        return beyond / scale


def ordinal(value: float | LaserClass | None) -> float:
    """A figure as a number: of a laser class, its place among all."""
    if value is None:
        return float("nan")
    return float(CLASSES.index(value)) if isinstance(value, str) else value


class DesignSection(Strict):
    """What a design may be, and what is sought.

    catalogue_file: the parts; those that come with lscan if left out.  sights, lasers, windows,
    tracks: of them, by names or patterns such as "basler-*"; a sight is a camera with a lens of
    its own, or a "camera + lens".  numbers: free ones, by stand_off_mm, baseline_mm,
    laser_height_mm, aim_z_mm (sim.studies.design.rig) or a dotted key of the scene: a list to
    choose from, or a range.
    minimise, maximise: the objectives.  limits: what a design has to keep to be on the front.
    trials: designs looked at, in generations of ``population``.  expose: the exposure follows the
    line's brightness; false keeps the scene's.  rendered: designs of the front that pictures are
    rendered of, to hold the prediction against, spread over the front's errors.
    """

    catalogue_file: str | None = None
    sights: Globs = ("*",)
    lasers: Globs = ("*",)
    windows: Globs = ("*",)
    tracks: Globs = ("*",)
    numbers: dict[str, FreeNumber] = Field(default_factory=dict)
    minimise: tuple[Figure, ...] = ("error_mm", "cost_eur", "laser_class")
    maximise: tuple[Figure, ...] = ("width_mm", "depth_mm")
    limits: dict[Figure, FigureBound] = Field(default_factory=dict)
    trials: Annotated[int, Field(ge=2, le=100_000)] = 200
    population: Annotated[int, Field(ge=2, le=1000)] = 20
    expose: bool = True
    rendered: Annotated[int, Field(ge=0, le=100)] = 3
    seed: Seed = 1

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        objectives = (*self.minimise, *self.maximise)
        if not objectives or len(set(objectives)) < len(objectives):
            raise ValueError("minimise and maximise: one objective or more, each named once")
        if self.trials % self.population:
            raise ValueError("trials must be a multiple of population: whole generations")
        for figure, bound in self.limits.items():
            texts = isinstance(bound.at_most, str) or isinstance(bound.at_least, str)
            if texts != (figure == "laser_class"):
                kind = f"one of {', '.join(CLASSES)}, as a text" if not texts else "a number"
                raise ValueError(f"limits: {figure} is {kind}")
        return self

    @property
    def objectives(self) -> tuple[tuple[Figure, bool], ...]:
        """Each objective, and whether it is minimised."""
        return (*((name, True) for name in self.minimise), *((n, False) for n in self.maximise))

    def space(self, catalogue: Catalogue) -> dict[str, tuple[str, ...] | FreeNumber]:
        """What each of a design's parameters may be, by name: the parts, then the numbers.

        Parts that cost too much with even the cheapest of the others are left out.

        Parameters
        ----------
        catalogue : Catalogue

        Raises
        ------
        InputError
            A pattern is none of the catalogue's parts', or all rigs cost too much.
        """
        costs: dict[str, dict[str, float]] = {
            "sight": {
                name: sum(part.price.eur for part in parts if part is not None)
                for name, parts in catalogue.sights.items()
            }
        }
        for kind in ("laser", "window", "track"):
            costs[kind] = {part.name: part.price.eur for part in getattr(catalogue, kind)}
        for kind, of in costs.items():
            chosen = _chosen(f"design.{kind}s", getattr(self, f"{kind}s"), list(of))
            costs[kind] = {name: of[name] for name in chosen}
        bound = self.limits["cost_eur"].at_most if "cost_eur" in self.limits else None
        most = float("inf") if bound is None else ordinal(bound)
        cheapest = sum(min(of.values()) for of in costs.values())
        if cheapest > most:
            what = "design.limits.cost_eur: no rig of the chosen parts is so cheap"
            raise InputError(what, value=bound, allowed=f"{cheapest:g} or more")
        found: dict[str, tuple[str, ...] | FreeNumber] = {}
        for kind, of in costs.items():
            spare = most - cheapest + min(of.values())
            found[kind] = tuple(name for name, cost in of.items() if cost <= spare)
        return {**found, **self.numbers}


def _chosen(key: str, globs: Globs, names: list[str]) -> tuple[str, ...]:
    """The names that one of the patterns fits, in the catalogue's order."""
    for pattern in globs:
        if not any(fnmatchcase(name, pattern) for name in names):
            what = f"{key}: is no part's name or pattern"
            raise InputError(what, value=pattern, allowed=", ".join(names))
    return tuple(name for name in names if any(fnmatchcase(name, glob) for glob in globs))
