"""Speed of the tank and of the instrument, measured as ratios side by side in one run.

The reference for the tank is Mitsuba's own ``volpath`` on the same emitter, scene and picture
window.  Efficiency is 1 / (mean squared error x time), the error being that against a
converged picture; its ratio says how many times longer the reference has to render for the
same error.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mitsuba as mi
import numpy as np

from lscan.acquire import scan
from lscan.disk import make_folder, write_atomically
from lscan.experiment import METHODS, measure_board
from lscan.planemap.calibration import Calibration
from lscan.records import Floats, Mask
from lscan.rig import RigFile, StripeSection, load_rig
from lscan.stripe import extract_stripe
from sim.scene import scene_of
from sim.sensor import Webcam
from sim.tank import Tank, stock_medium

# (left, top, width, height) in px: the line on a ridge of the grooved block with the halo
# about it, and water that the sheet crosses far above it.
LINE_WINDOW, VEIL_WINDOW = (190, 346, 64, 32), (240, 120, 64, 32)
GRID_SAMPLES, SCATTER_SAMPLES = 16, 4  # ours, of the first and of all higher orders
VEIL_SAMPLES = 4  # ours, of the first order alone
STOCK_SAMPLES, RUNS = 1024, 12
ALL_ORDERS, FIRST_ORDER = -1, 2  # volpath's max_depth
CONVERGED = (4096, 2048)
BARS = {"line core": 150.0, "halo": 20.0, "veil": 1000.0}  # required of the tank
REPEATS = 15

Window = tuple[int, int, int, int]


@dataclass(frozen=True)
class Figure:
    """One row of the table: what was measured, the figure, its unit, and its least value."""

    what: str
    figure: float
    unit: str
    bar: float | None = None

    @property
    def passed(self) -> bool | None:
        """Whether the figure reaches its bar; None where it has none."""
        return None if self.bar is None else self.figure >= self.bar

    def as_json(self) -> dict[str, Any]:
        """The row as out/bench.json holds it."""
        return {
            "what": self.what,
            "figure": self.figure,
            "bar": self.bar,
            "unit": self.unit,
            "passed": self.passed,
        }


def run_bench(scenes: Path, output: Path) -> list[Figure]:
    """The figures, also written to ``output`` as a list of rows."""
    groove = load_rig(scenes / "groove.toml")
    figures = [*efficiency(groove), *frame_times(groove), *map_times(scenes)]
    rows = [figure.as_json() for figure in figures]
    make_folder(output.parent)
    write_atomically(output, (json.dumps(rows, indent=2) + "\n").encode())
    return figures


def efficiency(rig_file: RigFile) -> list[Figure]:
    """How many times the reference's render time buys our noise, on line, halo and veil.

    Line and halo hold all orders of scattering.  The veil is light scattered once, rendered as
    that by both; the same part of the picture with all orders is given too, without a bar.
    The reference's rare bright specks are seldom among its pictures, so its error, and the
    ratio, are rather too small.
    """
    tank = Tank(scene_of(rig_file))
    line = _all_orders(tank, LINE_WINDOW)
    return [
        _figure("line core, all orders", line["line core"], BARS["line core"]),
        _figure("halo, all orders", line["halo"], BARS["halo"]),
        _figure("veil, single scattering", _veil(tank), BARS["veil"]),
        _figure("water above the line, all orders", _all_orders(tank, VEIL_WINDOW)["halo"], None),
    ]


def _figure(what: str, ratio: float, bar: float | None) -> Figure:
    what = f"efficiency against volpath ({STOCK_SAMPLES} samples), {what}"
    return Figure(what, ratio, "ratio", bar)


def _all_orders(tank: Tank, window: Window) -> dict[str, float]:
    """The ratio on each part of a window, all orders of scattering in both renders."""
    truth = _ours(tank, window, CONVERGED, 2)[0].mean(axis=0)
    ours = _ours(tank, window, (GRID_SAMPLES, SCATTER_SAMPLES), RUNS)
    theirs = _theirs(tank, window, ALL_ORDERS)
    parts = _parts(tank, window)
    return {name: _ratio(ours, theirs, truth, part) for name, part in parts.items() if part.any()}


def _veil(tank: Tank) -> float:
    """The ratio on the veil, light scattered once in both renders."""
    # At random places, for on its grid this render has no noise to compare.
    camera = tank.make_camera(VEIL_WINDOW, jitter=True)
    truth = _repeat(tank, tank.integrator, camera, CONVERGED[0], 2)[0].mean(axis=0)
    ours = _repeat(tank, tank.integrator, camera, VEIL_SAMPLES, RUNS)
    theirs = _theirs(tank, VEIL_WINDOW, FIRST_ORDER)
    return _ratio(ours, theirs, truth, np.ones(truth.shape, dtype=bool))


def _ratio(
    ours: tuple[Floats, float], theirs: tuple[Floats, float], truth: Floats, part: Mask
) -> float:
    """Their squared error times their time, over ours; pictures and seconds of each."""
    mine, other = (_square(images, truth, part) * time for images, time in (ours, theirs))
    return other / mine


def _parts(tank: Tank, window: Window) -> dict[str, Mask]:
    """Masks of a window: the line's core, and the halo, where none of its light goes direct."""
    left, top, width, height = window
    direct = tank.render(0.0, scatter_samples=0).direct
    inside = direct[top : top + height, left : left + width]
    brightest = float(direct.max())
    return {"line core": inside > 0.5 * brightest, "halo": inside < 1e-6 * brightest}


def _ours(tank: Tank, window: Window, samples: tuple[int, int], runs: int) -> tuple[Floats, float]:
    """Pictures of both our integrators together, and the seconds one takes."""
    grid, random = tank.make_camera(window), tank.make_camera(window, jitter=True)
    first, first_time = _repeat(tank, tank.integrator, grid, samples[0], runs)
    higher, higher_time = _repeat(tank, tank.higher, random, samples[1], runs)
    return first + higher, first_time + higher_time


def _theirs(tank: Tank, window: Window, depth: int) -> tuple[Floats, float]:
    """Pictures of the reference, and the seconds one takes."""
    camera = tank.make_camera(window, stock_medium(tank.water), jitter=True)
    stock = mi.load_dict({"type": "volpath", "max_depth": depth, "rr_depth": 8})
    return _repeat(tank, stock, camera, STOCK_SAMPLES, RUNS)


def frame_times(rig_file: RigFile) -> list[Figure]:
    """Milliseconds a frame of rendering, sensor and each of the paper's extractors."""
    scene = scene_of(rig_file)
    tank, webcam = Tank(scene), Webcam(scene)
    layers = tank.render(0.0)
    generator = np.random.default_rng(1)
    image = webcam.expose(layers, scene.rig.camera.exposure_ms, generator)
    samples = scene.tank.render.samples
    figures = [
        Figure(f"render, {samples} samples a pixel", _ms(tank.render, 0.0), "ms"),
        Figure("sensor", _ms(webcam.expose, layers, 20.0, generator), "ms"),
    ]
    for name in ("max", "centroid", "centroid-relative"):
        settings = StripeSection(extractor=name)
        elapsed = _ms(extract_stripe, image, settings)
        figures.append(Figure(f"extract, {name}", elapsed, "ms a frame"))
    return figures


def map_times(scenes: Path) -> list[Figure]:
    """Milliseconds each plane map takes for the 640 points of a profile."""
    points = np.column_stack([np.arange(640.0), np.full(640, 300.0)])
    return [
        Figure(f"map, {name}", _ms(calibration.plane_map.to_plane, points), "ms")
        for name, calibration in _calibrations(scenes).items()
    ]


def _calibrations(scenes: Path) -> Mapping[str, Calibration]:
    """Every plane map, solved from a board picture taken for the purpose."""
    with TemporaryDirectory() as folder:
        run = scan(load_rig(scenes / "board.toml"), Path(folder) / "board")
        return measure_board(run, METHODS).calibrations


def _repeat(
    tank: Tank,
    integrator: mi.Integrator,
    sensor: mi.Sensor,
    samples: int,
    runs: int,
) -> tuple[Floats, float]:
    """(runs, H, W) pictures of different seeds and the seconds one takes, the first left out."""
    pictures, seconds = [], []
    for seed in range(runs + 1):
        started = time.perf_counter()
        image = mi.render(
            tank.mitsuba_scene, sensor=sensor, integrator=integrator, spp=samples, seed=seed
        )
        pictures.append(np.array(image, dtype=float)[..., 0])
        seconds.append(time.perf_counter() - started)
    return np.array(pictures[1:]), float(np.median(seconds[1:]))


def _square(pictures: Floats, truth: Floats, part: Mask) -> float:
    """Mean squared error of the pictures over a part of them."""
    return float(np.mean((pictures - truth)[:, part] ** 2))


def _ms(call: Callable[..., object], *arguments: object) -> float:
    """Median milliseconds of a call, the first one left out."""
    call(*arguments)
    times = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        call(*arguments)
        times.append(time.perf_counter() - started)
    return 1e3 * float(np.median(times))
