"""Profiles stacked into a surface."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lscan.errors import InputError
from lscan.records import Profile, Surface


def stack(profiles: Sequence[Profile]) -> Surface:
    """The raw surface of F profiles of N points each, in the order given.

    Frame "head": a point is (x, s, z) in mm, where x and z lie in the laser sheet and s is
    the track position of its profile.  This is not yet the true shape where the sheet is
    yawed against the track: see :func:`lscan.surface.align.shear`.

    Raises InputError where there is no profile, where the profiles differ in length or
    where a track position is not finite.
    """
    if not profiles:
        raise InputError("no profiles to stack", where="surface", allowed="one or more")
    lengths = {len(profile.points.status) for profile in profiles}
    if len(lengths) > 1:
        raise InputError(
            "profiles differ in length",
            where="surface",
            value=sorted(lengths),
            allowed="one length",
        )
    position = np.array([profile.position_mm for profile in profiles], dtype=float)
    if not np.isfinite(position).all():
        where = f"profile {int(np.argmin(np.isfinite(position)))}"
        raise InputError("track position is not finite", where=where, allowed="a number of mm")
    status = np.stack([profile.points.status for profile in profiles])
    xz = np.stack([profile.points.xz_mm for profile in profiles])
    sigma = np.stack([profile.points.sigma_mm for profile in profiles])
    track = np.where(np.isfinite(xz[..., 0]), position[:, None], np.nan)
    return Surface(
        xyz_mm=np.stack([xz[..., 0], track, xz[..., 1]], axis=-1),
        sigma_x_mm=sigma[..., 0],
        sigma_mm=sigma[..., 1],
        status=status,
        position_mm=position,
    )
