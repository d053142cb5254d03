"""Photographs of a dense dot board."""

import cv2
import numpy as np
import pytest
from places import PHOTOGRAPHS, SUPPORT

from lscan.config.board import load_board
from lscan.records import Bytes

BOARD = load_board(SUPPORT / "dot-photograph.toml")


def photograph(name: str) -> Bytes:
    path = PHOTOGRAPHS / name
    if not path.exists():
        pytest.skip("the photographs are not here")
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    return np.asarray(picture, dtype=np.uint8)
