"""How much of the laser's light the surfaces send towards the camera: albedo and finish.

Written anew from the literature; the tank renders Mitsuba's own materials.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.ndimage import map_coordinates
from scipy.special import erf, roots_legendre

from lscan.records import Floats, Ints, Mask
from sim.meshes import Paint, reflectance_at, target_parts
from sim.scene import Scene, target_pose
from sim.truth.target.mesh import Mesh
from sim.truth.target.surfaces import TankSurface
from sim.water import water_optics

FRESNEL_NODES = 64  # of the mean over a hemisphere: good to 1e-4


@dataclass(frozen=True)
class LineInSpace:
    """N points of the scene's surfaces under the laser, seen by the camera.

    face: (N,) index into ``surfaces_of(scene)``.  points, entry: (N, 3) head frame, mm, the points
    and where the camera's rays to them enter the water.  direction: (N, 3) of these rays in the
    air, camera frame, of any length.  normals: (N, 3) unit, head frame, to either side.
    places: (N, 3) the points in the world frame, mm.  world_normals, to_laser, to_camera: (N, 3)
    unit vectors there.
    """

    face: Ints
    points: Floats
    entry: Floats
    direction: Floats
    normals: Floats
    places: Floats
    world_normals: Floats
    to_laser: Floats
    to_camera: Floats


@dataclass(frozen=True)
class Reflectance:
    """What the surfaces of a scene reflect at the laser's wavelength.

    albedo: of the target where its paint is white.  paint: of the target's first painted part.
    """

    scene: Scene
    surfaces: Sequence[TankSurface]
    albedo: float
    paint: Paint | None

    def albedo_at(self, face: Ints, places: Floats) -> Floats:
        """(N,) albedo at (N, 3) places of the world; a board's marks are taken for its ground."""
        floor = self._on_floor(face)
        albedo = np.full(len(face), self.albedo)
        if self.paint is not None:
            albedo[~floor] *= self._level(places[~floor])
        if self.scene.tank.floor is not None:
            albedo[floor] = self.scene.tank.floor.albedo
        return albedo

    def towards_camera(self, line: LineInSpace) -> Floats:
        """(N,) radiance towards the camera per irradiance across the light's way, 1/sr."""
        albedo = self.albedo_at(line.face, line.places)
        to_laser = np.einsum("ij,ij->i", line.world_normals, line.to_laser)
        to_camera = np.einsum("ij,ij->i", line.world_normals, line.to_camera)
        cosines = np.abs(to_laser), np.abs(to_camera)
        half = line.to_laser + line.to_camera
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        tilt = np.abs(np.einsum("ij,ij->i", line.world_normals, half))
        light = albedo / np.pi * cosines[0]
        target = self.scene.tank.target
        if target.finish != "matt":
            index = water_optics(self.scene.tank.water, self.scene.tank.laser.wavelength_nm).index
            glint = facets(*cosines, tilt, target.roughness)
            if target.finish == "mirror":
                finished = albedo * glint
            else:
                between = np.einsum("ij,ij->i", half, line.to_laser)
                ratio = target.coat_index / index
                finished = fresnel(between, ratio) * glint + coated(albedo, *cosines, ratio)
            light = np.where(self._on_floor(line.face), light, finished)
        return np.where(to_laser * to_camera > 0, light, 0.0)

    def _on_floor(self, face: Ints) -> Mask:
        """(N,) whether a face is the floor: it comes after all of the target's."""
        if self.scene.tank.floor is None:
            return np.zeros(len(face), dtype=bool)
        return face == len(self.surfaces) - 1

    def _level(self, places: Floats) -> Floats:
        """(N,) how bright the paint is at (N, 3) places of the target."""
        assert self.paint is not None
        target, own = self.scene.tank.target, target_pose(self.scene).invert(places)
        if target.shape == "mesh":
            mesh = self.surfaces[0]
            assert isinstance(mesh, Mesh)
            triangle = mesh.triangles_at(places)
            share = trimesh.triangles.points_to_barycentric(mesh.mesh.triangles[triangle], places)
            uv = np.einsum("nk,nkj->nj", share, self.paint.uv[mesh.mesh.faces[triangle]])
        else:
            assert target.texture is not None
            plan = own[:, (0, 2)] if target.shape == "board" else own[:, :2]
            uv = (plan - np.array(target.texture.corner_mm)) / np.array(target.texture.size_mm)
        height, width = self.paint.levels.shape
        at = [(1 - uv[:, 1]) * height - 0.5, uv[:, 0] * width - 0.5]
        return np.asarray(map_coordinates(self.paint.levels, at, order=1, mode="grid-wrap"))


def reflectance_of(scene: Scene, surfaces: Sequence[TankSurface]) -> Reflectance:
    """What the scene's surfaces reflect; InputError where a file of theirs cannot be read.

    surfaces: those of ``surfaces_of(scene)``.
    """
    target = scene.tank.target
    where = f"{scene.source}: target.albedo"
    albedo = reflectance_at(target.albedo, scene.tank.laser.wavelength_nm, where)
    painted = target.shape == "mesh" or target.texture is not None
    paints = [part.paint for part in target_parts(scene) if part.paint] if painted else []
    return Reflectance(scene, surfaces, albedo, paints[0] if paints else None)


def facets(to_laser: Floats, to_camera: Floats, tilt: Floats, roughness: float) -> Floats:
    """(N,) light that a rough mirror sends to the camera, per irradiance across its way, 1/sr.

    Beckmann's distribution of the facets' slopes and Smith's shading of one by another.
    to_laser, to_camera, tilt: (N,) cosines to the normal, of either way and of their middle.

    References
    ----------
    B. Walter, S. Marschner, H. Li, K. Torrance, Microfacet models for refraction through rough
    surfaces, Eurographics Symposium on Rendering (2007) 195.
    """
    steep = (1 - tilt**2) / tilt**2 / roughness**2
    density = np.exp(-steep) / (np.pi * roughness**2 * tilt**4)
    free = _unshaded(to_laser, roughness) * _unshaded(to_camera, roughness)
    return density * free / (4 * np.maximum(to_camera, np.finfo(float).tiny))


def _unshaded(cosine: Floats, roughness: float) -> Floats:
    """(N,) share of the facets that nothing shades, seen under a cosine: Smith's G1."""
    level = np.sqrt(np.maximum(1 - cosine**2, 1e-30))
    a = np.minimum(cosine / (roughness * level), 1e6)
    return 2 / (1 + erf(a) + np.exp(-(a**2)) / (np.maximum(a, 1e-12) * np.sqrt(np.pi)))


def coated(albedo: Floats, to_laser: Floats, to_camera: Floats, ratio: float) -> Floats:
    """(N,) light from the matt ground under a smooth coat, per irradiance across its way, 1/sr.

    ratio: the coat's index over the water's.  Light goes to and fro between ground and coat.

    References
    ----------
    J. L. Saunderson, Calculation of the color of pigmented plastics, J. Opt. Soc. Am. 32 (1942)
    727.
    """
    nodes, weights = roots_legendre(FRESNEL_NODES)
    cosine = (nodes + 1) / 2
    # What the coat holds back inside: 1 - R_in = (1 - R_out) / ratio^2, by reciprocity.
    outside = float(weights @ (cosine * fresnel(cosine, ratio)))
    inside = 1 - (1 - outside) / ratio**2
    through = (1 - fresnel(to_laser, ratio)) * (1 - fresnel(to_camera, ratio)) / ratio**2
    return through * albedo / (1 - albedo * inside) / np.pi * to_laser


def fresnel(cosine: Floats, ratio: float) -> Floats:
    """(N,) share of unpolarised light that a smooth face reflects (Born & Wolf sec. 1.5.2).

    cosine: (N,) of the angle of incidence.  ratio: index behind the face over that before it;
    1 where no light gets through.
    """
    behind = np.sqrt(np.maximum(1 - (1 - cosine**2) / ratio**2, 0.0))
    across = (cosine - ratio * behind) / (cosine + ratio * behind)
    along = (ratio * cosine - behind) / (ratio * cosine + behind)
    return np.asarray((across**2 + along**2) / 2)
