"""All orders of scattering against Mitsuba's own ``volpath``, on the same emitter and scene."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.ndimage import binary_dilation
from scipy.stats import t as student

from lscan.errors import InputError
from lscan.records import Floats, Mask, Status
from sim.render.layers import W_PER_M2_IN_MW_PER_MM2
from sim.render.tank import Tank
from sim.scene import Scene
from sim.truth import StripeTruth, stripe_truth
from sim.water import HenyeyGreensteinMixture, Optics, water_optics
from tests.validation.light.judge import JudgeEffort, judge
from tests.validation.light.rigs import scene_with, topic
from tests.validation.rows import Row, Topic, measured_rows, row

# The water as a medium of Mitsuba's own, for its own integrators.


def stock_medium(water: Optics) -> dict[str, Any]:
    """The water as a stock homogeneous medium: nested blends of its lobes and Rayleigh's.

    Parameters
    ----------
    water : Optics, its particles' phase function is a mixture of Henyey-Greenstein lobes

    Returns
    -------
    The dictionary that ``mitsuba.load_dict`` takes; lengths in mm.

    Raises
    ------
    InputError
        The phase function is none of Mitsuba's own.
    """
    if not isinstance(water.particles, HenyeyGreensteinMixture):
        raise InputError(
            "no phase function of Mitsuba's own",
            where="water.phase",
            value=type(water.particles).__name__,
            allowed="henyey-greenstein or petzold-mixture",
        )
    phase: dict[str, Any] = {"type": "rayleigh"}
    share = water.molecular_weight
    for weight, g in zip(water.particles.weights, water.particles.g, strict=True):
        share += (1 - water.molecular_weight) * weight
        lobe = {"type": "hg", "g": float(g)}
        # blendphase = (1 - w) first + w second
        blend = float((1 - water.molecular_weight) * weight / share)
        phase = {"type": "blendphase", "weight": blend, "first": phase, "second": lobe}
    return {
        "type": "homogeneous",
        "sigma_t": water.extinction_per_mm,
        "albedo": water.scattering_per_mm / water.extinction_per_mm,
        "phase": phase,
        "has_spectral_extinction": False,
    }


# All orders of scattering against Mitsuba's own ``volpath``, on the same emitter and scene.


SEED = 4000
ASYMMETRY = 0.924  # Petzold's mean cosine, in one lobe
# One lobe, because the reference must converge: an oceanic peak of 1e4 per sr, met by chance,
# leaves its means short of the truth for hours while their scatter looks small.
OTHER_ASYMMETRY = ASYMMETRY - 0.02
LEVEL = 1e-3  # chance of a false alarm in all tests of a check together
MASKS = ("core", "halo", "veil", "shadow")
CENTROID_PX = 0.01
OUR_SAMPLES, OUR_GRID = 64, 256  # of higher orders, at most, and of the first
STOCK = {"type": "volpath", "max_depth": -1, "rr_depth": 8}
JUDGE = JudgeEffort(photons=1 << 18, walks=64, cell_mm=0.5, voxel_mm=4.0)
# A narrow window for the centre: farther out the halo, noisy in the reference, has a long lever.
NEAR_PX, CENTRE_PX = 3, 1.5
FAR_PX = 8


@dataclass(frozen=True)
class Pictures:
    """Independent pictures of one scene, (runs, H, W) each, radiance times camera weight.

    ours: this project's; theirs: volpath's; judged: of the judge, whose first order is ours;
    other: ours in water of another asymmetry.
    direct: (H, W) light the laser's line sends straight to the camera, of ours.
    """

    ours: Floats
    theirs: Floats
    judged: Floats
    other: Floats
    direct: Floats
    truth: StripeTruth


@dataclass(frozen=True)
class ZTest:
    """Two sets of pictures on one mask.

    z: difference of their sums over its standard error.  share: that error over the mean.
    degrees: of freedom.
    """

    z: float
    share: float
    degrees: float


@dataclass(frozen=True)
class Comparison:
    """Ours against theirs in one water, each test by the name of its mask.

    judge, judged: of the judge against theirs, and of ours against the judge.  without_line,
    other_g: of our picture without the line, and of water whose asymmetry is 0.02 less.
    centroid_px: difference of the line's centre, averaged over its columns, and its standard
    error.
    """

    tests: dict[str, ZTest]
    judge: dict[str, ZTest]
    judged: dict[str, ZTest]
    without_line: dict[str, ZTest]
    other_g: dict[str, ZTest]
    centroid_px: float
    centroid_error_px: float

    @property
    def degrees(self) -> float:
        """Of freedom, the fewest of the tests that have to pass."""
        passing = (self.tests, self.judge, self.judged)
        return min(test.degrees for tests in passing for test in tests.values())


def multiple_scattering(waters: tuple[str, ...], runs: int, samples: int) -> Topic:
    """Masked z-tests and the line's centre in the waters named.

    runs: independent pictures a side; samples: volpath's, a pixel of each.
    """
    tests = len(MASKS) * len(waters)
    rows = [
        row
        for name in waters
        for row in measured_rows(
            f"all orders of scattering, {name}",
            partial(water_rows, name, runs, samples, tests),
        )
    ]
    return topic("multiple-scattering", rows=rows)


def water_rows(name: str, runs: int, samples: int, tests: int) -> list[Row]:
    """The rows of one water, whose z-tests are among so many of one chapter."""
    result = compare(pictures(name, runs, samples))
    bound = sidak_bound(tests, result.degrees)
    words: dict[str, Any] = {
        "seed": SEED,
        "water": name,
        "tests": tests,
        "level": LEVEL,
        "runs": runs,
        "samples": samples,
        "shares": ", ".join(f"{n} {100 * test.share:.2g} %" for n, test in result.tests.items()),
        "noise_px": result.centroid_error_px,
    }
    core = abs(result.without_line["core"].z)
    return [
        row("scattering", largest_z(result.tests), bar=bound, **words),
        row("scattering-judge", largest_z(result.judge), bar=bound, **words),
        row("scattering-judged", largest_z(result.judged), bar=bound, **words),
        row(
            "scattering-centre",
            result.centroid_px,
            bar=CENTROID_PX,
            sigma=result.centroid_error_px,
            **words,
        ),
        row("scattering-no-line", bound / core, **words),
        row("scattering-other-g", bound / largest_z(result.other_g), **words),
    ]


def largest_z(tests: Mapping[str, ZTest]) -> float:
    """The largest |z| of the tests."""
    return max(abs(test.z) for test in tests.values())


def pictures(water: str, runs: int, samples: int) -> Pictures:
    """Independent pictures of the scene in a named water, ours, volpath's, and of other g."""
    scene = scene_with(
        "block",
        water={"kind": water, "asymmetry": ASYMMETRY},
        render={"samples": OUR_GRID, "scatter_samples": OUR_SAMPLES},
    )
    tank = Tank(scene)
    right, wrong = (_one_lobe(scene, g) for g in (ASYMMETRY, OTHER_ASYMMETRY))
    # As few as leave most of the noise to the reference: its veil scatters four times as much.
    few = min(max(samples // 16, 4), OUR_SAMPLES)
    photons, walks = min(samples << 12, JUDGE.photons), min(samples, JUDGE.walks)
    effort = replace(JUDGE, photons=photons, batches=runs, walks=walks)
    # The reference first: our integrators hold the water they are given until the next.
    stock, seeds = mi.load_dict(STOCK), range(SEED, SEED + runs)
    theirs = _several(tank, stock, samples, seeds, medium=stock_medium(right))
    other = _ours(tank, wrong, runs, few, SEED + 2 * runs)
    ours = _ours(tank, right, runs, few, SEED + runs)
    higher = judge(tank, 0.0, effort=effort, seed=SEED).total
    judged = _several(tank, tank.integrator, OUR_GRID, range(SEED + 3 * runs, SEED + 4 * runs))
    judged += higher / W_PER_M2_IN_MW_PER_MM2
    direct = tank.render(0.0, scatter_samples=0).direct.astype(float) / W_PER_M2_IN_MW_PER_MM2
    truth = stripe_truth(scene, 0.0)
    return Pictures(ours, theirs, judged, other, direct, truth)


def _one_lobe(scene: Scene, asymmetry: float) -> Optics:
    """The scene's water with all its scattering in one Henyey-Greenstein lobe."""
    optics = water_optics(scene.tank.water, scene.tank.laser.wavelength_nm)
    lobe = HenyeyGreensteinMixture(weights=(1.0,), g=(asymmetry,))
    return replace(optics, particles=lobe, molecular_weight=0.0)


def _ours(tank: Tank, water: Optics, runs: int, samples: int, seed: int) -> Floats:
    """(runs, H, W) pictures of this project's two integrators, added up."""
    for integrator in (tank.integrator, tank.higher):
        integrator.configure(water, tank.sheets, 0.0)
    seeds = range(seed, seed + runs)
    first = _several(tank, tank.integrator, OUR_GRID, seeds)
    return first + _several(tank, tank.higher, samples, seeds)


def _several(
    tank: Tank,
    integrator: mi.Integrator,
    samples: int,
    seeds: range,
    medium: Mapping[str, Any] | None = None,
) -> Floats:
    """(runs, H, W) pictures, one a seed."""
    camera = tank.make_camera(medium=medium, jitter=True)
    return np.array([render_with(tank, camera, integrator, samples, seed) for seed in seeds])


def render_with(
    tank: Tank, camera: mi.Sensor, integrator: mi.Integrator, samples: int, seed: int
) -> Floats:
    """(H, W) radiance times the camera's weight of the tank's scene, by any integrator."""
    image = mi.render(
        tank.mitsuba_scene, sensor=camera, integrator=integrator, spp=samples, seed=seed
    )
    return np.array(image, dtype=float)[..., 0]


def compare(found: Pictures) -> Comparison:
    """Ours, the judge's and theirs on the masks, and the line's centre."""
    masks = parts_of_picture(found)

    def tests(one: Floats, other: Floats) -> dict[str, ZTest]:
        return {name: _difference(one, other, mask) for name, mask in masks.items()}

    return Comparison(
        tests(found.ours, found.theirs),
        tests(found.judged, found.theirs),
        tests(found.ours, found.judged),
        tests(found.ours - found.direct, found.theirs),
        tests(found.other, found.theirs),
        *centroid_difference(found),
    )


def parts_of_picture(found: Pictures) -> dict[str, Mask]:
    """(H, W) masks: core, halo, veil, shadow, by where the line's direct light falls.

    core: a third of its brightest or more.  halo: no more than 3 px from it, without direct
    light.  veil: 8 px or more above the uppermost part of the line.  shadow: within 3 px of
    where the truth has the sheet's hidden, unlit section, without direct light.
    """
    direct = found.direct
    lit = direct > 1e-4 * direct.max()
    core = direct > direct.max() / 3
    beside = binary_dilation(core, iterations=NEAR_PX) & ~lit
    rows = np.arange(direct.shape[0])[:, np.newaxis]
    top = np.argmax(lit.any(axis=1))
    veil = np.broadcast_to(rows < top - FAR_PX, direct.shape)
    hidden = (found.truth.status == Status.OCCLUDED) & found.truth.seen
    centre = np.where(hidden, found.truth.centre_px, np.inf)
    shadow = (np.abs(rows - centre) <= NEAR_PX) & ~lit
    return {"core": core, "halo": beside, "veil": veil, "shadow": shadow}


def _difference(ours: Floats, theirs: Floats, mask: Mask) -> ZTest:
    """Welch's test of two sets of pictures' sums over a mask: each set has its own variance."""
    a, b = ours[:, mask].sum(axis=1), theirs[:, mask].sum(axis=1)
    part_a, part_b = a.var(ddof=1) / len(a), b.var(ddof=1) / len(b)
    error = np.sqrt(part_a + part_b)
    degrees = error**4 / (part_a**2 / (len(a) - 1) + part_b**2 / (len(b) - 1))
    z = (a.mean() - b.mean()) / error
    return ZTest(float(z), share=float(error / b.mean()), degrees=float(degrees))


def sidak_bound(tests: int, degrees: float) -> float:
    """|z| that all of so many tests stay below but for a chance of LEVEL (Sidak 1967)."""
    each = 1 - (1 - LEVEL) ** (1 / tests)
    return float(student.isf(each / 2, degrees))


def centroid_difference(found: Pictures) -> tuple[float, float]:
    """Difference of the line's centre, px, averaged over its columns, and its standard error.

    The centre of a column is that of the light within 1.5 px of the true line.
    """
    shown = found.truth.status == Status.OK
    ours, theirs = (
        _centres(images, found.truth)[:, shown].mean(axis=1)
        for images in (found.ours, found.theirs)
    )
    error = np.hypot(*(c.std(ddof=1) / np.sqrt(len(c)) for c in (ours, theirs)))
    return abs(float(ours.mean() - theirs.mean())), float(error)


def _centres(images: Floats, truth: StripeTruth) -> Floats:
    """(runs, columns) centre of the light about the true line, px."""
    rows = np.arange(images.shape[1])[:, np.newaxis]
    line = np.where(np.isfinite(truth.centre_px), truth.centre_px, -np.inf)
    near = np.abs(rows - line) <= CENTRE_PX
    weight = images * near
    total = weight.sum(axis=1)
    return np.divide((weight * rows).sum(axis=1), total, out=np.zeros_like(total), where=total > 0)
