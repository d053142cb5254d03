"""From the stripe in a picture to the profile in the laser sheet."""

from collections.abc import Sequence

import numpy as np

from lscan.calibration.planemap import PlaneMap
from lscan.errors import InputError
from lscan.records import Ints, PlanePoints, Profile, Status, Stripe, has_value, select


def to_profile(stripe: Stripe, plane_map: PlaneMap, position_mm: float) -> Profile:
    """The scan line in the sheet of the head at a track position.

    A point without a value in the stripe keeps the stripe's status, and so does a clipped
    one (SATURATED) that the map can place; every other has the map's.  The map combines the
    stripe's sigma_px with its own uncertainty, and its modes are passed on; like the numbers
    they are NaN where there is no value.

    Parameters
    ----------
    stripe : Stripe, px, of N entries
    plane_map : PlaneMap, from the pixels of that camera to the laser sheet
    position_mm : float, mm, of the track

    Returns
    -------
    Profile
        Of N points (x, z), mm, frame of the sheet, in the stripe's order.

    Raises
    ------
    InputError
        Where ``position_mm`` is not finite.
    """
    return to_profiles([stripe], plane_map, [position_mm])[0]


def to_profiles(
    stripes: Sequence[Stripe], plane_map: PlaneMap, positions_mm: Sequence[float]
) -> list[Profile]:
    """The scan lines of several pictures, as :func:`to_profile` gives each, all mapped at once.

    Parameters
    ----------
    stripes : sequence of Stripe, px, one or more
    plane_map : PlaneMap, from the pixels of that camera to the laser sheet
    positions_mm : sequence of float, mm, of the track, one for each

    Raises
    ------
    InputError
        Where a position is not finite.
    """
    for position_mm in positions_mm:
        if not np.isfinite(position_mm):
            raise InputError("track position is not finite", where="to_profile", value=position_mm)
    pixels, sigma_px = ([stripe.image_px for stripe in stripes], [s.sigma_px for s in stripes])
    mapped = plane_map.to_plane(np.concatenate(pixels), np.concatenate(sigma_px))
    points = _placed(np.concatenate([stripe.status for stripe in stripes]), mapped)
    profiles, first = [], 0
    for stripe, position_mm in zip(stripes, positions_mm, strict=True):
        part = slice(first, first + len(stripe.status))
        brightness = stripe.peak if stripe.flux is None else stripe.flux
        profiles.append(Profile(float(position_mm), select(points, part), brightness))
        first = part.stop
    return profiles


def _placed(found: Ints, mapped: PlanePoints) -> PlanePoints:
    """The points that a map has placed, with what the stripe says of them."""
    status = np.where(~has_value(found) | (mapped.status == Status.OK), found, mapped.status)
    valued = has_value(status)[:, None]
    return PlanePoints(
        xz_mm=np.where(valued, mapped.xz_mm, np.nan),
        sigma_mm=np.where(valued, mapped.sigma_mm, np.nan),
        status=status,
        modes_mm=(
            None
            if mapped.modes_mm is None
            else np.where(valued[..., None], mapped.modes_mm, np.nan)
        ),
    )
