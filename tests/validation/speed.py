"""Speed of the tank and of the instrument, measured as ratios side by side in one run.

The reference for the tank is Mitsuba's own ``volpath`` on the same emitter, scene and picture
window.  Efficiency is 1 / (mean squared error x time), the error being that against a
converged picture; its ratio says how many times longer the reference has to render for the
same error.  Both render in turn, a pair a run, so that what else the machine does slows both;
the lower end of the ratio's interval over the runs is what is judged.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import mitsuba as mi
import numpy as np

from lscan.acquisition.scan import scan
from lscan.benchmark.methods import median_seconds, time_call
from lscan.config.rig import RigFile, StripeSection, load_rig
from lscan.paper.experiment import METHODS, measure_board
from lscan.records import Floats, Mask
from lscan.stripe import extract_stripe
from sim.render.layers import W_PER_M2_IN_MW_PER_MM2
from sim.render.spreads import PHOTONS, make_spread
from sim.render.tank import Tank
from sim.scene import scene_of
from sim.scene.matter import Water
from sim.sensor import Webcam
from sim.water import water_optics
from tests.validation.light.scattering import render_with, stock_medium
from tests.validation.picturespeed import BEGUN, instrument_times, picture_times, turbid_time
from tests.validation.rows import Chapters, Request, Row, row

# (left, top, width, height) in px: the line on a ridge of the grooved block with the halo
# about it, and water that the sheet crosses far above it.
LINE_WINDOW, VEIL_WINDOW = (190, 346, 64, 32), (240, 120, 64, 32)
VEIL_SAMPLES = 4  # ours, of the first order alone
OURS_A_RUN = 4  # pictures of ours for one of the reference, which takes some 20 times longer
ALL_ORDERS, FIRST_ORDER = -1, 2  # volpath's max_depth
BARS = {"line core": 150.0, "halo": 20.0, "veil": 1000.0}
SEED, RESAMPLES = 0, 2000
WAVELENGTH_NM = 650.0
CONFIDENCE = 0.95

Window = tuple[int, int, int, int]
Picture = Callable[[int], Floats]


@dataclass(frozen=True)
class SpeedEffort:
    """How much is rendered; by default all of it.

    runs: pairs of pictures.  stock_samples: volpath's, a pixel.  converged: samples of the
    first and of the higher orders in the pictures that all are held against.  repeats: of a
    call that is timed.  frames: of the sandwave, from which the instrument's surface is made.
    begun: of a scan, the pictures before those whose time counts.  photons: of the tables of how
    a beam spreads.
    """

    runs: int = 10
    stock_samples: int = 8192
    converged: tuple[int, int] = (4096, 2048)
    repeats: int = 15
    frames: int = 400
    begun: int = BEGUN
    photons: int = PHOTONS


FULL = SpeedEffort()
QUICK = SpeedEffort(
    runs=1, stock_samples=16, converged=(64, 32), repeats=1, frames=2, begun=1, photons=1 << 16
)


@dataclass(frozen=True)
class Gain:
    """Efficiency of ours over the reference's: all runs together, and its 95 % interval."""

    ratio: float
    low: float
    high: float


def chapters(request: Request) -> Chapters:
    """The chapters, on the paper's board, groove and sandwave.

    Parameters
    ----------
    request : Request

    Raises
    ------
    InputError
        A scene file is wrong.
    """
    groove, board, sandwave = (
        load_rig(request.scenes / "paper" / f"{name}.toml")
        for name in ("groove", "board", "sandwave")
    )
    effort = QUICK if request.quick else FULL
    return {
        "efficiency on line and halo": partial(line_efficiency, groove, effort),
        "efficiency on the veil": partial(veil_efficiency, groove, effort),
        "efficiency above the line": partial(water_efficiency, groove, effort),
        "time of a frame": partial(frame_times, groove, effort),
        "time of a picture": partial(picture_times, sandwave, effort.repeats, effort.begun),
        "time in turbid water": partial(turbid_time, sandwave, effort.frames),
        "time of a plane map": partial(map_times, board, effort),
        "time of the instrument": partial(
            instrument_times, board, sandwave, effort.frames, effort.repeats
        ),
        "time of a water's tables": partial(table_time, effort),
    }


def line_efficiency(rig_file: RigFile, effort: SpeedEffort) -> list[Row]:
    """How many times the reference's render time buys our noise, on the line and its halo.

    Both hold all orders of scattering.  The reference's rare bright specks are seldom among
    its pictures, so its error, and the ratio, are rather too small.
    """
    found = _all_orders(Tank(scene_of(rig_file)), LINE_WINDOW, effort)
    return [
        _gain_row(f"{part}, all orders", found[part], effort, BARS[part])
        for part in ("line core", "halo")
    ]


def veil_efficiency(rig_file: RigFile, effort: SpeedEffort) -> list[Row]:
    """The same on the veil, light scattered once, rendered as that by both."""
    tank = Tank(scene_of(rig_file))
    # At random places, for on its grid this render has no noise to compare.
    camera = tank.make_camera(VEIL_WINDOW, jitter=True)
    truth = _mean(partial(render_with, tank, camera, tank.integrator, effort.converged[0]))
    ours = partial(render_with, tank, camera, tank.integrator, VEIL_SAMPLES)
    whole = {"veil": np.ones(truth.shape, dtype=bool)}
    found = _gains(ours, _theirs(tank, VEIL_WINDOW, FIRST_ORDER, effort), truth, whole, effort)
    return [_gain_row("veil, single scattering", found["veil"], effort, BARS["veil"])]


def water_efficiency(rig_file: RigFile, effort: SpeedEffort) -> list[Row]:
    """The same part of the picture with all orders, which has no bar."""
    found = _all_orders(Tank(scene_of(rig_file)), VEIL_WINDOW, effort)
    return [_gain_row("water above the line, all orders", found["halo"], effort, None)]


def _gain_row(what: str, gain: Gain, effort: SpeedEffort, bar: float | None) -> Row:
    return row(
        "efficiency" if bar is not None else "efficiency-without-bar",
        gain.low,
        bar=bar,
        seed=SEED,
        what=what,
        samples=effort.stock_samples,
        runs=effort.runs,
        gain=gain,
        percent=100 * CONFIDENCE,
    )


def _all_orders(tank: Tank, window: Window, effort: SpeedEffort) -> dict[str, Gain]:
    """The gain on each part of a window, all orders of scattering in both renders.

    Ours is the tank's whole picture, whose error is no noise: its time counts as the share that
    the window has of the pixels.
    """
    left, top, width, height = window
    grid, random = tank.make_camera(window), tank.make_camera(window, jitter=True)

    def converged(samples: tuple[int, int], seed: int) -> Floats:
        first = render_with(tank, grid, tank.integrator, samples[0], seed)
        return first + render_with(tank, random, tank.higher, samples[1], seed)

    truth = _mean(partial(converged, effort.converged))
    parts = {name: part for name, part in _parts(tank, window).items() if part.any()}

    def ours(_: int) -> Floats:
        whole = tank.render(0.0).laser.astype(float) / W_PER_M2_IN_MW_PER_MM2
        return whole[top : top + height, left : left + width]

    camera = tank.scene.rig.camera
    share = width * height / (camera.width_px * camera.height_px)
    return _gains(ours, _theirs(tank, window, ALL_ORDERS, effort), truth, parts, effort, share)


def _theirs(tank: Tank, window: Window, depth: int, effort: SpeedEffort) -> Picture:
    """How the reference renders a picture."""
    camera = tank.make_camera(window, stock_medium(tank.water), jitter=True)
    stock = mi.load_dict({"type": "volpath", "max_depth": depth, "rr_depth": 8})
    return partial(render_with, tank, camera, stock, effort.stock_samples)


def _mean(picture: Picture) -> Floats:
    """The mean of two pictures whose seeds no other picture has."""
    return np.mean([picture(1000), picture(1001)], axis=0)


def _gains(
    ours: Picture,
    theirs: Picture,
    truth: Floats,
    parts: Mapping[str, Mask],
    effort: SpeedEffort,
    share: float = 1.0,
) -> dict[str, Gain]:
    """The gain on each part, from pairs of pictures rendered in turn.

    share: of ours's time that counts.
    """
    ours(0), theirs(0)  # compiles what is rendered
    costs: dict[str, list[list[float]]] = {name: [] for name in parts}
    for run in range(effort.runs):
        seeds = range(1 + OURS_A_RUN * run, 1 + OURS_A_RUN * (run + 1))
        pair = [
            time_call(partial(_stack, ours, seeds)),
            time_call(partial(_stack, theirs, [1 + run])),
        ]
        for name, part in parts.items():
            costs[name].append(
                [_square(taken, truth, part) * seconds / len(taken) for seconds, taken in pair]
            )
    return {name: gain_of(np.array(pairs) * [share, 1.0]) for name, pairs in costs.items()}


def _stack(picture: Picture, seeds: Iterable[int]) -> Floats:
    """(seeds, H, W) pictures, one for each seed."""
    return np.array([picture(seed) for seed in seeds])


def gain_of(costs: Floats) -> Gain:
    """The ratio of the means over all runs, and its interval.

    Parameters
    ----------
    costs : (runs, 2) array
        Squared error times seconds of a picture, of ours and of the reference.

    References
    ----------
    B. Efron and R. J. Tibshirani, An Introduction to the Bootstrap, 1993, ch. 13: the
    percentile interval, runs drawn again with replacement.
    """
    drawn = np.random.default_rng(SEED).integers(0, len(costs), (RESAMPLES, len(costs)))
    sums = costs[drawn].sum(axis=1)
    low, high = np.quantile(sums[:, 1] / sums[:, 0], [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Gain(float(costs[:, 1].sum() / costs[:, 0].sum()), float(low), float(high))


def _parts(tank: Tank, window: Window) -> dict[str, Mask]:
    """Masks of a window: the line's core, and the halo, where none of its light goes direct."""
    left, top, width, height = window
    direct = tank.render(0.0, scatter_samples=0).direct
    inside = direct[top : top + height, left : left + width]
    brightest = float(direct.max())
    return {"line core": inside > 0.5 * brightest, "halo": inside < 1e-6 * brightest}


def frame_times(rig_file: RigFile, effort: SpeedEffort) -> list[Row]:
    """Milliseconds a frame of rendering, sensor and each of the paper's extractors."""
    scene = scene_of(rig_file)
    tank, webcam = Tank(scene), Webcam(scene)
    layers = tank.render(0.0)
    generator = np.random.default_rng(1)
    image = webcam.expose(layers, scene.rig.camera.exposure_ms, generator)
    samples = scene.tank.render.samples
    calls: dict[str, Callable[[], object]] = {
        f"render, {samples} samples a pixel": lambda: tank.render(0.0),
        "sensor": lambda: webcam.expose(layers, 20.0, generator),
    }
    for name in ("max", "centroid", "centroid-relative"):
        settings = StripeSection(extractor=name)
        calls[f"extract, {name}"] = partial(extract_stripe, image, settings)
    return [_time_row(what, call, " a frame", effort) for what, call in calls.items()]


def map_times(board: RigFile, effort: SpeedEffort) -> list[Row]:
    """Milliseconds each plane map takes for the 640 points of a profile."""
    points = np.column_stack([np.arange(640.0), np.full(640, 300.0)])
    with TemporaryDirectory() as folder:
        solved = measure_board(scan(board, Path(folder) / "board"), METHODS).calibrations
    return [
        _time_row(f"map, {name}", partial(calibration.plane_map.to_plane, points), "", effort)
        for name, calibration in solved.items()
    ]


def table_time(effort: SpeedEffort) -> list[Row]:
    """Seconds that the tables of how a beam spreads take in a water of 5 NTU."""
    water = water_optics(Water(kind="tank", turbidity_ntu=5), WAVELENGTH_NM)
    seconds, _ = time_call(partial(make_spread, water, effort.photons, SEED))
    return [row("table", seconds, photons=effort.photons, seed=SEED)]


def _square(pictures: Floats, truth: Floats, part: Mask) -> float:
    """Mean squared error of the pictures over a part of them."""
    return float(np.mean((pictures - truth)[:, part] ** 2))


def _time_row(what: str, call: Callable[[], object], per: str, effort: SpeedEffort) -> Row:
    """Median milliseconds of a call, the first one left out."""
    return _milliseconds(what, median_seconds(call, effort.repeats), per, effort)


def _milliseconds(what: str, seconds: float, per: str, effort: SpeedEffort) -> Row:
    return row("time", 1e3 * seconds, what=what, repeats=effort.repeats, per=per)
