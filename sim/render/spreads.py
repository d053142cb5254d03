"""Tables of scattered light of a scene's water: made once and kept in the user's cache."""

import hashlib

import numpy as np

from lscan.errors import InputError
from lscan.records import Floats, Progress
from sim.render.photons import batches, first_crossings, plane_crossings
from sim.water import Optics
from sim.water.axes import ANGLE_AXIS
from sim.water.single import OnceScattered
from sim.water.spread import Spread, tabulate
from sim.water.tablecache import kept_arrays

FORMAT = 3  # of the kept files: raised where other numbers would be written
# 60 s on two cores in water of 10 NTU, 15 s of 1 NTU; the error is then 0.3 % and less where the
# light of a ring is 1 % of the brightest ring's, up to 2.5 rad off the beam.
PHOTONS, SEED = 20 * 2**20, 1
# Distances of a scanner's parts, mm.  Beyond so many scatterings hardly any light arrives.
NEAREST_MM, FARTHEST_MM = 100.0, 3000.0
MOST_SCATTERINGS = 25.0
SPHERES = 16
TO_PLANES = 4  # so many photons go to spheres for each one that goes to planes
TILTS = np.radians([0.0, 15.0, 30.0, 42.0, 52.0, 61.0, 69.0, 76.0])


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

    more = photons // TO_PLANES

    def made() -> dict[str, Floats]:
        first, every = batches(photons), batches(photons) + batches(more)
        shown = progress or (lambda done, every: None)
        crossings = first_crossings(
            water.phase, albedo, depths, photons, seed, lambda done, _: shown(done, every)
        )
        counts = plane_crossings(
            water.phase, albedo, depths, TILTS, more, seed, lambda d, _: shown(first + d, every)
        )
        spread = tabulate(water.phase, albedo, crossings, counts)
        once = spread.once.table.view(float)
        kept = ("multiple", "error", "horizon")
        return {"once": once, **{name: getattr(spread, name) for name in kept}}

    numbers = [FORMAT, albedo, photons, seed, *depths, *water.phase(ANGLE_AXIS.nodes())]
    key = hashlib.sha256(np.array(numbers, dtype=float).tobytes()).hexdigest()
    kept = kept_arrays(f"spread-{key[:32]}", made)
    once = OnceScattered(albedo, farthest, kept["once"].view(complex))
    tables = (kept[name] for name in ("multiple", "error", "horizon"))
    return Spread(once, nearest, farthest, *tables)
