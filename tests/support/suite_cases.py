"""A small suite of drawn lines, as a folder: what reading and judging are tested on."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from lscan.benchmark.drawn import (
    BOARDS,
    IMAGE_SIZE,
    OPTICS,
    LineCase,
    centres,
    draw,
    image_px,
    seen_marks,
)
from lscan.config.rig import NoiseSection, Rig, StripeSection
from lscan.records import Status
from lscan.suites import (
    BoardCase,
    CaseTruth,
    LightLayers,
    ScanCase,
    SuiteCase,
    write_case,
    write_manifest,
)

NOISE = NoiseSection(read_dn=1.0, dn_per_electron=255 / 15_000)


class Threads(ThreadPoolExecutor):
    """In place of a pool of processes, which take seconds to begin."""

    def __init__(self, count, *_):
        super().__init__(count)


def drawn_case(number, peak_dn=150.0, turned=False, dark=False):
    """A case of one drawn line; the first ten columns are said to hold none."""
    rng = np.random.default_rng([7, number])
    true = centres(rng.uniform(-0.5, 0.5))
    image = draw(LineCase("tap", 1.5, peak_dn, NOISE), true, rng)
    picture = np.repeat(image[..., None], 3, axis=2)
    status = np.full(len(true), int(Status.OK))
    status[:10] = int(Status.NO_PEAK)
    picture[:, :10] = 4
    shown = np.where(status == Status.OK, true, np.nan)
    sizes = [np.full(len(true), value) for value in (1.5, peak_dn, 1.0)]
    truth = CaseTruth(shown, *sizes, np.zeros(len(true), dtype=int), status)
    labels = np.zeros(image.shape, np.uint8)
    settings = StripeSection(threshold_dn=8.0, noise=NOISE)
    background = np.full_like(picture, 4) if dark else None
    if turned:
        picture, labels = picture.transpose(1, 0, 2).copy(), labels.T.copy()
        background = None if background is None else background.transpose(1, 0, 2).copy()
        settings = settings.model_copy(update={"axis": "rows"})
    axes = {"water": "tap", "target": f"peak {peak_dn:g}", "fault": "turned" if turned else "none"}
    layers = None
    if number < 2:
        light = [np.full(labels.shape, level) for level in (0.0, 3.0)]
        layers = LightLayers(picture[..., 0].astype(float), *light)
    name = f"case-{number:03d}"
    return SuiteCase(name, axes, picture, background, labels, truth, settings, layers)


def drawn_suite(folder, count=4, name="drawn"):
    """A suite's folder of ``count`` cases: turned ones, dim ones, one with its background."""
    cases = [
        drawn_case(n, 150.0 if n % 3 else 30.0, turned=n % 2 == 1, dark=n == 0)
        for n in range(count)
    ]
    for case in cases:
        write_case(folder, case)
    axes = {case.name: dict(case.axes) for case in cases}
    write_manifest(folder, name, 7, "lscan test", axes)
    return cases


def board_case(number, board="coarse"):
    """A case of a board without a picture of it: its marks and the map, exactly known."""
    made = BOARDS[board]
    marks_mm = np.concatenate([made.grid.points_mm(), *(r.points_mm() for r in made.ruler)])
    rng = np.random.default_rng(number)
    exact = image_px(marks_mm)
    marks = seen_marks(marks_mm, exact, IMAGE_SIZE, 0.0, rng)
    marks = replace(marks, sigma_px=0 * marks.sigma_px)
    span = np.array([made.grid.columns - 1, made.grid.rows - 1]) * made.grid.pitch_mm
    places = rng.random((50, 2)) * span * [1, -1]
    picture = np.full((IMAGE_SIZE[1] // 8, IMAGE_SIZE[0] // 8, 3), number, np.uint8)
    axes = {"water": "tap" if number % 2 else "harbor", "place": "level"}
    return BoardCase(
        f"board-{number:03d}", axes, picture, made, OPTICS, marks, image_px(places), places
    )


def board_suite(folder, count=4):
    """A suite's folder of a drawn line and ``count`` boards."""
    line, boards = drawn_case(0), [board_case(n) for n in range(count)]
    for case in (line, *boards):
        write_case(folder, case)
    axes = {case.name: dict(case.axes) for case in boards}
    write_manifest(folder, "boards", 7, "lscan test", {line.name: dict(line.axes)}, axes)
    return boards


def scan_case(number, kind="sandwave"):
    """A scan of two pictures without a line, of a rig that nothing can be calibrated with."""
    board = replace(board_case(number), name=f"scan-{number:03d}")
    height, width = board.picture.shape[:2]
    rig = Rig.model_validate({
        "camera": {"driver": "sim", "width_px": width, "height_px": height},
        "track": {"driver": "sim"}, "plan": {"frames": 2, "step_mm": 0.5},
        "workpiece": {"kind": kind}, "stripe": {"threshold_dn": 20.0},
        "board": board.board.model_dump(),
    })  # fmt: skip
    rng = np.random.default_rng([8, number])
    status = np.where(rng.random((2, width)) < 0.9, int(Status.OK), int(Status.OCCLUDED))
    places = rng.normal(100, 30, (2, width, 2)) * [1, -1]
    places = np.where(status[..., None] == Status.OK, places, np.nan)
    slices = rng.uniform(0, 150, (20 if kind == "sandwave" else 0, 3))
    return ScanCase(
        board.name,
        {"target": kind},
        board,
        tuple(rng.integers(0, 20, (2, height, width, 3)).astype(np.uint8)),
        rig,
        places,
        np.where(status == Status.OK, 100.0, np.nan),
        np.zeros_like(status),
        status,
        slices,
        np.zeros(len(slices), dtype=np.int64),
    )


def scan_suite(folder, count=2):
    """A suite's folder of scans, of sandwaves and of grooved blocks in turn."""
    scans = [scan_case(n, "grooved-block" if n % 2 else "sandwave") for n in range(count)]
    for case in scans:
        write_case(folder, case)
    axes = {case.name: dict(case.axes) for case in scans}
    write_manifest(folder, "scans", 7, "lscan test", {}, {}, axes)
    return scans
