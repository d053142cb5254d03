"""Where a laser sheet truly lies.

A sheet has a plane of its own, its frame turned out of the head's by the laser's skew and
tilt: the apex has the same x and z in both, and a sheet without tilt, skew and offset lies
in the head's y = 0, where the two frames are one.  Points of the sheet are given by their
(x, z) in that plane; a bowed sheet lies off it in y.  The fan's rays are straight in
(x, z) whether the sheet is bowed or not: a cone's rays all pass through its apex.
"""

from dataclasses import dataclass

import numpy as np

from lscan.errors import InputError
from lscan.records import Floats
from sim.scene import Laser, LaserLine, Pose, Scene, rotation
from sim.truth.bow import Bow, bow_of
from sim.water import water_index


@dataclass(frozen=True)
class TrueSheet:
    """One of the laser's sheets.  pose: frame of its plane to head frame.  bow: None if flat."""

    pose: Pose
    bow: Bow | None

    def in_head(self, xz_mm: Floats) -> Floats:
        """(N, 3) points of the sheet, mm, head frame.

        Parameters
        ----------
        xz_mm : (N, 2) array, mm, frame of the sheet's plane
        """
        x, z = xz_mm.T
        y = np.zeros(len(xz_mm)) if self.bow is None else self.bow.offset_mm(x, z)
        return self.pose.apply(np.column_stack([x, y, z]))

    def flattened(self, points_head: Floats) -> Floats:
        """(N, 2) points of the sheet beneath or above points, mm, frame of its plane.

        Parameters
        ----------
        points_head : (N, 3) array, mm, head frame
        """
        return self.pose.invert(points_head)[:, [0, 2]]

    def clearance_mm(self, points_head: Floats) -> Floats:
        """(N,) mm, how far points lie off the sheet, in y of its plane.

        Parameters
        ----------
        points_head : (N, 3) array, mm, head frame
        """
        local = self.pose.invert(points_head)
        return local[:, 1] if self.bow is None else self.bow.clearance_mm(local)


def sheet_of(scene: Scene, line: int = 0) -> TrueSheet:
    """The sheet of one of the laser's lines, head frame.

    Parameters
    ----------
    scene : Scene, its laser and its water
    line : int, index into ``laser.sheets``

    Raises
    ------
    InputError
        There is no such line.

    References
    ----------
    docs/explanation/physics.md, section 4.
    """
    laser = scene.tank.laser
    if not 0 <= line < len(laser.sheets):
        allowed = f"0 to {len(laser.sheets) - 1}"
        raise InputError("line of the laser", where=scene.source, value=line, allowed=allowed)
    index = water_index(scene.tank.water, laser.wavelength_nm)
    return TrueSheet(sheet_plane(laser, laser.sheets[line]), bow_of(laser, index))


def sheet_plane(laser: Laser, line: LaserLine) -> Pose:
    """Frame of the sheet's plane to head frame.

    Parameters
    ----------
    laser : Laser, its apex and angles
    line : LaserLine, one of ``laser.sheets``
    """
    turned = rotation("ZX", (laser.skew_deg, laser.tilt_deg + line.tilt_deg))
    apex = np.array(laser.apex_mm)
    return Pose(turned, apex - turned @ (apex * [1.0, 0.0, 1.0]))
