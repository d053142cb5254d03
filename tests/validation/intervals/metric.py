"""The metric route: how often the 95 % intervals of camera and sheet hold, whatever is shared.

Boards that are bent, one or each picture's own, lines that are scatter in one view or more,
fisheyes, thick slabs: what is not refused is to hold.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import binomtest

from lscan.calibration.metric.solve import calibrate_metric
from lscan.calibration.metric.views import CalibrationView
from lscan.camera.posedboards import CAMERA
from lscan.config.rig import OpticsSection
from lscan.errors import MeasurementError
from lscan.records import Status
from tests.support.metricviews import (
    FISHEYE_PX,
    SIZE,
    SLAB_MM,
    Rig,
    bends_of,
    fisheye_views,
    known,
    paper_rig,
    poses,
    scattered,
    slab_known,
    slab_views,
    views_of,
    with_noise,
)
from tests.validation.rows import Row, row

SEED, NOISE_PX = 58, 0.03
COVER = 0.95
SETS, FEW_SETS = 50, 4
FEWEST, MOST = 3, 10  # views of a set
PLACES_PX = np.array([[250.0, 200.0], [390.0, 280.0]])
INDEX_SIGMA = 0.003  # of the water, where it is found


@dataclass(frozen=True)
class ViewSet:
    """A set of views, what is known of their camera, and the truth by the parameter's name.

    Attributes
    ----------
    views : list of CalibrationView
    optics : OpticsSection, what is known
    truth : mapping of float, of the camera's parameters that are judged
    rig : Rig or None, whose places in the sheet are judged as well
    """

    views: list[CalibrationView]
    optics: OpticsSection
    truth: Mapping[str, float]
    rig: Rig | None = None


def metric_rows(quick: bool) -> list[Row]:
    """Coverage of focal length, index and places, and the sets refused, for each kind of set.

    Parameters
    ----------
    quick : bool, four sets of a kind in place of 50
    """
    return list(_rows(FEW_SETS if quick else SETS))


def _rows(count: int) -> Iterator[Row]:
    for what, drawn in KINDS.items():
        held, refused = list[list[bool]](), 0
        for number in range(count):
            rng = np.random.default_rng([SEED, number])
            views = drawn(rng, int(rng.integers(FEWEST, MOST + 1)))
            try:
                held.append(_held(views))
            except MeasurementError:
                refused += 1
        # What a set's camera is off by moves all of its numbers: sets count, not numbers.
        sets = len(held)
        share = float(np.mean(np.concatenate(held))) if held else COVER
        low, high = binomtest(round(share * sets), max(sets, 1)).proportion_ci(method="wilson")
        yield row(
            "metric-intervals",
            100 * abs(share - COVER),
            seed=SEED,
            sigma=100 * np.sqrt(COVER * (1 - COVER) / max(sets, 1)),
            what=what,
            percent=100 * share,
            low=100 * low,
            high=100 * high,
            count=sum(map(len, held)),
            refused=refused,
            sets=count,
        )


def _held(drawn: ViewSet) -> list[bool]:
    """Whether each 95 % interval of a set's solution holds."""
    found = calibrate_metric(drawn.views, drawn.optics, SIZE)
    at = [CAMERA.index(name) for name in drawn.truth]
    off = (found.theta[at] - list(drawn.truth.values())) / found.sigma[at]
    if drawn.rig is not None:
        plane = found.plane_map
        truth = replace(drawn.rig.truth, origin_px=plane.origin_px).locate(PLACES_PX)
        places = plane.to_plane(PLACES_PX)
        seen = places.status == Status.OK
        off = np.append(off, ((places.xz_mm - truth) / places.sigma_mm)[seen])
    return [bool(abs(z) <= 1.96) for z in off]


def _boards(common: bool | None, water: bool) -> Callable[[np.random.Generator, int], ViewSet]:
    """Sets of boards that are flat (None), bent alike, or each by itself."""

    def drawn(rng: np.random.Generator, count: int) -> ViewSet:
        rig = paper_rig(water)
        bends = None if common is None else bends_of(rng, count, common)
        views = views_of(rig, poses(rig, rng, count), bends)
        noisy = [with_noise(view, NOISE_PX, rng) for view in views]
        truth = {"focal_px": rig.camera.focal_px}
        if rig.camera.port is not None:
            truth["water_index"] = rig.camera.port.water_index
        optics = known(rig, INDEX_SIGMA)
        if rig.camera.port is not None:  # what is stated errs as it says
            stated = rig.camera.port.water_index + INDEX_SIGMA * rng.standard_normal()
            optics = optics.model_copy(update={"water_index": (stated, INDEX_SIGMA)})
        return ViewSet(noisy, optics, truth, rig)

    return drawn


def _scattered(rng: np.random.Generator, count: int) -> ViewSet:
    """One to four of at least four views hold points at random in place of the line."""
    drawn = _boards(None, False)(rng, max(count, 4))
    for number in rng.permutation(len(drawn.views))[: rng.integers(1, 5)]:
        drawn.views[number] = scattered(drawn.views[number], rng)
    return drawn


def _by_fisheye(rng: np.random.Generator, count: int) -> ViewSet:
    """Boards 150 to 500 mm before an equidistant fisheye, to 10 to 45 degrees off its axis."""
    views = fisheye_views(rng, count, rng.uniform(150, 500), rng.uniform(0.2, 1.0), NOISE_PX)
    return ViewSet(views, OpticsSection(port="none"), {"focal_px": FISHEYE_PX})


def _through_slab(rng: np.random.Generator, count: int) -> ViewSet:
    """Boards in air through 260 mm of glass, tilted by 10 degrees, said to be 100 to 400."""
    rig, views = slab_views(rng, count, rng.uniform(400, 600), NOISE_PX)
    optics = slab_known(rng.uniform(100.0, 400.0), 300.0)
    return ViewSet(views, optics, {"focal_px": 700.0, "thickness_mm": SLAB_MM}, rig)


KINDS = {
    "flat boards": _boards(None, False),
    "flat boards in water": _boards(None, True),
    "one board, bent by 0.2 mm": _boards(True, False),
    "boards each bent by 0.2 mm": _boards(False, False),
    "boards each bent by 0.2 mm, in water": _boards(False, True),
    "scatter in place of one to four lines": _scattered,
    "an equidistant fisheye": _by_fisheye,
    "a slab of 260 mm": _through_slab,
}
