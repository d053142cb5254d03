"""A plane map carried from the rig it was calibrated on to the rig of a scan.

What the scan's rig says of its water, and of what may have changed since the calibration.
"""

from collections.abc import Callable
from dataclasses import replace

from lscan.calibration.api import PlaneMap
from lscan.calibration.maps.auto import Auto
from lscan.calibration.physical import PhysicalMap
from lscan.calibration.solved import SolvedMap
from lscan.camera.optics import stated_water
from lscan.config.rig import OpticsSection, Rig, SinceSection
from lscan.errors import InputError

ALLOWED = "a refractive or metric map, or a calibration of the same water and rig"
SAME_INDEX = 1e-4  # a difference of a degree; it changes 300 mm by 0.02 mm


def carried(plane_map: PlaneMap, rig: Rig) -> PlaneMap:
    """The map for the pictures of a rig: in its water, with what may have changed since.

    Parameters
    ----------
    plane_map : PlaneMap, as calibrated
    rig : Rig, of the scan: its ``[optics]`` and ``[since_calibration]`` count

    Raises
    ------
    InputError
        For a map that does not know the physics.
    """
    plane_map, since = in_water_of(plane_map, rig.optics), rig.since_calibration
    if since is None or not any(dict(since).values()):
        return plane_map
    return with_chosen(plane_map, lambda solved: _changed(solved, since))


def in_water_of(plane_map: PlaneMap, optics: OpticsSection) -> PlaneMap:
    """The map for pictures taken in the water that an [optics] states, and its uncertainty.

    The same map where the calibration's own rig stated that water, and where none is stated.  A map
    that does not know the physics also stays where the two indices agree within SAME_INDEX.

    Parameters
    ----------
    plane_map : PlaneMap, as calibrated
    optics : OpticsSection, of the scan's rig

    Raises
    ------
    InputError
        For a map that does not know the physics.
    """
    return with_chosen(plane_map, lambda solved: _moved(solved, optics))


def with_chosen(plane_map: PlaneMap, change: Callable[[SolvedMap], SolvedMap]) -> PlaneMap:
    """A plane map changed; of ``auto`` the map that was chosen.

    A map of another package stays as it is: it answers for itself.

    Parameters
    ----------
    plane_map : PlaneMap, of any family
    change : callable, of a solved map
    """
    if isinstance(plane_map, Auto):
        return replace(plane_map, chosen=with_chosen(plane_map.chosen, change))
    return change(plane_map) if isinstance(plane_map, SolvedMap) else plane_map


def _moved(solved: SolvedMap, optics: OpticsSection) -> SolvedMap:
    water, own = stated_water(optics), solved.stated_water
    if water is None or water == own or optics.port == "none":
        return solved
    if isinstance(solved, PhysicalMap):
        return solved if solved.geometry.port == "none" else solved.in_water(water)
    # Where the calibration stated none, nobody knows whether it is another water.
    if own is None or abs(water[0] - own[0]) <= SAME_INDEX:
        return solved
    raise InputError(
        f"plane map {solved.name!r} cannot be carried to other water",
        where="optics",
        value=f"index {water[0]:.5f}, calibrated at {own[0]:.5f}",
        allowed=ALLOWED,
    )


def _changed(solved: SolvedMap, since: SinceSection) -> SolvedMap:
    if isinstance(solved, PhysicalMap):
        return solved.changed_since(since)
    raise InputError(
        "says of the rig what this plane map knows nothing of",
        where="since_calibration",
        value=solved.name,
        allowed=ALLOWED,
    )
