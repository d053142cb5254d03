"""The plane map of a calibration file, whichever route made it."""

from __future__ import annotations

from pathlib import Path

from lscan.calibration.api import PlaneMap
from lscan.calibration.file import MOST_BYTES
from lscan.calibration.multiview.file import FORMAT, metric_of
from lscan.calibration.solve import calibration_of
from lscan.config.documents import read_json


def load_plane_map(path: Path) -> tuple[PlaneMap, tuple[int, int]]:
    """The map of a calibration file of either route, and the (width, height) it is for.

    Raises InputError as ``load_metric`` and ``load_calibration`` do.
    """
    document = read_json(path, MOST_BYTES)
    if isinstance(document, dict) and document.get("format") == FORMAT:
        metric = metric_of(document, path)
        return metric.plane_map, metric.image_size
    calibration = calibration_of(document, path)
    return calibration.plane_map, calibration.reading.image_size
