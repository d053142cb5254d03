"""``[design]`` of a study: which parts and numbers a rig may have, and what is wanted of it."""

from fnmatch import fnmatchcase
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from lscan.config.documents import Strict
from lscan.errors import InputError
from sim.scene.instrument import Seed
from sim.studies.catalogue import Catalogue
from sim.studies.lasersafety import CLASSES, LaserClass

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
    laser_height_mm, aim_z_mm (sim.studies.design) or a dotted key of the scene: a list to choose
    from, or a range.
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
            raise InputError(
                f"{key}: is no part's name or pattern", value=pattern, allowed=", ".join(names)
            )
    return tuple(name for name in names if any(fnmatchcase(name, glob) for glob in globs))
