"""The tank: from a scene to radiance, in layers, wherever the head stands."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import ceil
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.devices.signals import interruption_kept
from lscan.errors import InputError
from lscan.records import Floats
from sim.meshes import MeshPart, scene_parts
from sim.render.ambient import AmbientField, OpenSky, sky_of
from sim.render.backend import flushing
from sim.render.firstorder import SparseLaserLight, ambient_picture, film_rays, reason_for_samples
from sim.render.gathered.picture import GatheredLight, reason_for_random
from sim.render.layers import W_PER_M2_IN_MW_PER_MM2, Layers, Radiance, finer_lens, pixel_parts
from sim.render.materials import mitsuba_shape
from sim.render.plugins.camera import RefractiveCamera
from sim.render.plugins.sheet import LaserSheet
from sim.render.sampled.integrator import SheetIntegrator, WaterIntegrator
from sim.render.sampled.multiple import MultipleIntegrator
from sim.scene import Head, Pose, Scene, camera_pose, head_pose
from sim.scene.file import check_samples
from sim.scene.poses import TRACK
from sim.water import glass_index, water_optics

_log = logging.getLogger(__name__)

UM_PER_MM = 1e3
PLACES = 5  # of a scan, that say what the camera sees in it


@contextmanager
def _rendering() -> Iterator[None]:
    """What holds while Mitsuba works for a tank."""
    with flushing(), interruption_kept():
        yield


class Tank:
    """A scene loaded into Mitsuba; only the head moves, so geometry is built once.

    integrator: light of the first order.  higher: light of all higher orders, at random.
    gathers: whether the laser's light of higher orders is gathered instead.

    A picture may have numbers of its own (sim.scene.file), which ``take`` takes on.  Where the
    head is, and how much light there is, costs nothing.  Where camera or sheets lie in the head,
    and the wavelength, cost the rays of a picture anew.  Of the light of higher orders that is
    gathered, what the line sends on, its halo and the glow on surfaces move with camera and
    sheets; the tables stay the scene's own: the veil's, and what surfaces leave of it and of the
    halo, as if camera and sheets lay in the head as there, and all for the scene's wavelength.
    On the paper's groove that is off by 1e-6 of the line's peak for a sheet tilted by 0.1 degrees,
    by 3e-5 for a camera turned by 0.01 degrees, by up to 4e-3 for 2 nm (the photons' noise of both
    tables included).
    """

    @_rendering()
    def __init__(self, scene: Scene, *, sampled: bool = False, water_step: float = 0.0) -> None:
        """Load meshes and plugins.

        Parameters
        ----------
        scene : Scene, all of it; the head may move later, by ``place``
        sampled : bool, the laser's light of the first order gets its samples in every pixel, not
            only where it is uneven
        water_step : float, relative, to which the water's coefficients are rounded for its light of
            higher orders: tanks of nearly the same water then have the same tables, which take
            seconds to make

        Raises
        ------
        InputError
            A mesh or a picture cannot be read.
        """
        self.scene = self._built = scene
        self._water_step = water_step
        self._anew, self._scales = False, (np.float32(1), np.float32(1))
        laser = scene.tank.laser
        self._lines = laser.sheets if laser.on else ()
        self.sheets = [LaserSheet(mi.Properties()) for _ in self._lines]
        self.integrator = SheetIntegrator(mi.Properties())
        self.higher = MultipleIntegrator(mi.Properties())
        is_lit = scene.tank.light.ambient_w_m2_sr > 0
        self._daylight = SheetIntegrator(mi.Properties()) if is_lit else None
        self._sky: AmbientField | OpenSky | None = None
        self._tune(laser.wavelength_nm)
        self._camera, self._random_camera = self.make_camera(), self.make_camera(jitter=True)
        self._parts = parts = scene_parts(scene)
        shapes = {f"part-{k}": mitsuba_shape(p, self.water.index) for k, p in enumerate(parts)}
        lights = {f"sheet-{k}": sheet for k, sheet in enumerate(self.sheets)}
        self.mitsuba_scene = mi.load_dict({"type": "scene", **shapes, **lights})
        self._sparse = None if sampled else self._few_rays()
        self._sky = self._known_sky(parts)
        self.gathers = bool(self.sheets) and not self._draws_higher_orders(parts)
        self._gathered: GatheredLight | None = None
        self.place(scene.rig.plan.start_mm)

    @_rendering()
    def make_camera(
        self,
        window: tuple[int, int, int, int] | None = None,
        medium: Mapping[str, Any] | None = None,
        jitter: bool = False,
    ) -> RefractiveCamera:
        """A camera of the scene, the head at track position 0, for any integrator.

        Its film has the scene's fineness of rows and columns to each of the picture's.

        Parameters
        ----------
        window : (left, top, width, height), px, of the picture to render; all of it if None
        medium : mapping or None, a stock medium to stand in, which integrators of Mitsuba's own
            need
        jitter : bool, random samples; without it they lie on a regular grid: what is a smooth
            function of position converges there at once, without noise
        """
        section, fineness = self.scene.rig.camera, self.scene.tank.render.fineness
        left, top, width, height = window or (0, 0, section.width_px, section.height_px)
        sampler = {"type": "independent"} if jitter else {"type": "stratified", "jitter": False}
        settings: dict[str, Any] = {
            "type": "refractive_camera",
            "film": {
                "type": "hdrfilm",
                "width": fineness * section.width_px,
                "height": fineness * section.height_px,
                "crop_offset_x": fineness * left,
                "crop_offset_y": fineness * top,
                "crop_width": fineness * width,
                "crop_height": fineness * height,
                "pixel_format": "luminance",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": sampler,
            "fineness": fineness,
        }
        if medium is not None:
            settings["medium"] = medium
        camera = mi.load_dict(settings)
        assert isinstance(camera, RefractiveCamera)
        self._focus(camera)
        head = self.scene.tank.head
        camera.place(head_pose(head, 0.0) @ camera_pose(head))
        return camera

    @_rendering()
    def take(self, scene: Scene) -> None:
        """Take on the numbers of a picture.

        Parameters
        ----------
        scene : Scene, the tank's own, or as ``sim.scene.at_moment`` makes it of that
        """
        built = self._built.tank
        powers = scene.tank.laser.power_mw / built.laser.power_mw
        is_lit = built.light.ambient_w_m2_sr > 0
        ambient = scene.tank.light.ambient_w_m2_sr / built.light.ambient_w_m2_sr if is_lit else 1.0
        self._scales = np.float32(powers), np.float32(ambient)
        # Light is proportional to its source: the tank goes on with the scene's power.
        changed = scene.with_tank(
            laser={"power_mw": built.laser.power_mw},
            light={"ambient_w_m2_sr": built.light.ambient_w_m2_sr},
        )
        if _optics(changed) != _optics(self.scene):
            # The tables are the scene's own, whichever picture comes first.
            self._look(anew=False, gathered=self.scene.tank.render.scatter_samples > 0)
            self._anew = True
        self.scene = changed

    def place(self, position_mm: float, exposure_ms: float | None = None) -> None:
        """Move the head, camera and laser, to a track position.

        Parameters
        ----------
        position_mm : float, mm, along the track
        exposure_ms : float or None, ms, how long the shutter is open, which matters where the head
            does not stand still; the rig's if None
        """
        head, sensor = self.scene.tank.head, self.scene.tank.sensor
        pose = head_pose(head, position_mm)
        velocity = head.speed_mm_s * TRACK
        exposure_ms = self.scene.rig.camera.exposure_ms if exposure_ms is None else exposure_ms
        for camera in (self._camera, self._random_camera):
            camera.place(pose @ camera_pose(head))
            if head.speed_mm_s != 0:
                camera.move(velocity, exposure_ms, sensor.readout_ms)
        for sheet in self.sheets:
            sheet.place(pose, velocity)

    @_rendering()
    def render(
        self,
        position_mm: float,
        samples: int | None = None,
        *,
        scatter_samples: int | None = None,
        time_s: float = 0.0,
        exposure_ms: float | None = None,
    ) -> Layers:
        """The layers seen from a track position, (f H, f W) with the scene's fineness f.

        Each of a pixel's f² parts gets its share of the samples, of the scattered ones rounded up.

        Parameters
        ----------
        position_mm : float, mm, along the track
        samples : int or None, a pixel, for light of the first order; the scene's if None
        scatter_samples : int or None, a pixel, for all higher orders; the scene's if None
        time_s : float, s since the laser was switched on
        exposure_ms : float or None, as of ``place``

        Raises
        ------
        InputError
            The samples are no square number in each part.
        """
        render, laser = self.scene.tank.render, self.scene.tank.laser
        samples = render.samples if samples is None else samples
        check_samples(samples, render.fineness, where="samples")
        parts = render.fineness**2
        anew = self._anew or laser.drift is not None
        if anew:
            self._tune(laser.wavelength_at(time_s))
            self._focus(self._camera)
            self._focus(self._random_camera)
        more = render.scatter_samples if scatter_samples is None else scatter_samples
        self._look(anew=anew, gathered=more > 0)
        self._anew = False  # once it is done: a picture that was interrupted leaves it to the next
        self.place(position_mm, exposure_ms)
        # The noise of one picture of a scan says nothing about that of the next.
        place = np.array([position_mm]).view(np.uint64)
        seed = int(np.random.SeedSequence([render.seed, int(place[0])]).generate_state(1)[0])
        if self._daylight is not None and self._sky is not None:
            self._daylight.light_by(self._sky, higher=more > 0)
        first = self._first_order(position_mm, samples, seed, gathered=more > 0)
        if more > 0 and ((self.sheets and not self.gathers) or self.higher.has_ambient):
            share = ceil(more / parts)
            higher = self._layers(self._random_camera, self.higher, share, seed)
            for name, layer in higher.items():
                first[name] = first[name] + layer
        laser_scale, ambient_scale = self._scales
        direct, scattered = first["direct"] * laser_scale, first["scattered"] * laser_scale
        return Layers(direct=direct, scattered=scattered, ambient=first["ambient"] * ambient_scale)

    @_rendering()
    def pixel_rays(self, position_mm: float) -> tuple[mi.Ray3f, mi.Float]:
        """The rays in the water through the middles of the pixels, row by row; their weights.

        In the world, as the tank was rendered last.

        Parameters
        ----------
        position_mm : float, mm, along the track
        """
        width, height = self.scene.rig.camera.size_px
        head, index = self.scene.tank.head, dr.arange(mi.UInt32, width * height)
        u, v = index % width, index // width
        if self._sparse is None or self.scene.tank.render.fineness > 1:
            camera = self.make_camera()
            camera.place(head_pose(head, position_mm) @ camera_pose(head))
            place = mi.Point2f((mi.Float(u) + 0.5) / width, (mi.Float(v) + 0.5) / height)
            return film_rays(camera, place)
        self._sparse.look(head, False)
        rays = self._sparse.rays
        inner = (v + 1) * rays.size_px[0] + u + 1  # within the margin of one pixel
        ray = dr.gather(mi.Ray3f, rays.seen_from(head_pose(head, position_mm)), inner)
        return ray, dr.gather(mi.Float, rays.weight, inner)

    @_rendering()
    def higher_orders(self, position_mm: float, samples: int | None = None) -> dict[str, Radiance]:
        """The laser's light of higher orders, (H, W) in W/(m2 sr), gathered, by families.

        Parameters
        ----------
        position_mm : float, mm, along the track
        samples : int or None, as of ``render``

        Returns
        -------
        mapping
            "surfaces", straight from surfaces that scattered or reflected light lights; "camera",
            scattered on its way from surfaces; "veil", never reflected.

        Raises
        ------
        InputError
            The scene's light is not gathered.
        """
        self._look(anew=False, gathered=True)
        if self._gathered is None or self._sparse is None:
            what = "its light of higher orders is not gathered"
            where = self.scene.source
            allowed = 'render.light = "gathered" and what that can do'
            raise InputError(what, where=where, value=self.scene.tank.render.light, allowed=allowed)
        samples = self.scene.tank.render.samples if samples is None else samples
        self.place(position_mm)
        head = head_pose(self.scene.tank.head, position_mm)
        first = self._sparse.picture(head, samples, sharp=True)
        head = self._camera_with(head)
        families = self._gathered.families(head, position_mm, first.direct, first.seen)
        return {name: light * W_PER_M2_IN_MW_PER_MM2 for name, light in families.items()}

    def _first_order(
        self, position_mm: float, samples: int, seed: int, gathered: bool
    ) -> dict[str, Radiance]:
        """All layers, of light of the first order; head and cameras are in place.

        gathered: with the laser's light of higher orders, where that is gathered.
        """
        fineness = self.scene.tank.render.fineness
        share = samples // fineness**2
        if self._sparse is None:
            return self._layers(self._camera, self.integrator, share, seed)
        head = head_pose(self.scene.tank.head, position_mm)
        if self.sheets:
            laser = self._sparse.picture(head, samples)
            direct, scattered = laser.direct, laser.scattered
            if gathered and self._gathered is not None:
                there, sharp = self._camera_with(head), laser
                if self._sparse.rays.defocus is not None:
                    sharp = self._sparse.picture(head, samples, sharp=True)
                families = self._gathered.families(there, position_mm, sharp.direct, sharp.seen)
                more = sum(families.values(), np.zeros((), np.float32))
                scattered = scattered + pixel_parts(more, fineness)
        else:
            width, height = self.scene.rig.camera.size_px
            direct = scattered = np.zeros((fineness * height, fineness * width), np.float32)
        unit = np.float32(W_PER_M2_IN_MW_PER_MM2)
        direct, scattered = direct * unit, scattered * unit
        if self._daylight is None:
            ambient = np.zeros_like(direct)
        elif self._sky is not None:
            ambient = unit * ambient_picture(
                self.mitsuba_scene, self._camera, self._daylight, self._sparse.rays, head, samples
            )
        else:
            ambient = self._layers(self._camera, self._daylight, share, seed)["ambient"]
        return {"direct": direct, "scattered": scattered, "ambient": ambient}

    def _camera_with(self, head: Pose) -> Pose:
        """Where a head whose camera sits as in the tank's own scene would have it where it is."""
        own, now = self._built.tank.head, self.scene.tank.head
        if _camera_of(own) == _camera_of(now):
            return head
        there, back = camera_pose(now), camera_pose(own)
        turn = there.rotation @ back.rotation.T
        return head @ Pose(turn, there.origin_mm - turn @ back.origin_mm)

    def _look(self, *, anew: bool, gathered: bool) -> None:
        """Compute what is the same in all pictures of a wavelength; all is placed after that.

        gathered: the light of higher orders, too, where it is gathered.
        """
        if self._sparse is None:
            return
        self._sparse.look(self.scene.tank.head, anew)
        if gathered and self.gathers and self._gathered is None:
            head, places_mm = self.scene.tank.head, self.scene.rig.plan.positions_mm()
            ends = places_mm[0], places_mm[-1]
            self._gathered = GatheredLight(
                self.mitsuba_scene,
                self._parts,
                self.integrator,
                self._sparse.rays,
                head,
                self.water.rounded(self._water_step),
                [head_pose(head, place_mm) for place_mm in np.linspace(*ends, PLACES)],
            )

    def _few_rays(self) -> SparseLaserLight | None:
        """What renders the laser's light of the first order from few rays, where that can be."""
        if reason := reason_for_samples(self.scene):
            _log.warning("note: %s: every pixel is sampled (%s)", self.scene.source, reason)
            return None
        return SparseLaserLight(self.scene, self.mitsuba_scene, self._camera, self.integrator)

    def _draws_higher_orders(self, parts: Sequence[MeshPart]) -> bool:
        """Whether the laser's light of higher orders is drawn at random."""
        if self.scene.tank.render.light == "sampled" or self._sparse is None:
            return True
        reason = reason_for_random(self.scene, parts, self.water)
        if reason and self.scene.tank.render.scatter_samples > 0:
            _log.warning("note: %s: higher orders are random (%s)", self.scene.source, reason)
        return bool(reason)

    def _layers(
        self, camera: RefractiveCamera, integrator: WaterIntegrator, samples: int, seed: int
    ) -> dict[str, Radiance]:
        """Each layer's name and picture."""
        image = mi.render(
            self.mitsuba_scene, sensor=camera, integrator=integrator, spp=samples, seed=seed
        )
        image, names = np.array(image), integrator.layers
        channels = image[..., -len(names) :]
        # Mitsuba weighs its own sum with the camera's transmission but not the channels beside
        # it; within a pixel that weight is the same for all samples.
        total = channels.sum(axis=-1)
        weight = np.divide(image[..., 0], total, out=np.zeros_like(total), where=total > 0)
        channels = channels * (weight * np.float32(W_PER_M2_IN_MW_PER_MM2))[..., np.newaxis]
        return {name: np.ascontiguousarray(channels[..., k]) for k, name in enumerate(names)}

    def _tune(self, wavelength_nm: float) -> None:
        """Set the water and the laser for a wavelength."""
        tank = self.scene.tank
        self.water = water_optics(tank.water, wavelength_nm)
        self.glass_index = glass_index(tank.port.glass_index, wavelength_nm)
        for sheet, line in zip(self.sheets, self._lines, strict=True):
            sheet.configure(tank.laser, line, self.water.index, wavelength_nm)
        ambient = tank.light.ambient_w_m2_sr / W_PER_M2_IN_MW_PER_MM2
        self.integrator.configure(self.water, self.sheets, ambient, tank.light)
        drawn = ambient if self._sky is None else 0.0
        self.higher.configure(self.water, self.sheets, drawn, tank.light)
        if self._daylight is not None:
            self._daylight.configure(self.water, (), ambient, tank.light)

    def _focus(self, camera: RefractiveCamera) -> None:
        """Set a camera's optics for the water as it is."""
        lens, sensor = self.scene.tank.lens, self.scene.tank.sensor
        focal_mm = lens.focal_px * sensor.pixel_um / UM_PER_MM
        aperture_mm = 0.0 if lens.focus_mm is None else focal_mm / lens.f_number
        camera.configure(
            finer_lens(lens, camera.fineness),
            self.scene.tank.port,
            self.glass_index,
            self.water.index,
            aperture_mm=aperture_mm,
        )

    def _known_sky(self, parts: Sequence[MeshPart]) -> AmbientField | OpenSky | None:
        """How ambient light falls on surfaces; None where it is drawn at random.

        That is on glossy surfaces, and on sand, whose grains are finer than a lattice of nodes.
        """
        if self._daylight is None or self._sparse is None:
            return None
        if self.scene.tank.target.sand is not None or any(p.finish.kind != "matt" for p in parts):
            return None
        self.higher.has_ambient = False
        return sky_of(self.mitsuba_scene, parts, self.water)


def _optics(scene: Scene) -> tuple[object, ...]:
    """What of a scene the rays in the head depend on, and changes from picture to picture."""
    return scene.tank.laser, _camera_of(scene.tank.head)


def _camera_of(head: Head) -> tuple[object, ...]:
    """Where the camera is in the head."""
    return head.camera_mm, head.depression_deg, head.heading_deg, head.roll_deg


# What surface each pixel of a picture sees, through the middle of the pixel and of the pupil.


@dataclass(frozen=True)
class SeenSurfaces:
    """The surfaces in a picture; NaN where a pixel sees none.

    Attributes
    ----------
    points_mm : (H, W, 3) array, mm, from the camera's pinhole; camera frame: x right, y down, z
        along the axis.  Behind a port they do not lie on the straight line through the pixel.
    normals : (H, W, 3) array, unit vectors towards the camera's side of the surface; camera frame
    """

    points_mm: Floats
    normals: Floats

    @property
    def depth_mm(self) -> Floats:
        """(H, W) mm along the camera's axis from its pinhole."""
        return self.points_mm[..., 2]


def surfaces_seen(tank: Tank, position_mm: float) -> SeenSurfaces:
    """The surfaces in the picture that a tank would take now.

    Parameters
    ----------
    tank : Tank, as it was rendered last
    position_mm : float, mm, along the track; where the head moves, in the middle of the read-out
    """
    width, height = tank.scene.rig.camera.size_px
    head = tank.scene.tank.head
    pose = head_pose(head, position_mm) @ camera_pose(head)
    ray, weight = tank.pixel_rays(position_mm)
    found = tank.mitsuba_scene.ray_intersect(ray)
    # The pose is data of the kernel: as a constant it would have each picture compiled anew.
    axes = [mi.Vector3f(column) for column in pose.rotation.T.tolist()]
    pinhole = mi.Point3f(pose.origin_mm.tolist())
    dr.make_opaque(axes, pinhole)
    place = ray.o + found.t * ray.d - pinhole
    towards = dr.select(dr.dot(found.n, ray.d) > 0, -found.n, found.n)
    seen = found.is_valid() & (weight > 0)
    parts = [dr.dot(vector, axis) for vector in (place, towards) for axis in axes]
    parts = [dr.select(seen, part, dr.nan) for part in parts]
    dr.eval(parts)
    along = np.stack([np.array(part).reshape(height, width) for part in parts], axis=-1)
    return SeenSurfaces(along[..., :3], along[..., 3:])
