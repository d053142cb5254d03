"""Cameras with oblong pixels: refused by name, with what to do; square ones solved as ever."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from metricviews import SIZE, known, paper_rig, poses, views_of, with_noise

from lscan.calibration.metric.solve import calibrate_camera, calibrate_metric
from lscan.calibration.metric.views import CalibrationView
from lscan.camera.posedboards import CAMERA
from lscan.config.rig import OpticsSection
from lscan.errors import MeasurementError

NOISE_PX = 0.03
VIEWS = 5
TILTS = ("tilt_x_deg", "tilt_y_deg")


def squeezed(
    height: float, water: bool, noise_px: float = NOISE_PX, count: int = VIEWS
) -> list[CalibrationView]:
    """Views whose pixels are so many times as high as wide."""
    rig, rng = paper_rig(water), np.random.default_rng(3)
    views = [with_noise(view, noise_px, rng) for view in views_of(rig, poses(rig, rng, count))]
    scale = np.array([1.0, 1 / height])
    found = []
    for view in views:
        assert view.marks is not None and view.line is not None
        marks = replace(view.marks, image_px=view.marks.image_px * scale)
        line = replace(view.line, image_px=view.line.image_px * scale)
        found.append(replace(view, marks=marks, line=line))
    return found


@pytest.mark.parametrize(
    ("height", "water"), [pytest.param(0.75, True, marks=pytest.mark.slow), (0.98, False)]
)
def test_oblong_pixels_are_refused_and_told(height: float, water: bool) -> None:
    """The size to scale to is that of the square-pixelled picture, to a pixel or two in 480."""
    rig = paper_rig(water)
    size = (SIZE[0], round(SIZE[1] / height))
    with pytest.raises(MeasurementError, match="pixels are not square") as refused:
        calibrate_metric(squeezed(height, water), known(rig), size)
    advised = int(str(refused.value).rpartition(" x ")[2].split()[0])
    # The port, of which the pinhole does not know, costs a few parts in a thousand.
    assert advised == pytest.approx(SIZE[1], abs=1 + 0.004 * SIZE[1] * water)


@pytest.mark.parametrize(
    ("tilt", "slab_mm"), [(6.0, 6.0), pytest.param(8.0, 150.0, marks=pytest.mark.slow)]
)
def test_a_tilted_window_is_no_oblong_pixel(tilt: float, slab_mm: float) -> None:
    """Stated to be square to the axis, it is named; left out, the views are solved."""
    square = paper_rig()
    assert square.camera.port is not None
    port = replace(square.camera.port, tilt_x_deg=tilt, thickness_mm=slab_mm)
    rig, rng = replace(square, camera=replace(square.camera, port=port)), np.random.default_rng(3)
    views = [with_noise(view, NOISE_PX, rng) for view in views_of(rig, poses(rig, rng, VIEWS))]
    exactly = known(rig).model_copy(update=dict.fromkeys(TILTS, (0.0, 0.0)))
    with pytest.raises(MeasurementError, match=r"port is not as .*tilt_x_deg = "):
        calibrate_metric(views, exactly, SIZE)
    silent = {name: getattr(OpticsSection(), name) for name in TILTS}
    solved = calibrate_metric(views, known(rig).model_copy(update=silent), SIZE)
    place = CAMERA.index("tilt_x_deg")
    assert abs(solved.theta[place] - tilt) < 4 * solved.sigma[place]


def test_square_pixels_are_solved() -> None:
    """As well as OpenCV says of the same marks, which knows the board to be flat and takes errors
    to be white: its bend, found beside, and what a view's marks share cost less than a third more.
    """
    views = squeezed(1.0, False, count=9)
    solved = calibrate_camera(views, known(paper_rig(False)), SIZE)
    seen = [view.marks for view in views if view.marks is not None]
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_K3
    _, camera, _, _, _, sigma, *_ = cv2.calibrateCameraExtended(
        [np.pad(one.board_mm, ((0, 0), (0, 1))).astype(np.float32) for one in seen],
        [one.image_px.astype(np.float32) for one in seen],
        SIZE, np.eye(3), np.zeros(5), flags=flags,
    )  # fmt: skip
    assert abs(solved.theta[0] - camera[0, 0]) < 2 * sigma[1, 0]
    assert abs(solved.theta[0] - 850.0) < 3.3 * solved.sigma[0]  # beyond: once in 1,000
    assert 1.0 < solved.sigma[0] / sigma[1, 0] < 1.33


def test_a_poor_fit_is_not_put_down_to_the_pixels() -> None:
    """Marks ten times as noisy as they state: a poor fit, and as poor with any pixels."""
    solved = calibrate_camera(squeezed(1.0, False, 0.3), known(paper_rig(False)), SIZE)
    assert solved.rms_px > 0.3
