"""Lenses of three models from views of a board: which is taken, and what comes out of it.

The marks come from lscan.camera, which is held to OpenCV and to the tank's truth elsewhere.
"""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from metricviews import SIZE, known, paper_rig, poses, views_of, with_noise

from lscan.calibration.calibrationfile import load_camera, load_metric, save_calibration
from lscan.calibration.marks import found_on
from lscan.calibration.metric.solve import (
    _held_out_px,
    calibrate_camera,
    calibrate_metric,
    capped_rms,
)
from lscan.calibration.metric.views import CalibrationView
from lscan.camera import CameraModel, project
from lscan.camera.posedboards import CAMERA, NEWER, priors_of
from lscan.camera.resection import FAR_PX, posed_boards
from lscan.config.rig import BENDS, LensChoice, OpticsSection
from lscan.records import Floats, Marks, Status

NOISE_PX = 0.05
IN_AIR = OpticsSection(port="none")
CENTRE = (322.0, 236.0)
LENSES = {
    "brown": CameraModel(500.0, CENTRE, -0.2, 0.05, 5e-4, -3e-4),
    # Half the angle of 120 and of 150 degrees in the picture's corner, 400 px from its middle.
    "fisheye": CameraModel(385.0, CENTRE, -0.03, 0.004, k3=-0.002, k4=5e-4, fisheye=True),
    "wider": CameraModel(300.0, CENTRE, 0.02, -0.006, k3=0.001, fisheye=True),
    "rational": CameraModel(350.0, CENTRE, 0.5, 0.02, 4e-4, 2e-4, 0.001, 0.75, 0.08, 0.002),
}
PITCH_MM, COLUMNS, ROWS = 20.0, 9, 7


def held(camera: CameraModel, rng: np.random.Generator, count: int) -> list[CalibrationView]:
    """A board all over the picture, up to 60 degrees off the axis, seen at 20 to 40 degrees."""
    column, row = np.meshgrid(np.arange(COLUMNS), np.arange(ROWS))
    board = PITCH_MM * np.column_stack([column.ravel(), -row.ravel()]).astype(float)
    local = (board - board.mean(axis=0)) * [1.0, -1.0]
    views: list[CalibrationView] = []
    while len(views) < count:
        off, side, lean = rng.uniform([0, 0, 0], [np.radians(60), 2 * np.pi, 2 * np.pi])
        towards = np.array([np.sin(off) * np.cos(side), np.sin(off) * np.sin(side), np.cos(off)])
        axis = np.cross([0.0, 0.0, 1.0], towards)
        faced = cv2.Rodrigues(axis / np.linalg.norm(axis) * off)[0]
        tilt = rng.uniform(0.35, 0.7) * np.array([np.cos(lean), np.sin(lean), 0.0])
        turned = np.asarray(faced @ cv2.Rodrigues(tilt)[0])
        points = rng.uniform(180, 350) * towards + local @ turned[:, :2].T
        image = project(camera, points)
        seen = np.isfinite(image).all(axis=1)
        seen[seen] = ((image[seen] > 5) & (image[seen] < np.array(SIZE) - 6)).all(axis=1)
        if seen.sum() < 30:
            continue
        image = np.where(seen[:, None], image + NOISE_PX * rng.standard_normal(image.shape), np.nan)
        status = np.where(seen, int(Status.OK), int(Status.OUT_OF_VIEW))
        sigma = np.where(seen, NOISE_PX, np.nan)
        views.append(CalibrationView(f"{len(views)}", Marks(board, image, sigma, status)))
    return views


def truth(camera: CameraModel) -> Floats:
    """(11,) focal length, centre and coefficients."""
    return np.array([camera.focal_px, *camera.centre_px, *(getattr(camera, k) for k in BENDS)])


@pytest.mark.parametrize(
    "name",
    ["brown", "fisheye", *(pytest.param(n, marks=pytest.mark.slow) for n in ("wider", "rational"))],
)
def test_the_model_is_taken_that_the_lens_is_of(name: str) -> None:
    """And what of it can be told apart lies within 4 sigmas; of the rational model its curve does.

    One of 16,000 numbers lies farther off.
    """
    camera = LENSES[name]
    found = calibrate_camera(held(camera, np.random.default_rng(4), 14), IN_AIR, SIZE)
    assert found.lens == name.replace("wider", "fisheye")
    assert found.misfit == ""
    some = slice(0, 3) if name == "rational" else slice(0, len(truth(camera)))
    off = np.abs(found.theta[: len(truth(camera))] - truth(camera))[some]
    sigma = found.sigma[: len(truth(camera))][some]
    free = sigma > 0
    assert (off[free] < 4 * sigma[free]).all()
    assert (off[~free] == 0).all()


def test_held_out_views_are_not_fitted() -> None:
    """Two views predict a third worse than all three fit themselves; the same views, as well."""
    views = held(LENSES["brown"], np.random.default_rng(9), 3)
    fitted = calibrate_camera(views, IN_AIR, SIZE, lens="rational")
    marks = found_on([view.marks for view in views if view.marks is not None], range(3))
    start = posed_boards(fitted.theta, "none", marks)
    assert start is not None
    priors = priors_of(IN_AIR, SIZE, assume_webcam=False, lens="rational")
    assert _held_out_px(start, marks, priors) > 1.01 * fitted.rms_px


def test_marks_that_a_model_has_no_place_for_count_against_it() -> None:
    """Closed form: one of a hundred counts as 6 / sqrt(2 ln 2) times the median, and not as 0."""
    lengths = np.array([1.0] * 99 + [FAR_PX])
    assert capped_rms(lengths) == pytest.approx(np.sqrt((99 + 36 / np.log(4)) / 100), rel=1e-12)
    assert capped_rms(np.array([1.0] * 99 + [0.0])) == pytest.approx(np.sqrt(0.99), rel=1e-12)


def test_a_forced_model_is_the_one_fitted() -> None:
    views = held(LENSES["brown"], np.random.default_rng(5), 8)
    lenses: tuple[LensChoice, ...] = ("brown", "rational", "fisheye")
    found = {lens: calibrate_camera(views, IN_AIR, SIZE, lens=lens) for lens in lenses}
    assert [found[lens].lens for lens in lenses] == list(lenses)
    assert [found[lens].theta[CAMERA.index("fisheye")] for lens in lenses] == [0, 0, 1]
    held_at_0 = {
        lens: [CAMERA[k] for k in range(3, 11) if found[lens].sigma[k] == 0] for lens in lenses
    }
    assert held_at_0 == {
        "brown": ["k3", "k4", "k5", "k6"], "rational": [], "fisheye": ["p1", "p2", "k5", "k6"],
    }  # fmt: skip


def test_errors_of_a_fisheye_are_as_large_as_sigma_says() -> None:
    """Focal length and centre of 12 draws: 36 numbers whose mean square, as chi squared has it, is
    1 within 0.5 in 997 of 1000."""
    z = []
    for seed in range(12):
        views = held(LENSES["fisheye"], np.random.default_rng([seed, 1]), 10)
        found = calibrate_camera(views, IN_AIR, SIZE, lens="fisheye")
        z.append((found.theta[:3] - truth(LENSES["fisheye"])[:3]) / found.sigma[:3])
    assert 0.4 < np.mean(np.square(z)) < 1.7


def test_behind_a_flat_port_brown_stays_unless_told() -> None:
    """What a port bends that is not as stated must not become a lens."""
    rig, rng = paper_rig(), np.random.default_rng(2)
    views = [with_noise(view, 0.03, rng) for view in views_of(rig, poses(rig, rng))]
    assert calibrate_metric(views, known(rig), SIZE).lens == "brown"
    wrong = known(rig).model_copy(update={"k1": (-0.2, 0.0), "k2": (0.06, 0.0)})
    off = calibrate_metric(views, wrong, SIZE)
    assert off.lens == "brown" and off.rms_px > 1.2 * np.sqrt(2) * 0.03
    forced = calibrate_metric(views, known(rig), SIZE, lens="rational")
    assert forced.lens == "rational"
    pixels = np.array([[250.0, 200.0], [319.5, 239.5], [400.0, 260.0]])
    one = calibrate_metric(views, known(rig), SIZE).plane_map.to_plane(pixels)
    two = forced.plane_map.to_plane(pixels)
    assert (np.abs(one.xz_mm - two.xz_mm) < 4 * two.sigma_mm).all()


def test_a_fisheyes_file_comes_back_number_for_number(tmp_path: Path) -> None:
    found = calibrate_camera(held(LENSES["fisheye"], np.random.default_rng(6), 8), IN_AIR, SIZE)
    save_calibration(tmp_path / "a.json", found)
    read = load_camera(tmp_path / "a.json")
    assert read.lens == "fisheye"
    np.testing.assert_array_equal(read.theta, found.theta)
    document = json.loads((tmp_path / "a.json").read_text())
    document["camera"]["fisheye"] = 0.5
    (tmp_path / "b.json").write_text(json.dumps(document))
    with pytest.raises(Exception, match=r"theta\.fisheye must be 0 or 1"):
        load_camera(tmp_path / "b.json")


def test_files_of_before_there_were_other_lenses_are_read(tmp_path: Path) -> None:
    """They lack four of the camera's parameters, and which model it is."""
    rig, rng = paper_rig(), np.random.default_rng(3)
    views = [with_noise(view, 0.02, rng) for view in views_of(rig, poses(rig, rng))]
    solved = calibrate_metric(views, known(rig), SIZE, k3=(0.0, 0.5))
    path = tmp_path / "a.json"
    save_calibration(path, solved)
    document = json.loads(path.read_text())
    del document["lens"]
    at = [CAMERA.index(name) for name in NEWER]
    document["camera_sigma"] = np.delete(document["camera_sigma"], at).tolist()
    parameters = document["parameters"]
    parameters["theta"] = {k: v for k, v in parameters["theta"].items() if k not in NEWER}
    for least in (2, 0):  # still older ones lack the origin's place, too
        parameters["modes"] = np.delete(solved.plane_map.modes, at, axis=0)[: 17 + least].tolist()
        path.write_text(json.dumps(document))
        read = load_metric(path)
        assert read.lens == "brown"
        np.testing.assert_array_equal(read.theta, solved.theta)
        np.testing.assert_array_equal(read.sigma, solved.sigma)
        np.testing.assert_array_equal(read.plane_map.modes[:21], solved.plane_map.modes[:21])


@pytest.mark.slow  # three models, each five times
def test_noise_is_no_other_lens() -> None:
    """Errors that all models leave alike keep the simplest."""
    rng = np.random.default_rng(7)
    views = []
    for view in held(LENSES["brown"], rng, 10):
        assert view.marks is not None
        shaken = view.marks.image_px + 0.3 * rng.standard_normal(view.marks.image_px.shape)
        views.append(replace(view, marks=replace(view.marks, image_px=shaken)))
    assert calibrate_camera(views, IN_AIR, SIZE).lens == "brown"
