"""How far the line is found from where it is on curved targets, and what corrections leave.

The paper's open question (its Sec. V): the error follows the target's concavity.  Here a
short scan is rendered without noise, each line is found as the centroid of all its light,
and its height is compared with the truth.  The plane map, the alignment and the sensor have
no part in it, so what is left are the blur along the line (lscan.stripe.corrections), the
sheet's thickness (lscan.surface.sheetresponse) and what neither describes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import trimesh

from lscan.config.documents import Document, merge
from lscan.config.rig import SheetSection, StripeSection, load_rig, parse_rig
from lscan.errors import InputError
from lscan.files.disk import make_folder, write_atomically, write_json
from lscan.records import Floats, Mask, Progress, Status, Stripe, Surface
from lscan.stripe.corrections import correct_blur
from lscan.surface.thickness import correct_thickness
from sim.render.tank import Tank
from sim.scene import Scene, scene_of
from sim.sensor import Webcam
from sim.truth import StripeTruth, project, stripe_truths

FINENESS = 2  # or the line's own width on level ground, 0.3 px, would follow the pixels
SAMPLES = 16  # a pixel
LINE_REACH_PX = 14  # of the window about the brightest pixel: six sigmas of the widest line here
DIMMEST = 0.05  # of the picture's brightest column: a camera of 8 bits sees no less
EDGE_PX = 6.0  # columns this near to an end of the line are left out
PEAK_DN = 200.0
SIGMA_PX = 0.01  # stated of centroids that have no noise: what a good extractor reaches
SPHERE_PX = (210, 290, 230, 190)  # the part of the picture that shows the sphere
BEYOND = 6  # profiles at either end of the short scan that only serve as neighbours


@dataclass(frozen=True)
class ConcavityCase:
    """A target to measure on.

    positions_mm: rising track positions, more than 2 BEYOND of them.  scatter_samples: a
    pixel, of the light of all higher orders; 0 leaves them out, and the water's veil with
    them: the line's own light alone is looked at.  derived: whether the relation was found on it.
    """

    name: str
    scene: Scene
    positions_mm: tuple[float, ...]
    scatter_samples: int = 0
    derived: bool = False


@dataclass(frozen=True)
class ConcavityErrors:
    """Height found less true height over the points of a scan, mm.

    name: of the target.  derived: whether the relation was found on it.  points: how many are
    compared.  rms_mm, q99_mm: root mean square and the 99 % quantile of the absolute error; one
    value each for the line as found, corrected for blur, and corrected for the sheet's thickness
    too.
    """

    name: str
    derived: bool
    points: int
    rms_mm: tuple[float, ...]
    q99_mm: tuple[float, ...]


@dataclass(frozen=True)
class ShortScan:
    """A scan without noise, each line the centroid of all its light, F frames of N columns.

    Attributes
    ----------
    found : (F, N) array, mm, heights as found
    surface : Surface, mm, head frame, with heights corrected for the camera's blur
    true_z_mm : (F, N) array, mm, true heights
    clear : (F, N) mask, of points with one line that is lit and seen, away from its ends
    """

    found: Floats
    surface: Surface
    true_z_mm: Floats
    clear: Mask


def concavity_errors(case: ConcavityCase) -> ConcavityErrors:
    """The errors over a short scan of the case's scene, before and after the corrections."""
    scan = short_scan(case.scene, case.positions_mm, case.scatter_samples)
    thin = correct_thickness(scan.surface, *sheet_of(case.scene))
    errors = [scan.found, scan.surface.xyz_mm[..., 2], thin.xyz_mm[..., 2]]
    compared = scan.clear & np.isfinite(scan.found)
    compared[:BEYOND] = compared[len(compared) - BEYOND :] = False
    off = [np.abs((z - scan.true_z_mm)[compared]) for z in errors]
    return ConcavityErrors(
        name=case.name,
        derived=case.derived,
        points=int(compared.sum()),
        rms_mm=tuple(float(np.sqrt(np.mean(e**2))) for e in off),
        q99_mm=tuple(float(np.quantile(e, 0.99)) for e in off),
    )


def short_scan(scene: Scene, positions_mm: Sequence[float], scatter_samples: int = 0) -> ShortScan:
    """A scan of a scene without noise, and its truth.

    Parameters
    ----------
    scene : Scene
    positions_mm : sequence of float, mm, of the track
    scatter_samples : int, a pixel, of the light of all higher orders; 0 leaves them out
    """
    scene = scene.with_tank(render={"samples": SAMPLES, "fineness": FINENESS})
    tank, webcam = Tank(scene), Webcam(scene)
    blur_px = scene.tank.lens.blur_px or None
    settings = StripeSection(blur_px=blur_px)
    truths = stripe_truths(scene, positions_mm)
    found, sharp = [], []
    for truth in truths:
        layers = tank.render(truth.position_mm, scatter_samples=scatter_samples)
        if scatter_samples == 0:
            layers = replace(layers, scattered=np.zeros_like(layers.scattered))
        electrons = webcam.mean_electrons(layers, scene.rig.camera.exposure_ms)[..., 0]
        light = electrons.T.astype(float)
        stripe = whole_line(light * (PEAK_DN / light.max()))
        found.append(_heights(scene, truth, stripe))
        sharp.append(_heights(scene, truth, correct_blur(stripe, settings, light)))
    return ShortScan(
        found=np.stack([z for z, _ in found]),
        surface=_surface(truths, sharp),
        true_z_mm=np.stack([truth.xz_mm[:, 1] for truth in truths]),
        clear=np.stack([_clear(truth) for truth in truths]),
    )


def whole_line(light: Floats) -> Stripe:
    """The centroid of all light about the brightest pixel of each column.

    light: (N, L) DN without noise, one column of the picture a row; the columns' medians are
    taken for background.
    """
    above = light - np.median(light, axis=1)[:, None]
    peak = above.max(axis=1)
    rows = above.argmax(axis=1)[:, None] + np.arange(-LINE_REACH_PX, LINE_REACH_PX + 1)
    inside = (rows >= 0) & (rows < light.shape[1])
    rows = np.clip(rows, 0, light.shape[1] - 1)
    window = np.where(inside, np.take_along_axis(above, rows, axis=1), 0.0)
    bright = peak > DIMMEST * peak.max()
    total = np.where(bright, window.sum(axis=1), 1.0)
    centre = np.where(bright, (window * rows).sum(axis=1) / total, np.nan)
    status = np.where(bright, int(Status.OK), int(Status.NO_PEAK))
    return Stripe("columns", centre, np.where(bright, SIGMA_PX, np.nan), peak, status)


def sheet_of(scene: Scene) -> tuple[SheetSection, float]:
    """What the correction for thickness has to know: the sheet, and its yaw in rad.

    Parameters
    ----------
    scene : Scene, its head moves on a linear track
    """
    laser, head = scene.tank.laser, scene.tank.head
    if head.shaft is not None:
        raise InputError("thickness: is corrected for on a linear track only", where=scene.source)
    sheet = SheetSection(
        thickness_mm=laser.waist_mm, camera_mm=head.camera_mm, apex_mm=laser.apex_mm
    )
    return sheet, float(np.radians(head.yaw_deg))


def _heights(scene: Scene, truth: StripeTruth, stripe: Stripe) -> tuple[Floats, Floats]:
    """(N,) heights in the sheet of a stripe's centres, and their sigmas, mm.

    Through the true projection, linear about the true point: 1 mm off, the tank's lens is
    nonlinear by less than 1e-3 mm.
    """
    known = np.flatnonzero(truth.status == Status.OK)
    x, z = truth.xz_mm[known].T
    here, above = (
        project(scene, np.column_stack([x, np.zeros_like(x), height])) for height in (z, z + 0.5)
    )
    scale = np.full(len(truth.status), np.nan)
    scale[known] = (above - here)[:, 1] / 0.5
    height = truth.xz_mm[:, 1] + (stripe.centre_px - truth.centre_px) / scale
    return height, stripe.sigma_px / np.abs(scale)


def _surface(truths: Sequence[StripeTruth], heights: Sequence[tuple[Floats, Floats]]) -> Surface:
    """The scan in the head frame."""
    z, sigma = (np.stack(column) for column in zip(*heights, strict=True))
    x = np.stack([truth.xz_mm[:, 0] for truth in truths])
    position = np.array([truth.position_mm for truth in truths])
    clear = np.stack([truth.status == Status.OK for truth in truths]) & np.isfinite(z)
    xyz = np.stack([x, np.broadcast_to(position[:, None], x.shape), z], axis=-1)
    status = np.where(clear, int(Status.OK), int(Status.NO_PEAK))
    return Surface(
        np.where(clear[..., None], xyz, np.nan), 0 * sigma, sigma, status, position, "head"
    )


def _clear(truth: StripeTruth) -> Mask:
    """(N,) columns with one point that is lit and seen, of the target, away from line ends."""
    inner: Mask = (truth.status == Status.OK) & ~truth.multiple & (truth.edge_px > EDGE_PX)
    return inner & (truth.face == 0)


def cases(scenes: Path, folder: Path) -> list[ConcavityCase]:
    """The sandwave the relation was found on, and the targets it has to prove itself on.

    scenes: folder of the scenes.  folder: where the meshes of a sphere and of two cylinders
    are written.  The meshes' chords stay within 0.005 mm of the shapes.
    """
    paper = load_rig(scenes / "paper" / "sandwave.toml").document
    wave, short = tuple(np.arange(150.0, 160.0, 0.5)), tuple(np.arange(-5.0, 5.0, 0.5))
    sphere, along, across = _meshes(folder)

    on_mesh = partial(mesh_scene, scenes)
    on_sphere = partial(mesh_scene, scenes, sphere, -380.0, SPHERE_PX)
    wide, green = {"blur_px": 1.2}, {"wavelength_nm": 532.0}
    thick, sea = {"waist_mm": 2.5}, {"particle_scattering_per_m": 0.4}
    return [
        ConcavityCase("sandwave, its steep end", _scene(paper), wave, derived=True),
        ConcavityCase("sandwave, blur 1.2 px", _scene(paper, lens=wide), wave),
        ConcavityCase("sphere of 60 mm", on_sphere(), short),
        ConcavityCase("sphere, sheet of 2.5 mm", on_sphere(laser=thick), short),
        ConcavityCase("sphere, 532 nm", on_sphere(laser=green), short),
        ConcavityCase("sphere, all orders, turbid", on_sphere(water=sea), short, 16),
        ConcavityCase("cylinders of 8 mm along the track", on_mesh(along, -330.0), short),
        ConcavityCase("cylinders of 8 mm across the track", on_mesh(across, -330.0), short),
        ConcavityCase(
            "mound of flat facets", on_mesh(scenes / "targets" / "mound.ply", -372.0), short
        ),
    ]


def mesh_scene(
    scenes: Path,
    file: Path,
    z_mm: float,
    window_px: tuple[int, int, int, int] = (0, 0, 640, 480),
    **sections: Document,
) -> Scene:
    """The scene of the grooved block with a mesh in its place.

    Parameters
    ----------
    scenes : Path, folder of the scenes
    file : Path, of the mesh, mm
    z_mm : float, mm, height of its origin in the tank
    window_px : tuple of int, left, top, width and height of the part of the picture that is kept
    sections : Document, sections laid over those of the scene
    """
    place = {"position_mm": [225.0, 0.0, z_mm], "turn_deg": 0.0}
    target = {"shape": "mesh", "file": str(file), "albedo": 0.5, **place}
    base = load_rig(scenes / "paper" / "groove.toml").document
    (left, top, width, height), (u, v) = window_px, base["lens"]["centre_px"]
    part = {
        "camera": {"width_px": width, "height_px": height},
        "lens": {"centre_px": [u - left, v - top]},
    }
    return _scene(merge(base, part), target=target, **sections)


def _scene(document: Document, **sections: Document) -> Scene:
    whole = merge(document, sections)
    return scene_of(parse_rig(whole, source="concavity", trusted=True))


def _meshes(folder: Path) -> tuple[Path, Path, Path]:
    """Files of a sphere, and of rows of cylinders along and across the track."""
    make_folder(folder)
    sphere = trimesh.creation.icosphere(subdivisions=6, radius=60.0)
    rods = [_rod(11.0 * k) for k in range(-9, 10)]
    along = trimesh.util.concatenate(rods)
    across = along.copy()
    across.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1]))
    paths = [folder / f"{name}.ply" for name in ("sphere", "along", "across")]
    for path, mesh in zip(paths, (sphere, along, across), strict=True):
        write_atomically(path, mesh.export(file_type="ply"))
    return paths[0], paths[1], paths[2]


def _rod(x_mm: float) -> trimesh.Trimesh:
    """A cylinder of 8 mm radius along y at ``x_mm``; rods 11 mm apart meet in grooves."""
    rod = trimesh.creation.cylinder(radius=8.0, height=160.0, sections=720)
    rod.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    rod.apply_translation([x_mm, 0.0, 0.0])
    return rod


def run_concavity(
    scenes: Path, output: Path, only: str = "", progress: Progress | None = None
) -> list[ConcavityErrors]:
    """The table, also written to ``output``/concavity.json.

    Parameters
    ----------
    scenes, output
        Folder of the scenes, and the one to write to.
    only
        What the names of the targets have to hold.
    progress
        Called with how many targets are done, and how many there are.

    Raises
    ------
    InputError
        Where there is no such target.
    """
    every = cases(scenes, output / "meshes")
    if not (chosen := [case for case in every if only in case.name]):
        allowed = "; ".join(case.name for case in every)
        raise InputError("no such target", where="--only", value=only, allowed=allowed)
    errors = []
    for done, case in enumerate(chosen):
        if progress is not None:
            progress(done, len(chosen))
        errors.append(concavity_errors(case))
    write_json(output / "concavity.json", errors)
    return errors
