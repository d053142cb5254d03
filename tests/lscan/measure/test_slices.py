"""How long the sandwave comes out along the track."""

import numpy as np
import pytest

from lscan.cli.measure import _note_scale
from lscan.config.rig import Rig
from lscan.config.targets import Sandwave
from lscan.errors import MeasurementError
from lscan.measure import scale_along_track
from lscan.records import Status, Surface

PIECE = Sandwave()


def block(stretch: float, seed: int = 1, off_mm: float = 0.0) -> Surface:
    """The waves as a track reports them that moves 1 / stretch of it; 0.5 mm of noise."""
    x, y = np.meshgrid(np.arange(-30.0, 180.0, 1.5), np.arange(-30.0, 180.0, 1.5))
    middle = PIECE.side_mm / 2
    z = PIECE.height_mm(x + off_mm, middle + (y - middle) / stretch)
    rng = np.random.default_rng(seed)
    z += rng.normal(0, 0.5, z.shape)
    wrong = rng.random(z.shape) < 0.02
    z[wrong] += rng.uniform(-20, 20, int(wrong.sum()))
    status = np.where(rng.random(z.shape) < 0.1, Status.OCCLUDED, Status.OK).astype(np.int64)
    sigma = np.full(z.shape, 0.5)
    return Surface(np.stack([x, y, z], -1), sigma, sigma, status, y[:, 0], "workpiece")


@pytest.mark.parametrize("stretch", [1 / 0.97, 1.0, 0.98])
def test_the_waves_tell_how_far_the_track_moves(stretch: float) -> None:
    # Least squares: noise over the part of the stretch's derivative that shifts do not explain.
    # Outliers and holes cost a tenth each way, soft L1 another: 4 of 1.2 standard deviations.
    x, y = np.meshgrid(np.arange(3.0, 147.0, 1.5), np.arange(3.0, 147.0, 1.5))
    by_x, by_y = PIECE.slopes(x.ravel(), y.ravel()).T
    design = np.column_stack([by_y * (y.ravel() - 75.0), by_x, by_y, np.ones(x.size)])
    sigma = 0.5 * np.sqrt(np.linalg.inv(design.T @ design)[0, 0])
    for seed, off_mm in ((1, 0.0), (2, 1.0)):
        found = scale_along_track(block(stretch, seed, off_mm), PIECE)
        assert found == pytest.approx(stretch, abs=4 * 1.2 * sigma)


def test_too_few_points_on_the_waves() -> None:
    empty = block(1.0)
    empty.status[:] = Status.NO_PEAK
    with pytest.raises(MeasurementError, match="0 points lie on the waves"):
        scale_along_track(empty, PIECE)


def test_a_wrong_scale_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    rig = Rig.model_construct(workpiece=PIECE)
    _note_scale(block(1.0), rig)
    assert capsys.readouterr().err == ""
    _note_scale(block(1 / 0.97), rig)
    said = " ".join(capsys.readouterr().err.split())
    assert "1.03" in said and "moves 0.97" in said
