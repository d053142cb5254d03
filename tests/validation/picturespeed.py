"""Speed of the tank's pictures: all orders over the first alone, turbid over tap water."""

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from lscan.acquisition.run import Run
from lscan.acquisition.scan import open_devices, scan
from lscan.acquisition.writer import PNG
from lscan.benchmark.methods import time_call
from lscan.calibration.planemap import PlaneMap
from lscan.config.rig import RigFile
from lscan.files.pictures import encode_picture
from lscan.pipeline import READ_AT_ONCE, calibrate_run, reconstruct
from lscan.records import Floats, Profile
from lscan.stripe.extract import extract_stripe
from lscan.surface.surface import to_profiles
from sim.demo import thin_out
from sim.render.tank import Tank
from sim.scene import scene_of
from sim.scene.matter import Water
from sim.sensor import Webcam
from tests.validation.rows import Row, row

STAGES = ("render", "sensor", "PNG")
WAYS = ("first order, every pixel sampled", "all orders")
BEGUN = 60  # pictures of a scan, until which the processes that help have loaded the tank
TURBID_NTU = 5.0
SEED = 0


def picture_times(rig_file: RigFile, repeats: int, begun: int = BEGUN) -> list[Row]:
    """Milliseconds of each stage from the scene to the PNG file, and the ratio of two ways.

    The first order alone with every pixel sampled, by one process as it was first rendered, and
    all orders as a scan renders them now.

    Parameters
    ----------
    rig_file : RigFile, of the scene
    repeats : int, pictures each, and twice as many of a scan
    begun : int, pictures of the scan before those
    """
    scene = scene_of(rig_file)
    taken = stage_seconds([(Tank(scene, sampled=True), 0), (Tank(scene), 1)], repeats)
    rows = [
        row("time", 1e3 * second, what=f"picture, {way}: {stage}", repeats=repeats, per=" a frame")
        for way, stages in zip(WAYS, np.median(taken, axis=1), strict=True)
        for stage, second in zip(STAGES, stages, strict=True)
    ]
    first_s, all_s = np.median(taken.sum(axis=2), axis=1).tolist()
    frames = 2 * repeats
    scan_s = scan_seconds(rig_file, frames, begun)
    words = {"frames": frames, "per_s": 1 / scan_s, "alone": first_s / all_s}
    return [*rows, row("picture-gain", first_s / scan_s, **words)]


def scan_seconds(rig_file: RigFile, frames: int, begun: int = BEGUN) -> float:
    """Seconds of a picture of a scan, from the scene to the PNG file, once it is under way.

    Parameters
    ----------
    rig_file : RigFile, of the scene
    frames : int, pictures that are counted
    begun : int, pictures before those
    """
    places_mm = rig_file.rig.plan.positions_mm()
    with open_devices(rig_file) as (camera, track):
        for frame, place_mm in enumerate(places_mm[: begun + frames]):
            if frame == begun:
                begun_s = time.perf_counter()
            track.move_to(place_mm)
            encode_picture(camera.grab(frame).image, ".png", PNG)
        return (time.perf_counter() - begun_s) / frames


def turbid_time(rig_file: RigFile, frames: int) -> list[Row]:
    """Time of a scan's pictures, all orders, in turbid water over that in the scene's own.

    Parameters
    ----------
    rig_file : RigFile, of the scene
    frames : int, pictures each
    """
    scene, water = scene_of(rig_file), Water(kind="tank", turbidity_ntu=TURBID_NTU)
    turbid = replace(scene, tank=scene.tank.model_copy(update={"water": water}))
    tanks = [(Tank(turbid), 1), (Tank(scene), 1)]
    turbid_s, own_s = stage_seconds(tanks, frames).sum(axis=(1, 2)).tolist()
    words = {"frames": frames, "turbid_s": turbid_s, "own_s": own_s}
    return [row("turbid-time", turbid_s / own_s, **words)]


def stage_seconds(tanks: Sequence[tuple[Tank, int]], pictures: int) -> Floats:
    """(tanks, pictures, STAGES) seconds, the tanks in turn at one place after the other.

    A first picture of each, which compiles and makes tables, is left out.

    Parameters
    ----------
    tanks : sequence of tuple, each with its samples of higher orders, 0 for none
    pictures : int, of each
    """
    generator = np.random.default_rng(SEED)
    webcams = [Webcam(tank.scene) for tank, _ in tanks]
    seconds = np.zeros((len(tanks), pictures + 1, len(STAGES)))
    for picture in range(pictures + 1):
        for k, ((tank, orders), webcam) in enumerate(zip(tanks, webcams, strict=True)):
            rig = tank.scene.rig
            place_mm, exposure_ms = picture * rig.plan.step_mm, rig.camera.exposure_ms
            render_s, layers = time_call(partial(tank.render, place_mm, scatter_samples=orders))
            sensor_s, image = time_call(partial(webcam.expose, layers, exposure_ms, generator))
            png_s, _ = time_call(partial(encode_picture, image, ".png", PNG))
            seconds[k, picture] = render_s, sensor_s, png_s
    return seconds[:, 1:]


# Speed of the instrument: its time for a picture over the time of decoding that picture.
#
# Both are taken in turn, so that what else the machine does slows both, and the ratio is that of
# their medians.


EXTRACTOR_BARS = {
    "max": 0.5,
    "centroid": 0.5,
    "centroid-relative": 0.5,
    "ml": 1.5,
    "steger": 3.0,
}


def instrument_times(board: RigFile, sandwave: RigFile, frames: int, repeats: int) -> list[Row]:
    """A row for each extractor, and one for the surface of a whole run.

    Parameters
    ----------
    board, sandwave : RigFile, of the scenes that are scanned, the first to calibrate
    frames : int, pictures of the sandwave, evenly over the scene's own way
    repeats : int, groups of pictures that are timed
    """
    with TemporaryDirectory() as folder:
        plane_map = calibrate_run(scan(board, Path(folder) / "board")).plane_map
        run = scan(thin_out(sandwave, frames), Path(folder) / "sandwave")
        extractors = [
            extractor_time(run, plane_map, name, bar, repeats)
            for name, bar in EXTRACTOR_BARS.items()
        ]
        return [*extractors, reconstruct_time(run, plane_map)]


def extractor_time(run: Run, plane_map: PlaneMap, extractor: str, bar: float, repeats: int) -> Row:
    """Extractor and map together, over decoding: medians over groups of pictures of the run.

    A group is what the pipeline maps in one call; its pictures are decoded one by one.

    Parameters
    ----------
    run : Run, of the pictures
    plane_map : PlaneMap, of the rig's camera
    extractor : str, its name
    bar : float, greatest ratio
    repeats : int, groups that are timed, after a first one that is not
    """
    settings = run.rig_file.rig.stripe.model_copy(update={"extractor": extractor})
    size = min(READ_AT_ONCE, len(run))

    def measured(group: int) -> tuple[float, float]:
        chosen = [(group * size + k) % len(run) for k in range(size)]
        decoding, frames = time_call(lambda: [run.frame(index) for index in chosen])

        def profiles() -> list[Profile]:
            stripes = [extract_stripe(frame.image, settings) for frame in frames]
            return to_profiles(stripes, plane_map, [frame.position_mm for frame in frames])

        return decoding / size, time_call(profiles)[0] / size

    measured(0)
    decoding, finding = 1e3 * np.median([measured(group) for group in range(repeats)], axis=0)
    return row(
        "picture-time",
        finding / decoding,
        bar=bar,
        extractor=extractor,
        finding_ms=finding,
        decoding_ms=decoding,
        pictures=repeats * size,
    )


def reconstruct_time(run: Run, plane_map: PlaneMap) -> Row:
    """The surface of a run, over decoding its pictures one after the other.

    Parameters
    ----------
    run : Run, of the pictures
    plane_map : PlaneMap, of the rig's camera
    """
    decoding, _ = time_call(lambda: [frame.index for frame in run.frames()])
    building, _ = time_call(partial(reconstruct, run, plane_map))
    return row(
        "reconstruct-time",
        building / decoding,
        frames=len(run),
        building_s=building,
        decoding_s=decoding,
    )
