"""A calibration of the drawn paper board."""

import numpy as np
from planeviews import View, paper_board, read_board

from lscan.calibration.calibrate import Calibration, calibrate
from lscan.config.rig import OpticsSection

BOARD = paper_board()


OPTICS = OpticsSection(focal_px=(850.0, 30.0), gap_mm=(12.0, 1.0))


def drawn_calibration(name: str = "graticule-2", noise_px: float = 0.05) -> Calibration:
    missing = np.zeros(100, dtype=bool)
    missing[[0, 17, 34, 99]] = True
    rng = np.random.default_rng(1)
    return calibrate(read_board(BOARD, View().project, noise_px, rng, missing), name, OPTICS)
