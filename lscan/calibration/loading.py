"""The calibration of a file, whichever route made it."""

from pathlib import Path

from lscan.calibration.api import PlaneMap
from lscan.calibration.file import MOST_BYTES, calibration_of, save_calibration
from lscan.calibration.multiview.file import CAMERA_FORMAT, FORMAT, metric_of, save_metric
from lscan.calibration.multiview.solve import MetricCalibration
from lscan.calibration.solve import Calibration
from lscan.errors import InputError
from lscan.files.disk import read_json

AnyCalibration = Calibration | MetricCalibration


def load_any(path: Path | str) -> AnyCalibration:
    """The calibration of a file.

    Parameters
    ----------
    path : Path or str, written by ``save_calibration`` or by ``save_metric``

    Raises
    ------
    InputError
        Where the file is no calibration, or is not as it was written.
    """
    path = Path(path)
    document = read_json(path, MOST_BYTES)
    kind = document.get("format") if isinstance(document, dict) else None
    if kind == CAMERA_FORMAT:
        allowed = f"lscan calibrate-metric VIEWS.toml --camera {path.name} -o FILE"
        raise InputError("holds a camera alone, no laser sheet", where=path, allowed=allowed)
    if kind == FORMAT:
        return metric_of(document, path)
    return calibration_of(document, path)


def save_any(path: Path, calibration: AnyCalibration) -> None:
    """Write a calibration to a file: a whole file or none.

    Parameters
    ----------
    path : Path, of the file
    calibration : Calibration or MetricCalibration

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    if isinstance(calibration, MetricCalibration):
        save_metric(path, calibration)
    else:
        save_calibration(path, calibration)


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
    calibration = load_any(path)
    return calibration.plane_map, calibration.image_size
