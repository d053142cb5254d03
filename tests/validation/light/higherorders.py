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
from sim.sensor.noise import electrons_of
from tests.validation.light.judge import Judged, JudgeEffort, judge
from tests.validation.light.rigs import TARGETS, LightCase, light_case, topic
from tests.validation.rows import Row, Topic, measured_rows, row

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
BLOCK_PX = 8  # neighbours along the line whose mean difference is looked at


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
    """Ours over the judge's light on a part of a window, and half of its interval."""

    where: str
    value: float
    half: float

    @property
    def beyond(self) -> float:
        """How far 1 lies outside the interval; negative within."""
        return abs(self.value - 1) - self.half


@dataclass(frozen=True)
class LightFound:
    """What was found in a window.

    ratios: of the parts of BARS.  centre_px, pixel_dn: deviation of the line's centre, rms, and of
    the pixels, the largest; with what the judge's noise explains of each.
    """

    ratios: Mapping[str, Sequence[LightRatio]]
    centre_px: tuple[float, float]
    pixel_dn: tuple[float, float]


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
            rows.append(row("light-part", off, bar=bar, **words))
    centre, noise = max((one.centre_px for one in found), key=lambda pair: pair[0] - pair[1])
    words |= {"required": CENTRE_BARS_PX[level], "noise": noise}
    rows.append(row("light-centre", centre, bar=np.hypot(words["required"], noise), **words))
    pixel, noise = max((one.pixel_dn for one in found), key=lambda pair: pair[0] - pair[1])
    words |= {"required": PIXEL_BAR_DN, "noise": noise}
    return [*rows, row("light-pixel", pixel, bar=PIXEL_BAR_DN + noise, **words)]


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
        _pixel_deviation(offset, grey),
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
    return LightRatio(where, value, float(student.ppf(0.5 + CONFIDENCE / 2, len(sums) - 1) * error))


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


def _pixel_deviation(offset: Floats, grey: Floats) -> tuple[float, float]:
    """Largest deviation of neighbours along the line, DN, and the largest of noise alone."""
    ours, one, other = grey
    blocks = np.array(
        [list(_blocks(offset, light)) for light in (ours - (one + other) / 2, one - other)]
    )
    return float(np.abs(blocks[0]).max()), float(np.abs(blocks[1]).max() / 2)


def _blocks(offset: Floats, light: Floats) -> Iterator[float]:
    """Means over neighbouring columns at equal distances from the line."""
    near = int(RINGS_PX[-1]) - BORDER_PX
    for start in range(BORDER_PX, light.shape[1] - BORDER_PX - BLOCK_PX + 1, BLOCK_PX):
        block = slice(start, start + BLOCK_PX)
        for distance in range(-near, near + 1):
            mask = np.rint(offset[BORDER_PX:-BORDER_PX, block]) == distance
            if mask.sum() == BLOCK_PX:
                yield float(light[BORDER_PX:-BORDER_PX, block][mask].mean())
