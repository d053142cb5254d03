"""Sections of a scene file about what fills the tank: water, light, target, floor."""

from typing import Annotated, Literal, Self

from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from lscan.config.documents import Strict
from sim.scene.instrument import Fraction, Seed, Vector

# The section ``[target.rough]``: a block whose upper side has a prescribed roughness.


class Ripples(Strict):
    """A train of ripples, its crests across ``heading_deg``, from x towards y.

    crests: 0 for a cosine, 1 for sharp crests between round troughs.
    """

    wavelength_mm: PositiveFloat
    height_mm: PositiveFloat
    heading_deg: float = 90.0
    crests: Fraction = 0.0


class RoughBlock(Strict):
    """A block of ``size_mm``, its upper side at z = 0 on average, from (0, 0) of its frame.

    Its heights are one draw, ``seed``, of a random field with the spectrum w2 / (h0 k)^gamma2,
    h0 = 1 cm, between wavelengths ``longest_mm`` and ``shortest_mm``, and nothing beyond; no
    such field where ``w2_cm4`` is 0.  ratio: how many times longer its features are across
    ``heading_deg``, from x towards y, than along it.  ripples are added to it.
    step_mm: between the vertices of its mesh.
    """

    size_mm: tuple[
        Annotated[float, Field(gt=0, le=2000)], Annotated[float, Field(gt=0, le=2000)]
    ] = (150.0, 150.0)
    depth_mm: PositiveFloat = 40.0
    step_mm: Annotated[float, Field(ge=0.05, le=20)] = 0.5
    gamma2: Annotated[float, Field(ge=0, le=8)] = 3.0
    w2_cm4: Annotated[float, Field(ge=0, le=10)] = 0.003
    longest_mm: PositiveFloat = 150.0
    shortest_mm: PositiveFloat = 2.0
    ratio: Annotated[float, Field(ge=1, le=20)] = 1.0
    heading_deg: float = 0.0
    ripples: Ripples | None = None
    seed: Seed = 1

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.shortest_mm >= self.longest_mm:
            raise ValueError("shortest_mm: must be below longest_mm")
        if self.step_mm > self.shortest_mm / 2:
            raise ValueError("step_mm: at most half of shortest_mm, or the mesh does not show it")
        if self.w2_cm4 == 0 and self.ripples is None:
            raise ValueError("w2_cm4 = 0 and no ripples: nothing is rough")
        return self


# Sections of a scene file about what fills the tank: water, light, target, floor.


WaterKind = Literal[
    "given", "pure", "clear", "coastal", "harbor", "tank", "air",
    "jerlov-I", "jerlov-IB", "jerlov-II", "jerlov-III", "jerlov-1C", "jerlov-7C", "jerlov-9C",
]  # fmt: skip
PhaseName = Literal["petzold-mixture", "petzold", "fournier-forand", "henyey-greenstein"]
COEFFICIENTS = (
    "particle_absorption_per_m",
    "particle_scattering_per_m",
    "absorption_per_m",
    "scattering_per_m",
)


class Water(Strict):
    """The water: its state gives the index, the rest its particles (sim.water).

    kind: a water with a name (with ``turbidity_ntu`` for "tank"), or "given": by what
    particles add to pure water at the laser's wavelength (particle_absorption_per_m,
    particle_scattering_per_m; nothing if left out), or by all there is of both
    (absorption_per_m and scattering_per_m).  "air": no water at all, the index 1 and nothing
    absorbed or scattered, whatever the temperature, the salinity and the pressure.
    phase: the particles' phase function.  "petzold-mixture": four Henyey-Greenstein lobes
    fitted to Petzold's average particle, "petzold": his table; "fournier-forand" with
    ``particle_index`` and ``junge_slope``; "henyey-greenstein" with ``asymmetry``.
    """

    kind: WaterKind = "given"
    turbidity_ntu: Annotated[float, Field(ge=0, le=100)] | None = None
    temperature_c: Annotated[float, Field(ge=0, le=30)] = 20.0
    salinity_psu: Annotated[float, Field(ge=0, le=35)] = 0.0
    pressure_mpa: Annotated[float, Field(ge=0.1, le=100)] = 0.101325
    particle_absorption_per_m: NonNegativeFloat | None = None
    particle_scattering_per_m: NonNegativeFloat | None = None
    absorption_per_m: NonNegativeFloat | None = None
    scattering_per_m: NonNegativeFloat | None = None
    phase: PhaseName = "petzold-mixture"
    particle_index: Annotated[float, Field(gt=1, le=1.5)] = 1.10
    junge_slope: Annotated[float, Field(gt=3, lt=5)] = 3.5835
    asymmetry: Annotated[float, Field(gt=-1, lt=1)] = 0.924

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        given = [name for name in COEFFICIENTS if getattr(self, name) is not None]
        if self.kind != "given" and given:
            raise ValueError(f'kind = "{self.kind}" and {given[0]} exclude each other')
        if (self.kind == "tank") != (self.turbidity_ntu is not None):
            raise ValueError('turbidity_ntu goes with kind = "tank", and only with it')
        totals = [name for name in given if not name.startswith("particle")]
        if totals and (len(totals) != 2 or len(given) != 2):
            raise ValueError(
                "absorption_per_m and scattering_per_m go together, and with no other coefficient"
            )
        return self


class Penumbra(Strict):
    """A shadow's soft edge on all surfaces, along y of the world frame.

    Ambient light falls off towards +x (side "right") or -x ("left") as a Gaussian's integral does,
    to the share ``left`` of itself; half way at ``x_mm``, with the standard deviation ``width_mm``.
    """

    x_mm: float
    width_mm: PositiveFloat
    left: Fraction = 0.02
    side: Literal["left", "right"] = "right"


class AmbientLight(Strict):
    """Ambient light: radiance in W/(m2 sr) that reaches every point from all directions.

    gradient_per_m: along x, y and z of the world frame, which share of it more reaches a point a
    metre on, of that at ``centre_mm``; never less than nothing.  What meets one surface or one
    place of the water goes with it.
    penumbra: less of it reaches the surfaces on one side; the light that the water scatters stays
    as without.  The light that met more than one surface stays as without either.
    """

    ambient_w_m2_sr: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    gradient_per_m: Vector = (0.0, 0.0, 0.0)
    centre_mm: Vector = (0.0, 0.0, 0.0)
    penumbra: Penumbra | None = None


class Sand(Strict):
    """A coat of sand glued to the workpiece: spherical grains, half sunk, on a flat pack."""

    grain_mm: Annotated[float, Field(gt=0.05, le=5)] = 0.4
    spread: Annotated[float, Field(ge=0, lt=1)] = 0.3
    seed: Seed = 1


class Texture(Strict):
    """A picture laid over the target as its albedo: grey levels 0 to 255 are 0 to 1.

    It spans ``size_mm`` from ``corner_mm`` in x and y of the target's frame (x and z for the
    board), and repeats beyond; ``albedo`` of the target multiplies it.
    """

    file: str
    corner_mm: tuple[float, float] = (0.0, 0.0)
    size_mm: tuple[PositiveFloat, PositiveFloat]


class Target(Strict):
    """What stands in the tank.

    shape "board": the rig's board, in the head's plane y = 0 at track position 0, moved by
    ``position_mm`` and turned, both in the head frame.  "workpiece": the rig's workpiece;
    "mesh": a mesh file, its lengths in ``unit``, mm if left out; "rough": a block of a given
    roughness, ``rough``; all three placed in the world frame, turned about the workpiece frame's
    origin first about x (tilt_x), then y (tilt_y), then z (turn).
    albedo: diffuse reflectance at the laser's wavelength, of the marks' ground where it is a
    board; or pairs (wavelength_nm, reflectance) to interpolate between, so that a red
    surface is bright to a red laser and dark to a green one.  A mesh file's vertex colours
    multiply it.
    finish: "matt" scatters diffusely; "wet": a glossy coat over it, whose facets have the
    slope ``roughness`` and the index ``coat_index``; "mirror": metal of that roughness, which
    reflects the line elsewhere.
    """

    shape: Literal["board", "workpiece", "mesh", "rough", "none"]
    file: str | None = None
    unit: Literal["mm", "cm", "m", "inch"] | None = None
    position_mm: Vector = (0.0, 0.0, 0.0)
    turn_deg: float = 0.0
    tilt_x_deg: float = 0.0
    tilt_y_deg: float = 0.0
    albedo: Fraction | tuple[tuple[PositiveFloat, Fraction], ...] = 0.5
    mark_albedo: Fraction = 0.05
    finish: Literal["matt", "wet", "mirror"] = "matt"
    roughness: Annotated[float, Field(ge=0.02, le=1)] = 0.1
    coat_index: Annotated[float, Field(gt=1.34, le=2.5)] = 1.5
    texture: Texture | None = None
    sand: Sand | None = None
    rough: RoughBlock | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.shape == "mesh") != (self.file is not None):
            raise ValueError('file goes with shape = "mesh", and only with it')
        if self.shape != "mesh" and self.unit is not None:
            raise ValueError('unit goes with shape = "mesh" only')
        if (self.shape == "rough") != (self.rough is not None):
            raise ValueError('[target.rough] goes with shape = "rough", and only with it')
        if isinstance(self.albedo, tuple):
            wavelengths = [pair[0] for pair in self.albedo]
            if len(wavelengths) < 2 or wavelengths != sorted(set(wavelengths)):
                raise ValueError("albedo: two or more pairs, their wavelengths rising")
        return self


class Floor(Strict):
    """The tank's floor, level in the world frame."""

    z_mm: float
    albedo: Fraction = 0.3
