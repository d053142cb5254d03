"""What decides where a camera sees a point: pinhole, lens distortion, flat port."""

from dataclasses import dataclass

import numpy as np

from lscan.records import Floats


@dataclass(frozen=True)
class PortModel:
    """A flat window between the camera's air and the water.

    Attributes
    ----------
    gap_mm : float, mm, air from the pinhole to the glass, along the glass's normal
    thickness_mm : float, mm, of the glass
    glass_index, water_index : float, relative to air, 1 or more
    tilt_x_deg, tilt_y_deg : float, degrees; the glass's normal is the camera's axis turned by
        Ry(tilt_y) Rx(tilt_x)

    References
    ----------
    docs/explanation/physics.md, section 6.
    """

    gap_mm: float
    thickness_mm: float
    glass_index: float
    water_index: float
    tilt_x_deg: float = 0.0
    tilt_y_deg: float = 0.0

    @property
    def normal(self) -> Floats:
        """(3,) unit normal of the glass in the camera frame, towards the water."""
        a, b = np.radians([self.tilt_x_deg, self.tilt_y_deg])
        return np.array([np.cos(a) * np.sin(b), -np.sin(a), np.cos(a) * np.cos(b)])

    @property
    def normal_derivatives(self) -> Floats:
        """(3, 2) of ``normal`` by the two tilts, per degree."""
        a, b = np.radians([self.tilt_x_deg, self.tilt_y_deg])
        by_a = [-np.sin(a) * np.sin(b), -np.cos(a), -np.sin(a) * np.cos(b)]
        by_b = [np.cos(a) * np.cos(b), 0.0, -np.cos(a) * np.sin(b)]
        return np.radians(np.column_stack([by_a, by_b]))


@dataclass(frozen=True)
class CameraModel:
    """A pinhole with Brown-Conrady distortion as OpenCV writes it, behind a port or in air.

    Attributes
    ----------
    focal_px : float, px, the same for u and v (square pixels)
    centre_px : tuple of float, px, (u, v) of the axis
    k1, k2 : float, radial distortion
    p1, p2 : float, decentring distortion
    k3 : float, radial distortion
    port : PortModel or None, None for a camera in air
    """

    focal_px: float
    centre_px: tuple[float, float]
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    port: PortModel | None = None
