"""Tables of scattered light of a scene's water: made once, kept, and looked up in kernels."""

import hashlib

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.errors import InputError
from lscan.records import Floats, Progress
from sim.render.photons import first_crossings
from sim.render.plugins.opaque import opaque
from sim.water import Optics
from sim.water.axes import ANGLE_AXIS, NEAREST_RAD, LogAxis
from sim.water.single import FARTHEST_RAD, OnceScattered
from sim.water.spread import Spread, tabulate
from sim.water.tablecache import kept_arrays

FORMAT = 1  # of the kept files: raised where other numbers would be written
PHOTONS, SEED = 30 * 2**20, 1
# Distances of a scanner's parts, mm.  Beyond so many scatterings next to nothing arrives.
NEAREST_MM, FARTHEST_MM = 100.0, 3000.0
MOST_SCATTERINGS = 15.0
SPHERES = 16


def spread_of(
    water: Optics, photons: int = PHOTONS, seed: int = SEED, progress: Progress | None = None
) -> Spread:
    """How a beam spreads in a water: from the user's cache, or made and kept there.

    Parameters
    ----------
    water : Optics, the water
    photons : int, how many at least
    seed : int, of the random numbers
    progress : callable, optional, called with (done, all) while the tables are made

    Raises
    ------
    InputError
        The water scatters nothing.
    """
    if water.scattering_per_mm <= 0:
        raise InputError("scatters no light", where="water", value=0.0, allowed="above 0")
    albedo = water.scattering_per_mm / water.extinction_per_mm
    farthest = min(water.extinction_per_mm * FARTHEST_MM, MOST_SCATTERINGS / albedo)
    nearest = min(water.extinction_per_mm * NEAREST_MM, farthest / 2)
    depths = np.geomspace(nearest, farthest, SPHERES)

    def made() -> dict[str, Floats]:
        crossings = first_crossings(water.phase, albedo, depths, photons, seed, progress)
        spread = tabulate(water.phase, albedo, crossings)
        once = spread.once.table.view(float)
        return {"once": once, "multiple": spread.multiple, "error": spread.error}

    numbers = [FORMAT, albedo, photons, seed, *depths, *water.phase(ANGLE_AXIS.nodes())]
    key = hashlib.sha256(np.array(numbers, dtype=float).tobytes()).hexdigest()
    kept = kept_arrays(f"spread-{key[:32]}", made)
    once = OnceScattered(albedo, farthest, kept["once"].view(complex))
    return Spread(once, nearest, farthest, kept["multiple"], kept["error"])


class SpreadLookup:
    """The tables for kernels; lengths in mm.

    Each call reads one pair of the table for light scattered more than once and two of that for
    light scattered once, each between four nodes.
    """

    def __init__(self, spread: Spread, extinction_per_mm: float) -> None:
        """Copy the tables.

        Parameters
        ----------
        spread : Spread, of the water
        extinction_per_mm : float, the water's attenuation, 1/mm
        """
        once = spread.once.table
        self.once = _KernelTable(np.stack([once.real, once.imag], -1), spread.once.across_axis)
        self.multiple = _KernelTable(spread.multiple, spread.depth_axis)
        self.extinction = opaque(extinction_per_mm)
        self.albedo, self.loss = opaque(spread.once.albedo), opaque(spread.loss)

    def __call__(
        self, theta: mi.Float, distance: mi.Float, end: mi.Float | None = None
    ) -> tuple[mi.Float, mi.Float]:
        """Radial and tangential part of the vector irradiance of a beam of unit power, 1/mm2.

        Parameters
        ----------
        theta : rad off the beam
        distance : mm from the beam's origin
        end : optional, mm, where the beam ends for light scattered once; left out, at ``distance``
        """
        theta = dr.clip(theta, NEAREST_RAD, FARTHEST_RAD)
        depth = self.extinction * distance
        end = depth if end is None else self.extinction * end
        sine, cosine = dr.sincos(theta)
        across, ahead = depth * sine, depth * cosine - end
        onward, seen = dr.hypot(across, ahead), dr.atan2(across, ahead)
        near, near_aside = self._integral(theta, across)
        far, far_aside = self._integral(seen, across)
        turn_sine, turn_cosine = dr.sincos(seen - theta)
        before, behind = dr.exp(-depth), dr.exp(-(end + onward))
        scale = self.albedo / across
        radial = before * near - behind * (far * turn_cosine - far_aside * turn_sine)
        aside = before * near_aside - behind * (far * turn_sine + far_aside * turn_cosine)
        log_value, ratio = self.multiple(depth, theta)
        more = dr.exp(log_value - self.loss * depth)
        unit = dr.square(self.extinction)
        return unit * (scale * radial + more), unit * (scale * aside + more * ratio)

    def _integral(self, angle: mi.Float, across: mi.Float) -> tuple[mi.Float, mi.Float]:
        angle = dr.maximum(angle, NEAREST_RAD)
        real, imaginary = self.once(across, angle)
        return real / angle, imaginary / angle


class _KernelTable:
    """A (R, C, 2) table over an axis of rows and ``ANGLE_AXIS``, read between its nodes."""

    def __init__(self, table: Floats, rows: LogAxis) -> None:
        # Units that interpolate in hardware keep 8 bits of a place.
        tensor = mi.TensorXf(np.ascontiguousarray(table, dtype=np.float32))
        self.texture = mi.Texture2f(tensor, use_accel=False)
        self.offset, self.rows = opaque(rows.offset), rows.count
        self.start, self.scale = opaque(rows.start), opaque(rows.scale)

    def __call__(self, row: mi.Float, angle: mi.Float) -> list[mi.Float]:
        down = (dr.log(row + self.offset) - self.start) * self.scale
        along = (dr.log(angle) - ANGLE_AXIS.start) * ANGLE_AXIS.scale
        return self.texture.eval(
            mi.Point2f((along + 0.5) / ANGLE_AXIS.count, (down + 0.5) / self.rows)
        )
