"""The file of a metric calibration: all it was solved from, and the map."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from lscan.calibration.file import MOST_BYTES, Side, StoredMarks, write_file
from lscan.calibration.multiview.planemap import solver
from lscan.calibration.multiview.solve import MetricCalibration
from lscan.calibration.multiview.views import FittedView, LinePoints
from lscan.calibration.stored import STRICT, Count, Matrix, NotNegativeOrNaN, Vector
from lscan.camera.parameters import COUNT
from lscan.config.documents import Strict, check, read_json
from lscan.config.rig import Known, OpticsSection
from lscan.errors import InputError
from lscan.records import Axis

FORMAT: Final = "lscan-metric-calibration"
VERSION = 1


@dataclass(frozen=True)
class StoredLine(LinePoints):
    """The line of a view that is in a file."""

    __pydantic_config__ = STRICT
    image_px: Matrix
    sigma_px: Vector
    axis: Axis

    def __post_init__(self) -> None:
        """Raise ValueError unless each point has its uncertainty, above 0."""
        count = len(self.sigma_px)
        if self.image_px.shape != (count, 2):
            raise ValueError(f"image_px must hold {count} pairs, one for each of sigma_px")
        if (self.sigma_px <= 0).any():
            raise ValueError("sigma_px must be above 0")


class StoredView(Strict):
    """views.FittedView; ``null`` for a root mean square of nothing."""

    name: str
    marks: StoredMarks | None
    line: StoredLine | None
    fault: str
    used: bool
    marks_used: Count
    rms_px: NotNegativeOrNaN
    line_used: bool
    line_points_used: Count
    line_rms_mm: NotNegativeOrNaN
    reason: str

    @model_validator(mode="after")
    def _used_what_there_is(self) -> Self:
        if self.used and (self.marks is None or np.isnan(self.rms_px) or not self.marks_used):
            raise ValueError("used must be false without marks, marks_used and rms_px")
        if self.line_used and (self.line is None or np.isnan(self.line_rms_mm) or not self.used):
            raise ValueError("line_used must be false without a used view, line and line_rms_mm")
        return self

    def view(self) -> FittedView:
        """As the program holds it."""
        return FittedView(**dict(self))


class MetricFile(Strict):
    """The whole file."""

    format: Literal["lscan-metric-calibration"] = FORMAT
    version: Annotated[int, Field(strict=True, ge=1, le=VERSION)]
    software: str
    plane_map: Literal["metric"]
    image_size: tuple[Side, Side]
    optics: OpticsSection
    k3: Known
    parameters: dict[str, Any]
    camera_sigma: Vector
    views: tuple[StoredView, ...]

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.camera_sigma.shape != (COUNT,) or (self.camera_sigma < 0).any():
            raise ValueError(f"camera_sigma must be {COUNT} numbers not below 0")
        if not any(view.line_used for view in self.views):
            raise ValueError("views must hold a line that was used")
        return self


def save_metric(path: Path, calibration: MetricCalibration) -> None:
    """Write the calibration to a file: a whole file or none.

    Parameters
    ----------
    path : Path, of the file
    calibration : MetricCalibration, with its views

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    content = MetricFile(
        version=VERSION,
        software=calibration.software,
        plane_map="metric",
        image_size=calibration.image_size,
        optics=calibration.optics,
        k3=calibration.k3,
        parameters=calibration.plane_map.parameters(),
        camera_sigma=calibration.sigma,
        views=tuple(StoredView.model_validate(asdict(view)) for view in calibration.views),
    )
    write_file(path, content)


def load_metric(path: Path) -> MetricCalibration:
    """The calibration that was saved in a file; it can be solved again from what it holds.

    Parameters
    ----------
    path : Path, of the file

    Raises
    ------
    InputError
        Names the file and the key of anything that is not as it was written.
    """
    return metric_of(read_json(path, MOST_BYTES), path)


def metric_of(document: Any, path: Path) -> MetricCalibration:
    """The calibration in the JSON document of a file.

    Parameters
    ----------
    document : object, as JSON has it
    path : Path, of the file, for messages

    Raises
    ------
    InputError
        As ``load_metric``.
    """
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise InputError("is no metric calibration", where=path, allowed=f'format "{FORMAT}"')
    content = check(MetricFile, document, where=path)
    try:
        with np.errstate(all="ignore"):  # of numbers that make no map
            plane_map = solver.restore("", content.parameters)
    except InputError as error:
        raise InputError(str(error), where=path) from error
    return MetricCalibration(
        plane_map=plane_map,
        views=tuple(view.view() for view in content.views),
        optics=content.optics,
        k3=content.k3,
        image_size=content.image_size,
        sigma=content.camera_sigma,
        software=content.software,
    )
