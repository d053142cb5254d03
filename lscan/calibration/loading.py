"""The plane map of a calibration file, whichever route made it."""

from pathlib import Path

from lscan.calibration.api import PlaneMap
from lscan.calibration.file import MOST_BYTES, calibration_of
from lscan.calibration.multiview.file import FORMAT, metric_of
from lscan.config.documents import read_json


def load_plane_map(path: Path | str) -> tuple[PlaneMap, tuple[int, int]]:
    """The plane map of a calibration file, and the (width, height) in px of its pictures.

    Parameters
    ----------
    path : Path or str, written by ``save_calibration`` or by ``save_metric``

    Raises
    ------
    InputError
        Where the file is no calibration, or is not as it was written.

    Examples
    --------
    >>> import lscan
    >>> plane_map, size_px = lscan.load_plane_map("calibration.json")
    >>> plane_map.name, size_px
    ('graticule-2', (640, 480))
    """
    path = Path(path)
    document = read_json(path, MOST_BYTES)
    if isinstance(document, dict) and document.get("format") == FORMAT:
        metric = metric_of(document, path)
        return metric.plane_map, metric.image_size
    calibration = calibration_of(document, path)
    return calibration.plane_map, calibration.reading.image_size
