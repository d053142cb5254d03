"""The parameters of a camera behind a port: their order, limits, and what is known beforehand."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lscan.camera.model import CameraModel, PortModel
from lscan.camera.water import UNKNOWN_WATER, stated_water
from lscan.config.rig import Known, OpticsSection
from lscan.errors import InputError
from lscan.records import Floats, Mask

LENS = ("focal_px", "centre_u_px", "centre_v_px", "k1", "k2", "p1", "p2", "k3")
PORT = ("gap_mm", "thickness_mm", "glass_index", "water_index", "tilt_x_deg", "tilt_y_deg")
CAMERA = LENS + PORT
COUNT = len(CAMERA)
WATER = CAMERA.index("water_index")

PortKind = Literal["flat", "none"]

# Where nothing is known: as uncertain as webcams differ among themselves; ours.
FOCAL_WIDTHS = (1.2, 0.8)  # focal length and its uncertainty over the picture's width
CENTRE_WIDTHS = 0.1  # uncertainty of the axis over the picture's width

# The permitted range of each parameter that has one.
LIMITS = {
    "focal_px": (1.0, np.inf),
    "gap_mm": (0.0, np.inf),
    "thickness_mm": (0.0, np.inf),
    "glass_index": (1.0, 4.0),
    "water_index": (1.0, 4.0),
    "tilt_x_deg": (-45.0, 45.0),
    "tilt_y_deg": (-45.0, 45.0),
}
LEAST, GREATEST = np.array([LIMITS.get(name, (-np.inf, np.inf)) for name in CAMERA]).T


@dataclass(frozen=True)
class CameraPriors:
    """What is known of a camera beforehand, in the order of CAMERA.

    Attributes
    ----------
    mean : (14,) array, units as the names in CAMERA say
    sigma : (14,) array, standard uncertainties; 0: the parameter is held; infinite: nothing is
        known
    focal_given : bool, whether the focal length is known, rather than assumed or open
    """

    mean: Floats
    sigma: Floats
    focal_given: bool

    @property
    def free(self) -> Mask:
        """(14,) mask of the parameters to be found."""
        return self.sigma > 0

    @property
    def informed(self) -> Mask:
        """(14,) mask of the free parameters of which something is known."""
        return self.free & np.isfinite(self.sigma)


def camera_of(theta: Floats, port: PortKind) -> CameraModel:
    """The camera of a vector of parameters.

    Parameters
    ----------
    theta : (14 or more,) array, the first in the order of CAMERA
    port : str, "flat", or "none" for a camera in air
    """
    focal, u, v, k1, k2, p1, p2, k3 = theta[: len(LENS)].tolist()
    window = PortModel(*theta[len(LENS) : COUNT].tolist()) if port == "flat" else None
    return CameraModel(focal, (u, v), k1, k2, p1, p2, k3, window)


def priors_of(
    optics: OpticsSection,
    image_size: tuple[int, int],
    k3: Known = (0.0, 0.0),
    assume_webcam: bool = True,
) -> CameraPriors:
    """What is known of the camera from the section [optics] and from k3.

    Parameters
    ----------
    optics : OpticsSection, of the rig file
    image_size : tuple of int, (width, height) of the pictures, px
    k3 : tuple of float, third radial coefficient and its standard uncertainty; held at 0 by default
    assume_webcam : bool, whether a focal length or centre that is not given is assumed to be that
        of a webcam; otherwise nothing is known of it

    Raises
    ------
    InputError
        Where a value is out of its range.
    """
    width, height = image_size
    webcam = {
        "focal_px": (FOCAL_WIDTHS[0] * width, FOCAL_WIDTHS[1] * width),
        "centre_u_px": ((width - 1) / 2, CENTRE_WIDTHS * width),
        "centre_v_px": ((height - 1) / 2, CENTRE_WIDTHS * width),
    }
    known = {"k3": k3, "water_index": stated_water(optics) or UNKNOWN_WATER}
    mean, sigma = np.zeros(COUNT), np.zeros(COUNT)
    for index, name in enumerate(CAMERA):
        given = known.get(name) or getattr(optics, name)
        mean[index], sigma[index] = given or webcam[name]
        if given is None and not assume_webcam:
            sigma[index] = np.inf
        low, high = LEAST[index], GREATEST[index]
        if not (np.isfinite(mean[index]) and low <= mean[index] <= high):
            raise InputError(
                "out of range",
                where="k3" if name == "k3" else f"optics.{name}",
                value=float(mean[index]),
                allowed=f"{low:g} to {high:g}",
            )
    if optics.port == "none":
        mean[WATER] = 1.0
        sigma[len(LENS) :] = 0.0
    return CameraPriors(mean, sigma, optics.focal_px is not None)
