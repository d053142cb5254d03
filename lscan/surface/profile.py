"""From the stripe in a picture to the profile in the laser sheet."""

import numpy as np

from lscan.calibration.api import PlaneMap
from lscan.errors import InputError
from lscan.records import PlanePoints, Profile, Status, Stripe, has_value


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
    if not np.isfinite(position_mm):
        raise InputError("track position is not finite", where="to_profile", value=position_mm)
    mapped = plane_map.to_plane(stripe.image_px, stripe.sigma_px)
    from_stripe = ~has_value(stripe.status) | (mapped.status == Status.OK)
    status = np.where(from_stripe, stripe.status, mapped.status)
    valued = has_value(status)[:, None]
    points = PlanePoints(
        xz_mm=np.where(valued, mapped.xz_mm, np.nan),
        sigma_mm=np.where(valued, mapped.sigma_mm, np.nan),
        status=status,
        modes_mm=(
            None
            if mapped.modes_mm is None
            else np.where(valued[..., None], mapped.modes_mm, np.nan)
        ),
    )
    brightness = stripe.peak if stripe.flux is None else stripe.flux
    return Profile(position_mm=float(position_mm), points=points, brightness=brightness)
