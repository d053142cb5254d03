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
STOCK = {"type": "volpath", "max_depth": -1, "rr_depth": 8}
STOCK_SAMPLES, RUNS = 1024, 12
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

    Both render all orders of scattering.  The reference's rare bright specks are seldom
    among its pictures, so its error, and the ratio, are rather too small.
    """
    tank = Tank(scene_of(rig_file))
    figures = []
    for window, names in ((LINE_WINDOW, ("line core", "halo")), (VEIL_WINDOW, ("veil",))):
        parts = _parts(tank, window)
        truth = _ours(tank, window, CONVERGED, 2)[0].mean(axis=0)
        ours, our_time = _ours(tank, window, (GRID_SAMPLES, SCATTER_SAMPLES), RUNS)
        theirs, their_time = _theirs(tank, window)
        figures += [
            Figure(
                f"efficiency against volpath ({STOCK_SAMPLES} samples, all orders), {name}",
                float(_square(theirs, truth, parts[name]) * their_time)
                / float(_square(ours, truth, parts[name]) * our_time),
                "ratio",
                BARS[name],
            )
            for name in names
        ]
    return figures


def _parts(tank: Tank, window: Window) -> dict[str, Mask]:
    """Masks of a window: the line's core, the halo without its light, the whole for the veil."""
    left, top, width, height = window
    direct = tank.render(0.0, scatter_samples=0).direct
    inside = direct[top : top + height, left : left + width]
    brightest = float(direct.max())
    dark = inside < 1e-6 * brightest
    return {"line core": inside > 0.5 * brightest, "halo": dark, "veil": dark}


def _ours(tank: Tank, window: Window, samples: tuple[int, int], runs: int) -> tuple[Floats, float]:
    """Pictures of both our integrators together, and the seconds one takes."""
    grid, random = tank.make_camera(window), tank.make_camera(window, jitter=True)
    first, first_time = _repeat(tank, tank.integrator, grid, samples[0], runs)
    higher, higher_time = _repeat(tank, tank.higher, random, samples[1], runs)
    return first + higher, first_time + higher_time


def _theirs(tank: Tank, window: Window) -> tuple[Floats, float]:
    """Pictures of the reference, and the seconds one takes."""
    camera = tank.make_camera(window, stock_medium(tank.water), jitter=True)
    return _repeat(tank, mi.load_dict(STOCK), camera, STOCK_SAMPLES, RUNS)


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
