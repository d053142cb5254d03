"""What a data set is drawn from: a spec file, and the scenes that it makes of a seed."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Self, get_args

import numpy as np
from pydantic import Field, model_validator

from lscan.config.documents import Document, Strict, by_content, check, named_files, read_document
from lscan.config.scenes import included_file, spec_file
from lscan.errors import InputError
from sim.devices import load_checked
from sim.scene import Scene
from sim.scene.instrument import Seed
from sim.scene.varying import ChangingKey, number_at, with_numbers
from sim.studies.studyfile import VaryingNumber

POSITION = "plan.position_mm"  # of the head along the track, which is no number of the scene
EACH_PICTURE = frozenset((*get_args(ChangingKey), POSITION))
USUAL = 0.05, 0.95  # quantiles that are tried before anything is rendered


class Drawn(VaryingNumber):
    """A number of the scene that is drawn from a distribution.

    key: dotted, of section and field, as that of a study's cause; ``plan.position_mm`` is where
    the head stands.  off: the number is added to the scene's own; relative: it is the share of it
    that is added.  with: other keys and their values, wherever this one is drawn.
    """

    @property
    def each_picture(self) -> bool:
        """Whether it is new in each picture; else in each tank, as its geometry or water is."""
        return {self.key, *self.together} <= EACH_PICTURE


class DatasetFile(Strict):
    """A data set as its file says it.

    scenes: files or names; each tank is one of them, of the same odds.  tank_pictures: of each tank
    and shard; what cannot change from picture to picture is drawn once for each.  licence: one
    line, for the data card.
    """

    name: str = "unnamed"
    scenes: Annotated[tuple[str, ...], Field(min_length=1)]
    seed: Seed = 1
    tank_pictures: Annotated[int, Field(ge=1, le=10_000)] = 50
    licence: str = "none stated"
    drawn: dict[str, Drawn] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _each_key_once(self) -> Self:
        keys = [key for one in self.drawn.values() for key in (one.key, *one.together)]
        if twice := sorted({key for key in keys if keys.count(key) > 1}):
            raise ValueError(f"drawn: {', '.join(twice)} is drawn twice")
        return self


@dataclass(frozen=True)
class DatasetSpec:
    """A spec and its scenes.

    Attributes
    ----------
    file : DatasetFile
    scenes : tuple of Scene
    source : str, path of the file, for errors
    """

    file: DatasetFile
    scenes: tuple[Scene, ...]
    source: str

    @property
    def document(self) -> Document:
        """All that the pictures depend on, of JSON types; of files of the scenes, the content."""
        models = [(one.rig, one.tank) for one in self.scenes]
        dumped = [[part.model_dump(mode="json") for part in parts] for parts in models]
        texts = [json.dumps(by_content(parts), sort_keys=True) for parts in dumped]
        hashes = [hashlib.sha256(text.encode()).hexdigest() for text in texts]
        return {"spec": self.file.model_dump(mode="json", by_alias=True), "scenes_sha256": hashes}

    @property
    def files(self) -> dict[str, str]:
        """SHA-256 of each file that the scenes name, by its path."""
        return {k: v for one in self.scenes for k, v in named_files(one.document).items()}

    def tank(self, shard: int) -> tuple[Scene, dict[str, float]]:
        """The scene that a shard's pictures have in common, and the numbers drawn for it.

        Parameters
        ----------
        shard : int, from 0

        Raises
        ------
        InputError
            A number is out of the range of its key.
        """
        which = np.random.default_rng([self.file.seed, shard, 1]).integers(len(self.scenes))
        return self._draw(self.scenes[which], shard, each_picture=False)

    def picture(self, tank: Scene, number: int) -> tuple[Scene, dict[str, float]]:
        """The scene of one picture, and the numbers drawn for it, the head's position among them.

        Parameters
        ----------
        tank : Scene, of its shard
        number : int, of the picture, from 0

        Raises
        ------
        InputError
            A number is out of the range of its key.
        """
        scene, numbers = self._draw(tank, number, each_picture=True)
        seeded = scene.with_tank(sensor={"seed": _stream(self.file.seed, "sensor.seed", number)})
        return seeded, {POSITION: scene.rig.plan.start_mm, **numbers}

    def _draw(
        self, scene: Scene, number: int, *, each_picture: bool
    ) -> tuple[Scene, dict[str, float]]:
        numbers: dict[str, float] = {}
        for name, one in self.file.drawn.items():
            if one.each_picture == each_picture:
                stream = _stream(self.file.seed, name, number)
                numbers |= one.together
                numbers[one.key] = one.number(_share(stream), _own(scene, one.key))
        return _with(scene, numbers, self.source), numbers


def load_dataset_spec(path: Path | str) -> DatasetSpec:
    """The spec in a TOML file, each of its keys and usual numbers tried.

    Parameters
    ----------
    path : Path or str, of the file, or the name of one that comes with lscan

    Raises
    ------
    InputError
        Names the file, the key, the value and what is allowed.
    """
    source = spec_file(path, "data set")
    file = check(DatasetFile, read_document(source), where=source)
    names = (included_file(source.parent, name) for name in file.scenes)
    scenes = tuple(load_checked(name) for name in names)
    for scene in scenes:
        for name, one in file.drawn.items():
            for share in USUAL:
                numbers = one.together | {one.key: one.number(share, _own(scene, one.key))}
                _with(scene, numbers, f"{source}, [drawn.{name}]")
    return DatasetSpec(file, scenes, str(source))


def _own(scene: Scene, key: str) -> float:
    return scene.rig.plan.start_mm if key == POSITION else number_at(scene, key)


def _with(scene: Scene, numbers: dict[str, float], where: str) -> Scene:
    mine = {key: number for key, number in numbers.items() if key != POSITION}
    if mine.get("light.ambient_w_m2_sr") is not None and scene.tank.light.ambient_w_m2_sr == 0:
        allowed = "a scene with ambient light, which can be scaled"
        raise InputError("light.ambient_w_m2_sr", where=where, value=0.0, allowed=allowed)
    return with_numbers(scene, mine, where) if mine else scene


def _stream(seed: int, name: str, number: int) -> int:
    """A number that tells seeds, what is drawn and pictures apart: another cause changes none."""
    text = f"{seed}/{name}/{number}".encode()
    return int.from_bytes(hashlib.blake2b(text, digest_size=4).digest(), "little") >> 1


def _share(stream: int) -> float:
    """A number in (0, 1)."""
    return float(np.clip(np.random.default_rng(stream).random(), 1e-12, 1 - 1e-12))
