"""A surface against a mesh: signed distances, their summary, histogram and coloured points."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import trimesh
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from lscan.errors import MeasurementError
from lscan.figures.style import FIRST, INK, SECOND, WIDTH_IN, png, styled
from lscan.files.disk import write_atomically
from lscan.measure.meshdistance import MeshSearch, PlacedMesh
from lscan.measure.shapefit import fit_shape, measured_points
from lscan.records import Floats, Mask, Surface

WITHIN_MM = 10.0
"""Points farther off the mesh are of something else, such as the floor it stands on."""

MOST_FITTED = 2_000
"""Points the mesh is fitted to, evenly picked: six parameters need no more."""

LIMIT = 0.98
"""Share of the distances that the colours and the histogram span; the rest lie at their ends."""

BARS = 80
"""Of the histogram, from one limit to the other."""


@dataclass(frozen=True)
class MeshPose:
    """Where a mesh lies: p = rotation @ mesh + translation_mm.

    Attributes
    ----------
    rotation : (3, 3) array, from the mesh's frame to the surface's
    translation_mm : (3,) array, mm, frame of the surface
    """

    rotation: Floats
    translation_mm: Floats

    @classmethod
    def at(cls, position_mm: tuple[float, float, float], turn_deg: float) -> "MeshPose":
        """The mesh turned about z, then shifted.

        Parameters
        ----------
        position_mm : tuple of float, mm, where the mesh's origin lies, frame of the surface
        turn_deg : float, degrees, about z
        """
        rotation: Floats = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
        return cls(rotation, np.array(position_mm))


@dataclass(frozen=True)
class MeshComparison:
    """The points of a surface against a mesh.

    Attributes
    ----------
    xyz_mm : (K, 3) array, mm, the points compared, frame of the surface
    distance_mm : (K,) array, mm, positive on the side of the mesh's normals
    sigma_mm : (K,) array, mm, standard uncertainty of the distance, all causes together; those of
        a fitted pose too
    mean_sigma_mm : float, mm, standard uncertainty of the mean distance
    far : int, number of points not compared, because they are too far off the mesh
    beside : int, number of points not compared, because they lie beside an open mesh
    pose : MeshPose, of the mesh
    fitted : bool, whether the pose was found from these points
    """

    xyz_mm: Floats
    distance_mm: Floats
    sigma_mm: Floats
    mean_sigma_mm: float
    far: int
    beside: int
    pose: MeshPose
    fitted: bool

    @property
    def limit_mm(self) -> float:
        """The distance, mm, that LIMIT of the points keep within."""
        return max(float(np.quantile(np.abs(self.distance_mm), LIMIT)), 1e-6)

    def as_json(self) -> dict[str, Any]:
        """Counts, distances and the mesh's pose."""
        low, middle, high = np.quantile(self.distance_mm, [0.025, 0.5, 0.975]).tolist()
        within = np.abs(self.distance_mm) <= 2 * self.sigma_mm
        return {
            "points": len(self.distance_mm),
            "far": self.far,
            "beside": self.beside,
            "mean_mm": {"value": float(self.distance_mm.mean()), "sigma": self.mean_sigma_mm},
            "rms_mm": float(np.sqrt(np.mean(self.distance_mm**2))),
            "median_mm": middle,
            "central_95_mm": [low, high],
            "min_mm": float(self.distance_mm.min()),
            "max_mm": float(self.distance_mm.max()),
            "within_2_sigma": float(within.mean()),
            "pose": {
                "fitted": self.fitted,
                "rotation": self.pose.rotation,
                "translation_mm": self.pose.translation_mm,
            },
        }


def compare_mesh(
    surface: Surface,
    mesh: trimesh.Trimesh,
    pose: MeshPose,
    fit: bool = False,
    within_mm: float = WITHIN_MM,
) -> MeshComparison:
    """The signed distances of a surface's points from a mesh.

    Parameters
    ----------
    surface : Surface, mm
    mesh : Trimesh, mm, in a frame of its own
    pose : MeshPose, of the mesh; where it is fitted, to within about ``within_mm``
    fit : bool, whether the pose is found from the points: the one of least squares
    within_mm : float, mm; points farther off the mesh than this are not compared

    Raises
    ------
    InputError
        Where the mesh has no triangle with an area.
    MeasurementError
        Where no point lies so near to the mesh, or the fit does not settle.

    References
    ----------
    The fit brings points to the tangent planes of the mesh: Y. Chen and G. Medioni, Image and
    Vision Computing 10, 145 (1992).

    Examples
    --------
    >>> import lscan, trimesh
    >>> surface = lscan.load_surface("surface.nc")
    >>> block = trimesh.creation.box(bounds=[[117, -60, -410], [332, 60, -330]])
    >>> pose = MeshPose.at((0.0, 0.0, 0.0), turn_deg=0.0)
    >>> compare_mesh(surface, block, pose).limit_mm < 10
    True
    """
    points = measured_points(surface)
    pivot = points.xyz_mm.mean(axis=0) if len(points.xyz_mm) else np.zeros(3)
    placed = PlacedMesh(MeshSearch(mesh), pose.rotation, pose.translation_mm, within_mm, pivot)
    terms = placed.terms(points.xyz_mm)
    _require_points(terms.usable, within_mm)
    covariance, modes = np.zeros((6, 6)), np.zeros((6, points.modes_mm.shape[2]))
    if fit:
        near = np.flatnonzero(terms.usable)
        some = near[:: -(-len(near) // MOST_FITTED)]
        found = fit_shape(placed, points.only(some), "the mesh")
        assert isinstance(found.shape, PlacedMesh)
        placed, covariance, modes = found.shape, found.covariance, found.modes
        terms = placed.terms(points.xyz_mm)
        _require_points(terms.usable, within_mm)
    used = terms.usable
    common = (terms.by_modes(points) + terms.design @ modes)[used]
    design = terms.design[used]
    own = terms.sigma_mm(points)[used] ** 2 + np.einsum("kp,pq,kq->k", design, covariance, design)
    mean = design.mean(axis=0)
    of_mean = own.sum() / len(own) ** 2 + mean @ covariance @ mean
    far = np.abs(terms.distance_mm) > within_mm
    return MeshComparison(
        xyz_mm=points.xyz_mm[used],
        distance_mm=terms.distance_mm[used],
        sigma_mm=np.sqrt(own + np.square(common).sum(axis=1)),
        mean_sigma_mm=float(np.sqrt(of_mean + np.square(common.mean(axis=0)).sum())),
        far=int(far.sum()),
        beside=int((~used & ~far).sum()),
        pose=MeshPose(placed.rotation, placed.translation_mm),
        fitted=fit,
    )


def _require_points(usable: Mask, within_mm: float) -> None:
    if not usable.any():
        raise MeasurementError(
            f"no point of the surface lies within {within_mm:g} mm of the mesh: is its position "
            "that in the surface's frame, and its unit right?"
        )


def save_coloured_points(path: Path, comparison: MeshComparison) -> None:
    """Write the points compared to a binary PLY file, coloured by their distance.

    Blue lies beneath the mesh and red above it, white on it.  Each vertex carries
    ``distance_mm`` and ``sigma_mm`` too.

    Parameters
    ----------
    path : Path, of the file
    comparison : MeshComparison, of a surface with a mesh

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    scaled = 0.5 + 0.5 * np.clip(comparison.distance_mm / comparison.limit_mm, -1.0, 1.0)
    colours = matplotlib.colormaps["coolwarm"](scaled, bytes=True)
    cloud = trimesh.PointCloud(comparison.xyz_mm, colors=colours)
    cloud.vertex_attributes = {
        "distance_mm": comparison.distance_mm.astype(np.float32),
        "sigma_mm": comparison.sigma_mm.astype(np.float32),
    }
    write_atomically(path, cloud.export(file_type="ply"))


@styled
def save_histogram(path: Path, comparison: MeshComparison) -> None:
    """Write a histogram of the distances as a PNG picture.

    Parameters
    ----------
    path : Path, of the file
    comparison : MeshComparison, of a surface with a mesh

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    limit = comparison.limit_mm
    figure = Figure(figsize=(WIDTH_IN, 2.8), layout="constrained", facecolor="white")
    axes = figure.subplots()
    shown = np.clip(comparison.distance_mm, -limit, limit)
    axes.hist(shown, bins=BARS, range=(-limit, limit), color=SECOND)
    axes.axvline(0.0, color=INK, linewidth=0.8)
    mean = float(comparison.distance_mm.mean())
    axes.axvline(mean, color=FIRST, label=f"mean {mean:+.3f} mm")
    axes.set_xlabel("distance from the mesh, mm")
    axes.set_ylabel("points")
    axes.legend()
    write_atomically(path, png(figure))
