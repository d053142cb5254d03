"""The files of the metric route: a metric calibration, or a camera alone, and all it rests on."""

from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self, TypeVar

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from lscan.calibration.file import MOST_BYTES, Side, StoredMarks, write_file
from lscan.calibration.multiview.planemap import solver
from lscan.calibration.multiview.solve import CameraCalibration, MetricCalibration, SolvedViews
from lscan.calibration.multiview.views import FittedView, LinePoints
from lscan.calibration.multiview.viewsfile import ViewsFile
from lscan.calibration.stored import (
    STRICT,
    Count,
    Matrix,
    NotNegativeOrNaN,
    Number,
    Vector,
    check_theta,
)
from lscan.camera.posedboards import CAMERA, COUNT
from lscan.config.documents import Strict, check
from lscan.config.rig import Known, OpticsSection
from lscan.errors import InputError
from lscan.files.disk import read_json
from lscan.records import Axis

FORMAT: Final = "lscan-metric-calibration"
CAMERA_FORMAT: Final = "lscan-camera-calibration"
VERSION = 1
ALIKE = ("software", "image_size", "optics", "k3")  # what a file and solve.SolvedViews name alike


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


class StoredViews(Strict):
    """What both files hold: solve.SolvedViews, its sigma as camera_sigma."""

    format: str
    version: Annotated[int, Field(strict=True, ge=1, le=VERSION)]
    software: str
    image_size: tuple[Side, Side]
    optics: OpticsSection
    k3: Known
    camera_sigma: Vector
    views: tuple[StoredView, ...]

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.camera_sigma.shape != (COUNT,) or (self.camera_sigma < 0).any():
            raise ValueError(f"camera_sigma must be {COUNT} numbers not below 0")
        return self

    def solved(self) -> dict[str, Any]:
        """The fields of a SolvedViews."""
        views = tuple(view.view() for view in self.views)
        alike = {name: getattr(self, name) for name in ALIKE}
        return alike | {"sigma": self.camera_sigma, "views": views}


class MetricFile(StoredViews):
    """The file of a metric calibration."""

    format: Literal["lscan-metric-calibration"] = FORMAT
    plane_map: Literal["metric"]
    parameters: dict[str, Any]

    @model_validator(mode="after")
    def _has_a_line(self) -> Self:
        if not any(view.line_used for view in self.views):
            raise ValueError("views must hold a line that was used")
        return self


class CameraFile(StoredViews):
    """The file of a camera alone.  camera: the parameters of camera and port, by name."""

    format: Literal["lscan-camera-calibration"] = CAMERA_FORMAT
    camera: Annotated[dict[str, Number], AfterValidator(partial(check_theta, names=CAMERA))]

    @model_validator(mode="after")
    def _has_a_view(self) -> Self:
        if not any(view.used for view in self.views):
            raise ValueError("views must hold one that was used")
        return self


Content = TypeVar("Content", bound=StoredViews)


def _stored(calibration: SolvedViews) -> dict[str, Any]:
    """The fields of a StoredViews, but for its format."""
    views = tuple(StoredView.model_validate(asdict(view)) for view in calibration.views)
    alike = {name: getattr(calibration, name) for name in ALIKE}
    return alike | {"version": VERSION, "camera_sigma": calibration.sigma, "views": views}


def _content(document: Any, model: type[Content], what: str, path: Path) -> Content:
    """The document as a model; InputError where it is of another format, or not as written."""
    wanted = model.model_fields["format"].default
    if not isinstance(document, dict) or document.get("format") != wanted:
        raise InputError(f"is no {what} calibration", where=path, allowed=f'format "{wanted}"')
    return check(model, document, where=path)


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
    parameters = calibration.plane_map.parameters()
    write_file(path, MetricFile(plane_map="metric", parameters=parameters, **_stored(calibration)))


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
    content = _content(document, MetricFile, "metric", path)
    try:
        with np.errstate(all="ignore"):  # of numbers that make no map
            plane_map = solver.restore("", content.parameters)
    except InputError as error:
        raise InputError(str(error), where=path) from error
    return MetricCalibration(plane_map=plane_map, **content.solved())


def save_camera(path: Path, calibration: CameraCalibration) -> None:
    """Write a camera alone to a file: a whole file or none.

    Parameters
    ----------
    path : Path, of the file
    calibration : CameraCalibration, with its views

    Raises
    ------
    InputError
        Where the file cannot be written.
    """
    camera = dict(zip(CAMERA, calibration.theta.tolist(), strict=True))
    write_file(path, CameraFile(camera=camera, **_stored(calibration)))


def load_camera(path: Path) -> CameraCalibration:
    """The camera alone that was saved in a file.

    Parameters
    ----------
    path : Path, of the file

    Raises
    ------
    InputError
        Names the file and the key of anything that is not as it was written.
    """
    content = _content(read_json(path, MOST_BYTES), CameraFile, "camera", path)
    return CameraCalibration(theta=np.array(list(content.camera.values())), **content.solved())


def require_same_camera(
    camera: CameraCalibration, views: ViewsFile, size: tuple[int, int], where: Path
) -> None:
    """Refuse a camera that cannot have taken the pictures of a views file.

    Parameters
    ----------
    camera : CameraCalibration, as loaded
    views : ViewsFile, whose [optics] and k3, where it has them, must be those of the camera
    size : tuple of int, (width, height) of its pictures, px
    where : Path, of the camera's file, for messages

    Raises
    ------
    InputError
        Where the pictures' size or what was known of the optics differs.
    """
    if camera.image_size != size:
        allowed = f"{camera.image_size[0]} x {camera.image_size[1]} px, as the camera's"
        raise InputError("pictures of another size", where=views.path, value=size, allowed=allowed)
    document = views.document
    for key, known in (("optics", camera.optics), ("k3", camera.k3)):
        if key in document.model_fields_set and getattr(document, key) != known:
            raise InputError(
                "differs from what the camera was calibrated with",
                where=f"{views.path}: {key}",
                allowed=f"leave it out, or as in {where}",
            )
