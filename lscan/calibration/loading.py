"""The plane map of a calibration file, whichever route it was solved by."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lscan.calibration.api import PlaneMap
from lscan.calibration.file import MOST_BYTES
from lscan.calibration.multiview.file import FORMAT, load_metric
from lscan.calibration.solve import load_calibration
from lscan.config.documents import read_json
from lscan.errors import InputError


def load_plane_map(path: Path) -> tuple[PlaneMap, tuple[int, int]]:
    """The plane map of a calibration file, and the (width, height) in px of its pictures.

    Parameters
    ----------
    path : Path
        Written by ``save_calibration`` or by ``save_metric``.

    Raises
    ------
    InputError
        Where the file is no calibration, or is not as it was written.
    """
    if _format_of(path) == FORMAT:
        metric = load_metric(path)
        return metric.plane_map, metric.image_size
    loaded = load_calibration(path)
    return loaded.plane_map, loaded.reading.image_size


def _format_of(path: Path) -> Any:
    """The format that a JSON file states; None for any other, whose reader says what is wrong."""
    try:
        document = read_json(path, MOST_BYTES)
    except InputError:
        return None
    return document.get("format") if isinstance(document, dict) else None
