"""How the scatter of the line's centre follows the light that a rig gives it.

The scatter itself is found on pictures of the rig as it ought to be (prepared.py).  Of a rig with
another power, exposure, water or albedo it is taken to grow as the bound of Cramér and Rao does:
the instrument's extractor is as far above the bound as it was.

The ratio is taken of all noise together, and of the sensor's alone.  An extractor that is told of
speckle (``[stripe.noise]``) comes close to the first bound; without speckle in the picture it
weighs the crest too little, and is a factor of two above the second.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lscan.records import Floats, Ints, Status
from sim.scene import Scene, at_moment
from sim.studies.places import ScanPlaces
from sim.studies.studyfile import Study
from sim.truth import StripeTruth, line_brightness, stripe_truths

LIGHT_KEYS = (
    "camera.exposure_ms", "laser.power_mw", "laser.waist_", "laser.wavelength_nm", "laser.fan_",
    "lens.blur_px", "lens.f_number", "lens.focus_mm", "lens.glare", "lens.vignetting", "light.",
    "sensor.", "target.albedo", "water.absorption", "water.particle_", "water.scattering",
    "water.turbidity",
)  # fmt: skip
"""What changes the line's brightness or width, or its noise, by more than its place does."""
REACH_PX = 12.0
STEP_PX = 0.25
"""Of the sum over a line's cross-section: it is a Gaussian integral to 1e-6 for widths of 0.4 px
and more, whose profile falls to exp(-4.5) within a third of the reach for the widest, 4 px."""


def depends_on_light(study: Study) -> bool:
    """Whether a cause changes the line's light in the scan.

    Parameters
    ----------
    study : Study
    """
    keys = {key for cause in study.file.cause.values() for key in (cause.key, *cause.together)
            if cause.when != "noise" and not key.startswith("calibrate.")}  # fmt: skip
    return any(key.removeprefix("scan.").startswith(LIGHT_KEYS) for key in keys)


def lines_at(scan: Scene, places: ScanPlaces) -> list[StripeTruth]:
    """The true line in each picture that has places, other columns left out.

    Parameters
    ----------
    scan : Scene, as it ought to be
    places : ScanPlaces
    """
    found = []
    for frame in np.unique(places.frame):
        here = places.frame == frame
        truth = stripe_truths(scan, [float(places.position_mm[here][0])])[0]
        status = np.full_like(truth.status, Status.NO_PEAK)
        status[places.entry[here]] = truth.status[places.entry[here]]
        found.append(replace(truth, status=status))
    return found


def line_bounds_px(scan: Scene, places: ScanPlaces, lines: Sequence[StripeTruth]) -> Floats:
    """(2, P) px, least scatter of the line's centre: by the sensor's noise, and speckle with it.

    The line is taken to lie where it ought to: what moves it by pixels changes its light little.

    Parameters
    ----------
    scan : Scene, in any state; its changes are those of each picture
    places : ScanPlaces
    lines : sequence of StripeTruth, as ``lines_at`` gives them

    References
    ----------
    Kay, Fundamentals of Statistical Signal Processing I, sec. 3.9: of a symmetric profile the
    centre's part of Fisher's information is independent of width, height and ground.
    """
    found = np.full((2, len(places.frame)), np.nan)
    for frame, line in zip(np.unique(places.frame), lines, strict=True):
        here = places.frame == frame
        moment = at_moment(scan, int(frame), line.position_mm)
        found[:, here] = _of_picture(moment.scene, line, places.entry[here])
    return found


def _of_picture(scene: Scene, line: StripeTruth, column: Ints) -> Floats:
    """(2, N) px at N columns of the picture."""
    speckled = line_brightness(scene, [line])[0]
    plain = line_brightness(scene.with_tank(sensor={"speckle": "none"}), [line])[0]
    height, ground = plain.height_dn[column], plain.noise_dn[column] ** 2
    crest = plain.height_sigma_dn[column] ** 2
    shot = (crest - ground) / height
    grain = speckled.height_sigma_dn[column] ** 2 - crest
    speckle2 = np.maximum(grain, 0.0) / height**2
    both = (
        centre_variance_px2(plain.width_px[column], height, ground, shot, grain2)
        for grain2 in (0.0 * speckle2, speckle2)
    )
    return np.sqrt(np.stack(list(both)))


def centre_variance_px2(
    width_px: Floats, height_dn: Floats, ground_dn2: Floats, shot_dn: Floats, speckle2: Floats
) -> Floats:
    """(N,) px², the bound of a Gaussian line's centre, pixels taken for points.

    Parameters
    ----------
    width_px : (N,) array, px, standard deviation of the line
    height_dn : (N,) array, DN, of its crest
    ground_dn2 : (N,) array, DN², variance of a pixel beside it
    shot_dn : (N,) array, DN, further variance for each DN of light
    speckle2 : (N,) array, further variance for each DN² of light
    """
    away = np.arange(-REACH_PX, REACH_PX + STEP_PX, STEP_PX)
    light = height_dn[:, None] * np.exp(-((away / width_px[:, None]) ** 2) / 2)
    variance = ground_dn2[:, None] + shot_dn[:, None] * light + speckle2[:, None] * light**2
    slope = light * away / width_px[:, None] ** 2
    information: Floats = STEP_PX * (slope**2 / variance).sum(axis=1)
    return 1 / information
