"""Ray geometry of a camera behind a flat port: float64, vectorised, both ways.

Camera frame: x right, y down, z ahead, origin at the pinhole, mm.
"""

from lscan.camera.model import CameraModel, PortModel
from lscan.camera.projection import Rays, project, rays

__all__ = ["CameraModel", "PortModel", "Rays", "project", "rays"]
