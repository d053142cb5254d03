"""Tables of scattered light of a scene's water: made once and kept in the user's cache."""

import hashlib
import os

import numpy as np

from lscan.errors import InputError
from lscan.files.disk import long_work
from lscan.records import Floats, Progress
from sim.render.photons import batches, first_crossings, plane_crossings
from sim.water import Optics
from sim.water.spread import ANGLE_AXIS, OnceScattered, Spread, tabulate
from sim.water.tablecache import kept_arrays

FORMAT = 3  # of the kept files: raised where other numbers would be written
# 81 s of one core in water of 10 NTU, 50 s in 5, 19 s in 1, shared by all cores: a third each for
# counting, for drawing angles and for the rest of the walks.  The standard error is then 0.3 % or
# less within 2.5 rad of the beam, wherever the light of a ring is 1 % of the brightest ring's.
MOST_PHOTONS, FEWEST_PHOTONS, SEED = 20 * 2**20, 2**14, 1
# Distances of a scanner's parts, mm.  Beyond so many scatterings hardly any light arrives.
NEAREST_MM, FARTHEST_MM = 100.0, 3000.0
MOST_SCATTERINGS = 25.0
SPHERES = 16
TO_PLANES = 4  # so many photons go to spheres for each one that goes to planes
KEPT = ("multiple", "error", "horizon")
TILTS = np.radians([0.0, 15.0, 30.0, 42.0, 52.0, 61.0, 69.0, 76.0])


def photons_asked_for() -> int:
    """As LSCAN_PHOTONS says, for who needs tables soon rather than smooth.

    Raises
    ------
    InputError
        It says no number, or too small a one.
    """
    said = os.environ.get("LSCAN_PHOTONS", str(MOST_PHOTONS))
    if not said.isdecimal() or int(said) < FEWEST_PHOTONS:
        allowed = f"a whole number from {FEWEST_PHOTONS} on"
        raise InputError("no number of photons", where="LSCAN_PHOTONS", value=said, allowed=allowed)
    return int(said)


PHOTONS = photons_asked_for()


def spread_of(water: Optics, photons: int = PHOTONS, seed: int = SEED) -> Spread:
    """How a beam spreads in a water: from the user's cache, or made and kept there.

    A command line shows how far the making is (``lscan.files.disk``).

    Parameters
    ----------
    water : Optics, the water
    photons : int, how many at least
    seed : int, of the random numbers

    Raises
    ------
    InputError
        The water scatters nothing.
    """
    depths = _depths(water)

    def made() -> dict[str, Floats]:
        with long_work("tables of this water's scattered light") as progress:
            spread = make_spread(water, photons, seed, progress)
        once = spread.once.table.view(float)
        return {"once": once, **{name: getattr(spread, name) for name in KEPT}}

    phase = water.phase(ANGLE_AXIS.nodes())
    numbers = np.array([FORMAT, _albedo(water), photons, seed, *depths, *phase], dtype=float)
    kept = kept_arrays(f"spread-{hashlib.sha256(numbers.tobytes()).hexdigest()[:32]}", made)
    nearest, farthest = (float(depth) for depth in depths[[0, -1]])
    once = OnceScattered(_albedo(water), farthest, kept["once"].view(complex))
    return Spread(once, nearest, farthest, *(kept[name] for name in KEPT))


def make_spread(water: Optics, photons: int, seed: int, progress: Progress | None = None) -> Spread:
    """How a beam spreads in a water, made anew.

    Parameters
    ----------
    water, photons, seed : as of ``spread_of``
    progress : callable, optional, called with (done, all)
    """
    albedo, depths, flat = _albedo(water), _depths(water), photons // TO_PLANES
    first, every = batches(photons), batches(photons) + batches(flat)
    shown = progress or (lambda done, every: None)
    crossings = first_crossings(
        water.phase, albedo, depths, photons, seed, lambda done, _: shown(done, every)
    )
    counts = plane_crossings(
        water.phase, albedo, depths, TILTS, flat, seed, lambda done, _: shown(first + done, every)
    )
    return tabulate(water.phase, albedo, crossings, counts)


def _albedo(water: Optics) -> float:
    return water.scattering_per_mm / water.extinction_per_mm


def _depths(water: Optics) -> Floats:
    """(SPHERES,) optical depths at which photons are counted."""
    if water.scattering_per_mm <= 0:
        raise InputError("scatters no light", where="water", value=0.0, allowed="above 0")
    farthest = min(water.extinction_per_mm * FARTHEST_MM, MOST_SCATTERINGS / _albedo(water))
    return np.geomspace(min(water.extinction_per_mm * NEAREST_MM, farthest / 2), farthest, SPHERES)
