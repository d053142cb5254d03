"""A catalogue of parts that a rig is made from: cameras, lenses, lasers, windows and tracks."""

from math import hypot
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from lscan.config.documents import Strict, check, read_document
from lscan.config.rig import Pixels
from lscan.config.scenes import CATALOGUE, FOLDERS, scenes_folder
from sim.scene.errors import TrackErrors
from sim.scene.instrument import Fraction, Glass

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

    stated_class: the maker's; ``sim.studies.lasersafety`` reckons its own.
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
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
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
