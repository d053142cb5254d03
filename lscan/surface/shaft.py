"""Profiles turned about a shaft, the paper's other way to move the head (its Sec. I).

The head turns rigidly about a line.  A point X of the head's frame at position s lies, in the
frame of the head at position 0, at

    p + R(d, s / r) (X - p)

p being a point of the shaft, d its direction, r the arc radius and R Rodrigues' rotation.  What
is not known of the shaft has five parameters: two offsets of p square to d, two tilts of d and
the relative scale of the angle; each displaces every point of the scan in a way of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lscan.config.rig import ShaftSection
from lscan.records import Floats, Profile, Surface
from lscan.surface.align.alignment import own_variances
from lscan.surface.stack import stack

PARAMETERS = 5
"""Offsets along the shaft's two axes (mm), tilts towards them (rad), scale of the angle."""


@dataclass(frozen=True)
class Shaft:
    """A shaft in the frame of the head at position 0, and how well it is known.

    Attributes
    ----------
    point_mm : (3,) array, mm, a point of it
    direction : (3,) array, unit vector, right-hand rule
    arc_radius_mm : float, mm; a position divided by it is the angle in rad
    covariance : (5, 5) array, of two offsets (mm) and two tilts (rad) along ``axes``, and the scale
    """

    point_mm: Floats
    direction: Floats
    arc_radius_mm: float
    covariance: Floats

    @property
    def axes(self) -> Floats:
        """(2, 3) unit vectors square to the shaft: y less its part along it, and the third."""
        first = np.array([0.0, 1.0, 0.0]) - self.direction[1] * self.direction
        first = first / np.linalg.norm(first)
        return np.stack([first, np.cross(self.direction, first)])

    def rotation(self, position_mm: Floats) -> Floats:
        """(..., 3, 3) rotation of the head at positions: Rodrigues' formula.

        Parameters
        ----------
        position_mm : (...,) array, mm, the arc turned by
        """
        angle = np.asarray(position_mm)[..., None, None] / self.arc_radius_mm
        cross = np.cross(np.eye(3), self.direction)  # by which a vector is multiplied, d x v
        return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)

    def turn(self, points_mm: Floats, position_mm: Floats) -> Floats:
        """(..., 3) points of the head in the frame of position 0, mm.

        Parameters
        ----------
        points_mm : (..., 3) array, mm, frame of the head at its position
        position_mm : (...,) array, mm, the arc turned by
        """
        offset = points_mm - self.point_mm
        turned = (self.rotation(position_mm) @ offset[..., None])[..., 0]
        return np.asarray(turned + self.point_mm)

    def moved(self, parameters: Floats) -> "Shaft":
        """The shaft with its five parameters changed; the covariance stays.

        Parameters
        ----------
        parameters : (5,) array, two offsets (mm) and two tilts (rad) along ``axes``, and the scale
        """
        offsets, tilts = parameters[:2] @ self.axes, parameters[2:4] @ self.axes
        direction = self.direction + tilts
        return replace(
            self,
            point_mm=self.point_mm + offsets,
            direction=direction / np.linalg.norm(direction),
            arc_radius_mm=self.arc_radius_mm / (1 + float(parameters[4])),
        )

    def displacement(
        self, points_mm: Floats, position_mm: Floats, axes: Floats | None = None
    ) -> Floats:
        """(..., 3, 5) what the unit of each parameter displaces turned points by, mm.

        A tilt by e turns all about the shaft by w = d x e: the points by w x R q, but q itself by
        -R (w x q), q = X - p.

        Parameters
        ----------
        points_mm : (..., 3) array, mm, frame of position 0, as ``turn`` gives them
        position_mm : (...,) array, mm, the arc turned by
        axes : (2, 3) array, optional, along which offsets and tilts are counted; the shaft's own by
            default
        """
        turned = points_mm - self.point_mm
        rotation = self.rotation(position_mm)
        columns = []
        own = self.axes if axes is None else axes
        for axis in own:
            columns.append(np.broadcast_to(axis - rotation @ axis, turned.shape))
        for axis in own:
            about = np.cross(self.direction, axis)
            columns.append(np.cross(about, turned) - np.cross(rotation @ about, turned))
        angle = np.asarray(position_mm)[..., None] / self.arc_radius_mm
        columns.append(angle * np.cross(self.direction, turned))
        return np.stack(columns, axis=-1)

    @property
    def sigma(self) -> Floats:
        """(5,) standard uncertainties of the parameters: mm, mm, rad, rad, 1."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def root(self) -> Floats:
        """(5, 5) matrix whose product with its transpose is the covariance; it may be singular.

        Its columns are five independent errors, each one standard deviation large.
        """
        scale = np.where(self.sigma > 0, self.sigma, 1.0)
        values, vectors = np.linalg.eigh(self.covariance / np.outer(scale, scale))
        return np.asarray(scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))


def shaft_of(section: ShaftSection) -> Shaft:
    """The shaft that a rig file's ``[shaft]`` describes.

    Parameters
    ----------
    section : ShaftSection, mm and degrees
    """
    direction = np.array(section.direction)
    sigma = np.array(
        [*section.offset_sigma_mm, *np.radians(section.tilt_sigma_deg), section.scale_sigma]
    )
    return Shaft(
        point_mm=np.array(section.point_mm),
        direction=direction / np.linalg.norm(direction),
        arc_radius_mm=section.arc_radius_mm,
        covariance=np.outer(sigma, sigma) * section.correlation_matrix(),
    )


def section_of(shaft: Shaft) -> ShaftSection:
    """The ``[shaft]`` of a rig file that describes the shaft.

    Parameters
    ----------
    shaft : Shaft, mm and rad
    """
    scale = np.where(shaft.sigma > 0, shaft.sigma, 1.0)
    correlation = (shaft.covariance / np.outer(scale, scale))[np.triu_indices(PARAMETERS, 1)]
    first, second, *tilts, of_scale = shaft.sigma.tolist()
    return ShaftSection.model_validate(
        {
            "arc_radius_mm": shaft.arc_radius_mm,
            "point_mm": shaft.point_mm.tolist(),
            "direction": shaft.direction.tolist(),
            "offset_sigma_mm": (first, second),
            "tilt_sigma_deg": np.degrees(tilts).tolist(),
            "scale_sigma": of_scale,
            "correlation": np.clip(correlation, -1.0, 1.0).tolist(),
        }
    )


def stack_about(profiles: Sequence[Profile], shaft: Shaft) -> Surface:
    """The surface of F profiles of N points, turned about the shaft, in the frame of position 0.

    Uncertainties and modes are turned along; where the profiles have modes, the shaft's five
    independent errors are put behind them, else the shaft's alone are known.

    Parameters
    ----------
    profiles : sequence of Profile, mm, frame of the sheet
    shaft : Shaft, about which the head turned

    Raises
    ------
    InputError
        As ``stack``.
    """
    raw = stack(profiles)
    position = np.broadcast_to(raw.position_mm[:, None], raw.status.shape)
    in_sheet = raw.xyz_mm * [1.0, 0.0, 1.0]
    xyz = shaft.turn(in_sheet, position)
    rotation = shaft.rotation(raw.position_mm)[:, None]
    modes = (shaft.displacement(xyz, position) @ shaft.root).astype(np.float32)
    if raw.modes_mm is not None:
        modes = np.concatenate([rotation.astype(np.float32) @ raw.modes_mm, modes], axis=-1)
    own = own_variances(raw) @ np.swapaxes(rotation[:, 0] ** 2, 1, 2)
    common = np.square(modes, dtype=np.float64).sum(axis=-1)
    sigma = np.sqrt(own + common)
    return replace(
        raw,
        xyz_mm=xyz,
        sigma_x_mm=sigma[..., 0],
        sigma_y_mm=sigma[..., 1],
        sigma_z_mm=sigma[..., 2],
        modes_mm=modes,
    )
