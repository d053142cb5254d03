"""Profiles stacked into a surface."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lscan.errors import InputError
from lscan.records import Profile, Surface


def stack(profiles: Sequence[Profile]) -> Surface:
    """The raw surface of F profiles of N points each, in the order given.

    Frame "head": a point is (x, s, z) in mm, where x and z lie in the laser sheet and s is
    the track position of its profile.  This is not yet the true shape where the sheet is
    yawed against the track: see :func:`lscan.surface.align.levelling.shear`.

    Parameters
    ----------
    profiles : sequence of Profile, mm, frame of the sheet

    Returns
    -------
    Surface
        Its modes_mm are the profiles' own, nothing common in y, in single precision; None unless
        every profile has them.

    Raises
    ------
    InputError
        Where there is no profile, where the profiles differ in length or in their number of modes,
        or where a track position is not finite.
    """
    if not profiles:
        raise InputError("no profiles to stack", where="surface", allowed="one or more")
    _require_one("length", {len(profile.points.status) for profile in profiles}, "one length")
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
        sigma_z_mm=sigma[..., 1],
        status=status,
        position_mm=position,
        modes_mm=_modes(profiles),
        brightness=np.stack([profile.brightness for profile in profiles]),
    )


def require_head_frame(surface: Surface) -> None:
    """InputError for a surface that is not in the head frame.

    Parameters
    ----------
    surface : Surface
    """
    if surface.frame != "head":
        raise InputError(
            "is aligned already",
            where="surface",
            value=surface.frame,
            allowed="the head frame, as of a rig that names no sandwave in [workpiece]",
        )


def _require_one(what: str, found: set[int], allowed: str) -> None:
    """InputError where the profiles differ in ``what``."""
    if len(found) > 1:
        message = f"profiles differ in {what}"
        raise InputError(message, where="surface", value=sorted(found), allowed=allowed)


def _modes(profiles: Sequence[Profile]) -> NDArray[np.float32] | None:
    """(F, N, 3, M) modes of x, y and z."""
    modes = [profile.points.modes_mm for profile in profiles]
    known = [mode for mode in modes if mode is not None]
    if len(known) < len(modes):
        return None
    counts = {mode.shape[2] for mode in known}
    _require_one("their number of modes", counts, "one calibration")
    stacked = np.zeros((len(known), len(known[0]), 3, *counts), dtype=np.float32)
    for row, mode in zip(stacked, known, strict=True):
        row[:, [0, 2]] = mode
    # y is the track's, without error, but holds no number where there is no point.
    stacked[:, :, 1][np.isnan(stacked[:, :, 0])] = np.nan
    return stacked
