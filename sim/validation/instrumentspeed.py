"""Speed of the instrument: its time for a picture over the time of decoding that picture.

Both are taken in turn, so that what else the machine does slows both, and the ratio is that of
their medians.
"""

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from lscan.acquisition.run import Run
from lscan.acquisition.scan import scan
from lscan.benchmark.methods import timed
from lscan.calibration.planemap import PlaneMap
from lscan.config.rig import RigFile
from lscan.pipeline import READ_AT_ONCE, calibrate_run, reconstruct
from lscan.records import Profile
from lscan.stripe.extract import extract_stripes
from lscan.surface.surface import to_profiles
from sim.demo import thin_out
from sim.validation.rows import Row, row

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
        decoding, frames = timed(lambda: [run.frame(index) for index in chosen])

        def profiles() -> list[Profile]:
            stripes = extract_stripes(((frame.image, None) for frame in frames), settings)
            return to_profiles(stripes, plane_map, [frame.position_mm for frame in frames])

        return decoding / size, timed(profiles)[0] / size

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
    decoding, _ = timed(lambda: [frame.index for frame in run.frames()])
    building, _ = timed(partial(reconstruct, run, plane_map))
    return row(
        "reconstruct-time",
        building / decoding,
        frames=len(run),
        building_s=building,
        decoding_s=decoding,
    )
