"""The section ``[target.rough]``: a block whose upper side has a prescribed roughness."""

from typing import Annotated, Self

from pydantic import Field, PositiveFloat, model_validator

from lscan.config.documents import Strict
from sim.scene.instrument import Fraction, Seed


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
