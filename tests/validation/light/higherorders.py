"""Light of two and more orders, as gathered, against the judge of bounded weights."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.stats import t as student

from lscan.config.rig import StripeSection
from lscan.records import Floats, Mask, Status
from lscan.stripe import find_extractor
from sim.render.tank import Tank
from sim.sensor import Webcam
from sim.sensor.webcam import electrons_of
from tests.validation.light.judge import Judged, JudgeEffort, judge
from tests.validation.light.rigs import TARGETS, LightCase, light_case, topic
from tests.validation.rows import FAULT, LEAST_POWER, Row, Topic, measured_rows, power_of, row

SEED = 91
DEPTHS = (0.1, 1.0, 5.0)  # b d: what the camera's metre of water scatters
BARS = {  # %, at those depths
    "core": (1.5, 1.5, 3.0),
    "halo": (1.5, 1.5, 3.0),
    "grooves and shadow": (3.0, 3.0, 6.0),
    "veil": (2.0, 2.0, 2.0),
}
JUDGE = JudgeEffort(batches=4)
CENTRE_BARS_PX, PIXEL_BAR_DN = (0.01, 0.01, 0.02), 1.0
RINGS_PX = (-1.0, 1.0, 4.0, 16.0, 64.0)  # from the line: the core, and the halo in three
CONFIDENCE, STANDARD_ERRORS = 0.95, 1.96
RIDGE_MM = 1.0  # below the highest of the groove's line by more, it is not on a ridge
BRIGHTEST_DN = 200.0
BORDER_PX, ENDS_PX = 3, 4.0  # left out: what the lens blurs into the window; the line's ends
# Columns along the line and distances from it over which differences are averaged: the first of
# these patches that shows a deviation twice as large as required is looked at.
PATCHES_PX = ((8, 1), (8, 4), (16, 8), (32, 16))


@dataclass(frozen=True)
class LightEffort:
    """How much is judged.

    targets, depths: how many of TARGETS and DEPTHS.  rigs: random ones of each target.  columns:
    of a picture's window.  judge: of each window.
    """

    targets: int = len(TARGETS)
    depths: int = len(DEPTHS)
    rigs: int = 1
    columns: int = 48
    judge: JudgeEffort = JUDGE


@dataclass(frozen=True)
class LightRatio:
    """Ours over the judge's light on a part of a window, half of its interval, and its error."""

    where: str
    value: float
    half: float
    sigma: float

    @property
    def beyond(self) -> float:
        """How far 1 lies outside the interval; negative within."""
        return abs(self.value - 1) - self.half

    def power(self, required: float) -> float:
        """The probability that a deviation of FAULT times ``required`` would be seen."""
        return power_of(FAULT * required, required + self.half, self.sigma)


@dataclass(frozen=True)
class LightPatch:
    """The largest difference of a patch of pixels, DN, and what noise explains.

    largest_dn, noise_dn: of the difference, and of both halves of the judge's batches, halved.
    sigma_dn: rms of the latter.  columns, distances: that a patch is the mean of.
    """

    largest_dn: float
    noise_dn: float
    sigma_dn: float
    columns: int
    distances: int

    @property
    def beyond(self) -> float:
        """How far the difference is above what noise explains, DN."""
        return self.largest_dn - self.noise_dn

    @property
    def power(self) -> float:
        """The probability that a difference of FAULT times PIXEL_BAR_DN would be seen."""
        return power_of(FAULT * PIXEL_BAR_DN, PIXEL_BAR_DN + self.noise_dn, self.sigma_dn)


@dataclass(frozen=True)
class LightFound:
    """What was found in a window.

    ratios: of the parts of BARS.  centre_px: rms deviation of the line's centre, and what the
    judge's noise explains of it.
    """

    ratios: Mapping[str, Sequence[LightRatio]]
    centre_px: tuple[float, float]
    patch: LightPatch


def higher_orders(effort: LightEffort) -> Topic:
    """Parts of the picture, the line's centre and single pixels, for each target and water."""
    rows = [
        found
        for target in list(TARGETS)[: effort.targets]
        for level in range(effort.depths)
        for found in measured_rows(
            f"light of higher orders, {target}, b d = {DEPTHS[level]:g}",
            partial(target_rows, target, level, effort),
        )
    ]
    return topic("higher-orders", rows)


def target_rows(target: str, level: int, effort: LightEffort) -> list[Row]:
    """The rows of a target in the water of that place of DEPTHS: the worst of its rigs."""
    generator = np.random.default_rng([SEED, list(TARGETS).index(target)])
    reach = int(RINGS_PX[-1])
    cases = [
        light_case(target, DEPTHS[level], generator, effort.columns, reach)
        for _ in range(effort.rigs)
    ]
    found = [compare(case, effort.judge, target == "groove") for case in cases]
    words: dict[str, Any] = {
        "seed": SEED,
        "target": target,
        "depth": DEPTHS[level],
        "rigs": effort.rigs,
    }
    rows = []
    for part, bars in BARS.items():
        ratios = [ratio for one in found for ratio in one.ratios[part]]
        if ratios:
            worst = max(ratios, key=lambda ratio: ratio.beyond)
            bar, off = bars[level] + 100 * worst.half, 100 * abs(worst.value - 1)
            words |= {"part": part, "ratio": worst, "required": bars[level]}
            power = min(ratio.power(bars[level] / 100) for ratio in ratios)
            rows.append(row("light-part", off, bar=bar, power=power, **words))
    centre, noise = max((one.centre_px for one in found), key=lambda pair: pair[0] - pair[1])
    required, bar = CENTRE_BARS_PX[level], float(np.hypot(CENTRE_BARS_PX[level], noise))
    power = power_of((FAULT * required) ** 2, bar**2, noise**2 / STANDARD_ERRORS)
    words |= {"required": required, "noise": noise}
    rows.append(row("light-centre", centre, bar=bar, power=power, **words))
    patch = max((one.patch for one in found), key=lambda patch: patch.beyond)
    words |= {"required": PIXEL_BAR_DN, "patch": patch}
    bar, power = PIXEL_BAR_DN + patch.noise_dn, min(one.patch.power for one in found)
    return [*rows, row("light-pixel", patch.largest_dn, bar=bar, power=power, **words)]


def compare(case: LightCase, effort: JudgeEffort, grooved: bool) -> LightFound:
    """Ours against the judge in the case's window.

    grooved: what lies below the ridges is no open surface.
    """
    tank = Tank(case.scene)
    families = tank.higher_orders(case.position_mm)
    ours = {name: light.astype(float) for name, light in families.items()}
    judged = judge(tank, case.position_mm, case.window, effort, SEED)
    grey = _grey_values(case, tank, np.asarray(sum(ours.values())), judged)
    left, top, width, height = case.window
    inside = slice(top, top + height), slice(left, left + width)
    here = {name: light[inside] for name, light in ours.items()}
    offset = np.arange(top, top + height)[:, np.newaxis] - case.truth.centre_px[inside[1]]
    return LightFound(
        _ratios(case, grooved, np.abs(offset), here, judged),
        _centre_deviation(case, grey),
        _worst_patch(offset, grey),
    )


def _ratios(
    case: LightCase, grooved: bool, distance: Floats, ours: Mapping[str, Floats], judged: Judged
) -> dict[str, list[LightRatio]]:
    """Ratios on the parts of a window; distance: (H, W) px from the line, along the columns."""
    left, _, width, _ = case.window
    here = slice(left, left + width)
    shown, z = case.truth.status[here] == Status.OK, case.truth.xz_mm[here, 1]
    is_open = shown & ((z > np.max(z[shown]) - RIDGE_MM) | (not grooved))
    total, whole = np.asarray(sum(ours.values())), judged.total
    ratios: dict[str, list[LightRatio]] = {part: [] for part in BARS}
    for low, high in pairwise(RINGS_PX):
        ring, where = (low < distance) & (distance <= high), f"{max(low, 0):g} to {high:g} px"
        surface = "core" if low < 0 else "halo"
        for part, mask in ((surface, ring & is_open), ("grooves and shadow", ring & ~is_open)):
            if mask.any():
                ratios[part].append(_ratio(where, total[mask], whole[:, mask]))
    veil = judged.families["veil"].reshape(len(whole), -1)
    ratios["veil"].append(_ratio("the window", ours["veil"], veil))
    return ratios


def _ratio(where: str, ours: Floats, judged: Floats) -> LightRatio:
    """The ratio of sums; judged: (batches, N), independent."""
    sums = judged.sum(axis=1)
    value = float(ours.sum() / sums.mean())
    error = sums.std(ddof=1) / np.sqrt(len(sums)) / sums.mean()
    half = student.ppf(0.5 + CONFIDENCE / 2, len(sums) - 1) * error
    return LightRatio(where, value, float(half), float(error))


def _grey_values(case: LightCase, tank: Tank, ours: Floats, judged: Judged) -> Floats:
    """(3, H, W) window in DN before the sensor's noise: ours, and by either half of the batches."""
    left, top, width, height = case.window
    inside = slice(top, top + height), slice(left, left + width)
    webcam, sensor = Webcam(case.scene), case.scene.tank.sensor
    first = tank.render(case.position_mm, scatter_samples=0)
    pictures = [ours]
    for half in (0, 1):
        pictures.append(ours.copy())
        pictures[-1][inside] = judged.total[half::2].mean(axis=0)
    layers = [
        replace(first, scattered=first.scattered + light.astype(np.float32)) for light in pictures
    ]
    exposure_ms = webcam.metered_ms(layers[0], BRIGHTEST_DN, 100.0)
    per_dn = electrons_of(sensor.black_level_dn + 1, sensor)
    grey = [webcam.mean_electrons(one, exposure_ms)[..., 0] / per_dn for one in layers]
    return np.array(grey, dtype=float)[:, *inside]


def _centre_deviation(case: LightCase, grey: Floats) -> tuple[float, float]:
    """Rms deviation of the line's centre by "ml", px, and what noise explains.

    Each half of the judge's batches errs by itself: the mean product of the deviations from either
    is free of their noise but for its standard error, the square of what is told.
    """
    left, _, width, _ = case.window
    settings, ml = StripeSection(extractor="ml"), find_extractor("ml")
    clipped: Mask = np.zeros(grey.shape[1:], dtype=bool)
    centres = [ml(np.asfortranarray(image), settings, clipped).centre_px for image in grey]
    ours, one, other = np.array(centres)[:, BORDER_PX:-BORDER_PX]
    edge_px = case.truth.edge_px[left : left + width][BORDER_PX:-BORDER_PX]
    used = (edge_px > ENDS_PX) & np.isfinite(ours + one + other)
    squares = ((ours - one) * (ours - other))[used]
    noise = np.sqrt(STANDARD_ERRORS * squares.std(ddof=1) / np.sqrt(len(squares)))
    return float(np.sqrt(max(squares.mean(), 0.0))), float(noise)


def _worst_patch(offset: Floats, grey: Floats) -> LightPatch:
    """The largest difference of the smallest patches in which FAULT would be seen; of the largest
    ones where it would be in none."""
    ours, one, other = grey
    for most, distances in PATCHES_PX:
        columns = min(most, offset.shape[1] - 2 * BORDER_PX)
        off, noise = (
            np.array(list(_patches(offset, light, columns, distances)))
            for light in (ours - (one + other) / 2, (one - other) / 2)
        )
        sigma = float(np.sqrt(np.mean(noise**2)))
        largest = float(np.abs(off).max()), float(np.abs(noise).max())
        patch = LightPatch(*largest, sigma, columns, distances)
        if patch.power >= LEAST_POWER:
            break
    return patch


def _patches(offset: Floats, light: Floats, columns: int, distances: int) -> Iterator[float]:
    """Means over neighbouring columns and distances from the line."""
    near = int(RINGS_PX[-1]) - BORDER_PX
    for start in range(BORDER_PX, light.shape[1] - BORDER_PX - columns + 1, columns):
        block = slice(start, start + columns)
        distance = np.rint(offset[BORDER_PX:-BORDER_PX, block])
        for low in range(-near, near + 2 - distances, distances):
            mask = (low <= distance) & (distance < low + distances)
            if mask.sum() == columns * distances:
                yield float(light[BORDER_PX:-BORDER_PX, block][mask].mean())
