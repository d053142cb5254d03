"""Ray geometry of a camera behind a flat port: float64, vectorised, both ways.

Camera frame: x right, y down, z ahead, origin at the pinhole, mm.
"""

from lscan.camera.optics import CameraModel, PortModel, Rays, project, rays

__all__ = ["CameraModel", "PortModel", "Rays", "project", "rays"]
