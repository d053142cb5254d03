"""What each pixel of a rendered picture shows: classes for training, and masks.

From the render's layers and the truth of the line, without looking at the picture itself.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from math import isqrt

import numpy as np

from lscan.errors import InputError
from lscan.records import Bytes, Floats, Ints, Mask, Status
from sim.render.layers import Layers
from sim.scene import Scene
from sim.scene.instrument import FULL_SCALE_DN
from sim.sensor import photons_per_radiance
from sim.sensor.webcam import electrons_of
from sim.truth import StripeTruth, line_brightness, sheet_of, stripe_truth
from sim.truth.light import line_in_space, offset_per_px
from sim.truth.surfaces import surfaces_of
from sim.water import water_optics

CORE = 3.0  # standard deviations on either side of the line's centre
RIPPLE = 0.05  # of a column's light, for samples too far apart


class Label(IntEnum):
    """Class of a pixel, and its value in the label picture."""

    DARK = 0  # less light than lifts the picture by one digital number
    LINE = 1  # laser light from the target prevails, within 3 sigma of the line's true centre
    VEIL = 2  # laser light scattered by the water prevails
    AMBIENT = 3  # light that is not the laser's prevails
    REFLECTION = 4  # laser light from the target prevails, but away from the true line


COLOURS: Mapping[Label, tuple[int, int, int]] = {
    Label.DARK: (0, 0, 0),
    Label.LINE: (230, 40, 40),
    Label.VEIL: (70, 130, 220),
    Label.AMBIENT: (150, 150, 150),
    Label.REFLECTION: (250, 200, 40),
}


def label_scene(
    scene: Scene,
    position_mm: float,
    layers: Layers,
    truths: Sequence[StripeTruth] | None = None,
    exposure_ms: float | None = None,
) -> Bytes:
    """(H, W) uint8 of Label: the classes of the scene's picture taken at a track position.

    layers: of that picture, of its pixels or finer.  The truth is that of every line of the
    laser; of none where it is off; found anew if None.  exposure_ms: of the picture; the rig's if
    None.  Raises InputError as ``label_picture`` and ``stripe_truth``.
    """
    truths = lit_truths(scene, position_mm) if truths is None else truths
    lines = [(truth, line_sigma_px(scene, truth)) for truth in truths]
    pixels = layers.binned(scene.rig.camera.size_px[::-1])
    return label_picture(pixels, lines, one_step_w_m2_sr(scene, exposure_ms))


def lit_truths(scene: Scene, position_mm: float) -> list[StripeTruth]:
    """The truth of each of the laser's lines, of none where it is off.

    Parameters
    ----------
    scene : Scene, as it is in the picture
    position_mm : float, mm, along the track
    """
    count = len(scene.tank.laser.sheets) if scene.tank.laser.on else 0
    return [stripe_truth(scene, position_mm, line) for line in range(count)]


def label_picture(
    layers: Layers, lines: Sequence[tuple[StripeTruth, Floats]], dark_w_m2_sr: float = 0.0
) -> Bytes:
    """(H, W) uint8 of Label: the layer that prevails in each pixel, and whether it is the line.

    lines: the truth of each of the laser's lines with its sigma across, (N,) px, as
    ``line_sigma_px`` gives it; none where the laser is off.  A column of several lit and seen
    points (``multiple``) has a line without a single true centre: all its direct light counts
    as LINE.  dark_w_m2_sr: radiance beneath which a pixel is DARK; one without light is so in
    any case.  Raises InputError where picture and truth differ in size.
    """
    stack = np.stack([layers.direct, layers.scattered, layers.ambient])
    total = stack.sum(axis=0)
    core = np.zeros(total.shape, dtype=bool)
    for truth, sigma_px in lines:
        core |= core_mask(truth, sigma_px, (total.shape[0], total.shape[1]))
    classes = np.array([Label.REFLECTION, Label.VEIL, Label.AMBIENT], dtype=np.uint8)
    labels = classes[stack.argmax(axis=0)]
    labels[core & (labels == Label.REFLECTION)] = Label.LINE
    labels[(total < dark_w_m2_sr) | (total <= 0)] = Label.DARK
    return labels


def one_step_w_m2_sr(scene: Scene, exposure_ms: float | None = None) -> float:
    """Radiance in W/(m2 sr) that lifts a pixel on the axis from black by one digital number.

    Of laser light, in the colour that sees it best, at an exposure, the rig's if None; infinite
    where no light reaches the sensor's electrons.
    """
    lens, sensor, laser = scene.tank.lens, scene.tank.sensor, scene.tank.laser
    response = sensor.laser_response
    exposure_ms = scene.rig.camera.exposure_ms if exposure_ms is None else exposure_ms
    photons = photons_per_radiance(lens, sensor, exposure_ms, laser.wavelength_nm)
    electrons = photons * max(response.red, response.green, response.blue)
    black_dn = FULL_SCALE_DN * (sensor.black_level_dn / FULL_SCALE_DN) ** (1 / sensor.gamma)
    return electrons_of(black_dn + 1, sensor) / electrons if electrons > 0 else float("inf")


def core_mask(truth: StripeTruth, sigma_px: Floats, shape: tuple[int, int]) -> Mask:
    """(H, W) the pixels within three sigma of the true line; all of a column of several.

    A pixel belongs to the line where any part of it does: half a pixel is added.
    """
    by_columns = truth.axis == "columns"
    across, along = shape if by_columns else shape[::-1]
    if along != len(truth.centre_px) or sigma_px.shape != truth.centre_px.shape:
        allowed = f"a picture of {len(truth.centre_px)} {truth.axis}"
        raise InputError("layers and truth differ in size", value=shape, allowed=allowed)
    shown = truth.status == Status.OK
    reach = np.where(shown, CORE * sigma_px + 0.5, -1.0)
    centre = np.where(shown, truth.centre_px, 0.0)
    mask = np.abs(np.arange(across)[:, np.newaxis] - centre) <= reach
    mask |= truth.multiple
    return mask if by_columns else mask.T


def colour_labels(labels: Bytes) -> Bytes:
    """(H, W, 3) uint8 RGB of a label picture, to look at (``COLOURS``)."""
    table = np.array([COLOURS[label] for label in Label], dtype=np.uint8)
    return table[labels]


def line_sigma_px(scene: Scene, truth: StripeTruth) -> Floats:
    """(N,) standard deviation of the line across it in the picture, px; NaN where not OK.

    The sheet's own (half its 1/e2 half width) as the camera sees it on the target, and the
    lens's blur, added in squares.
    """
    shown = truth.status == Status.OK
    line = line_in_space(scene, surfaces_of(scene), truth)
    mm_per_px = offset_per_px(scene, line, sheet_of(scene, truth.line))
    across = np.abs(mm_per_px[:, 1 if truth.axis == "columns" else 0])
    sheet_px = half_width_mm(scene, truth)[shown] / 2 / np.maximum(across, np.finfo(float).tiny)
    sigma = np.full(len(shown), np.nan)
    sigma[shown] = np.hypot(sheet_px, scene.tank.lens.blur_px)
    return sigma


def check_sampling(scene: Scene, position_mm: float, samples: int, where: object) -> None:
    """Refuse samples that lie farther apart than the sharp line is wide.

    Samples h px apart of a Gaussian of standard deviation s px add up to its light but for a share
    2 exp(-2 pi2 s2 / h2) either way (Poisson's summation formula), which is at most RIPPLE here, in
    the middle one of the columns.

    Parameters
    ----------
    scene : Scene, as it is in the picture
    position_mm : float, mm, along the track
    samples : int, a pixel, a square number
    where : object, what the error names as the place of the number

    Raises
    ------
    InputError
        Names the fewest samples that serve.
    """
    if not scene.tank.laser.on:
        return
    sharp = scene.with_tank(lens={"blur_px": 0.0})
    truths = lit_truths(scene, position_mm)
    widths = np.concatenate([line_sigma_px(sharp, truth) for truth in truths])
    if not np.isfinite(widths).any():
        return
    middle_px = float(np.nanmedian(widths))
    side = int(np.ceil(np.sqrt(np.log(2 / RIPPLE) / 2) / (np.pi * middle_px)))
    if isqrt(samples) < side:
        what = (
            f"samples lie farther apart than the sharp line is wide, a standard deviation of "
            f"{middle_px:.2g} px: its columns would be wrong by more than {RIPPLE:.0%}"
        )
        raise InputError(what, where=where, value=samples, allowed=f"{side**2} or more")


def half_width_mm(scene: Scene, truth: StripeTruth) -> Floats:
    """(N,) 1/e2 half width of the sheet where it meets the target, mm."""
    laser = scene.tank.laser
    index = water_optics(scene.tank.water, laser.wavelength_nm).index
    points = np.column_stack([truth.xz_mm[:, 0], truth.y_mm, truth.xz_mm[:, 1]])
    distance = np.linalg.norm(points - np.array(laser.apex_mm), axis=1)
    return laser.half_thickness_mm(distance, index)


@dataclass(frozen=True)
class LineColumns:
    """What is true of one line in each of the N columns (or rows) of a picture.

    Attributes
    ----------
    centre_px : (N,) array, px, of the line's middle; NaN where not OK
    status : (N,) array, of Status
    width_px : (N,) array, px, standard deviation across, in the picture; NaN where not OK
    height_dn : (N,) array, DN, by which the brightest pixel is expected above those beside the
        line; NaN where not OK
    """

    centre_px: Floats
    status: Ints
    width_px: Floats
    height_dn: Floats


def line_columns(scene: Scene, truth: StripeTruth, exposure_ms: float | None = None) -> LineColumns:
    """Centre, status, width and brightness of a true line, column by column.

    Parameters
    ----------
    scene, truth
        The scene as it is in the picture (``sim.at_moment``), and a line of it.
    exposure_ms
        Of the picture; the rig's if None.
    """
    light = line_brightness(scene, [truth], None if exposure_ms is None else [exposure_ms])[0]
    centre_px = np.where(truth.status == Status.OK, truth.centre_px, np.nan)
    return LineColumns(centre_px, truth.status, light.width_px, light.height_dn)
