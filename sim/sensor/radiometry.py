"""How many photons a pixel collects, and the speckle of the laser's light."""

from functools import lru_cache
from math import ceil, sqrt
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import j1, roots_legendre

from lscan.records import Floats
from sim.scene import Lens, Sensor

# How many photons a pixel collects of the radiance before the lens.

PLANCK_J_S = 6.62607015e-34  # exact, SI 2019
LIGHT_M_S = 299792458.0  # exact, SI 2019
AMBIENT_NM = 550.0  # photon energy of ambient light: the middle of the visible
# Fixed-point iteration contracts wherever the distortion does not fold the picture; 1e-9 of
# the tangent is a millionth of a pixel.
UNDISTORT = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-9)


def photons_per_radiance(
    lens: Lens, sensor: Sensor, exposure_ms: float, wavelength_nm: float
) -> float:
    """Photons a pixel on the axis collects for 1 W/(m2 sr) at the lens.

    Irradiance in the image of a distant surface is pi L T / (4 N^2); times pixel area, time, and
    the photons in a joule.

    Parameters
    ----------
    lens : Lens, its f-number N and transmission T
    sensor : Sensor, its pixel's side
    exposure_ms : float, ms
    wavelength_nm : float, nm

    References
    ----------
    Born & Wolf, Principles of Optics, sec. 4.8 (the camera equation); docs/explanation/physics.md,
    section 5.
    """
    irradiance = np.pi * lens.transmission / (4 * lens.f_number**2)
    area_m2 = (sensor.pixel_um * 1e-6) ** 2
    joule_per_photon = PLANCK_J_S * LIGHT_M_S / (wavelength_nm * 1e-9)
    return irradiance * area_m2 * exposure_ms * 1e-3 / joule_per_photon


@lru_cache(maxsize=2)  # 0.1 s a picture of 960 x 720; a study exposes the same lens a hundred times
def vignetting(lens: Lens, size_px: tuple[int, int]) -> NDArray[np.float32]:
    """What is left of the light off the axis: (H, W), 1 on the axis; not to be written to.

    cos^k of the angle in air between a pixel's direction and the axis, k = lens.vignetting;
    k = 4 is the natural law (Born & Wolf sec. 4.8).  size_px: (width, height).
    """
    x, y = np.moveaxis(directions(lens, size_px), -1, 0)
    cosine = 1 / np.sqrt(1 + x**2 + y**2)
    left: NDArray[np.float32] = (cosine**lens.vignetting).astype(np.float32)
    left.flags.writeable = False
    return left


def directions(lens: Lens, size_px: tuple[int, int]) -> Floats:
    """(H, W, 2) undistorted (x, y) of every pixel's centre: tangents in air, camera frame."""
    width, height = size_px
    u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    (cx, cy), focal = lens.centre_px, lens.focal_px
    matrix = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1.0]])
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    if lens.model == "fisheye":
        distortion = np.array([lens.k1, lens.k2, lens.k3, lens.k4])
        undistorted = cv2.fisheye.undistortPoints(pixels, matrix, distortion, criteria=UNDISTORT)
        return np.asarray(undistorted, dtype=float).reshape(height, width, 2)
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    distortion = np.array([getattr(lens, name) for name in names])
    # With OpenCV 4, undistortPoints takes no criteria; with 5, there is no other function.
    undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)
    undistorted = undistort(pixels, matrix, distortion, R=None, P=None, criteria=UNDISTORT)
    return np.asarray(undistorted, dtype=float).reshape(height, width, 2)


# Speckle of the laser's light: how strong a pixel sees it, and a pattern of it.
#
# Speckle is formed at the sensor, where light from all over the pupil meets, so it comes after the
# point spread of the lens, and before electrons are drawn.  Only light of the laser that a surface
# reflects shows it: what the water scatters comes from particles that drift through many
# wavelengths in an exposure, and its speckle averages out.


# Gauss-Legendre nodes: enough for a constant integrand, and more for every grain in a pixel.
NODES, NODES_PER_GRAIN = 32, 8


def speckle_contrast(
    pixel_um: float,
    f_number: float,
    wavelength_nm: float,
    light: Literal["polarised", "depolarised"],
) -> float:
    """Standard deviation over mean of the laser light that a pixel collects.

    C = 1/sqrt(M), where M is the number of grains a pixel averages: 1/M is the mean over all pairs
    of places in the pixel of |mu|^2, the squared coherence between them.  For a square pixel of
    side D

        1/M = 4/D^4 int_0^D int_0^D (D - x)(D - y) |mu(x, y)|^2 dx dy

    and for a circular pupil |mu|^2 = (2 J1(q)/q)^2, q = pi r/(lambda N), r^2 = x^2 + y^2.
    N is the f-number for a far object: the magnification of a webcam a metre away, half a
    percent, is left out as it is in the camera equation.

    Parameters
    ----------
    pixel_um : float, side D of a pixel, um
    f_number : float, N
    wavelength_nm : float, lambda, nm
    light : str, depolarised light is the sum of two independent patterns of equal strength: M
        doubles

    References
    ----------
    Goodman, Speckle Phenomena in Optics, sec. 4.6.

    Examples
    --------
    >>> round(speckle_contrast(6.0, 2.8, 650.0, "polarised"), 3)
    0.291
    """
    grains = pixel_um / (wavelength_nm * 1e-3 * f_number)
    nodes, weights = roots_legendre(NODES + ceil(NODES_PER_GRAIN * grains))
    place, weight = (nodes + 1) / 2, weights / 2  # x/D in 0 to 1
    overlap = 2 * weight * (1 - place)
    q = np.pi * grains * np.hypot(place[:, None], place[None, :])
    coherence = (2 * j1(q) / q) ** 2
    mean = float(overlap @ coherence @ overlap)
    return sqrt(mean / 2 if light == "depolarised" else mean)


def add_speckle(
    light: NDArray[np.float32], contrast: float, generator: np.random.Generator
) -> NDArray[np.float32]:
    """The light of surfaces as the pixels see it, one pattern over it; the same shape and unit."""
    seen = light.copy()
    lit = np.flatnonzero(light > 0)
    seen.reshape(-1)[lit] *= speckle_pattern(lit.shape, contrast, generator)
    return seen


def speckle_pattern(
    shape: tuple[int, ...], contrast: float, generator: np.random.Generator
) -> NDArray[np.float32]:
    """Factors of unit mean, each pixel's on its own, gamma distributed; of the given shape.

    The gamma law of M = 1/contrast^2 degrees is Goodman's approximation for integrated
    speckle (sec. 4.6), exact where M equal grains are summed.
    """
    degrees = np.float32(1 / contrast**2)
    drawn = generator.standard_gamma(degrees, size=shape, dtype=np.float32)
    return drawn / degrees
