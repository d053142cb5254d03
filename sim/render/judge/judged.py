"""The judge: light of two and more orders in a window of a picture, by families."""

from collections.abc import Mapping
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats
from sim.render.judge.photons import PhotonRecords, Waters, shoot
from sim.render.judge.walks import FAMILIES, CameraWalks
from sim.render.layers import W_PER_M2_IN_MW_PER_MM2
from sim.render.plugins.camera import RefractiveCamera
from sim.render.tank import Tank
from sim.scene import camera_pose, head_pose

Window = tuple[int, int, int, int]
RECORDS_A_PHOTON = 1  # at first; more where there is no room for all


@dataclass(frozen=True)
class JudgeEffort:
    """How much the judge does.

    Attributes
    ----------
    photons : int, of each sheet, a batch
    walks : int, of each pixel, a batch
    batches : int, independent ones, from which standard errors come
    cell_mm : float, mm, largest side of a cell of the surfaces; light that varies as a Gaussian of
        the standard deviation s comes out too low at its peak by cell_mm2 / (12 s2)
    voxel_mm : float, mm, side of a cell of the water
    """

    photons: int = 1 << 20
    walks: int = 64
    batches: int = 16
    cell_mm: float = 0.15
    voxel_mm: float = 2.0


EFFORT = JudgeEffort()


@dataclass(frozen=True)
class Judged:
    """What the judge found in a window, W/(m2 sr) in the air behind the port.

    Attributes
    ----------
    families : mapping of names to (batches, H, W) arrays, each batch's own estimate.  One surface
        and water before it ("laser"), behind it ("camera") or both ("both"), as the light goes;
        two surfaces and more ("interreflection"); none ("veil")
    """

    families: Mapping[str, Floats]

    @property
    def total(self) -> Floats:
        """(batches, H, W) of all families together."""
        return np.asarray(sum(self.families.values()))

    def mean(self, family: str) -> Floats:
        """(H, W) the best estimate.

        Parameters
        ----------
        family : str, one of ``families``
        """
        return np.asarray(self.families[family].mean(axis=0))

    def error(self, family: str) -> Floats:
        """(H, W) its standard error.

        Parameters
        ----------
        family : str, one of ``families``
        """
        batches = self.families[family]
        return np.asarray(batches.std(axis=0, ddof=1) / np.sqrt(len(batches)))


def judge(
    tank: Tank,
    position_mm: float,
    window: Window | None = None,
    effort: JudgeEffort = EFFORT,
    seed: int = 0,
) -> Judged:
    """The laser's light of two and more orders, without bias but that of the cells.

    The head stands still while the picture is taken; the lens is not yet counted.

    Parameters
    ----------
    tank : Tank
        Its water, sheets and surfaces, which have to be meshes, as they are.
    position_mm : float
        Track position of the head, mm.
    window : (left, top, width, height), optional
        Px, of the picture; all of it if None.  With the scene's fineness f the arrays have f rows
        and columns a pixel.
    effort : JudgeEffort
        How much is done.
    seed : int
        Of all random numbers.

    """
    tank.place(position_mm)
    camera = tank.make_camera(window=window, jitter=True)
    head = tank.scene.tank.head
    camera.place(head_pose(head, position_mm) @ camera_pose(head))
    waters = _waters(tank, effort)
    seeds = np.random.SeedSequence(seed).generate_state(effort.batches)
    batches = []
    capacity = RECORDS_A_PHOTON * effort.photons * len(tank.sheets)
    for one in (int(word) >> 1 for word in seeds):
        records = _photons_landed(tank, waters, effort.photons, one, capacity)
        capacity = records.landed.capacity
        walks = CameraWalks(waters, tank.integrator, records)
        batches.append(_pictures(walks, camera, effort.walks, one + len(tank.sheets)))
    pictures = np.moveaxis(np.array(batches), 1, 0)
    return Judged(dict(zip(FAMILIES, pictures, strict=True)))


def landed_irradiance(
    tank: Tank, rays: mi.Ray3f, effort: JudgeEffort = EFFORT, seed: int = 0
) -> Floats:
    """What one batch of photons brings to the places where rays meet a surface, mW/mm2.

    Light that was scattered on its way, but not reflected, of a photon each.

    Parameters
    ----------
    tank : Tank, its water, sheets and surfaces, as they are
    rays : Ray3f, each has to meet a surface
    effort : JudgeEffort, its photons and cells
    seed : int, of all random numbers

    Returns
    -------
    (N,) one estimate a ray.
    """
    waters, capacity = _waters(tank, effort), RECORDS_A_PHOTON * effort.photons * len(tank.sheets)
    landed = _photons_landed(tank, waters, effort.photons, seed, capacity).landed
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed + len(tank.sheets), dr.width(rays))
    key, area = waters.surfaces.find(waters.scene.ray_intersect(rays), -rays.d, mi.Bool(True))
    photon = landed.draw(key, sampler.next_1d(), mi.Bool(True))
    found = (photon.count > 0) & (photon.mark >= 0)
    light = dr.select(found, photon.power * photon.count / area, 0.0)
    return np.array(light, dtype=float)


def _waters(tank: Tank, effort: JudgeEffort) -> Waters:
    return Waters(tank.mitsuba_scene, tank.higher, effort.cell_mm, effort.voxel_mm)


def _photons_landed(
    tank: Tank, waters: Waters, photons: int, seed: int, capacity: int
) -> PhotonRecords:
    """The records of so many photons of each sheet, sorted; with more room where that is short."""
    records = PhotonRecords(capacity)
    for number, sheet in enumerate(tank.sheets):
        shoot(waters, sheet, photons, seed + number, records)
    if records.sort():
        return records
    return _photons_landed(tank, waters, photons, seed, 2 * capacity)


def _pictures(walks: CameraWalks, camera: RefractiveCamera, count: int, seed: int) -> list[Floats]:
    """(H, W) pictures of FAMILIES, by so many walks a pixel."""
    width, height = camera.film().crop_size()
    rays = width * height * count
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, rays)
    pixel = dr.arange(mi.UInt32, rays) // count
    place = mi.Point2f(pixel % width, pixel // width) + sampler.next_2d()
    place /= mi.Vector2f(width, height)
    ray, weight = camera.sample_ray(mi.Float(0.5), mi.Float(0), place, sampler.next_2d())
    light = [value * weight.x * W_PER_M2_IN_MW_PER_MM2 for value in walks.light(ray, sampler)]
    dr.eval(light)
    return [
        np.array(value, dtype=float).reshape(height, width, count).mean(axis=-1) for value in light
    ]
