"""What a rig sees and how well it will measure, from its scene alone: before any scan."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from lscan.calibration.marks import joined_marks
from lscan.errors import InputError
from lscan.figures.style import FIRST, MUTED, SECOND, legend, panels, png, styled
from lscan.records import Floats, Ints, Mask, Status
from lscan.stripe.peaks import FWHM
from sim.render.tank import Tank
from sim.scene import Scene
from sim.scene.instrument import FULL_SCALE_DN
from sim.sensor import Webcam
from sim.sensor.radiometry import speckle_contrast
from sim.studies.design.catalogue import LaserClass, laser_class
from sim.studies.design.rig import BRIGHT_SHARE, LONGEST_MS, PEAK_DN, measured_mm
from sim.studies.rig.prepared import centre_variance_px2
from sim.truth import (
    StripeTruth,
    board_truth,
    line_brightness,
    project,
    sheet_of,
    stripe_truth,
)
from sim.truth.light import CHANNELS

STEP_MM = 0.01  # of differences of the projection
# From the line: its core in widths and at least in px, and the px beside it that are its ground.
CORE_WIDTHS, LEAST_CORE_PX, BESIDE_PX = 3.0, 4, (5, 10)
WIDEST_PX = 4.0  # that the bound is worked out for
LEAST_WIDTH_PX = 0.3  # a line as thin as can be, spread by a pixel alone
CLIPPED_SHARE = 0.05  # of the line: more wants a shorter exposure
SHARES = 0.05, 0.5, 0.95  # of the line's columns, that are told
UNLIKE = 1.2  # times, by which a stated noise may be off before it is named


@dataclass(frozen=True)
class RigCheck:
    """A rig in its tank, by the truth of its line and one picture of it without noise.

    Attributes
    ----------
    scene : Scene
    width_mm, depth_mm : float, mm, of the sheet that is lit and seen, about the place that the
        camera aims at
    entry : (N,) array, columns (or rows) of the picture half-way through the scan in which the
        laser's line is lit and seen
    xz_mm : (N, 2) array, mm, the line's places in the sheet, head frame
    mm_per_px : (N, 2) array, mm of the target along the line a column, and of height a pixel across
    light : RenderedLine, what the picture there shows of the line
    sigma_z_mm : (2, N) array, mm, least standard uncertainty of a height, one column by itself: by
        the sensor's noise alone, and with speckle
    exposure_ms : float, ms, that puts the brightest parts of the line at 200 DN
    marks : tuple of int or None, marks of the board in view, and all; None where the scene's target
        is no board
    """

    scene: Scene
    width_mm: float
    depth_mm: float
    entry: Ints
    xz_mm: Floats
    mm_per_px: Floats
    light: "RenderedLine"
    sigma_z_mm: Floats
    exposure_ms: float
    marks: tuple[int, int] | None

    @property
    def laser_class(self) -> LaserClass:
        """After IEC 60825-1, as the search for designs has it."""
        return laser_class(self.scene.tank.laser)

    @property
    def clipped(self) -> Mask:
        """(N,) where the brightest pixel is at the end of the camera's range."""
        sensor = self.scene.tank.sensor
        end = min(sensor.gain * FULL_SCALE_DN, _linear_dn(sensor.clips_dn, self.scene))
        return self.light.crest_dn >= end

    @property
    def grey_dn(self) -> tuple[Floats, Floats]:
        """(N,) grey values of the brightest pixel, and beside the line, not rounded."""
        sensor = self.scene.tank.sensor
        most = FULL_SCALE_DN * (sensor.clips_dn / FULL_SCALE_DN) ** sensor.gamma
        crest, ground = (
            np.minimum(np.minimum(light, sensor.gain * FULL_SCALE_DN) + sensor.black_level_dn, most)
            for light in (self.light.crest_dn, self.light.ground_dn)
        )
        root, full = 1 / sensor.gamma, FULL_SCALE_DN
        return full * (crest / full) ** root, full * (ground / full) ** root

    @property
    def signal_to_noise(self) -> Floats:
        """(N,) of the brightest pixel above its ground, over the noise beside the line."""
        return (self.light.crest_dn - self.light.ground_dn) / self.light.noise_dn

    @cached_property
    def doubts(self) -> list[str]:
        """What in the scene contradicts something else in it, and what to do, a line each."""
        return list(_doubts(self))


def check_rig(scene: Scene) -> RigCheck:
    """What a rig sees and how well it measures its own target.

    Parameters
    ----------
    scene : Scene

    Raises
    ------
    InputError
        The laser's line is lit and seen nowhere half-way through the scan.

    References
    ----------
    The bound of a line's centre: Kay, Fundamentals of Statistical Signal Processing I, sec. 3.9.

    Examples
    --------
    >>> import sim
    >>> found = check_rig(sim.load_scene("paper/groove"))
    >>> found.laser_class, len(found.entry)
    ('2', 614)
    """
    positions = scene.rig.plan.positions_mm()
    middle_mm = positions[len(positions) // 2]
    truth = stripe_truth(scene, middle_mm)
    entry = np.flatnonzero(truth.status == Status.OK)
    is_board = scene.tank.target.shape == "board"
    if len(entry) == 0 and not is_board:
        what = "the laser's line is lit and seen nowhere half-way through the scan"
        allowed = "a target in view, such as `lscan-sim render` shows"
        raise InputError(what, where=scene.source, allowed=allowed)
    marks = None
    if is_board:
        status = joined_marks(board_truth(scene, positions[0]).centres).status
        marks = int(np.count_nonzero(status == Status.OK)), len(status)
    width_mm, depth_mm = measured_mm(scene)
    mm_per_px = _scale(scene, truth, entry)
    light = _line_light(scene, truth, entry, middle_mm)
    wanted_dn = _linear_dn(PEAK_DN, scene)
    brightest = np.quantile(light.crest_dn, BRIGHT_SHARE) if len(entry) else np.nan
    now_ms = scene.rig.camera.exposure_ms
    return RigCheck(
        scene=scene,
        width_mm=width_mm,
        depth_mm=depth_mm,
        entry=entry,
        xz_mm=truth.xz_mm[entry],
        mm_per_px=mm_per_px,
        light=light,
        sigma_z_mm=light.bounds_px * mm_per_px[:, 1],
        exposure_ms=float(np.minimum(now_ms * wanted_dn / brightest, LONGEST_MS)),
        marks=marks,
    )


@dataclass(frozen=True)
class RenderedLine:
    """What a picture without noise shows of a line, in DN that go with the light.

    Attributes
    ----------
    crest_dn, ground_dn : (N,) array, DN, above black: of the brightest pixel, and beside the line;
        what the camera's range would cut off is not
    width_px : (N,) array, px, standard deviation of the line across, pixels included
    noise_dn : (N,) array, DN, standard deviation of a pixel beside the line
    bounds_px : (2, N) array, px, least scatter of the line's centre: by the sensor's noise alone,
        and with speckle
    """

    crest_dn: Floats
    ground_dn: Floats
    width_px: Floats
    noise_dn: Floats
    bounds_px: Floats


def _line_light(scene: Scene, truth: StripeTruth, entry: Ints, position_mm: float) -> RenderedLine:
    """What the picture at a place shows of the line at some columns."""
    webcam, layers = Webcam(scene), Tank(scene).render(position_mm)
    dark = np.zeros_like(layers.direct)
    sensor, exposure_ms = scene.tank.sensor, scene.rig.camera.exposure_ms
    gain = sensor.gain * FULL_SCALE_DN / sensor.full_well_e
    weights = np.array(CHANNELS[scene.rig.stripe.colour], np.float32)
    whole = webcam.mean_electrons(layers, exposure_ms)
    direct = webcam.mean_electrons(replace(layers, scattered=dark, ambient=dark), exposure_ms)
    columns = [picture @ weights for picture in (whole, direct)]
    if scene.rig.stripe.axis == "columns":
        columns = [picture.T for picture in columns]
    row = np.rint(truth.centre_px[entry]).astype(int)
    known = line_brightness(scene, [truth])[0].width_px[entry]
    core_px = max(LEAST_CORE_PX, ceil(CORE_WIDTHS * np.median(known)) if len(known) else 0)
    away = np.arange(-core_px - BESIDE_PX[1], core_px + BESIDE_PX[1] + 1)
    places = np.clip(row[:, np.newaxis] + away, 0, columns[0].shape[1] - 1)
    light, of_line = (gain * picture[entry[:, np.newaxis], places] for picture in columns)
    core = np.abs(away) <= core_px
    crest = light[:, core].max(axis=1)
    ground = np.median(light[:, np.abs(away) >= core_px + BESIDE_PX[0]], axis=1)
    height = np.maximum(crest - ground, 1e-6)
    # The core's light over its height: a Gaussian's is sqrt(2 pi) times its standard deviation.
    width = (light[:, core] - ground[:, np.newaxis]).sum(axis=1) / height / np.sqrt(2 * np.pi)
    width = np.maximum(width, LEAST_WIDTH_PX)
    rounding = scene.rig.camera.step_dn**2 / 12
    colours = float((weights**2).sum())  # of noise: a mean of colours has less
    read = colours * (gain**2 * (sensor.dark_noise_e**2 + sensor.dsnu_e**2) + rounding)
    shot = colours * gain
    beside = read + shot * ground + colours * (sensor.prnu * ground) ** 2
    share = of_line[:, core].max(axis=1) / crest
    speckle2 = (_contrast(scene) * share) ** 2 + colours * sensor.prnu**2
    plain = np.full(len(entry), colours * sensor.prnu**2)
    each = np.full(len(entry), shot)
    # The information falls with the width: its pixels grow with it, their slopes squared fall as
    # its square.
    variances = [
        centre_variance_px2(np.minimum(width, WIDEST_PX), height, beside, each, grain)
        * np.maximum(width / WIDEST_PX, 1)
        for grain in (plain, speckle2)
    ]
    return RenderedLine(crest, ground, width, np.sqrt(beside), np.sqrt(np.stack(variances)))


def _contrast(scene: Scene) -> float:
    """Of the laser's speckle in a pixel."""
    sensor, lens, nm = scene.tank.sensor, scene.tank.lens, scene.tank.laser.wavelength_nm
    if sensor.speckle == "none" or not sensor.noise:
        return 0.0
    return speckle_contrast(sensor.pixel_um, lens.f_number, nm, sensor.speckle)


def _linear_dn(dn: float, scene: Scene) -> float:
    """Light, in DN of a linear camera above black, of a grey value."""
    sensor = scene.tank.sensor
    return float(FULL_SCALE_DN * (dn / FULL_SCALE_DN) ** sensor.gamma - sensor.black_level_dn)


def _scale(scene: Scene, truth: StripeTruth, entry: Ints) -> Floats:
    """(N, 2) mm of the target along the line a column, and mm of height a pixel across it.

    A height moves the line within its column, so x changes with it as the camera sees it.
    """
    here, sheet = truth.xz_mm[entry], sheet_of(scene)
    steps = [
        (project(scene, sheet.in_head(here + step)) - project(scene, sheet.in_head(here - step)))
        / (2 * STEP_MM)
        for step in STEP_MM * np.eye(2)
    ]
    image = np.stack(steps, axis=-1)  # (N, 2, 2) px/mm: of u and v by x and z
    along, across = (0, 1) if truth.axis == "columns" else (1, 0)
    by_px = np.linalg.inv(image)  # mm/px: of x and z by u and v
    return np.column_stack(
        [np.linalg.norm(by_px[:, :, along], axis=1), np.abs(by_px[:, 1, across])]
    )


def _doubts(found: RigCheck) -> Iterator[str]:
    scene = found.scene
    rig, tank = scene.rig, scene.tank
    sensor, stripe = tank.sensor, rig.stripe
    exposure_ms = rig.camera.exposure_ms
    seen = max(len(found.entry), 1)
    clipped = np.count_nonzero(found.clipped) / seen
    faint = np.count_nonzero(np.subtract(*found.grey_dn) <= stripe.threshold_dn) / seen
    if clipped > CLIPPED_SHARE:
        yield (
            f"{clipped:.0%} of the line is clipped: camera.exposure_ms = {found.exposure_ms:.3g} "
            f"in place of {exposure_ms:g}"
        )
    elif faint > CLIPPED_SHARE:
        longer = f"camera.exposure_ms = {found.exposure_ms:.3g} in place of {exposure_ms:g}"
        yield (
            f"{faint:.0%} of the line is below stripe.threshold_dn = {stripe.threshold_dn:g}: "
            f"a lower one{f', or {longer}' if found.exposure_ms > exposure_ms else ''}"
        )
    response = sensor.laser_response
    colours = {"red": response.red, "green": response.green, "blue": response.blue}
    best = max(colours, key=lambda colour: colours[colour])
    own = colours.get(stripe.colour)
    if own is not None and own < colours[best] / 2:
        yield (
            f'stripe.channel = "{stripe.channel}", though the camera sees the laser of '
            f"{tank.laser.wavelength_nm:g} nm best in {best}"
        )
    if sensor.gamma != 1 and stripe.gamma == 1:
        yield f"sensor.gamma = {sensor.gamma:g}, which stripe.gamma does not state"
    if stripe.noise is not None and sensor.noise:
        gain = sensor.gain * FULL_SCALE_DN / sensor.full_well_e
        rounding = rig.camera.step_dn**2 / 12
        read = float(np.sqrt(gain**2 * (sensor.dark_noise_e**2 + sensor.dsnu_e**2) + rounding))
        true = {"read_dn": read, "dn_per_electron": gain, "speckle": _contrast(scene)}
        for key, value in true.items():
            stated = getattr(stripe.noise, key)
            if max(stated, value) > UNLIKE * min(stated, value):
                yield f"stripe.noise.{key} = {stated:g}, the tank's is {value:.3g}"
    moved_mm = abs(tank.head.speed_mm_s) * exposure_ms / 1000
    if len(found.entry) and moved_mm > float(np.median(found.mm_per_px[:, 0])):
        yield f"the head moves by {moved_mm:.2g} mm while a picture is exposed"
    if found.marks is not None and found.marks[0] < found.marks[1]:
        seen, every = found.marks
        yield f"{every - seen} of the board's {every} marks are not seen"


# In words and as a picture.


def check_lines(found: RigCheck) -> list[str]:
    """The check in words, a line for each thing.

    Parameters
    ----------
    found : RigCheck
    """
    scene = found.scene
    size, axis = scene.rig.camera.size_px, scene.rig.stripe.axis
    count = size[0] if axis == "columns" else size[1]
    lines = [
        f"view: {found.width_mm:.0f} mm of the sheet and {found.depth_mm:.0f} mm of depth where "
        f"the camera aims; {len(found.entry)} of {count} {axis} show the line"
    ]
    if len(found.entry):
        along, height = np.median(found.mm_per_px, axis=0)
        (crest, ground), (sensor, both) = found.grey_dn, 1000 * found.sigma_z_mm
        lines += [
            f"line: {along:.3g} mm a pixel along it, {height:.3g} mm of height a pixel; "
            f"{np.median(FWHM * found.light.width_px):.1f} px wide at half its height",
            f"light: {_range(crest, '.0f')} DN on {np.median(ground):.0f} DN, "
            f"{np.mean(found.clipped):.0%} clipped; signal to noise "
            f"{np.median(found.signal_to_noise):.0f}",
            f"height: sigma of one column at least {_range(sensor, '.3g')} µm by the sensor, "
            f"{_range(both, '.3g')} µm with speckle",
            f"exposure: {scene.rig.camera.exposure_ms:g} ms; {found.exposure_ms:.3g} ms puts the "
            f"line's brightest parts at {PEAK_DN:.0f} DN",
        ]
    laser = f"class {found.laser_class} after IEC 60825-1" if scene.tank.laser.on else "off"
    lines.append(f"laser: {laser}")
    if found.marks is not None:
        lines.append(f"board: {found.marks[0]} of {found.marks[1]} marks are seen")
    return lines + [f"doubt: {doubt}" for doubt in found.doubts]


def check_json(found: RigCheck) -> dict[str, Any]:
    """The check as JSON has it: ranges are those of 5, 50 and 95 % of the line's columns.

    Parameters
    ----------
    found : RigCheck
    """
    (crest, ground), (sensor, both) = found.grey_dn, found.sigma_z_mm
    ranges = {
        "mm_per_px_along": found.mm_per_px[:, 0],
        "mm_of_height_per_px": found.mm_per_px[:, 1],
        "width_px": FWHM * found.light.width_px,
        "crest_dn": crest,
        "ground_dn": ground,
        "signal_to_noise": found.signal_to_noise,
        "sigma_z_mm": both,
        "sigma_z_mm_without_speckle": sensor,
    }
    any_line = len(found.entry) > 0
    return {
        "view_mm": [found.width_mm, found.depth_mm],
        "columns": len(found.entry),
        **{name: _shares(values) for name, values in ranges.items()},
        "clipped": float(np.mean(found.clipped)) if any_line else None,
        "exposure_ms": found.exposure_ms if any_line else None,
        "laser_class": found.laser_class,
        "marks_seen": None if found.marks is None else list(found.marks),
        "doubts": found.doubts,
    }


def _shares(values: Floats) -> list[float] | None:
    return np.quantile(values, SHARES).tolist() if len(values) else None


def _range(values: Floats, form: str) -> str:
    low, middle, high = np.quantile(values, SHARES)
    return f"{middle:{form}} ({low:{form}} to {high:{form}})"


@styled
def check_picture(found: RigCheck) -> bytes:
    """Brightness, width and uncertainty along the line, as a PNG file.

    Parameters
    ----------
    found : RigCheck
    """
    figure, (light, width, sigma) = panels(3, (5.8, 6.0))
    x = found.xz_mm[:, 0]
    crest, ground = found.grey_dn
    _along(light, x, crest, "DN", "line")
    light.plot(x, ground, ".", ms=2, color=MUTED, label="ground")
    light.set_ylim(0, FULL_SCALE_DN)
    _along(width, x, FWHM * found.light.width_px, "width, px", "full width at half height")
    width.set_ylim(bottom=0)
    _along(sigma, x, 1000 * found.sigma_z_mm[1], "sigma of z, µm", "with speckle")
    sigma.plot(x, 1000 * found.sigma_z_mm[0], ".", ms=2, color=SECOND, label="sensor")
    sigma.set_ylim(bottom=0)
    sigma.set_xlabel("x in the sheet, mm")
    for axes in (light, width, sigma):
        legend(axes)
    return png(figure)


def _along(axes: Axes, x: Floats, values: Floats, unit: str, label: str) -> None:
    axes.plot(x, values, ".", ms=2, color=FIRST, label=label)
    axes.set_ylabel(unit)
