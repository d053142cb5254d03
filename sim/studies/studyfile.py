"""A study file: which rig, what varies, and when."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from math import exp, expm1, sqrt
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, PositiveFloat, model_validator
from scipy.special import ndtri

from lscan.config.documents import Document, Strict, check, read_document
from lscan.config.scenes import included_file, scene_file, spec_file
from lscan.errors import InputError
from lscan.records import Floats
from sim.scene import Scene, load_scene
from sim.scene.instrument import Seed
from sim.studies.design.catalogue import DesignSection
from sim.studies.problem import SETS

# How a cause's number is distributed: its quantiles.


Pair = tuple[float, float]
KINDS = ("fixed", "normal", "uniform", "triangular", "lognormal", "values")


class Distribution(Strict):
    """One of six distributions of a number; exactly one of its fields says which.

    fixed: one value.  normal: mean and standard deviation.  uniform: the ends.  triangular: lower
    end, mode, upper end.  lognormal: the median and the standard deviation of the logarithm.
    values: one of several, of odds ``weights``.

    Examples
    --------
    >>> Distribution(uniform=(2.0, 4.0)).quantile(0.25)
    2.5
    """

    fixed: float | None = None
    normal: Pair | None = None
    uniform: Pair | None = None
    triangular: tuple[float, float, float] | None = None
    lognormal: tuple[PositiveFloat, float] | None = None
    values: Annotated[tuple[float, ...], Field(min_length=1)] | None = None
    weights: tuple[PositiveFloat, ...] | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        self._require_one_kind()
        return self

    def _require_one_kind(self) -> None:
        if sum(getattr(self, kind) is not None for kind in KINDS) != 1:
            raise ValueError(f"exactly one of {', '.join(KINDS)} says how the number is spread")
        for kind in ("normal", "lognormal"):
            pair = getattr(self, kind)
            if pair is not None and pair[1] < 0:
                raise ValueError(f"{kind}: the standard deviation must not be below 0")
        if self.uniform is not None and self.uniform[0] > self.uniform[1]:
            raise ValueError("uniform: the lower end must not be above the upper one")
        if self.triangular is not None and list(self.triangular) != sorted(self.triangular):
            raise ValueError("triangular: lower end, mode and upper end must rise")
        if self.weights is not None and len(self.weights) != len(self.values or ()):
            raise ValueError("weights goes with values, one for each of them")

    @property
    def kind(self) -> str:
        """The name of the field that says how the number is distributed."""
        return next(kind for kind in KINDS if getattr(self, kind) is not None)

    @property
    def in_words(self) -> str:
        """The distribution as a page shows it, such as ``uniform 0 to 35``."""
        kind, stated = self.kind, getattr(self, self.kind)
        if kind == "fixed":
            return f"{stated:g}"
        numbers = [f"{number:g}" for number in stated]
        joined = {"normal": " ± ", "uniform": " to ", "triangular": ", ", "lognormal": " ×÷ e^"}
        return f"{kind} {joined.get(kind, ', ').join(numbers)}"

    def quantile(self, share: float) -> float:
        """The number below which a share of all lie.

        Parameters
        ----------
        share : float, in (0, 1)
        """
        return float(self._law[0](share))

    @property
    def mean(self) -> float:
        """The expected number."""
        return float(self._law[1])

    @property
    def deviation(self) -> float:
        """The standard deviation of the number."""
        return float(self._law[2])

    @property
    def _law(self) -> tuple[Callable[[float], float], float, float]:
        """The quantiles, the mean and the standard deviation; without a spread, all are one."""
        if self.normal is not None:
            middle, sigma = self.normal
            return lambda share: middle + sigma * ndtri(share), middle, sigma
        if self.uniform is not None:
            low, high = self.uniform
            width = high - low
            return lambda share: low + width * share, (low + high) / 2, width / sqrt(12)
        if self.triangular is not None:
            low, mode, high = self.triangular
            sides = low - mode, mode - high, high - low

            def triangular(share: float) -> float:
                if share * (high - low) < mode - low:
                    return low + sqrt(share * (high - low) * (mode - low))
                return high - sqrt((1 - share) * (high - low) * (high - mode))

            return triangular, sum(self.triangular) / 3, sqrt(sum(a**2 for a in sides) / 36)
        if self.lognormal is not None:
            median, sigma = self.lognormal
            mean = median * exp(sigma**2 / 2)
            spread = mean * sqrt(expm1(sigma**2))
            return lambda share: median * exp(sigma * ndtri(share)), mean, spread
        if self.values is not None:
            values, weights = np.array(self.values), self.weights or np.ones(len(self.values))
            odds = np.cumsum(weights)
            edges = odds[:-1] / odds[-1]
            mean = float(np.average(values, weights=weights))
            spread = sqrt(np.average((values - mean) ** 2, weights=weights))
            return lambda share: values[np.searchsorted(edges, share, side="right")], mean, spread
        fixed = self.fixed or 0.0
        return lambda _: fixed, fixed, 0.0

    def scaled(self, factor: float) -> Self:
        """The same distribution, drawn in to its middle by a factor.

        Parameters
        ----------
        factor : float, of all deviations from the mean (of a log-normal one: from the median)
        """
        pair = self.normal or self.lognormal
        numbers = self.uniform or self.triangular or self.values
        if pair:
            return self.model_copy(update={self.kind: (pair[0], factor * pair[1])})
        if numbers:
            mean = self.mean
            drawn = tuple(mean + factor * (number - mean) for number in numbers)
            return self.model_copy(update={self.kind: drawn})
        return self


class _Keyed(Strict):
    """What has a key; its field comes before those of how the number is distributed."""

    key: str


class VaryingNumber(Distribution, _Keyed):
    """A number of the scene that is drawn from a distribution.

    key: dotted, of section and field.  off: the number is added to the scene's own; relative: it is
    the share of it that is added.  with: other keys and their values, wherever this one varies.
    """

    off: bool = False
    relative: bool = False
    together: Annotated[dict[str, float], Field(alias="with", default_factory=dict)]

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if self.off and self.relative:
            raise ValueError("off and relative exclude each other")
        return self

    def number(self, share: float, own: float) -> float:
        """The number at a quantile.

        Parameters
        ----------
        share : float, in (0, 1)
        own : float, the scene's own number
        """
        drawn = self.quantile(share)
        return own + drawn if self.off else own * (1 + drawn) if self.relative else drawn


# A study file: which rig, what varies, and when.


When = Literal["as-built", "drift", "each-frame", "noise"]
Tier = Literal["geometric", "rendered", "both"]
NOISES = ("sensor.noise", "sensor.speckle")


class Cause(VaryingNumber):
    """One number of the rig that is not what the instrument takes it for.

    key: dotted, of the scene's section and field, such as ``water.salinity_psu`` or
    ``head.camera_mm.1``; with ``calibrate.`` or ``scan.`` before it in that scene only, else in
    both.  when: "as-built", the same in calibration and scan; "drift", in the scan only, and in
    the calibration that is made anew before it; "each-frame", new in every picture of the scan;
    "noise", of the pictures: the sensor's (``sensor.noise``) or the speckle (``sensor.speckle``),
    which take no distribution.
    The distribution (fixed, normal, uniform, triangular, lognormal, values) is that of the number;
    ``off = true``: of what is added to the scene's own; ``relative = true``: of the share of it
    that is added.  Each frame's is always added.  correlation: pictures, of what is new in each.
    with: other keys and their values, wherever this cause is at work.  group: causes of one group
    have one index; causes that are correlated must be in one.  cost: of holding the stated spread,
    in any currency; where one cause states it, tolerances are weighted by it.
    """

    when: When
    correlation: Annotated[float, Field(ge=0, le=1000)] = 0.0
    group: str | None = None
    cost: PositiveFloat = 1.0

    def _require_one_kind(self) -> None:
        if self.when != "noise":
            super()._require_one_kind()
        elif self.key not in NOISES:
            raise ValueError(f"noise is one of {', '.join(NOISES)}")
        elif any(getattr(self, name) is not None for name in (*KINDS, "weights")):
            raise ValueError(f"noise takes no distribution, the scene says how much ({self.key})")

    @model_validator(mode="after")
    def _each_frames_own(self) -> Self:
        if self.when == "each-frame" and self.kind not in ("normal", "uniform", "values"):
            raise ValueError("each-frame is one of normal, uniform, values")
        if self.when == "each-frame" and self.mean != 0 and self.values is None:
            raise ValueError("each-frame: what is new in every picture is about 0")
        if self.correlation > 0 and self.when not in ("each-frame", "noise"):
            raise ValueError('correlation goes with when = "each-frame" only')
        return self

    @property
    def in_words(self) -> str:
        """The distribution as a page shows it, such as ``normal 0 ± 0.01, added``."""
        if self.when == "noise":
            return "the scene's own"
        words = super().in_words
        if self.off or self.relative or self.when == "each-frame":
            words += " of it, relative" if self.relative else ", added"
        return words


class Correlation(Strict):
    """Two causes of one group whose numbers go together.

    by: the correlation of the two normal numbers that they are made from, by their quantiles.
    """

    between: tuple[str, str]
    by: Annotated[float, Field(gt=-1, lt=1)]


class Precision(Strict):
    """When a study has enough runs.

    base: samples to begin with; each takes as many runs as there are causes, and two.  most: of
    these; half_width: of the intervals of the three largest indices.  alone: runs of each cause
    by itself.  rendered: runs that are rendered where the tier is both.
    """

    base: Annotated[int, Field(ge=SETS, le=1 << 20)] = 256
    most: Annotated[int, Field(ge=SETS, le=1 << 20)] = 1024
    half_width: PositiveFloat = 0.05
    alone: Annotated[int, Field(ge=SETS, le=1 << 16)] = 64
    rendered: Annotated[int, Field(ge=1, le=1 << 20)] = 256

    @model_validator(mode="after")
    def _whole_sets(self) -> Self:
        for name in ("base", "alone"):
            if getattr(self, name) % SETS:
                raise ValueError(f"{name} must be a multiple of {SETS}")
        return self


class Looked(Strict):
    """At how many of the scan's places the errors are found: pictures, and columns in each."""

    pictures: Annotated[int, Field(ge=1, le=4000)] = 16
    columns: Annotated[int, Field(ge=1, le=4000)] = 80


class Bound(Strict):
    """What the tolerances are to keep: ``output`` within ``most_mm`` in a share of all rigs."""

    output: str = "height"
    most_mm: PositiveFloat = 0.1
    in_share: Annotated[float, Field(gt=0.5, lt=1, alias="yield")] = 0.95


class StudyFile(Strict):
    """A study as its file says it."""

    name: str = "unnamed"
    calibrate: str
    scan: str
    tier: Tier = "geometric"
    seed: Seed = 1
    cause: Annotated[dict[str, Cause], Field(min_length=1)]
    correlation: tuple[Correlation, ...] = ()
    precision: Precision = Precision()
    places: Looked = Looked()
    tolerances: Bound | None = None
    design: DesignSection | None = None

    @model_validator(mode="after")
    def _known_causes(self) -> Self:
        for one in self.correlation:
            groups = []
            for name in one.between:
                if name not in self.cause:
                    raise ValueError(f"correlation: no such cause {name!r}")
                groups.append(self.cause[name].group)
            if groups[0] is None or groups[0] != groups[1]:
                pair = " and ".join(one.between)
                raise ValueError(f"correlation: {pair} must be in one group, their indices are one")
        streams = [cause.key for cause in self.cause.values() if cause.when == "noise"]
        if len(set(streams)) < len(streams):
            raise ValueError("a noise is a cause once")
        return self


ONE_RIG = "lens", "port", "head"
"""Sections of a scene that calibration and scan have in common."""


@dataclass(frozen=True)
class Study:
    """A study and its two scenes.

    Attributes
    ----------
    file : StudyFile, what varies
    calibrate : Scene, of the board
    scan : Scene, of what is measured
    document : Document, the file as it was read
    source : str, path of the file, for errors
    """

    file: StudyFile
    calibrate: Scene
    scan: Scene
    document: Document
    source: str

    @property
    def causes(self) -> tuple[str, ...]:
        """The names of the D causes, in the file's order."""
        return tuple(self.file.cause)

    @property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """The causes by name of their group; a cause without one is its own."""
        found: dict[str, tuple[str, ...]] = {}
        for name, cause in self.file.cause.items():
            group = cause.group or name
            found[group] = (*found.get(group, ()), name)
        return found

    def correlation_root(self) -> Floats | None:
        """(D, D) lower root of the correlations of the normal numbers behind the causes' quantiles.

        None where all are independent.

        Raises
        ------
        InputError
            No numbers have these correlations.
        """
        index = {name: k for k, name in enumerate(self.causes)}
        found = np.eye(len(index))
        for one in self.file.correlation:
            i, j = (index[name] for name in one.between)
            found[i, j] = found[j, i] = one.by
        try:
            root = np.asarray(np.linalg.cholesky(found), dtype=float)
        except np.linalg.LinAlgError as error:
            what = "correlation: no such numbers exist"
            allowed = "correlations that do not contradict each other"
            raise InputError(what, where=self.source, allowed=allowed) from error
        return root if self.file.correlation else None


def load_study(path: Path | str) -> Study:
    """The study that a TOML file describes.

    Parameters
    ----------
    path : Path or str, of the file, or the name of a study that comes with lscan

    Raises
    ------
    InputError
        Names the file, the key, the value and what is allowed.
    """
    file = spec_file(path, "study")
    return study_of(read_document(file), str(file))


def study_of(document: Document, source: str, scenes: tuple[Scene, Scene] | None = None) -> Study:
    """The study that a document describes.

    Parameters
    ----------
    document : dict, as read from TOML
    source : str, where it came from, for errors
    scenes : tuple of Scene, optional, of the calibration and of the scan; by default those that
        the document names

    Raises
    ------
    InputError
        As ``load_study``.
    """
    file = check(StudyFile, document, where=source)
    if scenes is None:
        scenes = _scene(file.calibrate, source), _scene(file.scan, source)
    study = Study(file, *scenes, document, source)
    if study.calibrate.tank.target.shape != "board":
        allowed = 'a scene with [target] shape = "board"'
        raise InputError("calibrate", where=source, value=file.calibrate, allowed=allowed)
    _require_one_rig(study)
    study.correlation_root()
    return study


def _require_one_rig(study: Study) -> None:
    """InputError where the two scenes state different rigs; what drifts is a cause."""
    board, scan = study.calibrate, study.scan
    apart = [name for name in ONE_RIG if getattr(board.tank, name) != getattr(scan.tank, name)]
    if board.rig.camera.size_px != scan.rig.camera.size_px:
        apart.append("camera.width_px or height_px")
    if apart:
        raise InputError(
            f"calibrate and scan are not of one rig: {', '.join(apart)} differ",
            where=study.source,
            value=f"{study.file.calibrate} and {study.file.scan}",
            allowed="the same in both scenes; what changes between them is a cause",
        )


def _scene(name: str, source: str) -> Scene:
    """The scene in a file beside the study, or of a name; see ``scene_file`` for its error."""
    beside = included_file(Path(source).parent, name)
    return load_scene(beside if os.path.lexists(beside) else scene_file(name))
