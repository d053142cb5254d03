"""What the marks or the line of a view share: bends, slow errors, scatter, lenses, slabs."""

from dataclasses import replace

import numpy as np
import pytest
from metricviews import (
    SIZE,
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

from lscan.calibration.metric.solve import UnsolvedViews, calibrate_camera, calibrate_metric
from lscan.calibration.metric.views import CalibrationView
from lscan.camera.posedboards import CAMERA
from lscan.errors import MeasurementError

RIG = paper_rig(water=False)
NOISE_PX = 0.03


def noisy_views(
    rng: np.random.Generator, count: int = 8, noise_px: float = NOISE_PX
) -> list[CalibrationView]:
    return [with_noise(view, noise_px, rng) for view in views_of(RIG, poses(RIG, rng, count))]


def wandering(view: CalibrationView, rng: np.random.Generator, rho: float) -> CalibrationView:
    """The view whose line errs by 0.3 px, alike at points that lie near one another."""
    assert view.line is not None
    slow, error = [0.0], 0.0
    for step in rng.standard_normal(len(view.line.image_px) + 200):
        error = rho * error + np.sqrt(1 - rho**2) * step
        slow.append(error)
    off = 0.3 * np.array(slow[-len(view.line.image_px) :])[:, None]
    places = view.line.image_px + off * view.line.across
    return replace(view, line=replace(view.line, image_px=places))


@pytest.mark.parametrize("count", [12, pytest.param(80, marks=pytest.mark.slow)])
def test_scatter_is_no_laser_line(count: int) -> None:
    rng = np.random.default_rng(count)
    views = noisy_views(rng, 5)
    views[2] = scattered(views[2], rng, count)
    found = calibrate_metric(views, known(RIG), SIZE)
    assert [view.line_used for view in found.views] == [True, True, False, True, True]
    assert "scatter by" in found.views[2].reason or "only" in found.views[2].reason
    with pytest.raises(UnsolvedViews, match=r"pose-0: .*scatter by|only"):
        calibrate_metric([scattered(view, rng, 60) for view in views], known(RIG), SIZE)


@pytest.mark.parametrize("rho", [0.9, pytest.param(0.97, marks=pytest.mark.slow)])
def test_a_sheet_that_slow_errors_move_is_found_with_its_uncertainty(rho: float) -> None:
    """Lines that say of themselves 0.01 px, and err by 0.3 px, alike over ten columns and more."""
    z, pixels = [], np.array([[260.0, 210.0], [380.0, 270.0]])
    for seed in range(3):
        rng = np.random.default_rng(seed)
        views = [wandering(view, rng, rho) for view in noisy_views(rng, 5, 0.01)]
        found = calibrate_metric(views, known(RIG), SIZE).plane_map
        places = found.to_plane(pixels)
        truth = replace(RIG.truth, origin_px=found.origin_px).locate(pixels)
        z.append((places.xz_mm - truth) / places.sigma_mm)
        assert np.abs(places.xz_mm - truth).max() < 0.3
    assert np.sqrt(np.mean(np.square(z))) < 1.8


@pytest.mark.parametrize("common", [True, False])
def test_a_bent_board_does_not_spoil_the_focal_length(common: bool) -> None:
    """0.2 mm over 210 mm: 3 to 4 sigma off when boards were taken to be flat."""
    z = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        boards = poses(RIG, rng, 6)
        views = views_of(RIG, boards, bends_of(rng, 6, common))
        noisy = [replace(with_noise(view, NOISE_PX, rng), line=None) for view in views]
        found = calibrate_camera(noisy, known(RIG), SIZE)
        assert found.misfit == ""
        z.append((found.theta[0] - 850.0) / found.sigma[0])
    assert np.sqrt(np.mean(np.square(z))) < 1.8


def test_a_fisheye_that_is_said_to_be_none_is_refused_by_name() -> None:
    """What its lens bends at 45 degrees, and 70 at the boards' rims, no radial polynomial does."""
    views = fisheye_views(np.random.default_rng(1), 5, 150.0, 1.0, NOISE_PX)
    with pytest.raises(MeasurementError, match=r"px rms off.*none that its model describes"):
        calibrate_camera(views, known(RIG), SIZE, lens="brown")


def test_a_lens_a_little_beside_the_model_is_named() -> None:
    """It counts, with an uncertainty that holds what all views share."""
    views = fisheye_views(np.random.default_rng(2), 5, 200.0, 0.6, NOISE_PX)
    found = calibrate_camera(views, known(RIG), SIZE, lens="brown")
    assert "times as far off" in found.misfit and "fisheye" in found.misfit
    assert abs(found.theta[0] - 290.0) < 3 * found.sigma[0]


@pytest.mark.slow  # three searches
def test_a_thick_slab_is_found_from_another_start() -> None:
    """Glass of 260 mm at 10 degrees, of which 400 ± 50 mm was known: the first minimum is none."""
    _, views = slab_views(np.random.default_rng(3), 5, 380.0, NOISE_PX)
    found = calibrate_camera(views, slab_known(400.0, 50.0), SIZE)
    at = CAMERA.index("thickness_mm")
    assert found.misfit == ""
    assert abs(found.theta[at] - 260.0) < 3 * found.sigma[at]
