"""The scene: models of a scene file's sections, and the poses they describe.

Lengths mm, angles in degrees in the file, inherent optical properties per metre.  Poses of
camera and laser are in the head frame (lscan.records): its plane y = 0 is where the laser
sheet ought to lie, x and z are those of the plane frame, whose origin is control point O of
the board.  The target stands in the world frame, which is the head frame of track position
0 turned by the head's yaw, so that the track runs along y.  On a shaft the head turns instead
of shifting, and positions are arcs (lscan.config.rig.ShaftSection).
"""

from sim.scene.file import (
    SECTIONS,
    Moment,
    Scene,
    at_moment,
    floor_corners_mm,
    load_scene,
    scene_of,
    target_pose,
)
from sim.scene.instrument import Head, Laser, LaserLine, Lens, PlanePort, Port, Sensor, TrueShaft
from sim.scene.poses import (
    Pose,
    camera_pose,
    head_pose,
    into_head,
    into_world,
    rotation,
    seat_pose,
    sheet_pose,
    track_pose,
)

__all__ = [
    "SECTIONS",
    "Head",
    "Laser",
    "LaserLine",
    "Lens",
    "Moment",
    "PlanePort",
    "Port",
    "Pose",
    "Scene",
    "Sensor",
    "TrueShaft",
    "at_moment",
    "camera_pose",
    "floor_corners_mm",
    "head_pose",
    "into_head",
    "into_world",
    "load_scene",
    "rotation",
    "scene_of",
    "seat_pose",
    "sheet_pose",
    "target_pose",
    "track_pose",
]
